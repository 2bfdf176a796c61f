"""Values of the steps of a run of an external filter, and their arrays."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from beliefscope.filters.external.adapter import Values, check_values, letters_of
from beliefscope.filters.external.ancestors import Words, ancestors, new_table, words_of
from beliefscope.filters.external.torchfilter_hooks import RESAMPLED

BLOCK = 32
"""Steps whose ancestors are searched together, which takes half of the time: code and tables stay in the caches."""


class StepValues:
    """Copies the values of T steps into arrays (T, N, ...), since a filter may modify its own in place.

    Memory is allocated once: fresh memory costs more time than the copy. A value whose shape or type changes between
    the steps has no array; its steps are copied one by one. Resampled particles are replaced by their ancestors.

    Attributes:
        steps: values of the steps so far.
    """

    def __init__(self, count: int) -> None:
        """count: number of steps T."""
        self.steps: list[Values] = []
        self._count = count
        self._arrays: dict[str, Tensor | None] = {}
        self._rows: dict[str, tuple[Tensor, ...]] = {}
        self._resampled: dict[int, Words] = {}
        self._memory: list[Words] = []

    def append(self, values: Values) -> None:
        t = len(self.steps)
        self.steps.append({name: self._copy(t, name, value) for name, value in values.items() if name != RESAMPLED})
        if RESAMPLED in values:
            self._resampled[t] = words_of(values[RESAMPLED], self._memory.pop() if self._memory else None)
            if len(self._resampled) == BLOCK:
                self._search()

    def stacked(self) -> Values:
        """The arrays of all T steps, without values that some steps lack. torch raises for different shapes."""
        self._search()
        result = stacked([{k: v for k, v in step.items() if self._arrays[k] is None} for step in self.steps])
        for name, array in self._arrays.items():
            if array is not None and all(name in step for step in self.steps):
                result[name] = array
        return result

    def _copy(self, t: int, name: str, value: Tensor) -> Tensor:
        if name not in self._arrays:
            array = torch.empty((self._count, *value.shape), dtype=value.dtype)
            self._arrays[name], self._rows[name] = array, array.unbind()
        row = self._rows[name][t]
        if self._arrays[name] is None or row.shape != value.shape or row.dtype != value.dtype:
            self._arrays[name] = None
            return value.clone()
        return row.copy_(value)

    def _search(self) -> None:
        table = before = None
        for t, after in self._resampled.items():
            particles = self.steps[t]["particles"]
            count = particles.shape[1]
            before = words_of(particles, before)
            table = new_table(count) if table is None or before.shape[2] != count else table
            index = ancestors(after, before, table)
            if int(index.max()) < count:
                self.steps[t]["ancestors"] = self._copy(t, "ancestors", index)
        self._memory.extend(self._resampled.values())
        self._resampled.clear()


def with_ancestors(values: Values) -> Values:
    """Values of a step with the ancestors of its resampled particles in their place, if all are among its particles."""
    result = {name: value for name, value in values.items() if name != RESAMPLED}
    if RESAMPLED in values:
        index = ancestors(words_of(values[RESAMPLED]), words_of(values["particles"]))
        result |= {"ancestors": index} if int(index.max()) < values["particles"].shape[1] else {}
    return result


def check_steps(runs: Sequence[Sequence[Values]], leading: Sequence[int], sizes: dict[str, int], source: str) -> None:
    """Raises BadInput that names the first step of some runs with an invalid value; arguments as ``check_values``."""
    for steps in runs:
        for t, values in enumerate(steps):
            check_values(values, leading, sizes, f"{source} at step {t}", t)


def joined(name: str, runs: Sequence[Tensor]) -> Tensor:
    """Values (T, ...) of several runs along T; NaN after the last channels of smaller measurements."""
    return torch.cat(_of_one_size(list(runs), name, 0))


def stacked(steps: Sequence[Values], channels: int = 0, dim: int = 0) -> Values:
    """Values of T steps with a leading axis T, or of N runs with an axis N, without values that some of them lack.

    channels: smallest number m of the measurements' channels; they have the largest of all steps if that is larger.
    """
    common = [name for name in steps[0] if all(name in step for step in steps)]
    return {name: torch.stack(_of_one_size([step[name] for step in steps], name, channels), dim) for name in common}


def _of_one_size(values: list[Tensor], name: str, channels: int) -> list[Tensor]:
    """The values of steps with different numbers m of channels, extended by NaN to the largest or ``channels``."""
    axes = letters_of(name).count("m")
    sizes = {channels, *(value.shape[-1] for value in values)} if axes else set()
    if len(sizes) < 2:
        return values
    ends = [[0, max(sizes) - value.shape[-1]] * axes for value in values]
    return [torch.nn.functional.pad(v, end, value=torch.nan) for v, end in zip(values, ends, strict=True)]
