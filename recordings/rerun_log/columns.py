"""A trace as named columns for exports: one row per step, one column per number or list of numbers."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.task import Task
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.schema import SCHEMA


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes:
        group: ``trace``, ``extra``, ``covariates`` or ``observations``.
        parts: name of the array, then modality and components if any.
        values: (T,), or (T, S) for S values per step: particles, sensor channels, pixels.
        shape: per step before flattening in C order.
        unit: of the numbers; empty if unknown.
    """

    group: str
    parts: tuple[str, ...]
    values: NDArray[Any]
    shape: tuple[int, ...] = ()
    unit: str = ""

    @property
    def name(self) -> str:
        """``estimate_mean.hinge_x``, ``modality_mean.image.hinge_x``, ``observations.force``."""
        return ".".join(self.parts if self.group == "trace" else (self.group, *self.parts))


def columns(trace: Trace) -> Iterator[Column]:
    """Every array over steps, with one column per modality and component."""
    task = trace.task
    for entity in SCHEMA:
        if entity.archetype != "Trace" or entity.static:
            continue
        name = entity.path.removeprefix("trace/")
        if name == "time":  # every format has its own
            continue
        array = getattr(trace if hasattr(trace, name) else trace.episode, name)
        if array is not None and array.size:
            yield from _split(name, array, re.findall(r"\w+", entity.shape), entity.unit, trace, task)
    for name, array in sorted(trace.extra.items()):
        yield Column("extra", (name,), *_flat(array))
    for name, array in sorted(trace.episode.covariates.items()):
        yield Column("covariates", (name,), *_flat(array))
    for key, array in sorted(trace.episode.observations.items()):
        yield Column("observations", (key,), *_flat(array))


def _split(
    name: str, array: NDArray[Any], axes: Sequence[str], unit: str, trace: Trace, task: Task
) -> Iterator[Column]:
    """Columns of an array: one per index of the axes K, n and W; other axes are kept."""
    labels = {"K": trace.modalities, "n": tuple(c.name for c in task.components), "W": ("",)}
    named = [i for i, axis in enumerate(axes) if axis in labels]
    array = np.moveaxis(array, [1 + i for i in named], range(1, 1 + len(named)))
    choices = []
    for axis, size in zip([axes[i] for i in named], array.shape[1:], strict=False):
        # There is one weight for all components, or one per component.
        choices.append(labels["n"] if axis == "W" and size > 1 else labels[axis])
    units = {component.name: component.unit for component in task.components}
    for index in product(*(range(len(choice)) for choice in choices)):
        names = [choice[i] for choice, i in zip(choices, index, strict=True)]
        parts = [units[name] for name, i in zip(names, named, strict=True) if axes[i] == "n"]
        label = f"{parts[0]}^2" if len(parts) > len(set(parts)) else " ".join(parts) or unit.replace("task's", "")
        values = np.moveaxis(array, 0, -1)[index]
        yield Column("trace", (name, *filter(None, names)), *_flat(np.moveaxis(values, -1, 0)), unit=label)


def _flat(array: NDArray[Any]) -> tuple[NDArray[Any], tuple[int, ...]]:
    """(T,) for one number per step, else (T, S); and the shape per step."""
    shape = tuple(array.shape[1:])
    size = int(np.prod(shape))
    return (array.reshape(len(array)) if size == 1 else array.reshape(len(array), size)), shape
