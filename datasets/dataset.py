"""Interface of a dataset: episodes of one task, independent of the file format."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.episode_parts import EpisodeParts
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class EpisodeSummary:
    """Metadata of an episode. ``contact_fraction`` of its steps are in contact; None without such a covariate."""

    index: int
    steps: int
    policy: str
    split: str
    seed: int
    contact_fraction: float | None


def no_training_episodes(task: Task, splits: Iterable[str], data: str = "the data set") -> BadInput:
    """The error for data without training episodes, with the next step. splits: those of the episodes."""
    present = " and ".join(repr(split) for split in sorted(set(splits)))
    name = task.name
    collect = f"collect some, beliefscope collect {name} -o {name}.h5, or " if task.simulate is not None else ""
    return BadInput(
        f"{data} has no episode of split 'train', only of {present or 'none'}: {collect}store some of the episodes "
        "with dataclasses.replace(episode, split='train') and bs.save_dataset, or import a log with beliefscope import "
        "--split train"
    )


class Dataset(ABC):
    """Sequence of episodes and context manager.

    Attributes:
        path: source file or folder. task: task of the episodes.
        summaries: one ``EpisodeSummary`` per episode.
        skipped: one line per unusable episode, if skipping was requested.
    """

    path: Path
    task: Task
    summaries: tuple[EpisodeSummary, ...]
    skipped: tuple[str, ...] = ()

    @property
    @abstractmethod
    def hash(self) -> str:
        """SHA-256 over the digests of the episodes, independent of the file format."""

    @abstractmethod
    def _episode(self, index: int) -> Episode:
        """Read the episode at a valid index. Raises BadInput for invalid data."""

    def __len__(self) -> int:
        return len(self.summaries)

    def __iter__(self) -> Iterator[Episode]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> Episode:
        """Read an episode. Raises BadInput for an index out of range or invalid data."""
        self._check_index(index)
        return self._episode(index)

    def _check_index(self, index: int) -> None:
        if not 0 <= index < len(self):
            raise BadInput(f"Episode {index} is not in {self.path}, which has episodes 0 to {len(self) - 1}.")

    def in_parts(self, index: int) -> Episode | EpisodeParts:
        """An episode that is read in parts, if it is long and the file allows it. Raises BadInput as ``[index]``."""
        return self[index]

    def held_out(self) -> list[int]:
        """Indices of the test episodes, else of the validation episodes, else of all episodes."""
        by_split = {split: [s.index for s in self.summaries if s.split == split] for split in ("test", "val")}
        return by_split["test"] or by_split["val"] or list(range(len(self)))

    def most_steps(self, indices: Iterable[int]) -> int:
        """Number of steps of the longest of these episodes; 0 without any."""
        return max((self.summaries[index].steps for index in indices if 0 <= index < len(self)), default=0)

    def close(self) -> None:  # noqa: B027 (closing is optional)
        """Close open files. Episodes already read stay valid."""

    def __enter__(self) -> Dataset:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class EpisodeList(Dataset):
    """Episodes of one task in memory."""

    def __init__(self, episodes: Sequence[Episode]) -> None:
        """Raises BadInput if there is none, or if their tasks differ."""
        if not episodes:
            raise BadInput("data are an empty list, expected at least one episode")
        self.task = episodes[0].task
        for episode in episodes:
            if episode.task != self.task:
                raise BadInput(f"data are episodes of the tasks {self.task.name!r} and {episode.task.name!r}")
        self.path = Path("list of episodes")
        self._episodes = tuple(episodes)
        with_contact = "contact" in self.task.covariates
        self.summaries = tuple(
            EpisodeSummary(
                index=i,
                steps=len(e),
                policy=str(e.provenance.get("policy", "")),
                split=e.split,
                seed=e.seed,
                contact_fraction=float(e.contact.mean()) if with_contact else None,
            )
            for i, e in enumerate(episodes)
        )

    @property
    def hash(self) -> str:
        return hashlib.sha256("\n".join(e.digest() for e in self._episodes).encode()).hexdigest()

    def _episode(self, index: int) -> Episode:
        return self._episodes[index]
