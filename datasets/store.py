"""Episodes in HDF5: written whole or not at all, checked on the way in. The layout is described in docs/data.md."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.catalog import TASKS, find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task

FORMAT = "beliefscope-episodes"
VERSION = 1
SPLITS = ("train", "val", "test")

T = TypeVar("T")

# What h5py raises on meeting a damaged file.
_DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError)
_SAMPLES = Path(__file__).parent / "samples"


@dataclass(frozen=True)
class EpisodeSummary:
    """What a list of episodes shows of one. ``contact_fraction`` is the share of its steps in contact."""

    index: int
    steps: int
    policy: str
    split: str
    seed: int
    contact_fraction: float


def sample_path(task_name: str) -> Path:
    """The sample set shipped for a task. Raises BadInput for an unknown task, or one that ships none."""
    path = _SAMPLES / f"{find_task(task_name).name}.h5"
    if not path.exists():
        raise BadInput(
            f"Task {task_name!r} ships no sample set. Give a file: beliefscope collect {task_name} makes one."
        )
    return path


def open_dataset(path: str | Path) -> Dataset:
    """Open a file of episodes for reading. Raises BadInput where it is missing, damaged, or not one of ours."""
    return Dataset(Path(path))


class Dataset:
    """A file of episodes of one task: ``len``, ``[i]``, iteration; a context manager.

    Opening reads only attributes; ``[i]`` reads one episode and checks it.

    Attributes:
        path: of the file. task: what it holds.
        summaries: one ``EpisodeSummary`` an episode.
        hash: SHA-256 over the episodes' digests, the same however they are stored.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = _open(path)
        try:
            self.task = self._read_task()
            self._groups = self._find_groups()
            self.summaries = tuple(self._summary(i) for i in range(len(self._groups)))
            digests = "\n".join(self._attribute(group, "digest", str) for group in self._groups)
            self.hash = hashlib.sha256(digests.encode()).hexdigest()
        except BadInput:
            self.close()
            raise
        except _DAMAGE as error:
            self.close()
            raise _damaged(path, error) from None

    def __len__(self) -> int:
        return len(self._groups)

    def __iter__(self) -> Iterator[Episode]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> Episode:
        """Read one episode.

        Raises BadInput where there is none of that index, where an array is missing, of another shape or type than the
        task's, or not finite, and where the whole does not match its digest.
        """
        if not 0 <= index < len(self):
            raise BadInput(f"Episode {index} is not in {self.path}, which has episodes 0 to {len(self) - 1}.")
        try:
            return self._read(index)
        except BadInput:
            raise
        except _DAMAGE as error:
            raise _damaged(self.path, error) from None

    def close(self) -> None:
        """Close the file. Episodes already read stay valid."""
        self._file.close()

    def __enter__(self) -> Dataset:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _read_task(self) -> Task:
        found = self._file.attrs.get("format")
        if found != FORMAT:
            raise BadInput(
                f"{self.path} is an HDF5 file, but not a set of episodes: its attribute 'format' is {found!r}, "
                f"expected {FORMAT!r}."
            )
        version = self._file.attrs.get("version")
        if version != VERSION:
            raise BadInput(f"{self.path} has version {version} of the layout; this release reads version {VERSION}.")
        name = self._file.attrs.get("task")
        if name not in TASKS:
            raise BadInput(f"{self.path} is of task {name!r}. Available: {', '.join(TASKS)}.")
        return TASKS[str(name)]

    def _find_groups(self) -> list[h5py.Group]:
        count = sum(1 for name in self._file if name.startswith("trajectory"))
        if not count:
            raise BadInput(f"{self.path} holds no trajectory; expected groups 'trajectory0', 'trajectory1', ...")
        groups = [self._file.get(f"trajectory{i}") for i in range(count)]
        for i, group in enumerate(groups):
            if not isinstance(group, h5py.Group):
                raise BadInput(f"{self.path} has {count} trajectories, but no group 'trajectory{i}'.")
        return groups

    def _summary(self, index: int) -> EpisodeSummary:
        group = self._groups[index]
        states = self._stored(group, "states")
        if not states.shape or states.shape[0] < 1:
            raise BadInput(f"{self._place(group, 'states')} has shape {states.shape}, expected at least one step.")
        split = self._attribute(group, "split", str)
        if split not in SPLITS:
            raise BadInput(f"{self._place(group, 'split')} is {split!r}. Available: {', '.join(SPLITS)}.")
        return EpisodeSummary(
            index=index,
            steps=int(states.shape[0]),
            policy=str(self._provenance(group).get("policy", "")),
            split=split,
            seed=self._attribute(group, "seed", int),
            contact_fraction=self._attribute(group, "contact_fraction", float),
        )

    def _read(self, index: int) -> Episode:
        group, summary, task = self._groups[index], self.summaries[index], self.task
        steps = summary.steps
        dt = self._attribute(group, "dt", float)
        if not math.isclose(dt, task.dt):
            raise BadInput(f"{self._place(group, 'dt')} is {dt} s; task {task.name!r} has steps of {task.dt} s.")
        episode = Episode(
            task=task.name,
            states=self._array(group, "states", (steps, len(task.components))),
            controls=self._array(group, "controls", (steps, task.control_size)),
            observations={
                key: self._array(
                    group, f"observations/{key}", (steps, *shape), np.uint8 if len(shape) == 2 else np.float32
                )
                for key, shape in task.observations.items()
            },
            contact=self._array(group, "contact", (steps,), np.uint8).astype(bool),
            qpos=self._array(group, "qpos", (steps, None)),
            dt=dt,
            seed=summary.seed,
            split=summary.split,
            provenance=self._provenance(group),
        )
        if episode.digest() != self._attribute(group, "digest", str):
            raise BadInput(f"{self.path}: the arrays of {group.name[1:]} do not match its digest: they were changed.")
        return episode

    def _provenance(self, group: h5py.Group) -> dict[str, Any]:
        try:
            value = json.loads(self._attribute(group, "provenance", str))
        except json.JSONDecodeError:
            value = None
        if not isinstance(value, dict):
            raise BadInput(f"{self._place(group, 'provenance')} is not a JSON object.")
        return value

    def _attribute(self, group: h5py.Group, key: str, kind: Callable[[Any], T]) -> T:
        if key not in group.attrs:
            raise BadInput(
                f"{self.path}: {group.name[1:]} has no attribute {key!r}. It has: {', '.join(group.attrs) or 'none'}."
            )
        value = group.attrs[key]
        try:
            return kind(value)
        except (TypeError, ValueError):
            name = getattr(kind, "__name__", "another type")
            raise BadInput(f"{self._place(group, key)} is {value!r}, expected {name}.") from None

    def _stored(self, group: h5py.Group, key: str) -> h5py.Dataset:
        stored = group.get(key)
        if not isinstance(stored, h5py.Dataset):
            raise BadInput(f"{self.path}: {group.name[1:]} has no {key!r}. It has: {', '.join(group) or 'nothing'}.")
        return stored

    def _array(
        self, group: h5py.Group, key: str, shape: tuple[int | None, ...], kind: type = np.float32
    ) -> NDArray[Any]:
        array, place = self._stored(group, key)[()], self._place(group, key)
        fits = np.ndim(array) == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
        if not fits:
            expected = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
            raise BadInput(f"{place} has shape {np.shape(array)}, expected {expected}.")
        if array.dtype != kind:
            raise BadInput(f"{place} is {array.dtype}, expected {np.dtype(kind)}.")
        if not np.isfinite(array).all():
            step = int(np.argwhere(~np.isfinite(array))[0][0])
            raise BadInput(f"{place} is {array[step]} at step {step}, expected finite numbers.")
        return np.asarray(array)

    def _place(self, group: h5py.Group, key: str) -> str:
        return f"{self.path}: {key!r} of {group.name[1:]}"


def write_dataset(path: str | Path, task: Task, episodes: Iterable[Episode]) -> None:
    """Write episodes to a new file; what was there is replaced only when all is written.

    The same episodes give the same bytes. Raises BadInput where the file cannot be written.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise BadInput(f"Folder {path.parent} does not exist: cannot write {path.name} there.")
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with h5py.File(unfinished, "w", libver=("v110", "v110")) as file:
            file.attrs["format"], file.attrs["version"], file.attrs["task"] = FORMAT, VERSION, task.name
            for index, episode in enumerate(episodes):
                _write_episode(file.create_group(f"trajectory{index}"), episode)
        os.replace(unfinished, path)
    except OSError as error:
        raise BadInput(f"Cannot write {path}: {_reason(error)}.") from None
    finally:
        unfinished.unlink(missing_ok=True)


def _write_episode(group: h5py.Group, episode: Episode) -> None:
    group.attrs["seed"] = episode.seed
    group.attrs["split"] = episode.split
    group.attrs["dt"] = episode.dt
    group.attrs["contact_fraction"] = float(episode.contact.mean())
    group.attrs["provenance"] = json.dumps(dict(episode.provenance), sort_keys=True)
    group.attrs["digest"] = episode.digest()
    arrays = {"states": episode.states, "controls": episode.controls, "qpos": episode.qpos}
    arrays["contact"] = episode.contact.astype(np.uint8)
    arrays |= {f"observations/{key}": value for key, value in episode.observations.items()}
    for key, array in arrays.items():
        # One HDF5 element a step: the shuffle filter then lays the bytes of each pixel or component out over time,
        # which takes a fifth off the pictures.
        element = np.dtype((array.dtype, array.shape[1:])) if array.ndim > 1 and array.size else array.dtype
        stored = group.create_dataset(
            key, (len(array),), element, chunks=(len(array),), compression="gzip", compression_opts=9, shuffle=True
        )
        stored[...] = array


def _open(path: Path) -> h5py.File:
    if not path.exists():
        raise BadInput(f"{path} does not exist.")
    if not path.is_file():
        raise BadInput(f"{path} is not a file.")
    try:
        return h5py.File(path, "r")
    except PermissionError:
        raise BadInput(f"No permission to read {path}.") from None
    except _DAMAGE as error:
        if not h5py.is_hdf5(path):
            raise BadInput(f"{path} is not an HDF5 file.") from None
        raise _damaged(path, error) from None


def _damaged(path: Path, error: Exception) -> BadInput:
    return BadInput(f"{path} is damaged or cut short: {_reason(error)}. Collect or copy it again.")


def _reason(error: Exception) -> str:
    """HDF5's own words, in one line."""
    return (getattr(error, "strerror", None) or " ".join(str(error).split())).strip(" '\".")
