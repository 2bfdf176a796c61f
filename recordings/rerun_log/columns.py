"""A trace as columns with names: one row a step, one column a number or a list of them. What exports are made of."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.task import Task
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.schema import SCHEMA


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes:
        of: ``trace`` or ``observations``. parts: the array's name, then modality and components where it has them.
        values: (T,), or (T, S) where a step has S of them: particles, sensor channels, a picture's pixels.
        shape: of one step's values before they were laid out in C order. unit: of the numbers, as far as it is known.
    """

    of: str
    parts: tuple[str, ...]
    values: NDArray[Any]
    shape: tuple[int, ...] = ()
    unit: str = ""

    @property
    def name(self) -> str:
        """``estimate_mean.hinge_x``, ``modality_mean.image.hinge_x``, ``observations.force``."""
        return ".".join(self.parts if self.of == "trace" else (self.of, *self.parts))


def columns(trace: Trace) -> Iterator[Column]:
    """Every array over steps, modalities and components apart; the two of the start are not over steps."""
    task = find_task(trace.episode.task)
    for entity in SCHEMA:
        if entity.archetype != "Trace" or entity.static:
            continue
        name = entity.path.removeprefix("trace/")
        array = getattr(trace if hasattr(trace, name) else trace.episode, name)
        if array is not None and array.size:
            yield from _apart(name, array, re.findall(r"\w+", entity.shape), entity.unit, trace, task)
    for key, array in sorted(trace.episode.observations.items()):
        yield Column("observations", (key,), *_flat(array))


def _apart(
    name: str, array: NDArray[Any], axes: Sequence[str], unit: str, trace: Trace, task: Task
) -> Iterator[Column]:
    """The array's columns: its K, n and W axes taken apart by name, the others kept."""
    labels = {"K": trace.modalities, "n": tuple(c.name for c in task.components), "W": ("",)}
    named = [i for i, axis in enumerate(axes) if axis in labels]
    array = np.moveaxis(array, [1 + i for i in named], range(1, 1 + len(named)))
    choices = []
    for axis, size in zip([axes[i] for i in named], array.shape[1:], strict=False):
        # A weight is for all components, or for each its own.
        choices.append(labels["n"] if axis == "W" and size > 1 else labels[axis])
    units = {component.name: component.unit for component in task.components}
    for index in product(*(range(len(choice)) for choice in choices)):
        names = [choice[i] for choice, i in zip(choices, index, strict=True)]
        of = [units[one] for one, i in zip(names, named, strict=True) if axes[i] == "n"]
        said = f"{of[0]}^2" if len(of) > len(set(of)) else " ".join(of) or unit.replace("task's", "")
        values = np.moveaxis(array, 0, -1)[index]
        yield Column("trace", (name, *filter(None, names)), *_flat(np.moveaxis(values, -1, 0)), unit=said)


def _flat(array: NDArray[Any]) -> tuple[NDArray[Any], tuple[int, ...]]:
    """(T,) where a step has one number, else (T, S); and the shape of one step."""
    shape = tuple(array.shape[1:])
    size = int(np.prod(shape))
    return (array.reshape(len(array)) if size == 1 else array.reshape(len(array), size)), shape
