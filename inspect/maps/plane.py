"""The plane of a map: one or two state components and their extents; the others are fixed or integrated out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task, with_unit
from beliefscope.inspect.statistics.signals import Array
from beliefscope.inspect.traces.data import Trace

Others = Literal["fixed", "marginal"]
OTHERS: tuple[Others, ...] = get_args(Others)
"""Treatment of the components that are not on the map: fixed at their true values, or integrated out."""

DEVIATIONS, MARGIN = 3.0, 2.0
"""Extent of an axis: MARGIN times an error plus DEVIATIONS standard deviations, exceeded in 5 % of the steps."""

COARSE = 20.0
"""Extent of the task's map, relative to that of a run, from which beliefs are smaller than its cells."""


@dataclass(frozen=True)
class Plane:
    """The axes of a map.

    Attributes:
        components: indices of the x and the y axis; of one only, for a map that is a curve.
        half_widths: SI, half the extent of each axis.
    """

    components: tuple[int, ...]
    half_widths: tuple[float, ...]

    @property
    def along(self) -> tuple[int, int]:
        """Components of columns and rows; the same for a curve, which has a single row at offset 0."""
        return self.components[0], self.components[-1]

    def offsets(self, size: int) -> tuple[Array, Array]:
        """(S,) offsets of the columns and (S,) or (1,) of the rows from the centre, SI: centres of the cells."""
        axes = [((np.arange(size) + 0.5) / size * 2.0 - 1.0) * half for half in self.half_widths]
        return axes[0], axes[1] if len(axes) == 2 else np.zeros(1)


def plane_of(trace: Trace, components: tuple[str, ...] = ()) -> Plane:
    """The plane of one or two components of a trace's task; by default the task's own map.

    The components of the task's map have its extent, unless its cells are larger than the beliefs. That of others
    covers errors and deviations of the estimates of all steps, as a round number in units for display. Two components
    of one unit share an extent, so that directions and distances on the map are those of the state.

    Raises:
        BadInput: unknown components, or not one or two different ones.
    """
    task = trace.task
    names = components or task.map_components
    if len(names) > 2 or len(set(names)) < len(names):
        raise BadInput(f"a map shows one component or two different ones, not {' and '.join(names)}")
    indices = tuple(task.index(name) for name in names)
    widths = [_half_width(trace, index) for index in indices]
    if len({task.components[index].unit for index in indices}) == 1:
        widths = len(widths) * [max(widths)]
    return Plane(indices, tuple(widths))


def is_outside(trace: Trace, step: int) -> bool:
    """Whether the fused estimate of a step is outside of the task's map around the true state."""
    plane = plane_of(trace)
    error = trace.task.difference(trace.estimate_mean[step], trace.anchors[step])[list(plane.components)]
    return bool((np.abs(error) > plane.half_widths).any())


def axis_titles(task: Task, components: Sequence[int]) -> list[tuple[str, float]]:
    """Title of each axis of a map, such as ``hinge x offset (cm)``, and the factor of its values."""
    parts = [task.components[i] for i in components]
    return [(with_unit(f"{c.label} offset", c.conversion[0]), c.conversion[1]) for c in parts]


def area_unit(task: Task, components: Sequence[int]) -> tuple[str, float]:
    """Unit for display of areas on a map, or of lengths on a curve, and its factor: ``cm²``, ``m·deg``."""
    units = [task.components[i].conversion for i in components]
    factor = float(np.prod([factor for _, factor in units]))
    if len(units) == 2 and units[0] == units[1] and units[0][0]:
        return f"{units[0][0]}²", factor
    return "·".join(unit for unit, _ in units if unit), factor


def other_components(trace: Trace, plane: Plane) -> list[int]:
    """Indices of the components that are not on the map."""
    return [i for i in range(len(trace.task.components)) if i not in plane.components]


def describe_others(trace: Trace, plane: Plane, others: Others) -> str:
    """What happens to components off the map, as part of a title; empty for one that is fixed."""
    labels = [trace.task.components[i].label for i in other_components(trace, plane)]
    if not labels or (others == "fixed" and len(labels) == 1):
        return ""
    return f"{', '.join(labels)} {'integrated out' if others == 'marginal' else 'at the true values'}"


def _half_width(trace: Trace, index: int) -> float:
    task = trace.task
    error = np.abs(task.difference(trace.estimate_mean, trace.anchors)[:, index])
    deviation = np.sqrt(np.maximum(trace.estimate_covariance[:, index, index].astype(np.float64), 0.0))
    extents = error + DEVIATIONS * np.nan_to_num(deviation)
    finite = extents[np.isfinite(extents)]  # a filter that runs in a loop of the user may have lost the state
    reach = MARGIN * float(np.quantile(finite, 0.95)) if len(finite) else 0.0
    if index in task.main_error.indices and not 0.0 < COARSE * reach < task.map_half_width:
        return task.map_half_width
    _, factor = task.components[index].conversion
    width = round_up(max(factor * reach, 1e-6)) / factor
    return min(width, np.pi) if task.components[index].unit == "rad" else width


def round_up(value: float) -> float:
    """Smallest of 1, 2 and 5 times a power of ten that is not below a value above 0."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value * (1.0 - 1e-9)))
