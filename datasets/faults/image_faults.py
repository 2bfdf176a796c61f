"""Faults of images, of any image sensor of a task. Units are gray levels 0 to 255 and pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.faults.fault import (
    Fault,
    GaussianNoise,
    Readings,
    Span,
    choose_steps,
    integer_field,
    name_field,
    number_field,
    value_field,
)
from beliefscope.datasets.task import Task

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


IMAGE_FAULTS = (
    Blackout,
    ImageFrozen,
    ImageUnderexposed,
    ImageNoise,
    ImageOutage,
    ImageBlur,
    ImageOccluded,
    ImageShift,
)
