"""Pushes of the MIT data set (Yu et al., "More than a Million Ways to Be Pushed", IROS 2016) as episodes.

A file is one push: ``object_pose``, ``tip_pose`` and ``ft_wrench``, each on a clock of its own. They are brought to one
rate, laid end to end into trajectories of 2.5 s, and seen by a camera.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any

import h5py
import mujoco
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

import beliefscope
from beliefscope.datasets.dataset import SPLITS, Dataset, EpisodeSummary
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.datasets.readers.hdf5_guard import DAMAGE, damaged, open_hdf5
from beliefscope.datasets.readers.hdf5_limits import numbers
from beliefscope.datasets.readers.push_real_task import CENTRE, OUTLINES, TOUCHING, gap, observed, pictures
from beliefscope.datasets.simulation.simulate import hand_controls
from beliefscope.datasets.task import Task

Array = NDArray[np.float64]

KEYS = ("object_pose", "tip_pose", "ft_wrench")
SECONDS = 2.5  # of a trajectory: 45 steps at 18 Hz, as in the paper
LEAST = {"train": 200}  # trajectories of a split, however few pushes there are
LEAST_HELD_OUT = 50
AREA = 0.125  # half the side of the square around CENTRE in which the block's centre stays, m
LONGEST_GAP = 0.5  # s without a row that is bridged by a straight line
LATEST, LARGEST = 1e10, 1e6  # s since 1970, and m, rad, N or N m: beyond these is no robot
LARGEST_STEP = {"object_pose": (0.05, 0.5), "tip_pose": (0.05, np.inf)}
"""Key -> what its place (m) and yaw (rad) change by from one row to the next, unless tracking was lost."""


@dataclass(frozen=True)
class Push:
    """What happened in T steps of a steady rate.

    Attributes:
        poses: (T, 3) the block's x, y (m) and yaw (rad, without jumps). tips: (T, 2) m.
        force: (T, 2) N, mean over the step. torque: (T,) about z, N m, likewise.
        shape: key of ``OUTLINES``. surface: what it is pushed over. files: the names of those it comes from.
    """

    poses: Array
    tips: Array
    force: Array
    torque: Array
    shape: str
    surface: str
    files: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.poses)

    def moved(self, pose: Array) -> Push:
        """The same, moved over the table as a whole so that it starts with the block at ``pose`` (3,)."""
        turn = pose[2] - self.poses[0, 2]
        c, s = np.cos(turn), np.sin(turn)
        rotated = np.array([[c, s], [-s, c]])  # from the right
        start = self.poses[0, :2]
        return replace(
            self,
            poses=np.column_stack([(self.poses[:, :2] - start) @ rotated + pose[:2], self.poses[:, 2] + turn]),
            tips=(self.tips - start) @ rotated + pose[:2],
            force=self.force @ rotated,
        )

    def then(self, other: Push) -> Push:
        """The other push after this one: it goes on with the block where this one left it."""
        other = other.moved(self.poses[-1])
        arrays: dict[str, Any] = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in _ARRAYS}
        return replace(self, **arrays, files=self.files + other.files)

    def first(self, steps: int) -> Push:
        """Its first steps."""
        arrays: dict[str, Any] = {name: getattr(self, name)[:steps] for name in _ARRAYS}
        return replace(self, **arrays)


_ARRAYS = ("poses", "tips", "force", "torque")


def is_mit(path: Path) -> bool:
    """Whether a file looks like one of these pushes: JSON, or HDF5 with one of the keys at its root."""
    if path.suffix == ".json":
        return True
    try:
        with open_hdf5(path) as file:
            return any(key in file for key in KEYS)
    except DAMAGE:
        return False


def read_push(path: Path, rate: float) -> Push:
    """One file, JSON or HDF5, resampled to ``rate`` Hz over the time that all its clocks share.

    Poses are interpolated linearly, yaw without its jumps by 2 pi; force and torque are means over the step.

    Raises:
        BadInput: where the file, a key or a value is not as it should be, a key has nothing for longer than 0.5 s, the
            block or the tip jumps, or the clocks do not overlap.
    """
    surface, shape = _named(path)
    streams = {key: _stream(path, key, rows) for key, rows in _content(path).items()}
    begin = max(rows[0, 0] for rows in streams.values())
    end = min(rows[-1, 0] for rows in streams.values())
    if end - begin < 1 / rate:
        clocks = ", ".join(f"{key!r} {rows[0, 0]:.2f} to {rows[-1, 0]:.2f} s" for key, rows in streams.items())
        raise BadInput(f"{path}: the clocks do not overlap: {clocks}; expected {1 / rate:.2f} s or more in common.")
    times = begin + np.arange(int((end - begin) * rate) + 1) / rate
    pose, tip, wrench = (streams[key] for key in KEYS)
    yaw = np.unwrap(pose[:, 3])
    felt = _means(times, 1 / rate, wrench)
    return Push(
        poses=np.column_stack([_at(times, pose, 1), _at(times, pose, 2), np.interp(times, pose[:, 0], yaw)]),
        tips=np.column_stack([_at(times, tip, 1), _at(times, tip, 2)]),
        force=felt[:, :2],
        torque=felt[:, 2],
        shape=shape,
        surface=surface,
        files=(path.name,),
    )


def _at(times: Array, rows: Array, column: int) -> Array:
    return np.interp(times, rows[:, 0], rows[:, column])


def _means(times: Array, step: float, rows: Array) -> Array:
    """(T, 3): means of the columns after the first over the ``step`` s before each time, or as much as there is."""
    clock = rows[:, 0]
    areas = np.diff(clock)[:, None] * (rows[1:, 1:] + rows[:-1, 1:]) / 2
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(areas, axis=0)])
    since = np.maximum(times - step, clock[0])
    width = times - since
    columns = []
    for column in range(3):
        area = np.interp(times, clock, integral[:, column]) - np.interp(since, clock, integral[:, column])
        now = _at(times, rows, column + 1)
        columns.append(np.where(width > 1e-6, area / np.maximum(width, 1e-6), now))
    return np.column_stack(columns)


def _named(path: Path) -> tuple[str, str]:
    """Surface and shape, which only the file's name tells."""
    found = re.search(r"surface=([^_]+)_shape=([^_]+)_", path.name)
    if not found:
        raise BadInput(f"{path} is not named as a push: expected motion_surface=..._shape=..._...")
    if found[2] not in OUTLINES:
        raise BadInput(f"{path}: {one_of('shape', found[2], OUTLINES)}")
    return found[1], found[2]


def _content(path: Path) -> dict[str, object]:
    """Key -> rows, unchecked."""
    try:
        if path.suffix == ".json":
            read = json.loads(path.read_bytes())
        else:
            with open_hdf5(path) as file:
                found = {key: file.get(key) for key in KEYS}
                read = {
                    key: numbers(stored, f"{path}: {key!r}")
                    for key, stored in found.items()
                    if isinstance(stored, h5py.Dataset)
                }
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise BadInput(f"{path} is not JSON or cut short: {error}.") from None
    except BadInput:
        raise
    except DAMAGE as error:
        raise damaged(path, error) from None
    if not isinstance(read, Mapping):
        raise BadInput(f"{path} is not a JSON object with the keys {', '.join(KEYS)}.")
    missing = [key for key in KEYS if key not in read]
    if missing:
        raise BadInput(f"{path} has no {missing[0]!r}; expected the keys {', '.join(KEYS)}.")
    return {key: read[key] for key in KEYS}


def _stream(path: Path, key: str, rows: object) -> Array:
    """(N, 4) rows [time, a, b, c] whose time grows. What the recorder wrote twice is kept once."""
    place = f"{path}: {key!r}"
    try:
        fits = not isinstance(rows, np.ndarray) or rows.shape[1:] == (4,)  # or 64 MB of bytes become 512 of floats
        stream = np.asarray(rows if fits else (), float)
    except (TypeError, ValueError, OverflowError):
        stream = np.zeros(0)
    if stream.ndim != 2 or stream.shape[1] != 4:
        raise BadInput(f"{place} is not a list of rows of 4 numbers, all as long as each other: time, x, y, angle.")
    wild = ~(np.abs(stream) <= [LATEST, LARGEST, LARGEST, LARGEST])
    if wild.any():
        row = int(np.argwhere(wild)[0][0])
        raise BadInput(f"{place} is {stream[row].tolist()} in row {row}, expected finite numbers below {LARGEST:g}.")
    clock = stream[:, 0]
    stream = stream[np.concatenate([[True], clock[1:] > np.maximum.accumulate(clock)[:-1]])] if len(clock) else stream
    if len(stream) < 2:
        raise BadInput(f"{place} has {len(stream)} rows of different times, expected at least 2.")
    wait = np.diff(stream[:, 0])
    at = int(wait.argmax())
    if wait[at] > LONGEST_GAP:
        after = f"after {stream[at, 0]:.2f} s"
        raise BadInput(f"{place} has nothing for {wait[at]:.2f} s {after}, expected {LONGEST_GAP} s at most.")
    if key in LARGEST_STEP:
        _check_tracked(place, stream, *LARGEST_STEP[key])
    return stream


def _check_tracked(place: str, stream: Array, farthest: float, largest_turn: float) -> None:
    distance = np.linalg.norm(np.diff(stream[:, 1:3], axis=0), axis=1)
    turn = np.abs(np.diff(np.unwrap(stream[:, 3])))
    for change, most, unit in ((distance, farthest, "m"), (turn, largest_turn, "rad")):
        at = int(change.argmax())
        if change[at] > most:
            jump = f"jumps by {change[at]:.2g} {unit} after {stream[at, 0]:.2f} s"
            raise BadInput(f"{place} {jump}, expected {most:g} {unit} at most.")


def stitch(pushes: Iterator[Push], steps: int, rng: Generator) -> Push:
    """Pushes end to end, ``steps`` steps in all, somewhere on the table.

    Each goes on with the block where the one before left it, tip and forces turned along; from one step to the next the
    tip is then elsewhere. The whole is turned and moved at random, so that the block starts with a yaw of -90 to 90
    degrees and stays within ``AREA`` of the centre: friction is taken to be the same all over the table.
    """
    whole = next(pushes)
    while len(whole) < steps:
        whole = whole.then(next(pushes))
    whole = whole.first(steps).moved(np.array([0.0, 0.0, rng.uniform(-np.pi / 2, np.pi / 2)]))
    low, high = whole.poses[:, :2].min(0), whole.poses[:, :2].max(0)
    # A block that travels farther than the area is wide has no room: its way is put in the middle.
    room = np.maximum(AREA - (high - low) / 2, 0.0)
    place = np.array(CENTRE) + rng.uniform(-room, room) - (low + high) / 2
    return whole.moved(np.array([*place, whole.poses[0, 2]]))


class MitPushes(Dataset):
    """Files of the MIT data set as a data set of one of the ``push-real`` tasks.

    A split is the name of the folder that a file lies in, ``test`` where that is none. Of each split, shape and surface
    there are 200 trajectories (50 outside ``train``), or as many as take every push once. They depend on the files and
    on the seed. Pictures are taken when an episode is first asked for.
    """

    def __init__(self, path: Path, files: Sequence[Path], task: Task, skip_bad: bool = False, seed: int = 0) -> None:
        self.path, self.task, self._seed = path, task, seed
        rate, left_out = 1 / task.dt, []
        groups: dict[tuple[str, str, str], list[Push]] = defaultdict(list)
        for file in sorted(files):
            try:
                push = read_push(file, rate)
            except BadInput as error:
                if not skip_bad:
                    raise
                left_out.append(str(error))
                continue
            folder = file.absolute().parent.name
            groups[folder if folder in SPLITS else "test", push.shape, push.surface].append(push)
        if not groups:
            raise BadInput(f"{path} has no push that can be used. The first: {left_out[0]}")
        self.left_out = tuple(left_out)
        numbers = {split: count(SPLITS.index(split)) for split in SPLITS}
        self._trajectories = [
            (split, push)
            for (split, *_), pushes in sorted(groups.items())
            for push in _trajectories(pushes, split, round(SECONDS * rate), _rng(seed, split, next(numbers[split])))
        ]
        self._touching = [gap(p.shape, p.poses, p.tips) < TOUCHING for _, p in self._trajectories]
        self._built: dict[int, Episode] = {}
        self.summaries = tuple(
            EpisodeSummary(i, len(push), _policy(push), split, -1, float(self._touching[i].mean()))
            for i, (split, push) in enumerate(self._trajectories)
        )

    @cached_property
    def hash(self) -> str:
        digests = "\n".join(episode.digest() for episode in self)
        return hashlib.sha256(digests.encode()).hexdigest()

    def _episode(self, index: int) -> Episode:
        if index not in self._built:
            split, push = self._trajectories[index]
            self._built[index] = self._build(index, split, push, self._touching[index])
        return self._built[index]

    def _build(self, index: int, split: str, push: Push, touching: NDArray[np.bool_]) -> Episode:
        qpos = np.column_stack([push.poses, push.tips]).astype(np.float32)
        haptics = observed(push.tips, push.force, push.torque, touching)
        return Episode(
            task=self.task.name,
            states=qpos[:, : len(self.task.components)],
            controls=hand_controls(haptics["effector_position"], haptics["contact"]),
            observations={"image": pictures(push.shape, qpos), **haptics},
            contact=touching,
            qpos=qpos,
            dt=self.task.dt,
            seed=-1,
            split=split,
            provenance={
                "policy": _policy(push),
                "source": "MIT pushing data set",
                "shape": push.shape,
                "surface": push.surface,
                "pushes": list(push.files),
                "stitching_seed": self._seed,
                "trajectory": index,
                "beliefscope": beliefscope.__version__,
                "mujoco": mujoco.__version__,
            },
        )


def _policy(push: Push) -> str:
    return f"{push.shape} on {push.surface}"


def _rng(seed: int, split: str, number: int) -> Generator:
    """By split and number within it, so that a split is the same alone and beside others."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(SPLITS.index(split), number)))


def _trajectories(pushes: Sequence[Push], split: str, steps: int, rng: Generator) -> Iterator[Push]:
    """Pushes are dealt from a shuffled pack, and it is shuffled again when it is empty: each is used equally often."""
    dealt = 0

    def deal() -> Iterator[Push]:
        nonlocal dealt
        while True:
            for index in rng.permutation(len(pushes)):
                dealt += 1
                yield pushes[index]

    pack, least = deal(), LEAST.get(split, LEAST_HELD_OUT)
    for number in count():
        if number >= least and dealt >= len(pushes):
            return
        yield stitch(pack, steps, rng)
