"""A set of episodes of one task, whatever kind of file it lies in."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class EpisodeSummary:
    """What a list of episodes shows of one. ``contact_fraction`` is the share of its steps in contact."""

    index: int
    steps: int
    policy: str
    split: str
    seed: int
    contact_fraction: float


class Dataset(ABC):
    """``len``, ``[i]``, iteration; a context manager.

    Attributes:
        path: file or folder it was opened from. task: what it holds.
        summaries: one ``EpisodeSummary`` an episode.
        left_out: one line for each trajectory that could not be used, where leaving out was asked for.
    """

    path: Path
    task: Task
    summaries: tuple[EpisodeSummary, ...]
    left_out: tuple[str, ...] = ()

    @property
    @abstractmethod
    def hash(self) -> str:
        """SHA-256 over the episodes' digests, the same however they are stored."""

    @abstractmethod
    def _episode(self, index: int) -> Episode:
        """Episode of an index that exists; raises BadInput for what is wrong with it."""

    def __len__(self) -> int:
        return len(self.summaries)

    def __iter__(self) -> Iterator[Episode]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> Episode:
        """One episode. Raises BadInput where there is none of that index, or something is wrong with it."""
        if not 0 <= index < len(self):
            raise BadInput(f"Episode {index} is not in {self.path}, which has episodes 0 to {len(self) - 1}.")
        return self._episode(index)

    def held_out(self) -> list[int]:
        """Indices of the episodes kept for tests; where there are none, of those for validation; else of all."""
        by_split = {split: [s.index for s in self.summaries if s.split == split] for split in ("test", "val")}
        return by_split["test"] or by_split["val"] or list(range(len(self)))

    def close(self) -> None:  # noqa: B027 (nothing to close is not wrong)
        """Close what is open. Episodes already read stay valid."""

    def __enter__(self) -> Dataset:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
