"""Reader of the MIT Push dataset (Yu et al., "More than a Million Ways to Be Pushed", IROS 2016).

A file is one push with ``object_pose``, ``tip_pose`` and ``ft_wrench``, each with its own timestamps. Pushes are
resampled to one rate, stitched into episodes and rendered by a camera.
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
from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.readers.hdf5_guard import HDF5_ERRORS, open_hdf5, read_error
from beliefscope.datasets.readers.hdf5_limits import read_array
from beliefscope.datasets.readers.push_real_task import (
    CAMERA,
    CENTRE,
    CONTACT_GAP,
    OUTLINES,
    gap,
    haptic_observations,
    render_images,
)
from beliefscope.datasets.simulation.ingredients import draw, finish, moved_camera
from beliefscope.datasets.simulation.simulate import hand_controls, path_controls
from beliefscope.datasets.task import Task
from beliefscope.datasets.text import plural

Array = NDArray[np.float64]

KEYS = ("object_pose", "tip_pose", "ft_wrench")
SECONDS = 2.5  # length of an episode: 45 steps at 18 Hz, as in the paper
FIELD_SECONDS = 8.0  # the same for tasks with ingredients, whose outages last 1 to 3 s
MIN_TRAIN, MIN_HELD_OUT = 200, 50  # episodes of a split, independent of the number of pushes
AREA = 0.125  # half side length of the square around CENTRE that contains the block's centre, m
MAX_GAP = 0.5  # s without a sample that is interpolated linearly
MAX_TIME, MAX_VALUE = 1e10, 1e6  # s since 1970; m, rad, N or N m
MAX_STEP = {"object_pose": (0.05, 0.5), "tip_pose": (0.05, np.inf)}
"""Key -> largest change of position (m) and yaw (rad) between samples. Larger changes are tracking failures."""


@dataclass(frozen=True)
class Push:
    """A push resampled to T steps at a constant rate.

    Attributes:
        poses: (T, 3) x, y (m) and unwrapped yaw (rad) of the block. tips: (T, 2) m.
        force: (T, 2) N and torque: (T,) N m about z, means over the step.
        shape: key of ``OUTLINES``. surface: material of the table. files: names of the source files.
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
        """Return a rigidly moved copy whose block starts at ``pose`` (3,)."""
        turn = pose[2] - self.poses[0, 2]
        c, s = np.cos(turn), np.sin(turn)
        rotated = np.array([[c, s], [-s, c]])  # multiplied from the right
        start = self.poses[0, :2]
        return replace(
            self,
            poses=np.column_stack([(self.poses[:, :2] - start) @ rotated + pose[:2], self.poses[:, 2] + turn]),
            tips=(self.tips - start) @ rotated + pose[:2],
            force=self.force @ rotated,
        )

    def append(self, other: Push) -> Push:
        """Append another push, moved to start at the final pose of this one."""
        other = other.moved(self.poses[-1])
        arrays: dict[str, Any] = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in _ARRAYS}
        return replace(self, **arrays, files=self.files + other.files)

    def first(self, steps: int) -> Push:
        """Return the first steps."""
        arrays: dict[str, Any] = {name: getattr(self, name)[:steps] for name in _ARRAYS}
        return replace(self, **arrays)


_ARRAYS = ("poses", "tips", "force", "torque")


def is_mit_push(path: Path) -> bool:
    """Whether a file is JSON, or HDF5 with one of ``KEYS`` at its root."""
    if path.suffix == ".json":
        return True
    try:
        with open_hdf5(path) as file:
            return any(key in file for key in KEYS)
    except HDF5_ERRORS:
        return False


def read_push(path: Path, rate: float) -> Push:
    """Read a JSON or HDF5 file and resample it to ``rate`` Hz over the common time range of its streams.

    Poses are interpolated linearly, with unwrapped yaw; force and torque are means over the step.

    Raises:
        BadInput: for an invalid file, key or value, a gap longer than 0.5 s, a jump of block or tip, or streams that do
            not overlap.
    """
    surface, shape = _parse_name(path)
    streams = {key: _validate(path, key, rows) for key, rows in _read(path).items()}
    begin = max(rows[0, 0] for rows in streams.values())
    end = min(rows[-1, 0] for rows in streams.values())
    if end - begin < 1 / rate:
        ranges = ", ".join(f"{key!r} {rows[0, 0]:.2f} to {rows[-1, 0]:.2f} s" for key, rows in streams.items())
        raise BadInput(f"{path}: the time ranges do not overlap: {ranges}; expected an overlap of {1 / rate:.2f} s.")
    times = begin + np.arange(int((end - begin) * rate) + 1) / rate
    pose, tip, wrench = (streams[key] for key in KEYS)
    yaw = np.unwrap(pose[:, 3])
    mean_wrench = _means(times, 1 / rate, wrench)
    return Push(
        poses=np.column_stack(
            [_interpolate(times, pose, 1), _interpolate(times, pose, 2), np.interp(times, pose[:, 0], yaw)]
        ),
        tips=np.column_stack([_interpolate(times, tip, 1), _interpolate(times, tip, 2)]),
        force=mean_wrench[:, :2],
        torque=mean_wrench[:, 2],
        shape=shape,
        surface=surface,
        files=(path.name,),
    )


def _interpolate(times: Array, rows: Array, column: int) -> Array:
    return np.interp(times, rows[:, 0], rows[:, column])


def _means(times: Array, step: float, rows: Array) -> Array:
    """(T, 3): means of the columns after the first over up to ``step`` s before each time."""
    clock = rows[:, 0]
    areas = np.diff(clock)[:, None] * (rows[1:, 1:] + rows[:-1, 1:]) / 2
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(areas, axis=0)])
    since = np.maximum(times - step, clock[0])
    width = times - since
    columns = []
    for column in range(3):
        area = np.interp(times, clock, integral[:, column]) - np.interp(since, clock, integral[:, column])
        now = _interpolate(times, rows, column + 1)
        columns.append(np.where(width > 1e-6, area / np.maximum(width, 1e-6), now))
    return np.column_stack(columns)


def _parse_name(path: Path) -> tuple[str, str]:
    """Surface and shape, which are stored only in the file name."""
    match = re.search(r"surface=([^_]+)_shape=([^_]+)_", path.name)
    if not match:
        raise BadInput(f"{path} is not named like a push: expected motion_surface=..._shape=..._...")
    if match[2] not in OUTLINES:
        raise BadInput(f"{path}: {unknown_name('shape', match[2], OUTLINES)}")
    return match[1], match[2]


def _read(path: Path) -> dict[str, object]:
    """Key -> rows, not validated."""
    try:
        if path.suffix == ".json":
            content = json.loads(path.read_bytes())
        else:
            with open_hdf5(path) as file:
                stored = {key: file.get(key) for key in KEYS}
                content = {
                    key: read_array(value, f"{path}: {key!r}")
                    for key, value in stored.items()
                    if isinstance(value, h5py.Dataset)
                }
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise BadInput(f"{path} is truncated or not JSON: {error}.") from None
    except BadInput:
        raise
    except HDF5_ERRORS as error:
        raise read_error(path, error) from None
    if not isinstance(content, Mapping):
        raise BadInput(f"{path} is not a JSON object with the keys {', '.join(KEYS)}.")
    missing = [key for key in KEYS if key not in content]
    if missing:
        raise BadInput(f"{path} has no {missing[0]!r}; expected the keys {', '.join(KEYS)}.")
    return {key: content[key] for key in KEYS}


def _validate(path: Path, key: str, rows: object) -> Array:
    """(N, 4) rows [time, a, b, c] with increasing times. Repeated and late rows are dropped."""
    place = f"{path}: {key!r}"
    try:
        fits = not isinstance(rows, np.ndarray) or rows.shape[1:] == (4,)  # or 64 MB of bytes become 512 MB of floats
        stream = np.asarray(rows if fits else (), float)
    except (TypeError, ValueError, OverflowError):
        stream = np.zeros(0)
    if stream.ndim != 2 or stream.shape[1] != 4:
        raise BadInput(f"{place} is not a list of rows of 4 numbers: time, x, y, angle.")
    invalid = ~(np.abs(stream) <= [MAX_TIME, MAX_VALUE, MAX_VALUE, MAX_VALUE])
    if invalid.any():
        row = int(np.argwhere(invalid)[0][0])
        raise BadInput(f"{place} is {stream[row].tolist()} in row {row}, expected finite numbers below {MAX_VALUE:g}.")
    clock = stream[:, 0]
    stream = stream[np.concatenate([[True], clock[1:] > np.maximum.accumulate(clock)[:-1]])] if len(clock) else stream
    if len(stream) < 2:
        raise BadInput(f"{place} has {plural(len(stream), 'row')} of different times, expected at least 2.")
    gaps = np.diff(stream[:, 0])
    at = int(gaps.argmax())
    if gaps[at] > MAX_GAP:
        after = f"after {stream[at, 0]:.2f} s"
        raise BadInput(f"{place} has a gap of {gaps[at]:.2f} s {after}, expected at most {MAX_GAP} s.")
    if key in MAX_STEP:
        _check_jumps(place, stream, *MAX_STEP[key])
    return stream


def _check_jumps(place: str, stream: Array, max_distance: float, max_turn: float) -> None:
    distance = np.linalg.norm(np.diff(stream[:, 1:3], axis=0), axis=1)
    turn = np.abs(np.diff(np.unwrap(stream[:, 3])))
    for change, limit, unit in ((distance, max_distance, "m"), (turn, max_turn, "rad")):
        at = int(change.argmax())
        if change[at] > limit:
            jump = f"jumps by {change[at]:.2g} {unit} after {stream[at, 0]:.2f} s"
            raise BadInput(f"{place} {jump}, expected at most {limit:g} {unit}.")


def stitch(pushes: Iterator[Push], steps: int, rng: Generator) -> Push:
    """Concatenate pushes to an episode of ``steps`` steps at a random pose on the table.

    Each push starts at the final block pose of the previous one, with tip and forces rotated accordingly; the tip jumps
    between pushes. The episode is rotated and moved at random: the block starts with a yaw of -90 to 90 degrees and
    stays within ``AREA`` of the centre. This assumes uniform friction of the table.
    """
    trajectory = next(pushes)
    while len(trajectory) < steps:
        trajectory = trajectory.append(next(pushes))
    trajectory = trajectory.first(steps).moved(np.array([0.0, 0.0, rng.uniform(-np.pi / 2, np.pi / 2)]))
    low, high = trajectory.poses[:, :2].min(0), trajectory.poses[:, :2].max(0)
    # An episode wider than the area is centred.
    margin = np.maximum(AREA - (high - low) / 2, 0.0)
    position = np.array(CENTRE) + rng.uniform(-margin, margin) - (low + high) / 2
    return trajectory.moved(np.array([*position, trajectory.poses[0, 2]]))


class MitPushDataset(Dataset):
    """Files of the MIT Push dataset as episodes of a ``push-real`` task.

    The split is the name of the file's folder, by default ``test``. Each split, shape and surface has 200 episodes
    (50 outside ``train``), or as many as are needed to use every push. Episodes depend on the files and the seed.
    Images are rendered on first access.
    """

    def __init__(self, path: Path, files: Sequence[Path], task: Task, skip_bad: bool = False, seed: int = 0) -> None:
        self.path, self.task, self._seed = path, task, seed
        rate, skipped = 1 / task.dt, []
        groups: dict[tuple[str, str, str], list[Push]] = defaultdict(list)
        for file in sorted(files):
            try:
                push = read_push(file, rate)
            except BadInput as error:
                if not skip_bad:
                    raise
                skipped.append(str(error))
                continue
            folder = file.absolute().parent.name
            groups[folder if folder in SPLITS else "test", push.shape, push.surface].append(push)
        if not groups:
            raise BadInput(f"{path} has no usable push. First error: {skipped[0]}")
        self.skipped = tuple(skipped)
        numbers = {split: count(SPLITS.index(split)) for split in SPLITS}
        steps = round((FIELD_SECONDS if task.ingredients else SECONDS) * rate)
        self._trajectories = [
            (split, push)
            for (split, *_), pushes in sorted(groups.items())
            for push in _trajectories(pushes, split, steps, _rng(seed, split, next(numbers[split])))
        ]
        self._contact = [gap(p.shape, p.poses, p.tips) < CONTACT_GAP for _, p in self._trajectories]
        self._built: dict[int, Episode] = {}
        self.summaries = tuple(
            EpisodeSummary(i, len(push), _policy(push), split, -1, float(self._contact[i].mean()))
            for i, (split, push) in enumerate(self._trajectories)
        )

    @cached_property
    def hash(self) -> str:
        digests = "\n".join(episode.digest() for episode in self)
        return hashlib.sha256(digests.encode()).hexdigest()

    def _episode(self, index: int) -> Episode:
        if index not in self._built:
            split, push = self._trajectories[index]
            self._built[index] = self._build(index, split, push, self._contact[index])
        return self._built[index]

    def _build(self, index: int, split: str, push: Push, contact: NDArray[np.bool_]) -> Episode:
        qpos = np.column_stack([push.poses, push.tips]).astype(np.float32)
        haptics = haptic_observations(push.tips, push.force, push.torque, contact)
        path, draws = haptics["effector_position"], draw(self.task, self._seed, index)
        episode = Episode(
            task=self.task,
            states=qpos[:, : len(self.task.components)],
            # The robot is stiff, so that the measured path of the tip stands for the commanded one.
            controls=path_controls(path) if draws else hand_controls(path, haptics["contact"]),
            observations={"image": render_images(push.shape, qpos, moved_camera(CAMERA, draws)), **haptics},
            contact=contact,
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
        return finish(self.task, episode, draws, {}) if draws else episode


def _policy(push: Push) -> str:
    return f"{push.shape} on {push.surface}"


def _rng(seed: int, split: str, number: int) -> Generator:
    """Generator for a split and the group's number within it, independent of the other splits."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(SPLITS.index(split), number)))


def _trajectories(pushes: Sequence[Push], split: str, steps: int, rng: Generator) -> Iterator[Push]:
    """Stitch episodes from shuffled pushes. All pushes are used before they are shuffled again."""
    used = 0

    def shuffled() -> Iterator[Push]:
        nonlocal used
        while True:
            for index in rng.permutation(len(pushes)):
                used += 1
                yield pushes[index]

    source, minimum = shuffled(), MIN_TRAIN if split == "train" else MIN_HELD_OUT
    for number in count():
        if number >= minimum and used >= len(pushes):
            return
        yield stitch(source, steps, rng)
