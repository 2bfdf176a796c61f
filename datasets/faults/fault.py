"""Base class of sensor faults: parameters, their validation and text form, and the span of active steps."""

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

Mask = NDArray[np.bool_]
"""(T,): whether each step has a reading (``Episode.present``)."""

AXES = ("x", "y", "z")

UNWRITTEN = ("factor", "fraction", "name", "steps", "s")
"""Units that the name of a parameter implies, such as ``seconds``."""

MAX_VALUE = 1e6
"""Upper bound of every parameter: larger values exceed the useful range of float32 filters."""


def value_field(default: Any, kind: type, unit: str, meaning: str, **range_: Any) -> Any:
    return field(default=default, metadata={"kind": kind, "unit": unit, "meaning": meaning} | range_)


def number_field(
    default: float, unit: str, meaning: str, minimum: float = -MAX_VALUE, maximum: float = MAX_VALUE
) -> Any:
    return value_field(default, float, unit, meaning, minimum=minimum, maximum=maximum)


def integer_field(default: int | None, unit: str, meaning: str, minimum: int = 0) -> Any:
    return value_field(default, int, unit, meaning, minimum=minimum, maximum=MAX_VALUE)


def name_field(default: str | None, meaning: str, choices: tuple[str, ...] = ()) -> Any:
    return value_field(default, str, "name", meaning, choices=choices)


@dataclass(frozen=True)
class Span:
    """Active steps of a fault. at: (T,) bool. first: first active step, at most the last of the episode. dt: s."""

    at: NDArray[np.bool_]
    first: int
    dt: float

    @property
    def elapsed(self) -> NDArray[np.float64]:
        """(T,) s since the first active step; negative before it."""
        return np.asarray(self.dt * (np.arange(len(self.at)) - self.first))


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A sensor fault from step ``from_`` up to, but excluding, step ``to`` (default: the end).

    Raises BadInput for a parameter of the wrong type or out of range.
    """

    from_: int = integer_field(0, "steps", "first step of the fault")
    to: int | None = integer_field(None, "steps", "first step after the fault; default: the end", minimum=1)

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
        span = self._span(len(readings), dt)
        changed = self.change(readings, span, rng)
        if readings.dtype == np.uint8:
            changed = np.rint(changed).clip(0, 255)
        return choose_steps(span.at, changed, readings).astype(readings.dtype)

    def apply_presence(self, present: Mask, dt: float, rng: np.random.Generator) -> Mask:
        """(T,): steps with a reading after the fault. rng: in the state that ``apply`` received."""
        span = self._span(len(present), dt)
        return np.where(span.at, self.presence(present, span, rng), present)

    def presence(self, present: Mask, span: Span, rng: np.random.Generator) -> Mask:
        """(T,): steps with a reading if the fault is active at all steps. Most faults change readings only."""
        return present

    def _span(self, steps: int, dt: float) -> Span:
        index = np.arange(steps)
        at = (index >= self.from_) & (index < (steps if self.to is None else self.to))
        return Span(at, min(self.from_, steps - 1), dt)

    def to_json(self) -> dict[str, Any]:
        """``{"fault": name, parameter: value, ...}``; ``from`` and ``to`` only if they differ from the defaults."""
        values = {key: getattr(self, parameter.name) for key, parameter in parameters(type(self)).items()}
        return {"fault": self.name} | {k: v for k, v in values.items() if v is not None and (k, v) != ("from", 0)}

    def describe(self) -> str:
        """The fault with all of its values and units, also those of defaults: ``image_noise (std 40 gray levels)``."""
        texts = []
        for key, parameter in parameters(type(self)).items():
            value, unit = getattr(self, parameter.name), parameter.metadata["unit"]
            if key == "to" and value is not None:
                texts.append(f"to step {value - 1}")
            elif key == "from" and value:
                texts.append(f"from step {value}")
            elif key not in ("from", "to") and value not in (None, "") and (value or parameter.default):
                texts.append(f"{key} {_format(value)}" + ("" if unit in UNWRITTEN else f" {unit}"))
        return self.name + (f" ({', '.join(texts)})" if texts else "")

    def __str__(self) -> str:
        texts = {}
        for key, parameter in parameters(type(self)).items():
            value = getattr(self, parameter.name)
            if value != parameter.default or isinstance(value, str):
                texts[key] = _format(value)
        first = texts.pop(first_parameter(type(self)), None)
        return "".join([self.name, "" if first is None else f"={first}", *(f":{k}={v}" for k, v in texts.items())])


def parameters(fault: type[Fault]) -> dict[str, Field[Any]]:
    """Parameter name in text -> dataclass field; the span comes last. ``from`` is a Python keyword: ``from_``."""
    span = {parameter.name for parameter in fields(Fault)}
    ordered = sorted(fields(fault), key=lambda parameter: (parameter.kw_only, parameter.name in span))
    return {parameter.name.rstrip("_"): parameter for parameter in ordered}


def first_parameter(fault: type[Fault]) -> str:
    """Name of the parameter whose value directly follows the name of a fault: the first, but for an optional sensor."""
    return next(name for name, p in parameters(fault).items() if (p.metadata["kind"], p.default) != (str, None))


def _validate(fault: str, key: str, parameter: Field[Any], value: Any) -> Any:
    meta = parameter.metadata
    if value is None and parameter.default is None:
        return None
    if meta["kind"] is str:
        if not isinstance(value, str) or not value.isprintable() or not value.strip() or set(value) & set(",:="):
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


def choose_steps(mask: NDArray[np.bool_], yes: Readings, no: Readings) -> Readings:
    """(T, ...): ``yes`` at steps where the mask (T,) is true, else ``no``."""
    return np.where(mask.reshape(-1, *[1] * (no.ndim - 1)), yes, no)


def delay_steps(readings: Readings, steps: int) -> Readings:
    return readings[np.maximum(np.arange(len(readings)) - steps, 0)]


def axis_values(fault: Fault, readings: Readings) -> FloatArray:
    """(d,) x, y, z of the fault for a sensor (T, d). Raises BadInput for a nonzero value of an axis beyond d."""
    values = np.array([getattr(fault, axis) for axis in AXES], np.float32)
    d = readings.shape[1]
    if values[d:].any():
        raise BadInput(f"{fault} uses an axis that the sensor does not have. Available: {', '.join(AXES[:d])}.")
    return values[:d]


class Offset(Fault):
    """A constant with the parameters x, y and z is added to each axis."""

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings + axis_values(self, readings)


class GaussianNoise(Fault):
    """Independent noise of a standard deviation is added to every value."""

    std: float

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return readings + rng.normal(0.0, self.std, readings.shape)
