"""What a fine-tuning learns from: windows of several slices in given shares, cut from episodes that are broken once."""

from __future__ import annotations

import re
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
from beliefscope.filters.finetuning.slices import NOMINAL, Slice


@dataclass(frozen=True)
class Moment:
    """Steps ``first`` up to, but without, ``last`` of the episode with this index; without ``last`` up to its end."""

    episode: int
    first: int = 0
    last: int | None = None

    @classmethod
    def parse(cls, text: str) -> Moment:
        """Reads ``9`` or ``9:20-60``. Raises BadInput for anything else."""
        found = re.fullmatch(r"(\d+)(?::(\d+)-(\d+))?", text.strip())
        if found is None or (found[2] is not None and int(found[3]) <= int(found[2])):
            raise BadInput(f"moment {text!r} is not EPISODE or EPISODE:FIRST-LAST, such as 9 or 9:20-60")
        return cls(int(found[1]), int(found[2] or 0), None if found[3] is None else int(found[3]))

    def __str__(self) -> str:
        return f"{self.episode}" if self.last is None else f"{self.episode}:{self.first}-{self.last}"


@dataclass(frozen=True)
class Windows:
    """N windows of T steps, those of the first slice first.

    Attributes:
        weight: (T, N) of each step in the loss, sum 1; 0 where a step does not count.
        present: (T, N, K) bool, whose evidence is used; None where that of all models is.
        parts: slice's name -> its columns of the N.
    """

    batch: Batch
    weight: Tensor
    present: Tensor | None
    parts: Mapping[str, slice]

    def heard(self, evidence: Evidence) -> Evidence:
        """The evidence of those who may speak in each window."""
        return evidence if self.present is None else evidence.of(self.present)


@dataclass(frozen=True)
class Part:
    """A slice's own copies of the episodes. share: of the loss. first, last: of the mix's episodes. mask: (S,) bool, of
    all steps those that count."""

    slice: Slice
    share: float
    first: int
    last: int
    mask: Tensor


@dataclass(frozen=True)
class Mix:
    """Copies of a set of episodes, broken as each of the slices says. models: the filter's, in the order of K."""

    steps: Steps
    parts: tuple[Part, ...]
    models: tuple[str, ...]

    @classmethod
    def of(
        cls,
        task: Task,
        models: Sequence[str],
        shares: Mapping[Slice, float],
        episodes: Sequence[Episode],
        seed: int,
        moments: Mapping[int, Sequence[Moment]] | None = None,
        device: torch.device | str = "cpu",
    ) -> Mix:
        """Args:
            shares: of each slice in the loss; they sum to 1. seed: of the faults.
            moments: place among the episodes -> what of it counts, and nothing else does but for nominal data.

        Raises BadInput for a slice that does not fit task or filter, and an episode that does not fit the task.
        """
        for one in shares:
            one.check(task, models)
        fault_sets = list(dict.fromkeys(one.faults for one in shares))
        copies = [faults.apply(episode, seed) for faults in fault_sets for episode in episodes]
        steps = Steps.of(task, copies, device)
        every = steps.windows(torch.arange(len(steps.states), device=device), 1)
        parts = []
        for one, share in shares.items():
            first = fault_sets.index(one.faults) * len(episodes)
            mask = one.mask(every)[0]
            if moments and one != NOMINAL:
                mask = mask & _inside(steps, first, moments)
            parts.append(Part(one, share, first, first + len(episodes), mask))
        return cls(steps, tuple(parts), tuple(models))

    def on(self, steps: Steps) -> Mix:
        """The same on other copies of its steps: those whose pictures are numbered."""
        return replace(self, steps=steps)

    def starts(self, length: int, unheeded: int = 0) -> list[Tensor]:
        """For each part the first steps of all windows of this length that hold a step that counts.

        unheeded: so many first steps of a window do not count. Raises BadInput where there is no window.
        """
        found = []
        for part in self.parts:
            of = self.steps.part(part.first, part.last)
            spans = zip(of.first.tolist(), of.length.tolist(), strict=True)
            every = torch.cat([torch.arange(a, max(a, a + n - length + 1), device=part.mask.device) for a, n in spans])
            counted = torch.nn.functional.pad(part.mask.long().cumsum(0), (1, 0))
            starts = every[counted[every + length] > counted[every + unheeded]]
            if not len(starts):
                raise BadInput(
                    f"slice {part.slice.name!r} has no step that counts in {part.last - part.first} episodes, the "
                    f"longest of {int(of.length.max())} steps, cut into windows of {length} steps"
                )
            found.append(starts)
        return found

    def drawn(self, starts: Sequence[Tensor], count: int, generator: torch.Generator) -> list[Tensor]:
        """Of each part's starts as many of ``count`` as its share says, at least one; each as likely as another."""
        counts = [max(1, round(part.share * count)) for part in self.parts]
        picks = [torch.randint(len(found), (n,), generator=generator) for found, n in zip(starts, counts, strict=True)]
        return [found[pick.to(found.device)] for found, pick in zip(starts, picks, strict=True)]

    def windows(self, starts: Sequence[Tensor], length: int, unheeded: int = 0) -> Windows:
        """The windows that begin at each part's starts."""
        joined = torch.cat(list(starts))
        index = joined + torch.arange(length, device=joined.device)[:, None]
        ends = [0, *torch.tensor([len(found) for found in starts]).cumsum(0).tolist()]
        columns = [slice(a, b) for a, b in pairwise(ends)]
        weight = torch.zeros(index.shape, device=joined.device)
        present = torch.ones(*index.shape, len(self.models), dtype=torch.bool, device=joined.device)
        for part, where in zip(self.parts, columns, strict=True):
            counts = part.mask[index[:, where]].float()
            counts[:unheeded] = 0.0
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


def spread(starts: Sequence[Tensor], count: int) -> list[Tensor]:
    """At most ``count`` of each part's starts, evenly over all of them."""
    return [
        found[torch.linspace(0, len(found) - 1, min(count, len(found))).round().long().to(found.device)]
        for found in starts
    ]


def _inside(steps: Steps, first: int, moments: Mapping[int, Sequence[Moment]]) -> Tensor:
    """(S,) bool: the steps of these moments of the episodes from ``first`` on."""
    mask = torch.zeros(len(steps.states), dtype=torch.bool, device=steps.states.device)
    for place, found in moments.items():
        begin, length = int(steps.first[first + place]), int(steps.length[first + place])
        for moment in found:
            mask[begin + moment.first : begin + min(length, length if moment.last is None else moment.last)] = True
    return mask
