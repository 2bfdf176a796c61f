"""Reader of the HDF5 files used by the authors of the paper.

One group per trajectory (``trajectory0``, ...), one array per key, time first. See docs/data.md.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

import beliefscope
from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.dataset import SPLITS, Dataset, EpisodeSummary
from beliefscope.datasets.episode import Episode, FloatArray
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.readers.hdf5_guard import HDF5_ERRORS, error_message, open_hdf5, read_error
from beliefscope.datasets.readers.hdf5_limits import read_array
from beliefscope.datasets.readers.push_real_task import RATE, haptic_observations
from beliefscope.datasets.simulation.simulate import hand_controls

Arrays = Mapping[str, NDArray[Any]]

KLOSS_VAL_SIZE = 50  # trajectories of kloss_val, as in the paper


@dataclass(frozen=True)
class Layout:
    """A file layout of the authors.

    Attributes:
        task: name of the task. keys: key -> shape per step. dt: seconds per step.
        state: arrays -> (T, n) states in the order of the task.
        contact: arrays -> (T,) ground truth of contact between robot and object.
        haptics: arrays -> haptic observations.
        gray: values of black and white; None: from the range of the file's images.
    """

    task: str
    keys: Mapping[str, tuple[int, ...]]
    dt: float
    state: Callable[[Arrays], NDArray[Any]]
    contact: Callable[[Arrays], NDArray[Any]]
    haptics: Callable[[Arrays], dict[str, FloatArray]]
    gray: tuple[float, float] | None = None


def _door_haptics(data: Arrays) -> dict[str, FloatArray]:
    return {
        "effector_position": data["eef_pos"],
        "force": data["ee-force-obs"],
        "torque": data["ee-torque-obs"],
        "contact": data["contact-obs"][:, None],
    }


def _push_haptics(data: Arrays) -> dict[str, FloatArray]:
    return {
        "effector_position": data["eef_pos"],
        "force": data["force"][:, :3],
        "torque": data["force"][:, 3:],
        "contact": data["contact"][:, None],
    }


def _real_haptics(data: Arrays) -> dict[str, FloatArray]:
    return haptic_observations(data["tip"][:, [0, 2]], data["force"][:, :2], data["force"][:, 2], data["contact"] > 0.5)


LAYOUTS = (
    Layout(
        task="door",
        keys={
            "object-state": (5,),  # contact, angle, angular velocity, hinge x, hinge y
            "eef_pos": (3,),
            "ee-force-obs": (3,),
            "ee-torque-obs": (3,),
            "contact-obs": (),
            "image": (64, 64),
        },
        dt=0.05,
        state=lambda data: data["object-state"][:, [3, 4, 1]],
        contact=lambda data: data["object-state"][:, 0] > 0.5,
        haptics=_door_haptics,
        gray=(-1.0, 1.0),
    ),
    Layout(
        task="push",
        keys={"Cylinder0_pos": (3,), "eef_pos": (3,), "force": (6,), "contact": (), "image": (32, 32)},
        dt=0.1,
        state=lambda data: data["Cylinder0_pos"][:, :2],
        contact=lambda data: data["contact"] > 0.5,
        haptics=_push_haptics,
    ),
    Layout(
        task="push-real",
        keys={"pos": (3,), "tip": (3,), "force": (3,), "contact": (), "image": (32, 32, 3)},
        dt=1 / RATE,
        state=lambda data: data["pos"][:, [0, 2]],
        contact=lambda data: data["contact"] > 0.5,
        haptics=_real_haptics,
    ),
)


def is_paper_file(path: Path) -> bool:
    """Whether a file is HDF5 without a ``format`` attribute and has a trajectory of a known layout."""
    try:
        with open_hdf5(path) as file:
            return "format" not in file.attrs and _layout(file) is not None
    except HDF5_ERRORS:
        return False


def _layout(file: h5py.File) -> Layout | None:
    """The layout that shares the most keys, at least two, with the first trajectory."""
    names = _trajectories(file)
    keys = set(file[names[0]]) if names and isinstance(file[names[0]], h5py.Group) else set()
    best = max(LAYOUTS, key=lambda layout: len(keys & set(layout.keys)))
    return best if len(keys & set(best.keys)) > 1 else None


def _trajectories(file: h5py.File) -> list[str]:
    return sorted((name for name in file if re.fullmatch(r"trajectory\d+", name)), key=lambda name: int(name[10:]))


@dataclass(frozen=True)
class _Source:
    """A trajectory, its file and the file's values of black and white."""

    path: Path
    group: h5py.Group
    gray: tuple[float, float]

    @property
    def place(self) -> str:
        return f"{self.path}: {self.group.name[1:]}"


class PaperDataset(Dataset):
    """Files of one layout as a dataset. Opening reads the contact flags; ``[i]`` reads a trajectory.

    The split is the name of the file's folder; otherwise ``test`` for names like ``..._10.hdf5``, ``val`` for names
    that contain it, else ``train``.
    """

    def __init__(self, path: Path, files: Sequence[Path], skip_bad: bool = False) -> None:
        self.path = path
        self._open = ExitStack()
        try:
            self._layout, sources = self._open_files(files)
            self.task = find_task(self._layout.task)
            usable: list[_Source] = []
            skipped: list[str] = []
            summaries: list[EpisodeSummary] = []
            for source in sources:
                try:
                    if skip_bad:
                        self._read(source)
                    summaries.append(self._summary(len(usable), source))
                except BadInput as error:
                    if not skip_bad:
                        raise
                    skipped.append(str(error))
                    continue
                usable.append(source)
            if not usable:
                raise BadInput(f"{path} has no usable episode. First error: {skipped[0]}")
            self._sources, self.summaries, self.skipped = usable, tuple(summaries), tuple(skipped)
        except BaseException:
            self.close()
            raise

    @cached_property
    def hash(self) -> str:
        return hashlib.sha256("\n".join(episode.digest() for episode in self).encode()).hexdigest()

    def close(self) -> None:
        self._open.close()

    def _open_files(self, paths: Sequence[Path]) -> tuple[Layout, list[_Source]]:
        layouts: dict[str, tuple[Layout, Path]] = {}
        sources = []
        for path in paths:
            try:
                file = self._open.enter_context(open_hdf5(path))
                layout, names = _layout(file), _trajectories(file)
                groups = [file[name] for name in names]
            except BadInput:
                raise
            except HDF5_ERRORS as error:
                raise read_error(path, error) from None
            if layout is None:
                keys = ", ".join("/".join(layout.keys) for layout in LAYOUTS)
                raise BadInput(f"{path} has no episode of a known layout; expected the keys {keys}.")
            layouts.setdefault(layout.task, (layout, path))
            if len(layouts) > 1:
                (task, (_, first)), (other, (_, second)) = layouts.items()
                raise BadInput(f"{first} is of task {task!r}, {second} of {other!r}: give files of one task.")
            gray = layout.gray or _gray(path, groups[0])
            limit = KLOSS_VAL_SIZE if path.stem == "kloss_val" else None
            sources += [_Source(path, group, gray) for group in groups[:limit]]
        ((layout, _),) = layouts.values()
        return layout, sources

    def _summary(self, index: int, source: _Source) -> EpisodeSummary:
        layout = self._layout
        steps = len(self._array(source, next(iter(layout.keys)), None))
        data = {key: self._array(source, key, steps) for key in layout.keys if key in ("object-state", "contact")}
        fraction = float(layout.contact(data).mean())
        return EpisodeSummary(index, steps, _policy(source.path), _split(source.path), -1, fraction)

    def _episode(self, index: int) -> Episode:
        return self._read(self._sources[index])

    def _read(self, source: _Source) -> Episode:
        layout = self._layout
        first = next(iter(layout.keys))
        steps = len(self._array(source, first, None))
        data = {key: self._array(source, key, steps) for key in layout.keys}
        haptics = {key: np.ascontiguousarray(v, np.float32) for key, v in layout.haptics(data).items()}
        return Episode(
            task=self.task,
            states=np.ascontiguousarray(layout.state(data), np.float32),
            controls=hand_controls(haptics["effector_position"], haptics["contact"]),
            observations={"image": _to_bytes(source, data["image"]), **haptics},
            contact=layout.contact(data),
            qpos=np.zeros((steps, 0), np.float32),
            dt=layout.dt,
            seed=-1,
            split=_split(source.path),
            provenance={
                "policy": _policy(source.path),
                "source": source.path.name,
                "trajectory": source.group.name[1:],
                "recorded_dt": layout.dt,
                "beliefscope": beliefscope.__version__,
            },
        )

    def _array(self, source: _Source, key: str, steps: int | None) -> NDArray[Any]:
        """Read and validate an array (T, ...) float32; ``steps`` None accepts any T of at least 1."""
        shape = self._layout.keys[key]
        try:
            stored = source.group.get(key) if isinstance(source.group, h5py.Group) else None
        except HDF5_ERRORS as error:
            raise BadInput(f"{source.place}: {key!r} cannot be read: {error_message(error)}.") from None
        if not isinstance(stored, h5py.Dataset):
            keys = ", ".join(self._layout.keys)
            raise BadInput(f"{source.place} has no {key!r}; expected the keys {keys}.")
        place = f"{source.path}: {key!r} of {source.group.name[1:]}"
        expected = f"({'T' if steps is None else steps}{''.join(f', {n}' for n in shape)}{',' if not shape else ''})"
        if stored.shape is None or stored.shape[1:] != shape or not stored.shape or not stored.shape[0]:
            raise BadInput(f"{place} has shape {stored.shape}, expected {expected}.")
        if steps is not None and len(stored) != steps:
            first = next(iter(self._layout.keys))
            raise BadInput(f"{place} has {len(stored)} steps, {first!r} has {steps}; expected the same number.")
        try:
            array = np.asarray(read_array(stored, place), np.float32)
        except BadInput:
            raise
        except HDF5_ERRORS as error:
            raise BadInput(f"{place} cannot be read: {error_message(error)}.") from None
        if not np.isfinite(array).all():
            at = np.argwhere(~np.isfinite(array))[0]
            raise BadInput(f"{place} is {array[tuple(at)]} at step {at[0]}, expected finite numbers.")
        return array


def _to_bytes(source: _Source, image: NDArray[Any]) -> NDArray[np.uint8]:
    """(T, 32, 32) uint8: every second pixel of 64 x 64 images, mean of the colours."""
    (black, white), low, high = source.gray, float(image.min()), float(image.max())
    if low < black or high > white:
        raise BadInput(
            f"{source.path}: 'image' of {source.group.name[1:]} ranges from {low:g} to {high:g}, "
            f"expected {black:g} (black) to {white:g} (white)."
        )
    gray = image.mean(-1) if image.ndim == 4 else image
    gray = gray[:, ::2, ::2] if gray.shape[1] == 64 else gray
    return np.rint((gray - black) * (255 / (white - black))).astype(np.uint8)


def _gray(path: Path, group: h5py.Group) -> tuple[float, float]:
    """Values of black and white from the range of a trajectory's images: -1 to 1, 0 to 1, or 0 to 255."""
    place = f"{path}: 'image' of {group.name[1:]}"
    try:
        stored = group.get("image")
        if not isinstance(stored, h5py.Dataset) or not stored.size:
            return 0.0, 255.0
        values = read_array(stored, place)
    except BadInput:
        raise
    except HDF5_ERRORS as error:
        raise BadInput(f"{place} cannot be read: {error_message(error)}.") from None
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if low < 0:
        return -1.0, 1.0
    return (0.0, 1.0) if high <= 1 else (0.0, 255.0)


def _split(path: Path) -> str:
    folder = path.absolute().parent.name
    if folder in SPLITS:
        return folder
    return "test" if path.stem.endswith("_10") else "val" if "val" in path.stem else "train"


def _policy(path: Path) -> str:
    return "pull" if "pull" in path.stem else "push"
