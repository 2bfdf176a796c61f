"""Episodes in Beliefscope's HDF5 layout (docs/data.md), validated when they are read."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.catalog import stored_task
from beliefscope.datasets.dataset import SPLITS, Dataset, EpisodeSummary
from beliefscope.datasets.episode import Episode, time_error
from beliefscope.datasets.episode_check import array_error
from beliefscope.datasets.episode_index import read_index, write_index
from beliefscope.datasets.episode_parts import STEPS_PER_PART, EpisodeParts
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.datasets.readers.hdf5_guard import HDF5_ERRORS, open_hdf5, read_error
from beliefscope.datasets.readers.hdf5_limits import check_array
from beliefscope.datasets.task import Task
from beliefscope.datasets.text import plural

FORMAT = "beliefscope-episodes"
VERSION = 1

T = TypeVar("T")


def is_episode_file(path: Path) -> bool:
    """Whether a file has the layout of this module, of any version."""
    if path.suffix == ".json":
        return False
    try:
        with open_hdf5(path) as file:
            return bool(file.attrs.get("format", "") == FORMAT)
    except (BadInput, *HDF5_ERRORS):
        return False


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
        digest = combined(self._attribute(group, "digest", str) for group in groups)
        if skip_bad:
            self._names = [group.name for group in groups]
        else:
            write_index(self.path, summaries, digest)
        return summaries, digest

    def _episode(self, index: int) -> Episode:
        return self._checked(self._read, self._group(index))

    def in_parts(self, index: int) -> Episode | EpisodeParts:
        """An episode that is stored in chunks of steps is read in parts."""
        self._check_index(index)
        group = self._group(index)
        steps = self._summary(group, 0).steps
        if steps <= STEPS_PER_PART or any(
            (self._stored(group, name).chunks or (0,))[0] > STEPS_PER_PART for name in ("states", *self._observed())
        ):
            return self[index]
        return EpisodeParts(
            steps,
            partial(self._checked, self._read, group),
            lambda name, rows: self._stored(group, name)[rows],
            self._attribute(group, "digest", str),
            f"{group.name[1:]} in {self.path}",
        )

    def _observed(self) -> list[str]:
        return [f"observations/{key}" for key in self.task.observations]

    def _group(self, index: int) -> h5py.Group:
        name = f"trajectory{index}" if self._names is None else self._names[index]
        try:
            group = self._file.get(name)
        except HDF5_ERRORS as error:
            raise read_error(self.path, error) from None
        if not isinstance(group, h5py.Group):
            raise BadInput(f"{self.path}: {name} is not a group.")
        return group

    def _checked(self, read: Callable[..., Episode], *args: Any) -> Episode:
        """Call a function that reads. Errors of HDF5 are raised as BadInput."""
        try:
            return read(*args)
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
                f"{self.path} is an HDF5 file, but not a data set: its attribute 'format' is {format_!r}, "
                f"expected {FORMAT!r}."
            )
        version = self._file.attrs.get("version")
        if version != VERSION:
            raise BadInput(f"{self.path} has version {version} of the layout; this release reads version {VERSION}.")
        try:
            definition = self._file.attrs.get("definition")
            name = str(self._file.attrs.get("task"))
            document = name if definition is None else read_json(definition)
        except (TypeError, ValueError) as error:
            raise BadInput(f"{self.path}: the attribute 'definition' is not the JSON of a task: {error}") from None
        try:
            return stored_task(document, given)
        except (TypeError, ValueError) as error:
            raise BadInput(f"{self.path}: {error}") from None

    def _find_groups(self) -> list[h5py.Group]:
        count = sum(1 for name in self._file if name.startswith("trajectory"))
        if not count:
            raise BadInput(f"{self.path} has no episode; expected groups 'trajectory0', 'trajectory1', ...")
        groups = [self._file.get(f"trajectory{i}") for i in range(count)]
        for i, group in enumerate(groups):
            if not isinstance(group, h5py.Group):
                raise BadInput(f"{self.path} has {plural(count, 'episode')}, but no group 'trajectory{i}'.")
        return groups

    def _usable_groups(self) -> list[h5py.Group]:
        """Groups that can be read completely; the others are skipped."""
        groups, skipped = [], []
        for name in sorted((n for n in self._file if n.startswith("trajectory")), key=lambda n: (len(n), n)):
            try:
                group = self._file.get(name)
                if not isinstance(group, h5py.Group):
                    raise BadInput(f"{self.path}: {name} is not a group.")
                self._checked(self._read, group)
            except (BadInput, *HDF5_ERRORS) as error:
                skipped.append(str(error if isinstance(error, BadInput) else read_error(self.path, error)))
                continue
            groups.append(group)
        if not groups:
            raise BadInput(f"{self.path} has no usable episode." + (f" First error: {skipped[0]}" if skipped else ""))
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

    def _read(self, group: h5py.Group, rows: slice = slice(None)) -> Episode:
        """An episode, or a part of it, whose digest is not checked."""
        task, summary, provenance = self.task, self._summary(group, 0), self._provenance(group)
        steps, dt = len(range(summary.steps)[rows]), self._attribute(group, "dt", float)
        array = partial(self._array, group, rows)
        # Converted external files record their own time step in the provenance.
        if not math.isclose(dt, task.dt) and dt != provenance.get("recorded_dt"):
            raise BadInput(f"{self._place(group, 'dt')} is {dt} s; task {task.name!r} has steps of {task.dt} s.")
        episode = Episode(
            task=task,
            states=array("states", (steps, len(task.components))),
            controls=array("controls", (steps, task.control_size)),
            observations={
                key: array(f"observations/{key}", (steps, *shape), task.dtype(key))
                for key, shape in task.observations.items()
            },
            contact=array("contact", (steps,), np.uint8).astype(bool),
            qpos=array("qpos", (steps, None)),
            dt=dt,
            seed=summary.seed,
            split=summary.split,
            provenance=provenance,
            covariates={
                name: array(f"covariates/{name}", (steps,), unknown=True)
                for name in task.covariates
                if f"covariates/{name}" in group
            },
            time=array("time", (steps,), np.float64) if "time" in group else None,
        )
        if episode.time is not None and (error := time_error(episode.time)):
            raise BadInput(f"{self._place(group, 'time')} {error}.")
        if rows == slice(None) and episode.digest() != self._attribute(group, "digest", str):
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
        rows: slice,
        key: str,
        shape: tuple[int | None, ...],
        kind: type = np.float32,
        unknown: bool = False,
    ) -> NDArray[Any]:
        """Some rows of an array, validated. unknown: whether values may be NaN."""
        array, place = self._stored(group, key)[rows], self._place(group, key)
        if error := array_error(array, shape, kind, unknown):
            raise BadInput(f"{place} {error}.")
        return np.asarray(array)

    def _place(self, group: h5py.Group, key: str) -> str:
        return f"{self.path}: {key!r} of {group.name[1:]}"


def combined(digests: Iterable[str]) -> str:
    """Hash of a dataset from the digests of its episodes."""
    return hashlib.sha256("\n".join(digests).encode()).hexdigest()
