"""The ways in which a sensor breaks: small frozen values that print, and that turn what was read into what is reported.

Values are SI, gray levels 0 to 255 and pixels. ``datasets/faults/injection.py`` puts them on episodes.
"""

from __future__ import annotations

from dataclasses import Field, dataclass, field, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import FloatArray
from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.datasets.task import Task

Readings = NDArray[Any]
"""(T, ...): what one sensor reported at each step."""

AXES = ("x", "y", "z")

LARGEST = 1e6
"""Of any parameter's value: beyond it float32 arithmetic of a filter has no meaning."""


def _parameter(default: Any, kind: type, unit: str, meaning: str, **range_: Any) -> Any:
    return field(default=default, metadata={"kind": kind, "unit": unit, "meaning": meaning} | range_)


def _number(default: float, unit: str, meaning: str, least: float = -LARGEST, most: float = LARGEST) -> Any:
    return _parameter(default, float, unit, meaning, least=least, most=most)


def _whole(default: int | None, unit: str, meaning: str, least: int = 0) -> Any:
    return _parameter(default, int, unit, meaning, least=least, most=LARGEST)


def _word(default: str, meaning: str, choices: tuple[str, ...] = ()) -> Any:
    return _parameter(default, str, "name", meaning, choices=choices)


@dataclass(frozen=True)
class Span:
    """When a fault acts: at (T,) bool. first: its first step, or the episode's last if that comes before. dt: s."""

    at: NDArray[np.bool_]
    first: int
    dt: float


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One way in which a sensor breaks, from step ``from_`` up to, but without, step ``to``; else to the end.

    Raises BadInput for a parameter of another type or out of its range.
    """

    from_: int = _whole(0, "steps", "first step of the fault")
    to: int | None = _whole(None, "steps", "first step after it; the end without it", least=1)

    name: ClassVar[str]
    sensor: ClassVar[str]

    def __post_init__(self) -> None:
        for key, one in parameters(type(self)).items():
            object.__setattr__(self, one.name, _checked(self.name, key, one, getattr(self, one.name)))
        if self.to is not None and self.to <= self.from_:
            raise BadInput(f"{self.name}'s 'to' is {self.to}, not a step after 'from', which is {self.from_}")

    def keys(self, task: Task) -> tuple[str, ...]:
        """The observations it breaks. Raises BadInput where the task has none such."""
        if self.sensor not in task.observations:
            raise one_of(f"sensor of task {task.name!r}", self.sensor, task.observations)
        return (self.sensor,)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        """(T, ...): the readings as if the fault acted throughout; ``apply`` takes of them what lies in the span."""
        raise NotImplementedError

    def apply(self, readings: Readings, dt: float, rng: np.random.Generator) -> Readings:
        """(T, ...): the broken readings, a new array of the same type."""
        steps = np.arange(len(readings))
        at = (steps >= self.from_) & (steps < (len(steps) if self.to is None else self.to))
        span = Span(at, min(self.from_, len(steps) - 1), dt)
        changed = self.change(readings, span, rng)
        if readings.dtype == np.uint8:
            changed = np.rint(changed).clip(0, 255)
        return _choose(span.at, changed, readings).astype(readings.dtype)

    def to_json(self) -> dict[str, Any]:
        """``{"fault": name, parameter: value, ...}``; the span only where it is not the whole episode."""
        given = {key: getattr(self, one.name) for key, one in parameters(type(self)).items()}
        return {"fault": self.name} | {k: v for k, v in given.items() if v is not None and (k, v) != ("from", 0)}

    def __str__(self) -> str:
        text, first = self.name, True
        for key, one in parameters(type(self)).items():
            value = getattr(self, one.name)
            if value != one.default or isinstance(value, str):
                text += f"={_written(value)}" if first else f":{key}={_written(value)}"
            first = False
        return text


def parameters(fault: type[Fault]) -> dict[str, Field[Any]]:
    """Parameter as written -> dataclass field; the fault's own first, then its span. ``from`` is a word of Python's."""
    span = {one.name for one in fields(Fault)}
    ordered = sorted(fields(fault), key=lambda one: one.name in span)
    return {one.name.rstrip("_"): one for one in ordered}


def _checked(fault: str, key: str, parameter: Field[Any], value: Any) -> Any:
    wanted = parameter.metadata
    if value is None and parameter.default is None:
        return None
    if wanted["kind"] is str:
        if not isinstance(value, str) or not value.isprintable() or not value or set(value) & set(",:= "):
            raise BadInput(f"{fault}'s {key!r} is {value!r}, not a name")
        if wanted["choices"] and value not in wanted["choices"]:
            raise one_of(f"{key} of {fault}", value, wanted["choices"])
        return value
    good = isinstance(value, int | float) and not isinstance(value, bool) and wanted["least"] <= value <= wanted["most"]
    if good and wanted["kind"](value) == value:
        return wanted["kind"](value)
    kind = "a whole number" if wanted["kind"] is int else "a number"
    raise BadInput(f"{fault}'s {key!r} is {value!r}, not {kind} from {wanted['least']:g} to {wanted['most']:g}")


def _written(value: Any) -> str:
    return repr(value).removesuffix(".0") if isinstance(value, float) else str(value)


def _choose(mask: NDArray[np.bool_], yes: Readings, no: Readings) -> Readings:
    """(T, ...): at each step all of one or all of the other. mask: (T,)."""
    return np.where(mask.reshape(-1, *[1] * (no.ndim - 1)), yes, no)


def _late(readings: Readings, steps: int) -> Readings:
    return readings[np.maximum(np.arange(len(readings)) - steps, 0)]


def _axes(fault: Fault, readings: Readings) -> FloatArray:
    """(d,) the fault's x, y, z for a sensor (T, d). Raises BadInput where it has a value for an axis beyond d."""
    values = np.array([getattr(fault, axis) for axis in AXES], np.float32)
    d = readings.shape[1]
    if values[d:].any():
        raise BadInput(f"{fault} is of an axis that the sensor has not. Available: {', '.join(AXES[:d])}.")
    return values[:d]


@dataclass(frozen=True)
class Blackout(Fault):
    """Pictures are black, each step on its own."""

    name, sensor = "blackout", "image"
    probability: float = _number(1.0, "share", "chance of a black picture at a step", 0, 1)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return _choose(rng.random(len(readings)) < self.probability, np.zeros_like(readings), readings)


@dataclass(frozen=True)
class ImageFrozen(Fault):
    """The picture of the fault's first step stays."""

    name, sensor = "image_frozen", "image"

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return np.broadcast_to(readings[span.first], readings.shape)


@dataclass(frozen=True)
class ImageDarker(Fault):
    """Pictures are darker, or brighter; they saturate at white."""

    name, sensor = "image_darker", "image"
    factor: float = _number(0.4, "factor", "of every gray level", 0)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings * self.factor


@dataclass(frozen=True)
class ImageNoise(Fault):
    """Every pixel of every picture has noise of its own."""

    name, sensor = "image_noise", "image"
    std: float = _number(40.0, "gray levels", "standard deviation", 0)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings + rng.normal(0.0, self.std, readings.shape)


@dataclass(frozen=True)
class ImagePatch(Fault):
    """A square hides the same part of every picture."""

    name, sensor = "image_patch", "image"
    size: int = _whole(12, "pixels", "side of the square")
    x: int | None = _whole(None, "pixels", "its left column; drawn for each episode without it")
    y: int | None = _whole(None, "pixels", "its top row; drawn for each episode without it")
    gray: float = _number(0.0, "gray levels", "of the square", 0, 255)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        room = np.maximum(np.array(readings.shape[1:]) - self.size, 0)
        top, left = (int(n) for n in rng.integers(room + 1))
        top, left = top if self.y is None else self.y, left if self.x is None else self.x
        hidden = readings.copy()
        hidden[:, top : top + self.size, left : left + self.size] = round(self.gray)
        return hidden


@dataclass(frozen=True)
class ForceBias(Fault):
    """The force is off by a constant."""

    name, sensor = "force_bias", "force"
    x: float = _number(0.0, "N", "offset along x")
    y: float = _number(0.0, "N", "offset along y")
    z: float = _number(0.0, "N", "offset along z")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings + _axes(self, readings)


@dataclass(frozen=True)
class ForceNoise(Fault):
    """The force is noisy, each axis and step on its own."""

    name, sensor = "force_noise", "force"
    std: float = _number(5.0, "N", "standard deviation", 0)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings + rng.normal(0.0, self.std, readings.shape)


@dataclass(frozen=True)
class ForceDrift(Fault):
    """The force is off by what grows from the fault's first step on."""

    name, sensor = "force_drift", "force"
    x: float = _number(0.0, "N/s", "growth along x")
    y: float = _number(0.0, "N/s", "growth along y")
    z: float = _number(0.0, "N/s", "growth along z")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings + _axes(self, readings) * span.dt * (np.arange(len(readings)) - span.first)[:, None]


@dataclass(frozen=True)
class ForceSaturation(Fault):
    """The force ends at a limit, each axis on its own."""

    name, sensor = "force_saturation", "force"
    limit: float = _number(5.0, "N", "largest magnitude", 0)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings.clip(-self.limit, self.limit)


@dataclass(frozen=True)
class ForceStuck(Fault):
    """One axis of the force stays at what it is at the fault's first step."""

    name, sensor = "force_stuck", "force"
    axis: str = _word("x", "x, y or z", AXES)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        axis, stuck = AXES.index(self.axis), readings.copy()
        if axis >= readings.shape[1]:
            raise one_of("axis of the force", self.axis, AXES[: readings.shape[1]])
        stuck[:, axis] = readings[span.first, axis]
        return stuck


@dataclass(frozen=True)
class EffectorOffset(Fault):
    """The end effector is told to be elsewhere."""

    name, sensor = "effector_offset", "effector_position"
    x: float = _number(0.0, "m", "offset along x")
    y: float = _number(0.0, "m", "offset along y")
    z: float = _number(0.0, "m", "offset along z")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings + _axes(self, readings)


@dataclass(frozen=True)
class ContactFlipped(Fault):
    """The contact sensor says the opposite, each step on its own."""

    name, sensor = "contact_flipped", "contact"
    probability: float = _number(1.0, "share", "chance at a step", 0, 1)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return _choose(rng.random(len(readings)) < self.probability, 1 - readings, readings)


@dataclass(frozen=True)
class ContactLate(Fault):
    """The contact sensor is behind."""

    name, sensor = "contact_late", "contact"
    steps: int = _whole(5, "steps", "how far")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return _late(readings, self.steps)


@dataclass(frozen=True)
class OfModality(Fault):
    """A fault of all sensors of a modality."""

    modality: str = _word("image", "a modality of the task: image, haptics")

    def keys(self, task: Task) -> tuple[str, ...]:
        if self.modality not in task.modalities:
            raise one_of(f"modality of task {task.name!r}", self.modality, task.modalities)
        return task.modalities[self.modality]


@dataclass(frozen=True)
class Delay(OfModality):
    """A modality is behind: a step gets the readings of an earlier one, the first steps those of step 0."""

    name = "delay"
    steps: int = _whole(5, "steps", "how far")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return _late(readings, self.steps)


@dataclass(frozen=True)
class Drop(OfModality):
    """A modality reports nothing for a while: a picture is black, every other reading stays what it was before."""

    name = "drop"
    probability: float = _number(1.0, "share", "chance at a step that a gap begins", 0, 1)
    steps: int = _whole(1, "steps", "length of a gap", least=1)

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        begun = np.concatenate([[0], np.cumsum(span.at & (rng.random(len(readings)) < self.probability))])
        now = np.arange(1, len(begun))
        lost = begun[now] > begun[np.maximum(now - self.steps, 0)]
        if readings.dtype == np.uint8:
            return _choose(lost, np.zeros_like(readings), readings)
        return readings[np.maximum.accumulate(np.where(lost & span.at, 0, now - 1))]


FAULTS: dict[str, type[Fault]] = {
    fault.name: fault
    for fault in (
        Blackout,
        ImageFrozen,
        ImageDarker,
        ImageNoise,
        ImagePatch,
        ForceBias,
        ForceNoise,
        ForceDrift,
        ForceSaturation,
        ForceStuck,
        EffectorOffset,
        ContactFlipped,
        ContactLate,
        Delay,
        Drop,
    )
}
"""Every fault there is, by name. A new one is a class and a line here."""
