"""Settings of a fine-tuning run, and their JSON form."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.filters import legacy_names
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.slices import CLEAN, Slice
from beliefscope.filters.finetuning.success import Criterion

LIMITS = {"length": 10**4, "windows": 1024, "steps": 10**7, "check": 10**7, "patience": 10**7, "particles": 10**4}
"""Upper limits of the settings that determine the memory of a step and the duration of a run."""


@dataclass(frozen=True)
class StepRange:
    """Steps ``first`` to ``last - 1`` of the episode with this index; to its end if ``last`` is None."""

    episode: int
    first: int = 0
    last: int | None = None

    @classmethod
    def parse(cls, text: str) -> StepRange:
        """Reads ``9`` or ``9:20-60``. Raises BadInput for anything else."""
        match = re.fullmatch(r"(\d+)(?::(\d+)-(\d+))?", text.strip())
        if match is None or (match[2] is not None and int(match[3]) <= int(match[2])):
            raise BadInput(f"event {text!r} is not EPISODE or EPISODE:FIRST-LAST, such as 9 or 9:20-60")
        return cls(int(match[1]), int(match[2] or 0), None if match[3] is None else int(match[3]))

    def __str__(self) -> str:
        return f"{self.episode}" if self.last is None else f"{self.episode}:{self.first}-{self.last}"


@dataclass(frozen=True)
class FineTune:
    """Modules to train, training data and optimiser settings. The defaults make a run of about a minute.

    Attributes:
        train, freeze: presets and patterns of trained and frozen modules (``module_selection.py``).
        mix: slices to train on, with relative weights. clean_weight: weight of clean data in the loss, which preserves
            the filter's accuracy elsewhere; 1 without slices.
        events: restricts the slices to these steps; without, they cover all training episodes.
        length: steps in a window. windows: in a batch. steps: of the optimiser, at most.
        rate: Adam's learning rate, which decays to a twentieth. rates: patterns with their own rate, the last
            match takes precedence; by default ``dynamics.log_noise`` has ten times the rate, image encoders a third.
        l2_sp: strength of the decay towards the base checkpoint's weights. check: steps between two validations.
            patience: validations without improvement that end the run.
        particles, likelihood_weight: as in training (``Plan``). seed: of all random numbers.
        calibrate: whether process and measurement noise are scaled at the end such that NEES / n is 1 on the validation
            episodes (``calibration.py``).
        success: criterion of the run's verdict; without one there is no verdict.
    """

    train: tuple[str, ...] = ()
    freeze: tuple[str, ...] = ()
    mix: tuple[tuple[Slice, float], ...] = ()
    clean_weight: float = 0.5
    events: tuple[StepRange, ...] = ()
    length: int = 32
    windows: int = 16
    steps: int = 300
    rate: float = 3e-4
    rates: tuple[tuple[str, float], ...] = ()
    l2_sp: float = 1.0
    check: int = 25
    patience: int = 6
    particles: int = 30
    likelihood_weight: float = 0.05
    seed: int = 0
    calibrate: bool = False
    success: Criterion | None = None

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of its range."""
        for name, limit in LIMITS.items():
            value = getattr(self, name)
            if not 1 <= value <= limit:
                raise BadInput(f"{name} of a fine-tuning run is {value}, not a whole number from 1 to {limit}")
        if not 0 <= self.seed < 2**63:
            raise BadInput(f"seed of a fine-tuning run is {self.seed}, not a whole number from 0 to 2^63 - 1")
        for name in ("rate", "l2_sp", "likelihood_weight"):
            value = getattr(self, name)
            if not (0.0 < value < math.inf or (value == 0.0 and name != "rate")):
                raise BadInput(f"{name} of a fine-tuning run is {value!r}, not a number of at least 0")
        if not 0.0 <= self.clean_weight <= 1.0:
            raise BadInput(f"clean_weight of a fine-tuning run is {self.clean_weight!r}, not from 0 to 1")
        for pattern, rate in self.rates:
            if not 0.0 <= rate < math.inf:
                raise BadInput(f"the rate of {pattern!r} is {rate!r}, not a number of at least 0")
        for slice_, share in self.mix:
            if not 0.0 < share < math.inf:
                raise BadInput(f"the share of slice {slice_.name!r} is {share!r}, not above 0")
        if len({slice_.name for slice_, _ in self.mix} | {CLEAN.name}) != len(self.mix) + 1:
            raise BadInput(f"slice names must be unique, and {CLEAN.name!r} is reserved for clean data")

    def shares(self) -> dict[Slice, float]:
        """Weight of every slice in the loss, clean data first; they sum to 1."""
        total = sum(share for _, share in self.mix)
        clean = self.clean_weight if self.mix else 1.0
        others = {slice_: (1.0 - clean) * share / total for slice_, share in self.mix}
        return {slice_: share for slice_, share in {CLEAN: clean, **others}.items() if share > 0.0}

    def check_fit(self, filter_: Filter) -> None:
        """Raises BadInput if a slice or the success criterion does not fit the filter."""
        slices = [slice_ for slice_, _ in self.mix]
        for slice_ in slices:
            slice_.check(filter_.task, filter_.names)
        if self.success is not None:
            self.success.check(filter_.task, filter_.names, slices)

    def compared_slices(self, filter_: Filter) -> list[Slice]:
        """Slices to compare with the base checkpoint in addition to the standard ones."""
        trained = [slice_ for slice_, _ in self.mix]
        return self.success.slices(filter_.task, filter_.names, trained) if self.success else trained

    def to_json(self) -> dict[str, Any]:
        """The inverse of ``from_json``."""
        return {f.name: getattr(self, f.name) for f in fields(self)} | {
            "train": list(self.train),
            "freeze": list(self.freeze),
            "mix": [{"slice": slice_.to_json(), "share": share} for slice_, share in self.mix],
            "events": [str(event) for event in self.events],
            "rates": [list(rate) for rate in self.rates],
            "success": self.success and str(self.success),
        }

    @classmethod
    def from_json(cls, value: Any) -> FineTune:
        """Reads the values of ``to_json``; missing ones take their default. Raises BadInput for anything else."""
        if not isinstance(value, Mapping):
            raise BadInput(f'settings of a fine-tuning run are {value!r}, not an object such as {{"steps": 300}}')
        settings = {f.name: f for f in fields(cls)}
        arguments: dict[str, Any] = {}
        for key, setting in legacy_names.rename_keys(value, legacy_names.SETTINGS).items():
            if key not in settings:
                raise unknown_name("fine-tuning setting", str(key), settings)
            try:
                arguments[key] = _READERS[settings[key].type](setting)
            except (TypeError, ValueError, KeyError, AttributeError, OverflowError) as error:
                if isinstance(error, BadInput):
                    raise
                raise BadInput(f"setting {key!r} of a fine-tuning run is {setting!r}, which does not fit") from None
        return cls(**arguments)


def parse_rates(texts: Iterable[str]) -> tuple[float, tuple[tuple[str, float], ...]]:
    """Default rate, and rates of patterns, from texts such as ``0.001`` and ``weight_model=0.0001``.

    Raises BadInput for other texts.
    """
    default, rates = FineTune.rate, []
    for text in texts:
        pattern, _, number = text.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            raise BadInput(f"--rate {text!r} is neither a number nor PATTERN=NUMBER") from None
        if pattern:
            rates.append((pattern, value))
        else:
            default = value
    return default, tuple(rates)


def _names(value: Any) -> tuple[str, ...]:
    if isinstance(value, str) or not all(isinstance(name, str) for name in value):
        raise TypeError
    return tuple(value)


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    return float(value)


def _integer(value: Any) -> int:
    if _number(value) != int(value):
        raise TypeError
    return int(value)


def _boolean(value: Any) -> bool:
    if not isinstance(value, bool):
        raise TypeError
    return value


_READERS: dict[Any, Callable[[Any], Any]] = {
    "bool": _boolean,
    "tuple[str, ...]": _names,
    "tuple[tuple[Slice, float], ...]": lambda v: tuple((Slice.from_json(e["slice"]), _number(e["share"])) for e in v),
    "tuple[StepRange, ...]": lambda v: tuple(StepRange.parse(text) for text in v),
    "tuple[tuple[str, float], ...]": lambda v: tuple((str(name), _number(rate)) for name, rate in v),
    "Criterion | None": lambda v: Criterion.parse(v) if v else None,
    "float": _number,
    "int": _integer,
}
"""Type annotation of a setting -> reader of its JSON value."""
