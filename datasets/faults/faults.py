"""Sensor faults: frozen dataclasses that convert to text and JSON and transform sensor readings.

Units are SI, gray levels 0 to 255 and pixels. ``datasets/faults/injection.py`` applies faults to episodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from beliefscope.datasets.errors import unknown_name
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
from beliefscope.datasets.faults.image_faults import IMAGE_FAULTS
from beliefscope.datasets.faults.sensor_faults import SENSOR_FAULTS
from beliefscope.datasets.task import Task

PERMUTATIONS = tuple("".join(order) for order in permutations(AXES))[1:]
"""Orders of the axes other than x, y, z."""


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
        return readings + axis_values(self, readings) * span.elapsed[:, None]


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

    name, sensor = "contact_inverted", "contact"
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
        *IMAGE_FAULTS,
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
