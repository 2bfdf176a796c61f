"""Training batches of a fine-tuning run: windows of several slices in given shares, cut from episodes with faults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task
from beliefscope.filters.batch import Batch, Steps
from beliefscope.filters.belief import Evidence
from beliefscope.filters.finetuning.settings import StepRange
from beliefscope.filters.finetuning.slices import CLEAN, Slice


@dataclass(frozen=True)
class Windows:
    """N windows of T steps, ordered by slice.

    Attributes:
        weight: (T, N) of each step in the loss, sum 1; 0 for steps outside the slice.
        present: (T, N, K) bool, the models whose evidence is used; None for all.
        parts: slice's name -> its columns of the N.
    """

    batch: Batch
    weight: Tensor
    present: Tensor | None
    parts: Mapping[str, slice]

    def select_evidence(self, evidence: Evidence) -> Evidence:
        """The evidence of the models that each window's slice uses."""
        return evidence if self.present is None else evidence.select_models(self.present)


@dataclass(frozen=True)
class Part:
    """A slice's copies of the episodes.

    Attributes:
        share: in the loss. first, last: range of the mix's episodes. mask: (S,) bool, the steps of the slice.
    """

    slice: Slice
    share: float
    first: int
    last: int
    mask: Tensor


@dataclass(frozen=True)
class Mix:
    """Copies of a set of episodes with each slice's faults. models: the filter's, in the order of K."""

    steps: Steps
    parts: tuple[Part, ...]
    models: tuple[str, ...]

    @classmethod
    def from_shares(
        cls,
        task: Task,
        models: Sequence[str],
        shares: Mapping[Slice, float],
        episodes: Sequence[Episode],
        seed: int,
        events: Mapping[int, Sequence[StepRange]] | None = None,
        device: torch.device | str = "cpu",
    ) -> Mix:
        """Args:
            shares: of each slice in the loss; they sum to 1. seed: of the faults.
            events: position among the episodes -> the only steps to use, except for clean data.

        Raises BadInput for a slice that does not fit task or filter, and an episode that does not fit the task.
        """
        for slice_ in shares:
            slice_.check(task, models)
        fault_sets = list(dict.fromkeys(slice_.faults for slice_ in shares))
        copies = [faults.apply(episode, seed) for faults in fault_sets for episode in episodes]
        steps = Steps.from_episodes(task, copies, device)
        all_steps = steps.windows(torch.arange(len(steps.states), device=device), 1)
        parts = []
        for slice_, share in shares.items():
            first = fault_sets.index(slice_.faults) * len(episodes)
            mask = slice_.mask(all_steps)[0]
            if events and slice_ != CLEAN:
                mask = mask & _event_mask(steps, first, events)
            parts.append(Part(slice_, share, first, first + len(episodes), mask))
        return cls(steps, tuple(parts), tuple(models))

    def with_steps(self, steps: Steps) -> Mix:
        """The same mix over another representation of its steps, such as with image indices."""
        return replace(self, steps=steps)

    def starts(self, length: int, warmup: int = 0) -> list[Tensor]:
        """For each part the first steps of all windows of this length that contain a step of the slice.

        Indices (P,) into ``steps`` for each part. warmup: number of first steps of a window to exclude.

        Raises BadInput if there is no window.
        """
        starts = []
        for part in self.parts:
            steps = self.steps.part(part.first, part.last)
            spans = zip(steps.first.tolist(), steps.length.tolist(), strict=True)
            device = part.mask.device
            candidates = torch.cat([torch.arange(a, max(a, a + n - length + 1), device=device) for a, n in spans])
            counts = torch.nn.functional.pad(part.mask.long().cumsum(0), (1, 0))
            valid = candidates[counts[candidates + length] > counts[candidates + warmup]]
            if not len(valid):
                raise BadInput(
                    f"slice {part.slice.name!r} has no matching step in windows of {length} steps: it covers "
                    f"{part.last - part.first} episodes of at most {int(steps.length.max())} steps"
                )
            starts.append(valid)
        return starts

    def sample_starts(self, starts: Sequence[Tensor], count: int, generator: torch.Generator) -> list[Tensor]:
        """Uniform samples (P,) of each part's starts: its share of ``count``, at least one."""
        counts = [max(1, round(part.share * count)) for part in self.parts]
        picks = [torch.randint(len(first), (n,), generator=generator) for first, n in zip(starts, counts, strict=True)]
        return [first[pick.to(first.device)] for first, pick in zip(starts, picks, strict=True)]

    def windows(self, starts: Sequence[Tensor], length: int, warmup: int = 0) -> Windows:
        """The windows that begin at each part's starts (P,). length, warmup: as for ``starts``."""
        joined = torch.cat(list(starts))
        index = joined + torch.arange(length, device=joined.device)[:, None]
        ends = [0, *torch.tensor([len(first) for first in starts]).cumsum(0).tolist()]
        columns = [slice(a, b) for a, b in pairwise(ends)]
        weight = torch.zeros(index.shape, device=joined.device)
        present = torch.ones(*index.shape, len(self.models), dtype=torch.bool, device=joined.device)
        for part, where in zip(self.parts, columns, strict=True):
            counts = part.mask[index[:, where]].float()
            counts[:warmup] = 0.0
            weight[:, where] = part.share * counts / counts.sum()
            if part.slice.only:
                present[:, where] = torch.tensor(
                    [name in part.slice.only for name in self.models], device=joined.device
                )
        return Windows(
            batch=self.steps.windows(joined, length),
            weight=weight,
            present=present if any(part.slice.only for part in self.parts) else None,
            parts={part.slice.name: where for part, where in zip(self.parts, columns, strict=True)},
        )


def evenly_spaced(starts: Sequence[Tensor], count: int) -> list[Tensor]:
    """At most ``count`` of each part's starts (P,), evenly spaced."""
    return [
        first[torch.linspace(0, len(first) - 1, min(count, len(first))).round().long().to(first.device)]
        for first in starts
    ]


def _event_mask(steps: Steps, first: int, events: Mapping[int, Sequence[StepRange]]) -> Tensor:
    """(S,) bool: the steps of these events, counting episodes from ``first``."""
    mask = torch.zeros(len(steps.states), dtype=torch.bool, device=steps.states.device)
    for position, ranges in events.items():
        begin, length = int(steps.first[first + position]), int(steps.length[first + position])
        for event in ranges:
            mask[begin + event.first : begin + min(length, length if event.last is None else event.last)] = True
    return mask
