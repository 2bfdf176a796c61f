"""Readers of the HDF5 files that the paper's authors trained and measured on, for who has them.

One group a trajectory (``trajectory0``, ...), one array a key, time first. See docs/data.md.
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
from beliefscope.datasets.readers.hdf5_guard import DAMAGE, damaged, open_hdf5, reason
from beliefscope.datasets.readers.hdf5_limits import numbers
from beliefscope.datasets.readers.push_real_task import RATE, observed
from beliefscope.datasets.simulation.simulate import hand_controls

Arrays = Mapping[str, NDArray[Any]]

VALIDATION_USED = 50  # trajectories of kloss_val, as in the paper


@dataclass(frozen=True)
class Layout:
    """One of their kinds of file.

    Attributes:
        task: ours that it belongs to. keys: key -> shape of one step. dt: s a step.
        state: (T, n) in our order. touching: (T,) whether the robot truly touched the object.
        haptics: our observations but the picture.
        gray: values of black and white; None where they are told by the pictures of the file.
    """

    task: str
    keys: Mapping[str, tuple[int, ...]]
    dt: float
    state: Callable[[Arrays], NDArray[Any]]
    touching: Callable[[Arrays], NDArray[Any]]
    haptics: Callable[[Arrays], dict[str, FloatArray]]
    gray: tuple[float, float] | None = None


def _door_haptics(of: Arrays) -> dict[str, FloatArray]:
    return {
        "effector_position": of["eef_pos"],
        "force": of["ee-force-obs"],
        "torque": of["ee-torque-obs"],
        "contact": of["contact-obs"][:, None],
    }


def _push_haptics(of: Arrays) -> dict[str, FloatArray]:
    return {
        "effector_position": of["eef_pos"],
        "force": of["force"][:, :3],
        "torque": of["force"][:, 3:],
        "contact": of["contact"][:, None],
    }


def _real_haptics(of: Arrays) -> dict[str, FloatArray]:
    return observed(of["tip"][:, [0, 2]], of["force"][:, :2], of["force"][:, 2], of["contact"] > 0.5)


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
        state=lambda of: of["object-state"][:, [3, 4, 1]],
        touching=lambda of: of["object-state"][:, 0] > 0.5,
        haptics=_door_haptics,
        gray=(-1.0, 1.0),
    ),
    Layout(
        task="push",
        keys={"Cylinder0_pos": (3,), "eef_pos": (3,), "force": (6,), "contact": (), "image": (32, 32)},
        dt=0.1,
        state=lambda of: of["Cylinder0_pos"][:, :2],
        touching=lambda of: of["contact"] > 0.5,
        haptics=_push_haptics,
    ),
    Layout(
        task="push-real",
        keys={"pos": (3,), "tip": (3,), "force": (3,), "contact": (), "image": (32, 32, 3)},
        dt=1 / RATE,
        state=lambda of: of["pos"][:, [0, 2]],
        touching=lambda of: of["contact"] > 0.5,
        haptics=_real_haptics,
    ),
)


def is_authors(path: Path) -> bool:
    """Whether a file looks like one of theirs: HDF5, without a format of ours, with a trajectory and keys of theirs."""
    try:
        with open_hdf5(path) as file:
            return "format" not in file.attrs and _layout(file) is not None
    except DAMAGE:
        return False


def _layout(file: h5py.File) -> Layout | None:
    """The layout most of whose keys the first trajectory has, at least two."""
    names = _trajectories(file)
    found = set(file[names[0]]) if names and isinstance(file[names[0]], h5py.Group) else set()
    best = max(LAYOUTS, key=lambda layout: len(found & set(layout.keys)))
    return best if len(found & set(best.keys)) > 1 else None


def _trajectories(file: h5py.File) -> list[str]:
    return sorted((name for name in file if re.fullmatch(r"trajectory\d+", name)), key=lambda name: int(name[10:]))


@dataclass(frozen=True)
class _Source:
    """A trajectory: where it is, and which values are black and white in its file."""

    path: Path
    group: h5py.Group
    gray: tuple[float, float]

    @property
    def place(self) -> str:
        return f"{self.path}: {self.group.name[1:]}"


class AuthorsFiles(Dataset):
    """One file of theirs, or several of one kind joined. Opening reads contacts; ``[i]`` reads one trajectory.

    A split is the name of the folder that a file lies in; else ``test`` for a file of 10 (``..._10.hdf5``), ``val``
    where its name says so, and ``train``.
    """

    def __init__(self, path: Path, files: Sequence[Path], skip_bad: bool = False) -> None:
        self.path = path
        self._open = ExitStack()
        try:
            self._layout, sources = self._open_files(files)
            self.task = find_task(self._layout.task)
            usable: list[_Source] = []
            left_out: list[str] = []
            summaries: list[EpisodeSummary] = []
            for source in sources:
                try:
                    if skip_bad:
                        self._read(source)
                    summaries.append(self._summary(len(usable), source))
                except BadInput as error:
                    if not skip_bad:
                        raise
                    left_out.append(str(error))
                    continue
                usable.append(source)
            if not usable:
                raise BadInput(f"{path} holds no trajectory that can be used. The first: {left_out[0]}")
            self._sources, self.summaries, self.left_out = usable, tuple(summaries), tuple(left_out)
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
            except DAMAGE as error:
                raise damaged(path, error) from None
            if layout is None:
                known = ", ".join("/".join(layout.keys) for layout in LAYOUTS)
                raise BadInput(f"{path} holds no trajectory of a known layout; expected the keys {known}.")
            layouts.setdefault(layout.task, (layout, path))
            if len(layouts) > 1:
                (one, (_, first)), (other, (_, second)) = layouts.items()
                raise BadInput(f"{first} is of task {one!r}, {second} of {other!r}: give files of one task.")
            gray = layout.gray or _gray(path, groups[0])
            used = groups[:VALIDATION_USED] if path.stem == "kloss_val" else groups
            sources += [_Source(path, group, gray) for group in used]
        ((layout, _),) = layouts.values()
        return layout, sources

    def _summary(self, index: int, source: _Source) -> EpisodeSummary:
        layout = self._layout
        steps = len(self._array(source, next(iter(layout.keys)), None))
        sensed = {key: self._array(source, key, steps) for key in layout.keys if key in ("object-state", "contact")}
        fraction = float(layout.touching(sensed).mean())
        return EpisodeSummary(index, steps, _policy(source.path), _split(source.path), -1, fraction)

    def _episode(self, index: int) -> Episode:
        return self._read(self._sources[index])

    def _read(self, source: _Source) -> Episode:
        layout = self._layout
        first = next(iter(layout.keys))
        steps = len(self._array(source, first, None))
        of = {key: self._array(source, key, steps) for key in layout.keys}
        haptics = {key: np.ascontiguousarray(v, np.float32) for key, v in layout.haptics(of).items()}
        return Episode(
            task=layout.task,
            states=np.ascontiguousarray(layout.state(of), np.float32),
            controls=hand_controls(haptics["effector_position"], haptics["contact"]),
            observations={"image": _picture(source, of["image"]), **haptics},
            contact=layout.touching(of),
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
        """(T, ...) float32, checked; ``steps`` None takes any T of at least 1."""
        shape = self._layout.keys[key]
        try:
            stored = source.group.get(key) if isinstance(source.group, h5py.Group) else None
        except DAMAGE as error:
            raise BadInput(f"{source.place}: {key!r} cannot be read: {reason(error)}.") from None
        if not isinstance(stored, h5py.Dataset):
            expected = ", ".join(self._layout.keys)
            raise BadInput(f"{source.place} has no {key!r}; expected the keys {expected}.")
        place = f"{source.path}: {key!r} of {source.group.name[1:]}"
        wanted = f"({'T' if steps is None else steps}{''.join(f', {n}' for n in shape)}{',' if not shape else ''})"
        if stored.shape is None or stored.shape[1:] != shape or not stored.shape or not stored.shape[0]:
            raise BadInput(f"{place} has shape {stored.shape}, expected {wanted}.")
        if steps is not None and len(stored) != steps:
            first = next(iter(self._layout.keys))
            raise BadInput(f"{place} has {len(stored)} steps, {first!r} has {steps}; expected as many.")
        try:
            array = np.asarray(numbers(stored, place), np.float32)
        except BadInput:
            raise
        except DAMAGE as error:
            raise BadInput(f"{place} cannot be read: {reason(error)}.") from None
        if not np.isfinite(array).all():
            at = np.argwhere(~np.isfinite(array))[0]
            raise BadInput(f"{place} is {array[tuple(at)]} at step {at[0]}, expected finite numbers.")
        return array


def _picture(source: _Source, image: NDArray[Any]) -> NDArray[np.uint8]:
    """(T, 32, 32) uint8: every second pixel of a larger picture, the mean of colours."""
    (black, white), low, high = source.gray, float(image.min()), float(image.max())
    if low < black or high > white:
        raise BadInput(
            f"{source.path}: 'image' of {source.group.name[1:]} goes from {low:g} to {high:g}, "
            f"expected {black:g} (black) to {white:g} (white)."
        )
    gray = image.mean(-1) if image.ndim == 4 else image
    gray = gray[:, ::2, ::2] if gray.shape[1] == 64 else gray
    return np.rint((gray - black) * (255 / (white - black))).astype(np.uint8)


def _gray(path: Path, group: h5py.Group) -> tuple[float, float]:
    """Values of black and white by the range of one trajectory's pictures: -1 to 1, 0 to 1, or 0 to 255."""
    place = f"{path}: 'image' of {group.name[1:]}"
    try:
        stored = group.get("image")
        if not isinstance(stored, h5py.Dataset) or not stored.size:
            return 0.0, 255.0
        values = numbers(stored, place)
    except BadInput:
        raise
    except DAMAGE as error:
        raise BadInput(f"{place} cannot be read: {reason(error)}.") from None
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
