"""Episodes in HDF5: written whole or not at all, checked on the way in. The layout is described in docs/data.md."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.catalog import TASKS, find_task
from beliefscope.datasets.dataset import SPLITS, Dataset, EpisodeSummary
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import unwritable
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.datasets.readers.hdf5_guard import DAMAGE, SHIPPED, Sink, damaged, look_over, open_hdf5, trust
from beliefscope.datasets.readers.hdf5_limits import check_claim
from beliefscope.datasets.readers.mit_push import MitPushes, is_mit
from beliefscope.datasets.readers.paper_authors import AuthorsFiles, is_authors
from beliefscope.datasets.readers.push_real_task import PUSH_REAL, PUSH_REAL_TASKS
from beliefscope.datasets.task import Task

FORMAT = "beliefscope-episodes"
VERSION = 1

T = TypeVar("T")


def sample_path(task_name: str) -> Path:
    """The sample set shipped for a task. Raises BadInput for an unknown task, or one that ships none."""
    path = SHIPPED / f"{find_task(task_name).name}.h5"
    if not path.exists():
        can_simulate = find_task(task_name).simulate is not None
        raise BadInput(
            f"Task {task_name!r} ships no sample set. Give its data with --data"
            + (f": beliefscope collect {task_name} makes some." if can_simulate else ".")
        )
    return path


def open_dataset(path: str | Path, task: Task | None = None, skip_bad: bool = False) -> Dataset:
    """Open episodes for reading, by what is found: a file of ours, or files of others, or a folder of these.

    Args:
        path: an HDF5 file of ours; a file or folder (searched to its bottom) of pushes of the MIT data set; a file or
            folder of the HDF5 files of the paper's authors.
        task: what they are wanted for, where the files leave a choice: which of the ``push-real`` tasks.
        skip_bad: leave out trajectories that cannot be used, and say so in ``Dataset.left_out``.

    Raises:
        BadInput: where it is missing, damaged, of no known kind, or nothing in it can be used.
    """
    path = Path(path)
    files = data_files(path)
    look_over(files)
    if is_mit(files[0]):
        wanted = task if task in PUSH_REAL_TASKS else PUSH_REAL
        return MitPushes(path, files, wanted, skip_bad)
    if is_authors(files[0]):
        return AuthorsFiles(path, files, skip_bad)
    if path.is_dir():
        raise BadInput(f"{path} holds sets of episodes, such as {files[0].name}: give one of the files.")
    return EpisodeFile(path, skip_bad)


def data_files(path: Path) -> list[Path]:
    """The file itself, or what a folder holds of data. Raises BadInput where there is none."""
    if not path.exists():
        raise BadInput(f"{path} does not exist.")
    if not path.is_dir():
        return [path]
    files = sorted(file for file in path.rglob("*") if file.suffix in (".json", ".h5", ".hdf5") and file.is_file())
    if not files:
        raise BadInput(f"Folder {path} holds no data: expected files that end in .json, .h5 or .hdf5.")
    return files


class EpisodeFile(Dataset):
    """A file of our own layout. Opening reads only attributes; ``[i]`` reads one episode and checks it: its arrays must
    be of the task's shapes and types, finite, and match their digest."""

    def __init__(self, path: Path, skip_bad: bool = False) -> None:
        self.path = path
        self._file = open_hdf5(path)
        try:
            self.task = self._read_task()
            self._groups = self._usable_groups() if skip_bad else self._find_groups()
            self.summaries = tuple(self._summary(group, i) for i, group in enumerate(self._groups))
            digests = "\n".join(self._attribute(group, "digest", str) for group in self._groups)
            self._hash = hashlib.sha256(digests.encode()).hexdigest()
        except BadInput:
            self.close()
            raise
        except DAMAGE as error:
            self.close()
            raise damaged(path, error) from None

    @property
    def hash(self) -> str:
        return self._hash

    def _episode(self, index: int) -> Episode:
        return self._checked(self._groups[index])

    def _checked(self, group: h5py.Group) -> Episode:
        try:
            return self._read(group)
        except BadInput:
            raise
        except DAMAGE as error:
            raise damaged(self.path, error) from None

    def close(self) -> None:
        self._file.close()

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

    def _usable_groups(self) -> list[h5py.Group]:
        """Those that can be read to the end; the others are left out."""
        groups, left_out = [], []
        for name in sorted((n for n in self._file if n.startswith("trajectory")), key=lambda n: (len(n), n)):
            try:
                group = self._file.get(name)
                if not isinstance(group, h5py.Group):
                    raise BadInput(f"{self.path}: {name} is not a group.")
                self._checked(group)
            except (BadInput, *DAMAGE) as error:
                left_out.append(str(error if isinstance(error, BadInput) else damaged(self.path, error)))
                continue
            groups.append(group)
        if not groups:
            raise BadInput(
                f"{self.path} holds no trajectory that can be used."
                + (f" The first: {left_out[0]}" if left_out else "")
            )
        self.left_out = tuple(left_out)
        return groups

    def _summary(self, group: h5py.Group, index: int) -> EpisodeSummary:
        states = self._stored(group, "states")
        if not states.shape or states.shape[0] < 1:
            raise BadInput(f"{self._place(group, 'states')} has shape {states.shape}, expected at least one step.")
        split = self._attribute(group, "split", str)
        if split not in SPLITS:
            raise BadInput(f"{self._place(group, 'split')} is {split!r}. Available: {', '.join(SPLITS)}.")
        contact = self._attribute(group, "contact_fraction", float)
        if not 0.0 <= contact <= 1.0:
            raise BadInput(f"{self._place(group, 'contact_fraction')} is {contact}, expected a share from 0 to 1.")
        return EpisodeSummary(
            index=index,
            steps=int(states.shape[0]),
            policy=str(self._provenance(group).get("policy", "")),
            split=split,
            seed=self._attribute(group, "seed", int),
            contact_fraction=contact,
        )

    def _read(self, group: h5py.Group) -> Episode:
        task, summary, provenance = self.task, self._summary(group, 0), self._provenance(group)
        steps, dt = summary.steps, self._attribute(group, "dt", float)
        # A reader of others' files says in the provenance that theirs have another step.
        if not math.isclose(dt, task.dt) and dt != provenance.get("recorded_dt"):
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
            provenance=provenance,
        )
        if episode.digest() != self._attribute(group, "digest", str):
            raise BadInput(f"{self.path}: the arrays of {group.name[1:]} do not match its digest: they were changed.")
        return episode

    def _provenance(self, group: h5py.Group) -> dict[str, Any]:
        try:
            value = read_json(self._attribute(group, "provenance", str))
        except ValueError as error:
            if isinstance(error, BadInput):
                raise
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
        except (TypeError, ValueError, OverflowError):
            name = getattr(kind, "__name__", "another type")
            raise BadInput(f"{self._place(group, key)} is {value!r}, expected {name}.") from None

    def _stored(self, group: h5py.Group, key: str) -> h5py.Dataset:
        stored = group.get(key)
        if not isinstance(stored, h5py.Dataset):
            raise BadInput(f"{self.path}: {group.name[1:]} has no {key!r}. It has: {', '.join(group) or 'nothing'}.")
        check_claim(stored, self._place(group, key))
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
            at = tuple(np.argwhere(~np.isfinite(array))[0])
            raise BadInput(f"{place} is {array[at]} at step {at[0]}, expected finite numbers.")
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
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with Sink(unfinished, "w+b") as sink:
            with h5py.File(sink, "w", libver=("v110", "v110")) as file:
                file.attrs["format"], file.attrs["version"], file.attrs["task"] = FORMAT, VERSION, task.name
                for index, episode in enumerate(episodes):
                    _write_episode(file.create_group(f"trajectory{index}"), episode)
                    sink.check()
            sink.check()
        os.replace(unfinished, path)
        trust(path)
    except OSError as error:
        unfinished.unlink(missing_ok=True)  # before it is told what is free
        raise unwritable(path, error) from None
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
        if not array.size:
            group.create_dataset(key, data=array)  # no joint positions where there is no replay
            continue
        element = np.dtype((array.dtype, array.shape[1:])) if array.ndim > 1 else array.dtype
        stored = group.create_dataset(
            key, (len(array),), element, chunks=(len(array),), compression="gzip", compression_opts=9, shuffle=True
        )
        stored[...] = array
