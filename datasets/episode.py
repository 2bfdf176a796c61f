"""A recorded episode as NumPy arrays in SI units."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.task import Task

FloatArray = NDArray[np.float32]

MISSED = 2
"""Typical intervals between readings without one that are an outage: more than one missed reading."""

_MISSING: Any = np.zeros(0)


def _missing() -> Any:
    return _MISSING


def _single(array: NDArray[Any]) -> NDArray[Any]:
    return array.astype(np.float32) if array.dtype == np.float64 else array


@dataclass(frozen=True)
class Episode:
    """An episode of T steps. The first axis of every array is time.

    Attributes:
        task: definition of the state, the sensors and the control.
        states: (T, n) true state, components as in ``Task.components`` (m, rad), or with quaternions
            (``Task.states``); float32.
        controls: (T, c) control applied between steps t-1 and t, float32; default: none (c is 0).
        observations: observation key -> (T, ...) sensor readings, uint8 images and float32 (``Task.dtype``).
        contact: (T,) bool, ground truth of contact between robot and object; default: False.
        qpos: (T, nq) joint positions for replay, float32; default: no replay (nq is 0).
        dt: seconds per step; default: that of the task. With ``time``, the typical one.
        seed: seed of the simulation, or -1 for recorded data.
        split: ``train``, ``val`` or ``test``.
        covariates: name -> (T,) float32, values of the task's covariates except contact; NaN where unknown.
        provenance: JSON values: origin and replay parameters (hinge position, policy, versions).
        time: (T,) float64 s since the first step, ascending; None: steps times ``dt``.
        first_duration: s since the step before the first one, of a part of an episode with ``time``; 0: ``dt``.
    """

    task: Task
    states: FloatArray
    controls: FloatArray = field(default_factory=_missing)
    observations: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    contact: NDArray[np.bool_] = field(default_factory=_missing)
    qpos: FloatArray = field(default_factory=_missing)
    dt: float = 0.0
    seed: int = -1
    split: str = "train"
    provenance: Mapping[str, Any] = field(default_factory=dict)
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)
    time: NDArray[np.float64] | None = None
    first_duration: float = 0.0

    def __post_init__(self) -> None:
        """Fill in the defaults, and convert floating-point arrays to float32."""
        steps = len(self.states)
        contact = self.covariates.get("contact")
        in_contact = np.zeros(steps, bool) if contact is None else np.asarray(contact, np.float64) > 0.5
        absent = {"contact": in_contact, "controls": np.zeros((steps, 0)), "qpos": np.zeros((steps, 0))}
        values: dict[str, Any] = {name: array for name, array in absent.items() if getattr(self, name) is _MISSING}
        values |= {} if self.dt else {"dt": self.task.dt}
        values["states"] = self.task.states(self.states)
        for name in ("states", "controls", "qpos"):
            values[name] = _single(values.get(name, getattr(self, name)))
        for name in ("observations", "covariates"):
            mapping = getattr(self, name)
            if any(array.dtype == np.float64 for array in mapping.values()):
                values[name] = {key: _single(array) for key, array in mapping.items()}
        for name, value in values.items():
            object.__setattr__(self, name, value)  # episodes are frozen

    def covariate(self, name: str) -> FloatArray:
        """(T,) values of one of the task's covariates; NaN where unknown."""
        if name == "contact":
            return self.contact.astype(np.float32)
        return self.covariates.get(name, np.full(len(self), np.nan, np.float32))

    def group_values(self, name: str) -> FloatArray:
        """(T,) values that define the groups of a covariate: those of a sensor's mask are 0 only in its outages."""
        values = self.covariate(name)
        return values if name not in self.task.masks.values() else 1 - outages(values == 0).astype(np.float32)

    def present(self, key: str) -> NDArray[np.bool_]:
        """(T,): whether a step has a reading of a sensor (``Task.masks``); other steps repeat the last one."""
        name = self.task.masks.get(key)
        return np.ones(len(self), np.bool_) if name is None else np.asarray(self.covariate(name) != 0.0)

    @property
    def times(self) -> NDArray[np.float64]:
        """(T,) s since the first step."""
        return np.arange(len(self), dtype=np.float64) * self.dt if self.time is None else self.time

    @property
    def durations(self) -> NDArray[np.float64]:
        """(T,) s since the previous step; of the first step of an episode, ``dt``."""
        if self.time is None:
            return np.full(len(self), self.dt, np.float64)
        return np.concatenate([[self.first_duration or self.dt], np.diff(self.time)])[: len(self)]

    @property
    def positions(self) -> NDArray[np.float64]:
        """(T,) times in steps of the usual duration ``dt``; the indices of the steps without timestamps."""
        return np.arange(len(self), dtype=np.float64) if self.time is None else self.time / self.dt

    def time_of(self, step: int) -> float | None:
        """s from the first step to a step; None if the data have no timestamps."""
        return None if self.time is None else float(self.time[step])

    @property
    def duration_text(self) -> str:
        """Duration of a step, such as ``0.10 s``, or the shortest and the longest."""
        if self.time is None or len(self) < 2:
            return f"{self.dt:.2f} s"
        steps = np.diff(self.time)
        return f"{steps.min():.2f} to {steps.max():.2f} s"

    def __len__(self) -> int:
        return len(self.states)

    def part(self, first: int, last: int) -> Episode:
        """Steps ``first`` to ``last - 1``, as views of the same arrays; times still count from the first step."""
        arrays: dict[str, Any] = {n: getattr(self, n)[first:last] for n in ("states", "controls", "contact", "qpos")}
        for name in ("observations", "covariates"):
            arrays[name] = {key: array[first:last] for key, array in getattr(self, name).items()}
        if self.time is not None:
            arrays["time"] = self.time[first:last]
            arrays["first_duration"] = float(self.durations[first]) if first < len(self) else 0.0
        return replace(self, **arrays)

    def digest(self) -> str:
        """SHA-256 over the names, shapes, types and bytes of the arrays, independent of the file format."""
        return digest_of(self, len(self), lambda name: [self.arrays[name]])

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """All arrays by name; ``observations/image`` is that of an observation."""
        arrays: dict[str, NDArray[Any]] = {n: getattr(self, n) for n in ("states", "controls", "contact", "qpos")}
        arrays |= {f"observations/{key}": value for key, value in self.observations.items()}
        arrays |= {f"covariates/{key}": value for key, value in self.covariates.items()}
        return arrays if self.time is None else arrays | {"time": self.time}


def digest_of(like: Episode, steps: int, blocks: Callable[[str], Iterable[NDArray[Any]]]) -> str:
    """Digest of an episode whose arrays are read in blocks of consecutive steps.

    Args:
        like: some steps of the episode.
        steps: of the whole episode.
        blocks: name of an array -> its blocks.
    """
    digest = hashlib.sha256(f"{like.task.name} {like.dt} {like.seed} {like.split}".encode())
    for name, array in sorted(like.arrays.items()):
        digest.update(f"{name} {(steps, *array.shape[1:])} {array.dtype.str}".encode())
        for block in blocks(name):
            digest.update(np.ascontiguousarray(block).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def step_text(step: int, time: float | None) -> str:
    """A step, and its time where the data have timestamps: ``step 12``, ``step 12 (3.40 s)``."""
    return f"step {step}" if time is None else f"step {step} ({time:.2f} s)"


def durations_text(episodes: Sequence[Episode]) -> str:
    """Duration of the steps of episodes: ``0.1 s each``, ``0.1 s each (0.08 to 3.2 s)``."""
    typical = f"{episodes[0].dt:.4g} s each"
    steps = np.concatenate([np.diff(episode.times) for episode in episodes])
    if not len(steps) or steps.max() < 1.05 * steps.min():
        return typical
    return f"{typical} ({steps.min():.3g} to {steps.max():.3g} s)"


def hold(readings: NDArray[Any], present: NDArray[np.bool_]) -> NDArray[Any]:
    """Readings (T, ...) with the last present one at absent steps, and zeros before the first one."""
    if present.all():
        return readings
    last = np.maximum.accumulate(np.where(present, np.arange(len(present)), -1))
    held = readings[np.maximum(last, 0)]
    held[last < 0] = 0
    return held


def time_error(time: NDArray[Any]) -> str:
    """Why the times (T,) of the steps are invalid, such as ``is 0.1 at step 3, after 0.2``; empty if they are valid."""
    if not np.isfinite(time).all():
        at = int(np.flatnonzero(~np.isfinite(time))[0])
        return f"is {time[at]} at step {at}, expected finite numbers"
    if (wrong := np.flatnonzero(np.diff(time) <= 0.0)).size:
        at = int(wrong[0]) + 1
        return f"is {time[at]:.9g} s at step {at}, after {time[at - 1]:.9g} s; expected ascending times"
    return ""


def outages(lost: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(T,): steps in outages, intervals of steps without a reading that are long for this sensor.

    Args:
        lost: (T,) steps without a reading. A sensor that is slower than the steps has such steps between its readings.
    """
    spacing = np.diff(np.flatnonzero(~lost))
    shortest = MISSED * float(np.median(spacing)) if len(spacing) else MISSED
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]]).astype(np.int8))).reshape(-1, 2)
    result = np.zeros(len(lost), np.bool_)
    for first, end in edges:
        result[first:end] = end - first >= shortest
    return result


def is_image(readings: NDArray[Any]) -> bool:
    """Whether readings (T, ...) are images: (T, H, W) gray or (T, H, W, 3) RGB, uint8."""
    return readings.dtype == np.uint8 and readings.ndim in (3, 4)


def lost_images(images: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(T,): whether all pixels of an image (T, H, W) or (T, H, W, 3) are equal."""
    return np.asarray((images == images[:, :1, :1]).all(axis=tuple(range(1, images.ndim))))
