"""Sensor faults: frozen dataclasses that convert to text and JSON and transform sensor readings.

Units are SI, gray levels 0 to 255 and pixels. ``datasets/faults/injection.py`` applies faults to episodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from beliefscope.datasets.errors import BadInput, check_name, unknown_name
from beliefscope.datasets.faults.control_faults import ControlDelayed, ControlScaled
from beliefscope.datasets.faults.fault import (
    AXES,
    Fault,
    GaussianNoise,
    Mask,
    Offset,
    Readings,
    Span,
    axis_values,
    choose_steps,
    delay_steps,
    integer_field,
    name_field,
    number_field,
    value_field,
)
from beliefscope.datasets.faults.sensor_faults import SENSOR_FAULTS
from beliefscope.datasets.task import Task

PERMUTATIONS = tuple("".join(order) for order in permutations(AXES))[1:]
"""Orders of the axes other than x, y, z."""

MAX_SHIFT = 4096
"""Largest shift of an image, pixels."""


@dataclass(frozen=True, kw_only=True)
class ImageFault(Fault):
    """A fault of one image sensor."""

    sensor = "image"
    key: str | None = name_field(None, "an image sensor of the task; default: image, or the only one")

    def keys(self, task: Task) -> tuple[str, ...]:
        images = task.images
        if self.key is None and self.sensor in task.observations:
            return (self.sensor,)
        if not images:
            sensors = ", ".join(task.observations)
            raise BadInput(f"{self.name} needs an image sensor; task {task.name!r} has none. Its sensors: {sensors}.")
        if self.key is None and len(images) > 1:
            texts = ", ".join(f"{self.name}:key={key}" for key in images)
            raise BadInput(f"{self.name} needs the name of one of the image sensors of task {task.name!r}: {texts}")
        key = images[0] if self.key is None else self.key
        check_name(f"image sensor of task {task.name!r}", key, images)
        return (key,)


@dataclass(frozen=True)
class Blackout(ImageFault):
    """Images are blacked out, independently at each step."""

    name = "blackout"
    probability: float = number_field(1.0, "fraction", "probability of a blackout at a step", 0, 1)
    gray: int | None = value_field(
        None,
        int,
        "gray levels",
        "level of all pixels; default: 0; the paper's code has mid-gray, 128",
        minimum=0,
        maximum=255,
    )

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return choose_steps(
            rng.random(len(readings)) < self.probability, np.full_like(readings, self.gray or 0), readings
        )


@dataclass(frozen=True)
class ImageFrozen(ImageFault):
    """The image of the fault's first step is repeated."""

    name = "image_frozen"

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return np.broadcast_to(readings[span.first], readings.shape)


@dataclass(frozen=True)
class ImageUnderexposed(ImageFault):
    """Images are under- or overexposed and saturate at white."""

    name = "image_underexposed"
    factor: float = number_field(0.4, "factor", "scale of every gray level", 0)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings * self.factor


@dataclass(frozen=True)
class ImageNoise(ImageFault, GaussianNoise):
    """Independent Gaussian noise is added to every pixel."""

    name = "image_noise"
    std: float = number_field(40.0, "gray levels", "standard deviation", 0)


@dataclass(frozen=True)
class ImageOutage(ImageFault):
    """Images are black in stretches of random length: a two-state Markov chain with these stationary moments."""

    name = "image_outage"
    fraction: float = number_field(0.5, "fraction", "expected share of steps without an image", 0, 1)
    seconds: float = number_field(2.0, "s", "mean duration of an outage", 0.01)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        # The chain changes at a step only if its number falls below ``begin`` or above ``stay``, whatever its state.
        end = min(1.0, span.dt / self.seconds)
        begin = 1.0 if self.fraction == 1.0 else min(1.0, end * self.fraction / (1.0 - self.fraction))
        number, stay = rng.random(len(readings)), max(1.0 - end, begin)
        decided = (number < begin) | (number >= stay)
        outage = number < begin
        decided[0], outage[0] = True, number[0] < self.fraction
        latest = np.maximum.accumulate(np.where(decided, np.arange(len(readings)), 0))
        return choose_steps(outage[latest], np.zeros_like(readings), readings)


@dataclass(frozen=True)
class ImageBlur(ImageFault):
    """Images are blurred with a Gaussian kernel."""

    name = "image_blur"
    std: float = number_field(1.0, "pixels", "standard deviation of the kernel", 0, 32)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        rows, columns = (self._kernel(size) for size in readings.shape[1:3])
        channels = np.moveaxis(readings.astype(float), -1, 1) if readings.ndim == 4 else readings.astype(float)
        blurred = rows @ channels @ columns.T
        return np.moveaxis(blurred, 1, -1) if readings.ndim == 4 else blurred

    def _kernel(self, size: int) -> Readings:
        """(size, size): weights of the pixels of a line, normalised at the borders."""
        distance = np.subtract.outer(np.arange(size), np.arange(size))
        weights = np.exp(-0.5 * (distance / max(self.std, 1e-3)) ** 2)
        return weights / weights.sum(1, keepdims=True)


@dataclass(frozen=True)
class ImageOccluded(ImageFault):
    """A square occludes the same part of every image."""

    name = "image_occluded"
    size: int = integer_field(12, "pixels", "side length of the square")
    x: int | None = integer_field(None, "pixels", "left column; default: random for each episode")
    y: int | None = integer_field(None, "pixels", "top row; default: random for each episode")
    gray: float = number_field(0.0, "gray levels", "gray level of the square", 0, 255)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        room = np.maximum(np.array(readings.shape[1:3]) - self.size, 0)
        top, left = (int(n) for n in rng.integers(room + 1))
        top, left = top if self.y is None else self.y, left if self.x is None else self.x
        occluded = readings.copy()
        occluded[:, top : top + self.size, left : left + self.size] = round(self.gray)
        return occluded


@dataclass(frozen=True)
class ImageShift(ImageFault):
    """Images are shifted, as by a displaced camera; pixels at the border are repeated."""

    name = "image_shift"
    x: int = integer_field(3, "pixels", "shift to the right", minimum=-MAX_SHIFT)
    y: int = integer_field(0, "pixels", "shift downwards", minimum=-MAX_SHIFT)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        rows, columns = (
            np.clip(np.arange(size) - shift, 0, size - 1)
            for size, shift in zip(readings.shape[1:3], (self.y, self.x), strict=True)
        )
        return readings[:, rows[:, None], columns]


@dataclass(frozen=True)
class ForceBias(Offset):
    """A constant is added to the force."""

    name, sensor = "force_bias", "force"
    x: float = number_field(0.0, "N", "offset along x")
    y: float = number_field(0.0, "N", "offset along y")
    z: float = number_field(0.0, "N", "offset along z")


@dataclass(frozen=True)
class ForceNoise(GaussianNoise):
    """Independent Gaussian noise is added to each axis of the force."""

    name, sensor = "force_noise", "force"
    std: float = number_field(5.0, "N", "standard deviation", 0)


@dataclass(frozen=True)
class ForceDrift(Fault):
    """A bias that grows linearly from the fault's first step is added to the force."""

    name, sensor = "force_drift", "force"
    x: float = number_field(0.0, "N/s", "drift rate along x")
    y: float = number_field(0.0, "N/s", "drift rate along y")
    z: float = number_field(0.0, "N/s", "drift rate along z")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings + axis_values(self, readings) * span.dt * (np.arange(len(readings)) - span.first)[:, None]


@dataclass(frozen=True)
class ForceSaturation(Fault):
    """Each axis of the force saturates at a limit."""

    name, sensor = "force_saturation", "force"
    limit: float = number_field(5.0, "N", "largest magnitude", 0)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings.clip(-self.limit, self.limit)


@dataclass(frozen=True)
class ForceGain(Fault):
    """The force is scaled."""

    name, sensor = "force_gain", "force"
    factor: float = number_field(-1.0, "factor", "scale of all axes; -1 inverts the sign")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings * self.factor


@dataclass(frozen=True)
class ForceAxes(Fault):
    """The axes of the force are exchanged."""

    name, sensor = "force_axes", "force"
    order: str = name_field("yxz", "axes reported as x, y and z", PERMUTATIONS)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        available = AXES[: readings.shape[1]]
        missing = sorted(set(self.order) - set(available))
        if missing:
            raise unknown_name("axis of the force", missing[0], available)
        return readings[:, [AXES.index(axis) for axis in self.order]]


@dataclass(frozen=True)
class ForceStuck(Fault):
    """One axis of the force, or all, keep their value at the fault's first step."""

    name, sensor = "force_stuck", "force"
    axis: str = name_field("x", "x, y, z or all", (*AXES, "all"))

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        if self.axis == "all":
            return np.broadcast_to(readings[span.first], readings.shape)
        axis, stuck = AXES.index(self.axis), readings.copy()
        if axis >= readings.shape[1]:
            raise unknown_name("axis of the force", self.axis, AXES[: readings.shape[1]])
        stuck[:, axis] = readings[span.first, axis]
        return stuck


@dataclass(frozen=True)
class TorqueBias(Offset):
    """A constant is added to the torque."""

    name, sensor = "torque_bias", "torque"
    x: float = number_field(0.0, "N m", "offset about x")
    y: float = number_field(0.0, "N m", "offset about y")
    z: float = number_field(0.0, "N m", "offset about z")


@dataclass(frozen=True)
class TorqueNoise(GaussianNoise):
    """Independent Gaussian noise is added to each axis of the torque."""

    name, sensor = "torque_noise", "torque"
    std: float = number_field(0.1, "N m", "standard deviation", 0)


@dataclass(frozen=True)
class EffectorOffset(Offset):
    """A constant is added to the end-effector position."""

    name, sensor = "effector_offset", "effector_position"
    x: float = number_field(0.0, "m", "offset along x")
    y: float = number_field(0.0, "m", "offset along y")
    z: float = number_field(0.0, "m", "offset along z")


@dataclass(frozen=True)
class EffectorNoise(GaussianNoise):
    """Independent Gaussian noise is added to each axis of the end-effector position."""

    name, sensor = "effector_noise", "effector_position"
    std: float = number_field(0.005, "m", "standard deviation", 0)


@dataclass(frozen=True)
class ContactFlipped(Fault):
    """The contact flag is inverted, independently at each step."""

    name, sensor = "contact_flipped", "contact"
    probability: float = number_field(1.0, "fraction", "probability of an inversion at a step", 0, 1)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return choose_steps(rng.random(len(readings)) < self.probability, 1 - readings, readings)


@dataclass(frozen=True)
class ContactStuck(Fault):
    """The contact flag is constant."""

    name, sensor = "contact_stuck", "contact"
    value: int = value_field(0, int, "flag", "0: no contact, 1: contact", minimum=0, maximum=1)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return np.full_like(readings, self.value)


@dataclass(frozen=True)
class ContactDelayed(Fault):
    """The contact flag is delayed."""

    name, sensor = "contact_delayed", "contact"
    steps: int = integer_field(5, "steps", "length of the delay")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return delay_steps(readings, self.steps)


@dataclass(frozen=True)
class ModalityFault(Fault):
    """A fault of all sensors of a modality."""

    modality: str = name_field("image", "a modality of the task: image, haptics")

    def keys(self, task: Task) -> tuple[str, ...]:
        if self.modality not in task.modalities:
            raise unknown_name(f"modality of task {task.name!r}", self.modality, task.modalities)
        return task.modalities[self.modality]


@dataclass(frozen=True)
class Delay(ModalityFault):
    """A modality is delayed; the first steps repeat the readings of step 0."""

    name = "delay"
    steps: int = integer_field(5, "steps", "length of the delay")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return delay_steps(readings, self.steps)

    def presence(self, present: Mask, span: Span, rng: np.random.Generator) -> Mask:
        return delay_steps(present, self.steps)


@dataclass(frozen=True)
class Drop(ModalityFault):
    """A modality drops out: images are black, other readings repeat their last value."""

    name = "drop"
    probability: float = number_field(1.0, "fraction", "probability that a dropout begins at a step", 0, 1)
    steps: int = integer_field(1, "steps", "length of a dropout", minimum=1)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        lost = self._lost(span, rng)
        if readings.dtype == np.uint8:
            return choose_steps(lost, np.zeros_like(readings), readings)
        return readings[np.maximum.accumulate(np.where(lost & span.at, 0, np.arange(len(lost))))]

    def presence(self, present: Mask, span: Span, rng: np.random.Generator) -> Mask:
        return present & ~self._lost(span, rng)

    def _lost(self, span: Span, rng: np.random.Generator) -> Mask:  # (T,) steps of a dropout
        started = np.concatenate([[0], np.cumsum(span.at & (rng.random(len(span.at)) < self.probability))])
        return np.asarray(started[1:] > started[np.maximum(np.arange(1, len(started)) - self.steps, 0)])


FAULTS: dict[str, type[Fault]] = {
    fault.name: fault
    for fault in (
        Blackout,
        ImageFrozen,
        ImageUnderexposed,
        ImageNoise,
        ImageOutage,
        ImageBlur,
        ImageOccluded,
        ImageShift,
        ForceBias,
        ForceNoise,
        ForceDrift,
        ForceSaturation,
        ForceGain,
        ForceAxes,
        ForceStuck,
        TorqueBias,
        TorqueNoise,
        EffectorOffset,
        EffectorNoise,
        ContactFlipped,
        ContactStuck,
        ContactDelayed,
        Delay,
        Drop,
        *SENSOR_FAULTS,
        ControlDelayed,
        ControlScaled,
    )
}
"""All faults by name. To add one, write a class and list it here."""
