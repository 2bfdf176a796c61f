"""Faults of any sensor, by the name of its observation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.faults.fault import (
    Fault,
    GaussianNoise,
    Readings,
    Span,
    integer_field,
    name_field,
    number_field,
)
from beliefscope.datasets.task import Task


@dataclass(frozen=True)
class SensorFault(Fault):
    """A fault of one observation."""

    key: str = name_field("force", "an observation of the task, such as image or force")

    def keys(self, task: Task) -> tuple[str, ...]:
        check_name(f"sensor of task {task.name!r}", self.key, task.observations)
        return (self.key,)


@dataclass(frozen=True)
class SensorBias(SensorFault):
    """A constant is added to all values of a sensor."""

    name = "sensor_bias"
    offset: float = number_field(1.0, "units of the sensor", "constant")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings + self.offset


@dataclass(frozen=True)
class SensorDrift(SensorFault):
    """A bias that grows linearly from the fault's first step is added to all values of a sensor."""

    name = "sensor_drift"
    rate: float = number_field(0.1, "units of the sensor per second", "growth of the bias")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings + self.rate * span.elapsed.reshape(-1, *(1,) * (readings.ndim - 1))


@dataclass(frozen=True)
class SensorGain(SensorFault):
    """The values of a sensor are scaled."""

    name = "sensor_gain"
    factor: float = number_field(2.0, "factor", "scale")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return self.factor * readings


@dataclass(frozen=True)
class SensorNoise(SensorFault, GaussianNoise):
    """Independent Gaussian noise is added to every value of a sensor."""

    name = "sensor_noise"
    std: float = number_field(1.0, "units of the sensor", "standard deviation", minimum=0)


@dataclass(frozen=True)
class SensorFrozen(SensorFault):
    """A sensor repeats its reading of the fault's first step."""

    name = "sensor_frozen"

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return np.broadcast_to(readings[span.first], readings.shape)


@dataclass(frozen=True)
class SensorSwapped(SensorFault):
    """Two channels of a sensor, entries of a vector or colours of an image, are exchanged."""

    name = "sensor_swapped"
    first: int = integer_field(0, "channel", "index of a channel")
    second: int = integer_field(1, "channel", "index of the other channel")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        count = readings.shape[-1] if readings.ndim != 3 else 1  # the last axis of a gray image is its width
        if max(self.first, self.second) >= count:
            raise BadInput(f"{self} uses a channel that the sensor does not have. Available: 0 to {count - 1}.")
        order = np.arange(count)
        order[[self.first, self.second]] = self.second, self.first
        return readings[..., order]


SENSOR_FAULTS = (SensorBias, SensorDrift, SensorGain, SensorNoise, SensorFrozen, SensorSwapped)
