"""Episodes in HDF5: written whole or not at all, checked on the way in. The layout is described in docs/data.md."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

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

    Opening reads only attributes; ``[i]`` reads and checks one episode.

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
            digests = [self._attribute(group, "digest", str) for group in self._groups]
        except OSError as error:
            self.close()
            raise BadInput(f"{path} is damaged: {_reason(error)}. Collect or copy it again.") from None
        except BaseException:
            self.close()
            raise
        self.hash = hashlib.sha256("\n".join(digests).encode()).hexdigest()

    def __len__(self) -> int:
        return len(self._groups)

    def __iter__(self) -> Iterator[Episode]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> Episode:
        """Read one episode. Raises BadInput where a key is missing, of a wrong shape, not finite, or damaged."""
        if not 0 <= index < len(self):
            raise BadInput(f"Episode {index} is not in {self.path}, which has episodes 0 to {len(self) - 1}.")
        group, summary, task = self._groups[index], self.summaries[index], self.task
        states = self._array(group, "states", (summary.steps, len(task.components)))
        observations = {
            key: self._array(
                group, f"observations/{key}", (summary.steps, *shape), np.uint8 if len(shape) == 2 else np.float32
            )
            for key, shape in task.observations.items()
        }
        episode = Episode(
            task=task.name,
            states=states,
            controls=self._array(group, "controls", (summary.steps, task.control_size)),
            observations=observations,
            contact=self._array(group, "contact", (summary.steps,), np.uint8).astype(bool),
            qpos=self._array(group, "qpos", (summary.steps, None)),
            dt=float(self._attribute(group, "dt", float)),
            seed=summary.seed,
            split=summary.split,
            provenance=self._provenance(group),
        )
        if episode.digest() != self._attribute(group, "digest", str):
            raise BadInput(
                f"{self.path}: {group.name[1:]} does not match its digest: it was changed or damaged. Collect or copy it again."
            )
        return episode

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
        if self._file.attrs.get("format") != FORMAT:
            raise BadInput(
                f"{self.path} is an HDF5 file, but not a set of episodes: its attribute 'format' is "
                f"{self._file.attrs.get('format')!r}, expected {FORMAT!r}."
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
        missing = [f"trajectory{i}" for i in range(count) if f"trajectory{i}" not in self._file]
        if missing:
            raise BadInput(f"{self.path} has {count} trajectories, but {missing[0]!r} is missing.")
        return [self._file[f"trajectory{i}"] for i in range(count)]

    def _summary(self, index: int) -> EpisodeSummary:
        group = self._groups[index]
        split = self._attribute(group, "split", str)
        if split not in SPLITS:
            raise BadInput(f"{self.path}: {group.name[1:]} is of split {split!r}. Available: {', '.join(SPLITS)}.")
        if "states" not in group:
            raise self._missing(group, "states", group)
        return EpisodeSummary(
            index=index,
            steps=len(group["states"]),
            policy=str(self._provenance(group).get("policy", "")),
            split=split,
            seed=int(self._attribute(group, "seed", int)),
            contact_fraction=float(self._attribute(group, "contact_fraction", float)),
        )

    def _provenance(self, group: h5py.Group) -> dict[str, Any]:
        text = self._attribute(group, "provenance", str)
        try:
            value = json.loads(text)
        except json.JSONDecodeError:
            value = None
        if not isinstance(value, dict):
            raise BadInput(f"{self.path}: attribute 'provenance' of {group.name[1:]} is not a JSON object.")
        return value

    def _attribute(self, group: h5py.Group, key: str, kind: type) -> Any:
        if key not in group.attrs:
            raise BadInput(
                f"{self.path}: {group.name[1:]} has no attribute {key!r}. It has: {', '.join(group.attrs) or 'none'}."
            )
        try:
            return kind(group.attrs[key])
        except (TypeError, ValueError):
            raise BadInput(
                f"{self.path}: attribute {key!r} of {group.name[1:]} is {group.attrs[key]!r}, expected {kind.__name__}."
            ) from None

    def _missing(self, group: h5py.Group, key: str, where: h5py.Group) -> BadInput:
        return BadInput(f"{self.path}: {group.name[1:]} has no {key!r}. It has: {', '.join(where) or 'nothing'}.")

    def _array(
        self, group: h5py.Group, key: str, shape: tuple[int | None, ...], kind: type = np.float32
    ) -> NDArray[Any]:
        place = f"{self.path}: {key!r} of {group.name[1:]}"
        if not isinstance(group.get(key), h5py.Dataset):
            raise self._missing(group, key, group)
        try:
            array = group[key][()]
        except OSError as error:
            raise BadInput(f"{place} cannot be read: {_reason(error)}. Collect or copy the file again.") from None
        fits = len(array.shape) == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
        if not fits:
            expected = "(" + ", ".join("n" if n is None else str(n) for n in shape) + ")"
            raise BadInput(f"{place} has shape {array.shape}, expected {expected}.")
        if array.dtype != kind:
            raise BadInput(f"{place} is {array.dtype}, expected {np.dtype(kind)}.")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            step = int(np.argwhere(~np.isfinite(array))[0][0])
            raise BadInput(f"{place} holds {array[step]} at step {step}, expected finite numbers.")
        return np.asarray(array)


def write_dataset(path: str | Path, task: Task, episodes: Iterable[Episode]) -> None:
    """Write episodes to a new file, replacing what is there only once all is written.

    The same episodes give the same bytes. Raises BadInput where the folder does not exist or cannot be written.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise BadInput(f"Folder {path.parent} does not exist: cannot write {path.name} there.")
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with h5py.File(partial, "w", libver=("v110", "v110")) as file:
            file.attrs["format"], file.attrs["version"], file.attrs["task"] = FORMAT, VERSION, task.name
            for index, episode in enumerate(episodes):
                _write_episode(file.create_group(f"trajectory{index}"), episode)
        os.replace(partial, path)
    except PermissionError:
        raise BadInput(f"No permission to write {path}.") from None
    finally:
        partial.unlink(missing_ok=True)


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
        _write_array(group, key, np.ascontiguousarray(array))


def _write_array(group: h5py.Group, key: str, array: NDArray[Any]) -> None:
    """One HDF5 element a step: the shuffle filter then lays each pixel's or component's bytes out over time."""
    kind = np.dtype((array.dtype, array.shape[1:])) if array.ndim > 1 and array.size else array.dtype
    group.create_dataset(
        key, (len(array),), kind, chunks=(len(array),), compression="gzip", compression_opts=9, shuffle=True
    )[...] = array


def _open(path: Path) -> h5py.File:
    if not path.exists():
        raise BadInput(f"{path} does not exist.")
    if not path.is_file():
        raise BadInput(f"{path} is not a file.")
    try:
        return h5py.File(path, "r")
    except PermissionError:
        raise BadInput(f"No permission to read {path}.") from None
    except OSError as error:
        if not h5py.is_hdf5(path):
            raise BadInput(f"{path} is not an HDF5 file.") from None
        raise BadInput(f"{path} is damaged or cut short: {_reason(error)}. Collect or copy it again.") from None


def _reason(error: OSError) -> str:
    return str(error).splitlines()[0].rstrip(".")
