"""Sensor faults: frozen dataclasses that convert to text and JSON and transform sensor readings.

Units are SI, gray levels 0 to 255 and pixels. ``datasets/faults/injection.py`` applies faults to episodes.
"""

from __future__ import annotations

from dataclasses import Field, dataclass, field, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import FloatArray
from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.task import Task

Readings = NDArray[Any]
"""(T, ...): readings of a sensor at each step."""

AXES = ("x", "y", "z")

MAX_VALUE = 1e6
"""Upper bound of every parameter: larger values exceed the useful range of float32 filters."""


def _parameter(default: Any, kind: type, unit: str, meaning: str, **range_: Any) -> Any:
    return field(default=default, metadata={"kind": kind, "unit": unit, "meaning": meaning} | range_)


def _number(default: float, unit: str, meaning: str, minimum: float = -MAX_VALUE, maximum: float = MAX_VALUE) -> Any:
    return _parameter(default, float, unit, meaning, minimum=minimum, maximum=maximum)


def _integer(default: int | None, unit: str, meaning: str, minimum: int = 0) -> Any:
    return _parameter(default, int, unit, meaning, minimum=minimum, maximum=MAX_VALUE)


def _name(default: str, meaning: str, choices: tuple[str, ...] = ()) -> Any:
    return _parameter(default, str, "name", meaning, choices=choices)


@dataclass(frozen=True)
class Span:
    """Active steps of a fault. at: (T,) bool. first: first active step, at most the last of the episode. dt: s."""

    at: NDArray[np.bool_]
    first: int
    dt: float


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A sensor fault from step ``from_`` up to, but excluding, step ``to`` (default: the end).

    Raises BadInput for a parameter of the wrong type or out of range.
    """

    from_: int = _integer(0, "steps", "first step of the fault")
    to: int | None = _integer(None, "steps", "first step after the fault; default: the end", minimum=1)

    name: ClassVar[str]
    sensor: ClassVar[str]

    def __post_init__(self) -> None:
        for key, parameter in parameters(type(self)).items():
            value = _validate(self.name, key, parameter, getattr(self, parameter.name))
            object.__setattr__(self, parameter.name, value)
        if self.to is not None and self.to <= self.from_:
            raise BadInput(f"{self.name}'s 'to' is {self.to}, not a step after 'from', which is {self.from_}")

    def keys(self, task: Task) -> tuple[str, ...]:
        """Observation keys that the fault changes. Raises BadInput if the task lacks the sensor."""
        if self.sensor not in task.observations:
            raise unknown_name(f"sensor of task {task.name!r}", self.sensor, task.observations)
        return (self.sensor,)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        """(T, ...): faulty readings for all steps; ``apply`` uses those of the active steps."""
        raise NotImplementedError

    def apply(self, readings: Readings, dt: float, rng: np.random.Generator) -> Readings:
        """(T, ...): faulty readings, a new array of the same type."""
        steps = np.arange(len(readings))
        at = (steps >= self.from_) & (steps < (len(steps) if self.to is None else self.to))
        span = Span(at, min(self.from_, len(steps) - 1), dt)
        changed = self.change(readings, span, rng)
        if readings.dtype == np.uint8:
            changed = np.rint(changed).clip(0, 255)
        return _choose(span.at, changed, readings).astype(readings.dtype)

    def to_json(self) -> dict[str, Any]:
        """``{"fault": name, parameter: value, ...}``; ``from`` and ``to`` only if they differ from the defaults."""
        values = {key: getattr(self, parameter.name) for key, parameter in parameters(type(self)).items()}
        return {"fault": self.name} | {k: v for k, v in values.items() if v is not None and (k, v) != ("from", 0)}

    def __str__(self) -> str:
        text, first = self.name, True
        for key, parameter in parameters(type(self)).items():
            value = getattr(self, parameter.name)
            if value != parameter.default or isinstance(value, str):
                text += f"={_format(value)}" if first else f":{key}={_format(value)}"
            first = False
        return text


def parameters(fault: type[Fault]) -> dict[str, Field[Any]]:
    """Parameter name in text -> dataclass field; the span comes last. ``from`` is a Python keyword: ``from_``."""
    span = {parameter.name for parameter in fields(Fault)}
    ordered = sorted(fields(fault), key=lambda parameter: parameter.name in span)
    return {parameter.name.rstrip("_"): parameter for parameter in ordered}


def _validate(fault: str, key: str, parameter: Field[Any], value: Any) -> Any:
    meta = parameter.metadata
    if value is None and parameter.default is None:
        return None
    if meta["kind"] is str:
        if not isinstance(value, str) or not value.isprintable() or not value or set(value) & set(",:= "):
            raise BadInput(f"{fault}'s {key!r} is {value!r}, not a name")
        if meta["choices"] and value not in meta["choices"]:
            raise unknown_name(f"{key} of {fault}", value, meta["choices"])
        return value
    low, high = meta["minimum"], meta["maximum"]
    valid = isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high
    if valid and meta["kind"](value) == value:
        return meta["kind"](value)
    kind = "a whole number" if meta["kind"] is int else "a number"
    raise BadInput(f"{fault}'s {key!r} is {value!r}, not {kind} from {low:g} to {high:g}")


def _format(value: Any) -> str:
    return repr(value).removesuffix(".0") if isinstance(value, float) else str(value)


def _choose(mask: NDArray[np.bool_], yes: Readings, no: Readings) -> Readings:
    """(T, ...): ``yes`` at steps where the mask (T,) is true, else ``no``."""
    return np.where(mask.reshape(-1, *[1] * (no.ndim - 1)), yes, no)


def _delay(readings: Readings, steps: int) -> Readings:
    return readings[np.maximum(np.arange(len(readings)) - steps, 0)]


def _axes(fault: Fault, readings: Readings) -> FloatArray:
    """(d,) x, y, z of the fault for a sensor (T, d). Raises BadInput for a nonzero value of an axis beyond d."""
    values = np.array([getattr(fault, axis) for axis in AXES], np.float32)
    d = readings.shape[1]
    if values[d:].any():
        raise BadInput(f"{fault} uses an axis that the sensor does not have. Available: {', '.join(AXES[:d])}.")
    return values[:d]


@dataclass(frozen=True)
class Blackout(Fault):
    """Images are blacked out, independently at each step."""

    name, sensor = "blackout", "image"
    probability: float = _number(1.0, "fraction", "probability of a blackout at a step", 0, 1)
    gray: int | None = _parameter(
        None,
        int,
        "gray levels",
        "level of all pixels; default: 0; the paper's code has mid-gray, 128",
        minimum=0,
        maximum=255,
    )

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return _choose(rng.random(len(readings)) < self.probability, np.full_like(readings, self.gray or 0), readings)


@dataclass(frozen=True)
class ImageFrozen(Fault):
    """The image of the fault's first step is repeated."""

    name, sensor = "image_frozen", "image"

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return np.broadcast_to(readings[span.first], readings.shape)


@dataclass(frozen=True)
class ImageUnderexposed(Fault):
    """Images are under- or overexposed and saturate at white."""

    name, sensor = "image_underexposed", "image"
    factor: float = _number(0.4, "factor", "scale of every gray level", 0)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings * self.factor


@dataclass(frozen=True)
class ImageNoise(Fault):
    """Independent Gaussian noise is added to every pixel."""

    name, sensor = "image_noise", "image"
    std: float = _number(40.0, "gray levels", "standard deviation", 0)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings + rng.normal(0.0, self.std, readings.shape)


@dataclass(frozen=True)
class ImageOccluded(Fault):
    """A square occludes the same part of every image."""

    name, sensor = "image_occluded", "image"
    size: int = _integer(12, "pixels", "side length of the square")
    x: int | None = _integer(None, "pixels", "left column; default: random for each episode")
    y: int | None = _integer(None, "pixels", "top row; default: random for each episode")
    gray: float = _number(0.0, "gray levels", "gray level of the square", 0, 255)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        room = np.maximum(np.array(readings.shape[1:]) - self.size, 0)
        top, left = (int(n) for n in rng.integers(room + 1))
        top, left = top if self.y is None else self.y, left if self.x is None else self.x
        occluded = readings.copy()
        occluded[:, top : top + self.size, left : left + self.size] = round(self.gray)
        return occluded


@dataclass(frozen=True)
class ForceBias(Fault):
    """A constant is added to the force."""

    name, sensor = "force_bias", "force"
    x: float = _number(0.0, "N", "offset along x")
    y: float = _number(0.0, "N", "offset along y")
    z: float = _number(0.0, "N", "offset along z")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings + _axes(self, readings)


@dataclass(frozen=True)
class ForceNoise(Fault):
    """Independent Gaussian noise is added to each axis of the force."""

    name, sensor = "force_noise", "force"
    std: float = _number(5.0, "N", "standard deviation", 0)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings + rng.normal(0.0, self.std, readings.shape)


@dataclass(frozen=True)
class ForceDrift(Fault):
    """A bias that grows linearly from the fault's first step is added to the force."""

    name, sensor = "force_drift", "force"
    x: float = _number(0.0, "N/s", "drift rate along x")
    y: float = _number(0.0, "N/s", "drift rate along y")
    z: float = _number(0.0, "N/s", "drift rate along z")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings + _axes(self, readings) * span.dt * (np.arange(len(readings)) - span.first)[:, None]


@dataclass(frozen=True)
class ForceSaturation(Fault):
    """Each axis of the force saturates at a limit."""

    name, sensor = "force_saturation", "force"
    limit: float = _number(5.0, "N", "largest magnitude", 0)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings.clip(-self.limit, self.limit)


@dataclass(frozen=True)
class ForceStuck(Fault):
    """One axis of the force keeps its value at the fault's first step."""

    name, sensor = "force_stuck", "force"
    axis: str = _name("x", "x, y or z", AXES)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        axis, stuck = AXES.index(self.axis), readings.copy()
        if axis >= readings.shape[1]:
            raise unknown_name("axis of the force", self.axis, AXES[: readings.shape[1]])
        stuck[:, axis] = readings[span.first, axis]
        return stuck


@dataclass(frozen=True)
class EffectorOffset(Fault):
    """A constant is added to the end-effector position."""

    name, sensor = "effector_offset", "effector_position"
    x: float = _number(0.0, "m", "offset along x")
    y: float = _number(0.0, "m", "offset along y")
    z: float = _number(0.0, "m", "offset along z")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings + _axes(self, readings)


@dataclass(frozen=True)
class ContactFlipped(Fault):
    """The contact flag is inverted, independently at each step."""

    name, sensor = "contact_flipped", "contact"
    probability: float = _number(1.0, "fraction", "probability of an inversion at a step", 0, 1)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return _choose(rng.random(len(readings)) < self.probability, 1 - readings, readings)


@dataclass(frozen=True)
class ContactDelayed(Fault):
    """The contact flag is delayed."""

    name, sensor = "contact_delayed", "contact"
    steps: int = _integer(5, "steps", "length of the delay")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return _delay(readings, self.steps)


@dataclass(frozen=True)
class ModalityFault(Fault):
    """A fault of all sensors of a modality."""

    modality: str = _name("image", "a modality of the task: image, haptics")

    def keys(self, task: Task) -> tuple[str, ...]:
        if self.modality not in task.modalities:
            raise unknown_name(f"modality of task {task.name!r}", self.modality, task.modalities)
        return task.modalities[self.modality]


@dataclass(frozen=True)
class Delay(ModalityFault):
    """A modality is delayed; the first steps repeat the readings of step 0."""

    name = "delay"
    steps: int = _integer(5, "steps", "length of the delay")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return _delay(readings, self.steps)


@dataclass(frozen=True)
class Drop(ModalityFault):
    """A modality drops out: images are black, other readings repeat their last value."""

    name = "drop"
    probability: float = _number(1.0, "fraction", "probability that a dropout begins at a step", 0, 1)
    steps: int = _integer(1, "steps", "length of a dropout", minimum=1)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        started = np.concatenate([[0], np.cumsum(span.at & (rng.random(len(readings)) < self.probability))])
        now = np.arange(1, len(started))
        lost = started[now] > started[np.maximum(now - self.steps, 0)]
        if readings.dtype == np.uint8:
            return _choose(lost, np.zeros_like(readings), readings)
        return readings[np.maximum.accumulate(np.where(lost & span.at, 0, now - 1))]


FAULTS: dict[str, type[Fault]] = {
    fault.name: fault
    for fault in (
        Blackout,
        ImageFrozen,
        ImageUnderexposed,
        ImageNoise,
        ImageOccluded,
        ForceBias,
        ForceNoise,
        ForceDrift,
        ForceSaturation,
        ForceStuck,
        EffectorOffset,
        ContactFlipped,
        ContactDelayed,
        Delay,
        Drop,
    )
}
"""All faults by name. To add one, write a class and list it here."""
