"""The plane of a map: two state components and their extents; the other components are fixed or integrated out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.statistics.measures import wrapped
from beliefscope.inspect.traces.data import Trace

Others = Literal["fixed", "marginal"]
OTHERS: tuple[Others, ...] = get_args(Others)
"""Treatment of the components that are not on the map: fixed at their true values, or integrated out."""

DEVIATIONS, MARGIN = 3.0, 2.0
"""Extent of an axis: MARGIN times an error plus DEVIATIONS standard deviations, exceeded in 5 % of the steps."""


@dataclass(frozen=True)
class Plane:
    """Attributes: components: indices of the x and the y axis. half_widths: SI, half the extent of each axis."""

    components: tuple[int, int]
    half_widths: tuple[float, float]


def plane_of(trace: Trace, components: tuple[str, ...] = ()) -> Plane:
    """The plane of two components of a trace's task; by default the task's own map.

    The components of the task's map have its extent. That of others covers errors and deviations of the estimates of
    all steps, as a round number in units for display. Two components of one unit share an extent, so that directions
    and distances on the map are those of the state.

    Raises:
        BadInput: unknown components, or not two different ones.
    """
    task = trace.task
    names = components or task.map_components
    if len(names) != 2 or names[0] == names[1]:
        raise BadInput(f"a map shows two different components, not {' and '.join(names) or 'none'}")
    x, y = (task.index(name) for name in names)
    widths = [_half_width(trace, index) for index in (x, y)]
    if task.components[x].unit == task.components[y].unit:
        widths = 2 * [max(widths)]
    return Plane((x, y), (widths[0], widths[1]))


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
    if index in task.map_indices:
        return task.map_half_width
    error = np.abs(wrapped(task, trace.estimate_mean - trace.anchors)[:, index])
    deviation = np.sqrt(np.maximum(trace.estimate_covariance[:, index, index].astype(np.float64), 0.0))
    reach = MARGIN * float(np.quantile(error + DEVIATIONS * np.nan_to_num(deviation), 0.95))
    _, factor = task.components[index].shown
    width = round_up(max(factor * reach, 1e-6)) / factor
    return min(width, np.pi) if task.components[index].unit == "rad" else width


def round_up(value: float) -> float:
    """Smallest of 1, 2 and 5 times a power of ten that is not below a value above 0."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value * (1.0 - 1e-9)))
