"""Fault injections: faults that act one after the other on an episode and leave a broken copy.

What the sensors report changes, and the controls that follow from it; the truth (states, contact, joint positions)
never does. In text, ``blackout=0.4,force_bias:x=5:from=20`` is two faults: a value right behind a fault's name is its
first parameter's, the others are named; commas divide faults.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode, FloatArray
from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.datasets.faults.faults import FAULTS, Fault, Readings, parameters
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.datasets.simulation.simulate import hand_controls
from beliefscope.datasets.task import Task


@dataclass(frozen=True)
class Faults:
    """Faults in the order in which they act; ``bool`` says whether there are any, ``+`` joins, ``str`` is its text."""

    sequence: tuple[Fault, ...] = ()

    @classmethod
    def of(cls, value: Any) -> Faults:
        """From JSON: a list of ``{"fault": name, ...}``, one such, or ``{name: first parameter's value, ...}``.

        Raises BadInput for anything else, and for faults, parameters and values that there are not.
        """
        if isinstance(value, Mapping) and "fault" not in value:
            return cls(tuple(_fault(name, {None: first}) for name, first in value.items()))
        listed = [value] if isinstance(value, Mapping) else value
        if not isinstance(listed, list) or not all(isinstance(one, Mapping) and "fault" in one for one in listed):
            raise BadInput(f'faults is {value!r}, not a list of objects such as {{"fault": "blackout"}}')
        return cls(tuple(_fault(one["fault"], {k: v for k, v in one.items() if k != "fault"}) for one in listed))

    @classmethod
    def parse(cls, text: str) -> Faults:
        """From its text, ``blackout=0.4,delay=image:steps=3``, or from JSON as text. Raises BadInput as ``of`` does."""
        if text.lstrip().startswith(("{", "[")):
            try:
                document = read_json(text)
            except ValueError as error:
                raise BadInput(f"faults is not JSON: {error}") from None
            return cls.of(document)
        return cls(tuple(_read(part.strip()) for part in text.split(",")) if text.strip() else ())

    def to_json(self) -> list[dict[str, Any]]:
        """``Faults.of`` makes the same of it."""
        return [fault.to_json() for fault in self.sequence]

    def __str__(self) -> str:
        return ",".join(map(str, self.sequence))

    def __iter__(self) -> Iterator[Fault]:
        return iter(self.sequence)

    def __bool__(self) -> bool:
        return bool(self.sequence)

    def __add__(self, other: Faults) -> Faults:
        return Faults(self.sequence + other.sequence)

    def check(self, task: Task) -> None:
        """Raises BadInput for a fault of a sensor that the task has not."""
        for fault in self.sequence:
            fault.keys(task)

    def apply(self, episode: Episode, seed: int = 0) -> Episode:
        """A broken copy. What is drawn depends on the seed, the episode's digest and each fault's place alone.

        Raises BadInput for a fault of a sensor that the episode's task has not.
        """
        if not self.sequence:
            return episode
        task, observations, digest = find_task(episode.task), dict(episode.observations), int(episode.digest()[:16], 16)
        for place, fault in enumerate(self.sequence):
            for key in fault.keys(task):
                if key not in observations:
                    raise one_of("observation of the episode", key, observations)
                # The same draws for all sensors of a modality: they are lost together.
                rng = np.random.default_rng([seed, digest, place])
                observations[key] = fault.apply(observations[key], episode.dt, rng)
        return replace(episode, observations=observations, controls=_controls(episode, observations))


WHOLE = Faults()
"""No fault."""

FAULT_PRESETS: dict[str, str] = {
    "40 % black pictures": "blackout=0.4",
    "80 % black pictures": "blackout=0.8",
    "image frozen": "image_frozen=20",
    "image darker": "image_darker=0.4",
    "image noisy": "image_noise=40",
    "image behind a patch": "image_patch=12",
    "image 5 steps late": "delay=image:steps=5",
    "force off by 5 N": "force_bias=5",
    "force noisy": "force_noise=5",
    "force drifting": "force_drift=1",
    "force saturated at 2 N": "force_saturation=2",
    "force axis stuck": "force_stuck=x:from=20",
    "effector off by 2 cm": "effector_offset=0.02",
    "contact flipped": "contact_flipped",
    "contact 5 steps late": "contact_late=5",
    "haptics 5 steps late": "delay=haptics:steps=5",
    "haptics dropped": "drop=haptics:from=20",
}
"""What it is called -> faults: the ones to try first."""


def ready(task: Task) -> dict[str, str]:
    """Those of ``FAULT_PRESETS`` that the task has the sensors for."""

    def fits(text: str) -> bool:
        with suppress(BadInput):
            Faults.parse(text).check(task)
            return True
        return False

    return {name: text for name, text in FAULT_PRESETS.items() if fits(text)}


def described() -> list[dict[str, Any]]:
    """Every fault as JSON values: ``fault``, ``meaning`` and ``parameters``, each with default, unit and meaning."""
    return [
        {
            "fault": name,
            "meaning": (fault.__doc__ or "").split("\n")[0],
            "parameters": [
                {"name": key, "default": p.default, "unit": p.metadata["unit"], "meaning": p.metadata["meaning"]}
                for key, p in parameters(fault).items()
            ],
        }
        for name, fault in FAULTS.items()
    ]


def broken_copies(faults: Faults, episodes: Iterable[Episode], seed: int) -> list[Episode]:
    """A broken copy of each training episode."""
    return [faults.apply(episode, seed) for episode in episodes if episode.split == "train"]


def _fault(name: Any, given: Mapping[str | None, Any]) -> Fault:
    """The fault of that name; the key None stands for its first parameter."""
    if not isinstance(name, str) or name not in FAULTS:
        raise one_of("fault", str(name), FAULTS)
    known = parameters(FAULTS[name])
    arguments: dict[str, Any] = {}
    for key, value in given.items():
        key = next(iter(known)) if key is None else key
        if key not in known:
            raise one_of(f"parameter of {name}", key, known)
        if known[key].name in arguments:
            raise BadInput(f"{name}'s {key!r} is given twice")
        arguments[known[key].name] = value
    return FAULTS[name](**arguments)


def _read(text: str) -> Fault:
    """A fault from its text: ``name``, ``name=value`` and so on with ``:parameter=value``."""
    head, *rest = text.split(":")
    name, _, first = head.partition("=")
    given: dict[str | None, Any] = {None: _value(first)} if first else {}
    for part in rest:
        key, equals, value = part.partition("=")
        if not equals or key in given:
            raise BadInput(f"{part!r} in {text!r} is not a new parameter=value")
        given[key] = _value(value)
    return _fault(name, given)


def _value(text: str) -> float | int | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def _controls(episode: Episode, observations: Mapping[str, Readings]) -> FloatArray:
    """The controls that follow from what is now reported, where the episode's follow from what was."""
    keys = ("effector_position", "contact")
    if not all(key in episode.observations for key in keys):
        return episode.controls
    if not np.array_equal(hand_controls(*(episode.observations[key] for key in keys)), episode.controls):
        return episode.controls
    return hand_controls(*(observations[key] for key in keys))
