"""Datasets in HDF5: atomic writes and validated reads. The layout is described in docs/data.md."""

from __future__ import annotations

import copyreg
import hashlib
import json
import math
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.catalog import TASKS, find_task, stored_task
from beliefscope.datasets.dataset import SPLITS, Dataset, EpisodeSummary
from beliefscope.datasets.episode import Episode, time_error
from beliefscope.datasets.episode_index import read_index, write_index
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import write_error
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.datasets.readers.hdf5_guard import (
    HDF5_ERRORS,
    SAMPLES,
    DeferredErrorFile,
    mark_readable,
    open_hdf5,
    probe,
    read_error,
)
from beliefscope.datasets.readers.hdf5_limits import check_array
from beliefscope.datasets.readers.mit_push import MitPushDataset, is_mit_push
from beliefscope.datasets.readers.paper_authors import PaperDataset, is_paper_file
from beliefscope.datasets.readers.push_real_task import PUSH_REAL, PUSH_REAL_TASKS
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import difference, task_to_json

FORMAT = "beliefscope-episodes"
VERSION = 1

T = TypeVar("T")


def sample_path(task: str | Task) -> Path:
    """Path of a task's sample dataset. Raises BadInput for an unknown task or one without samples."""
    task = find_task(task)
    if not has_sample(task):
        can_simulate = task.simulate is not None
        raise BadInput(
            f"Task {task.name!r} has no sample dataset. Give its data with --data"
            + (f": beliefscope collect {task.name} simulates some." if can_simulate else ".")
        )
    return _sample_file(task.name)


def has_sample(task: str | Task) -> bool:
    """Whether the task is a shipped one with a sample dataset."""
    task = find_task(task)
    return task.name in TASKS and not difference(TASKS[task.name], task) and _sample_file(task.name).exists()


def _sample_file(name: str) -> Path:
    return SAMPLES / f"{name}.h5"


def open_dataset(
    path: str | Path, task: Task | None = None, skip_bad: bool = False, given: Sequence[Task] = ()
) -> Dataset:
    """Open a dataset for reading; the format is detected.

    Args:
        path: HDF5 file written by ``write_dataset``; file or folder (searched recursively) of the MIT Push dataset;
            file or folder of the HDF5 files of the paper's authors.
        task: which of the ``push-real`` tasks to use for MIT Push files.
        skip_bad: skip unusable trajectories and list them in ``Dataset.skipped``.
        given: user-defined tasks, as for ``stored_task``; ``task`` is one of them.

    Raises:
        BadInput: if the data are missing, damaged, of an unknown format or unusable.
    """
    path = Path(path)
    files = data_files(path)
    if read_index(path) is not None:
        mark_readable(path)  # it was read completely when the index was written
    probe(files)
    if is_mit_push(files[0]):
        return MitPushDataset(path, files, task if task in PUSH_REAL_TASKS else PUSH_REAL, skip_bad)
    if is_paper_file(files[0]):
        return PaperDataset(path, files, skip_bad)
    if path.is_dir():
        raise BadInput(f"{path} contains datasets, such as {files[0].name}: give one of the files.")
    return EpisodeFile(path, skip_bad, given if task is None else (task, *given))


def data_files(path: Path) -> list[Path]:
    """The file itself, or the data files of a folder. Raises BadInput if there is none."""
    if not path.exists():
        raise BadInput(f"{path} does not exist.")
    if not path.is_dir():
        return [path]
    files = sorted(file for file in path.rglob("*") if file.suffix in (".json", ".h5", ".hdf5") and file.is_file())
    if not files:
        raise BadInput(f"Folder {path} has no data: expected files that end in .json, .h5 or .hdf5.")
    return files


class EpisodeFile(Dataset):
    """A file written by ``write_dataset``. Opening reads only attributes; ``[i]`` reads and validates an episode.

    Its arrays must have the task's shapes and types, be finite and match their digest.
    """

    def __init__(self, path: Path, skip_bad: bool = False, given: Sequence[Task] = ()) -> None:
        self.path = path
        self._file = open_hdf5(path)
        try:
            self.task = self._read_task(given)
            self._names: list[str] | None = None  # trajectory0, trajectory1, ...
            index = None if skip_bad else read_index(path)
            self.summaries, self._hash = self._read_all(skip_bad) if index is None else index
        except BadInput:
            self.close()
            raise
        except HDF5_ERRORS as error:
            self.close()
            raise read_error(path, error) from None

    @property
    def hash(self) -> str:
        return self._hash

    def _read_all(self, skip_bad: bool) -> tuple[tuple[EpisodeSummary, ...], str]:
        """Summaries and hash of the episodes. Keeps the names of usable groups, or else stores the index."""
        groups = self._usable_groups() if skip_bad else self._find_groups()
        summaries = tuple(self._summary(group, i) for i, group in enumerate(groups))
        digest = _combined(self._attribute(group, "digest", str) for group in groups)
        if skip_bad:
            self._names = [group.name for group in groups]
        else:
            write_index(self.path, summaries, digest)
        return summaries, digest

    def _episode(self, index: int) -> Episode:
        name = f"trajectory{index}" if self._names is None else self._names[index]
        try:
            group = self._file.get(name)
        except HDF5_ERRORS as error:
            raise read_error(self.path, error) from None
        if not isinstance(group, h5py.Group):
            raise BadInput(f"{self.path}: {name} is not a group.")
        return self._read_checked(group)

    def _read_checked(self, group: h5py.Group) -> Episode:
        try:
            return self._read(group)
        except BadInput:
            raise
        except HDF5_ERRORS as error:
            raise read_error(self.path, error) from None

    def close(self) -> None:
        self._file.close()

    def _read_task(self, given: Sequence[Task]) -> Task:
        format_ = self._file.attrs.get("format")
        if format_ != FORMAT:
            raise BadInput(
                f"{self.path} is an HDF5 file, but not a dataset: its attribute 'format' is {format_!r}, "
                f"expected {FORMAT!r}."
            )
        version = self._file.attrs.get("version")
        if version != VERSION:
            raise BadInput(f"{self.path} has version {version} of the layout; this release reads version {VERSION}.")
        try:
            definition = self._file.attrs.get("definition")
            name = str(self._file.attrs.get("task"))
            return stored_task(name if definition is None else read_json(definition), given)
        except (TypeError, ValueError) as error:
            raise BadInput(f"{self.path}: {error}") from None

    def _find_groups(self) -> list[h5py.Group]:
        count = sum(1 for name in self._file if name.startswith("trajectory"))
        if not count:
            raise BadInput(f"{self.path} has no trajectory; expected groups 'trajectory0', 'trajectory1', ...")
        groups = [self._file.get(f"trajectory{i}") for i in range(count)]
        for i, group in enumerate(groups):
            if not isinstance(group, h5py.Group):
                raise BadInput(f"{self.path} has {count} trajectories, but no group 'trajectory{i}'.")
        return groups

    def _usable_groups(self) -> list[h5py.Group]:
        """Groups that can be read completely; the others are skipped."""
        groups, skipped = [], []
        for name in sorted((n for n in self._file if n.startswith("trajectory")), key=lambda n: (len(n), n)):
            try:
                group = self._file.get(name)
                if not isinstance(group, h5py.Group):
                    raise BadInput(f"{self.path}: {name} is not a group.")
                self._read_checked(group)
            except (BadInput, *HDF5_ERRORS) as error:
                skipped.append(str(error if isinstance(error, BadInput) else read_error(self.path, error)))
                continue
            groups.append(group)
        if not groups:
            raise BadInput(
                f"{self.path} has no usable trajectory." + (f" First error: {skipped[0]}" if skipped else "")
            )
        self.skipped = tuple(skipped)
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
            raise BadInput(f"{self._place(group, 'contact_fraction')} is {contact}, expected a fraction from 0 to 1.")
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
        # Converted external files record their own time step in the provenance.
        if not math.isclose(dt, task.dt) and dt != provenance.get("recorded_dt"):
            raise BadInput(f"{self._place(group, 'dt')} is {dt} s; task {task.name!r} has steps of {task.dt} s.")
        episode = Episode(
            task=task,
            states=self._array(group, "states", (steps, len(task.components))),
            controls=self._array(group, "controls", (steps, task.control_size)),
            observations={
                key: self._array(group, f"observations/{key}", (steps, *shape), task.dtype(key))
                for key, shape in task.observations.items()
            },
            contact=self._array(group, "contact", (steps,), np.uint8).astype(bool),
            qpos=self._array(group, "qpos", (steps, None)),
            dt=dt,
            seed=summary.seed,
            split=summary.split,
            provenance=provenance,
            covariates={
                name: self._array(group, f"covariates/{name}", (steps,), unknown=True)
                for name in task.covariates
                if f"covariates/{name}" in group
            },
            time=self._array(group, "time", (steps,), np.float64) if "time" in group else None,
        )
        if episode.time is not None and (error := time_error(episode.time)):
            raise BadInput(f"{self._place(group, 'time')} {error}.")
        if episode.digest() != self._attribute(group, "digest", str):
            raise BadInput(f"{self.path}: the arrays of {group.name[1:]} do not match its digest: they were modified.")
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
        check_array(stored, self._place(group, key))
        return stored

    def _array(
        self,
        group: h5py.Group,
        key: str,
        shape: tuple[int | None, ...],
        kind: type = np.float32,
        unknown: bool = False,
    ) -> NDArray[Any]:
        """A validated array. unknown: whether values may be NaN."""
        array, place = self._stored(group, key)[()], self._place(group, key)
        fits = np.ndim(array) == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
        if not fits:
            expected = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
            raise BadInput(f"{place} has shape {np.shape(array)}, expected {expected}.")
        if array.dtype != kind:
            raise BadInput(f"{place} is {array.dtype}, expected {np.dtype(kind)}.")
        invalid = np.isinf(array) if unknown else ~np.isfinite(array)
        if invalid.any():
            at = tuple(np.argwhere(invalid)[0])
            raise BadInput(f"{place} is {array[at]} at step {at[0]}, expected finite numbers.")
        return np.asarray(array)

    def _place(self, group: h5py.Group, key: str) -> str:
        return f"{self.path}: {key!r} of {group.name[1:]}"


def _reduce(data: Dataset) -> tuple[Any, ...]:
    """For other processes, which open the file themselves."""
    return open_dataset, (data.path, data.task, bool(data.skipped))


for _kind in (EpisodeFile, MitPushDataset, PaperDataset):
    copyreg.pickle(_kind, _reduce)


def _combined(digests: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(digests).encode()).hexdigest()


def write_dataset(path: str | Path, task: Task, episodes: Iterable[Episode]) -> None:
    """Write episodes to a file, which is replaced atomically, and its index. The same episodes give the same bytes.

    Raises BadInput if the file cannot be written.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise BadInput(f"Folder {path.parent} does not exist: cannot write {path.name} there.")
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    summaries: list[EpisodeSummary] = []
    digests: list[str] = []
    try:
        with DeferredErrorFile(partial, "w+b") as output:
            with h5py.File(output, "w", libver=("v110", "v110")) as file:
                file.attrs["format"], file.attrs["version"], file.attrs["task"] = FORMAT, VERSION, task.name
                file.attrs["definition"] = json.dumps(task_to_json(task), sort_keys=True)
                for index, episode in enumerate(episodes):
                    group = file.create_group(f"trajectory{index}")
                    _write_episode(group, episode)
                    output.check()
                    summaries.append(
                        EpisodeSummary(
                            index=index,
                            steps=len(episode),
                            policy=str(episode.provenance.get("policy", "")),
                            split=episode.split,
                            seed=int(episode.seed),
                            contact_fraction=group.attrs["contact_fraction"],
                        )
                    )
                    digests.append(group.attrs["digest"])
            output.check()
        os.replace(partial, path)
        mark_readable(path)
        write_index(path, tuple(summaries), _combined(digests))
    except OSError as error:
        partial.unlink(missing_ok=True)  # before the free space is measured
        raise write_error(path, error) from None
    finally:
        partial.unlink(missing_ok=True)


def _write_episode(group: h5py.Group, episode: Episode) -> None:
    group.attrs["seed"] = episode.seed
    group.attrs["split"] = episode.split
    group.attrs["dt"] = episode.dt
    group.attrs["contact_fraction"] = float(episode.contact.mean())
    group.attrs["provenance"] = json.dumps(dict(episode.provenance), sort_keys=True)
    group.attrs["digest"] = episode.digest()
    arrays: dict[str, NDArray[Any]] = {"states": episode.states, "controls": episode.controls, "qpos": episode.qpos}
    arrays["contact"] = episode.contact.astype(np.uint8)
    arrays |= {f"observations/{key}": value for key, value in episode.observations.items()}
    arrays |= {f"covariates/{key}": value for key, value in episode.covariates.items()}
    arrays |= {} if episode.time is None else {"time": episode.time}
    for key, array in arrays.items():
        # One HDF5 element per step: the shuffle filter then orders the bytes of each pixel or component by time,
        # which makes the images a fifth smaller.
        if not array.size:
            group.create_dataset(key, data=array)  # no joint positions without replay
            continue
        element = np.dtype((array.dtype, array.shape[1:])) if array.ndim > 1 else array.dtype
        stored = group.create_dataset(
            key, (len(array),), element, chunks=(len(array),), compression="gzip", compression_opts=9, shuffle=True
        )
        stored[...] = array
