"""Fault injection: apply a sequence of sensor faults to a copy of an episode.

Faults change the sensor readings, the controls computed from them and the controls themselves, never the ground truth
(states, contact, joint positions). The text ``blackout=0.4,force_bias:x=5:from=20`` stands for two faults: the value
after a fault's name sets its first parameter, the other parameters are named, and commas separate faults.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.episode import Episode, FloatArray, hold
from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.faults.control_faults import ControlFault
from beliefscope.datasets.faults.fault import Fault, Readings, first_parameter, parameters
from beliefscope.datasets.faults.faults import FAULTS
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.datasets.simulation.simulate import hand_controls
from beliefscope.datasets.task import Task, display_name


@dataclass(frozen=True)
class Faults:
    """A sequence of faults, applied in order. False if empty; ``+`` concatenates; ``str`` returns the text."""

    sequence: tuple[Fault, ...] = ()

    @classmethod
    def from_json(cls, value: Any) -> Faults:
        """From JSON: ``[{"fault": name, ...}, ...]``, a single such object, or ``{name: first parameter, ...}``.

        Raises BadInput for other values, unknown faults and parameters, and values out of range.
        """
        if isinstance(value, Mapping) and "fault" not in value:
            return cls(tuple(_create(name, {None: first}) for name, first in value.items()))
        items = [value] if isinstance(value, Mapping) else value
        if not isinstance(items, list) or not all(isinstance(item, Mapping) and "fault" in item for item in items):
            raise BadInput(f'faults is {value!r}, not a list of objects such as {{"fault": "blackout"}}')
        return cls(tuple(_create(item["fault"], {k: v for k, v in item.items() if k != "fault"}) for item in items))

    @classmethod
    def parse(cls, text: str) -> Faults:
        """From text, ``blackout=0.4,delay=image:steps=3`` or JSON. Raises BadInput for invalid faults."""
        if text.lstrip().startswith(("{", "[")):
            try:
                document = read_json(text)
            except ValueError as error:
                raise BadInput(f"faults is not JSON: {error}") from None
            return cls.from_json(document)
        return cls(tuple(_parse_fault(part.strip()) for part in text.split(",")) if text.strip() else ())

    def to_json(self) -> list[dict[str, Any]]:
        """The inverse of ``from_json``."""
        return [fault.to_json() for fault in self.sequence]

    def __str__(self) -> str:
        return ",".join(map(str, self.sequence))

    def __iter__(self) -> Iterator[Fault]:
        return iter(self.sequence)

    def __bool__(self) -> bool:
        return bool(self.sequence)

    def __add__(self, other: Faults) -> Faults:
        return Faults(self.sequence + other.sequence)

    def check(self, task: Task, steps: int = 0) -> None:
        """Raise BadInput for a fault of a sensor that the task does not have, or that starts after the last step.

        steps: number of steps of the longest episode; 0 if unknown.
        """
        for fault in self.sequence:
            fault.keys(task)
            if steps and fault.from_ >= steps:
                raise BadInput(f"fault {fault} starts after the last step, {steps - 1}")

    def apply_all(self, data: Dataset, indices: Sequence[int], seed: int = 0) -> dict[int, Episode]:
        """Faulty copies of episodes by index. Raises BadInput as ``apply`` and ``check``."""
        self.check(data.task, data.most_steps(indices))
        return {index: self.apply(data[index], seed) for index in indices}

    def apply(self, episode: Episode, seed: int = 0) -> Episode:
        """Return a faulty copy. Random numbers depend only on the seed, the episode's digest and each fault's position.

        Raises BadInput for a fault of a sensor that the episode does not have.
        """
        if not self.sequence:
            return episode
        observations, digest = dict(episode.observations), int(episode.digest()[:16], 16)
        present = {key: episode.present(key) for key in episode.task.masks}
        for position, fault in enumerate(self.sequence):
            for key in fault.keys(episode.task):
                if key not in observations:
                    raise unknown_name("observation of the episode", key, observations)
                # The same random numbers for all sensors of a modality: they drop out together.
                rng = [seed, digest, position]
                observations[key] = fault.apply(observations[key], episode.dt, np.random.default_rng(rng))
                if key in present:
                    present[key] = fault.apply_presence(present[key], episode.dt, np.random.default_rng(rng))
                    observations[key] = hold(observations[key], present[key])
        controls = derived_controls(episode, observations)
        for position, fault in enumerate(self.sequence):
            if isinstance(fault, ControlFault):
                controls = fault.apply(controls, episode.dt, np.random.default_rng([seed, digest, position]))
        masks = {episode.task.masks[key]: mask.astype(np.float32) for key, mask in present.items()}
        covariates = {**episode.covariates, **masks} if masks else episode.covariates
        return replace(episode, observations=observations, controls=controls, covariates=covariates)


NO_FAULTS = Faults()
"""The empty sequence of faults."""

FAULT_PRESETS: dict[str, str] = {
    "40 % image blackout": "blackout=0.4",
    "80 % image blackout": "blackout=0.8",
    "image frozen": "image_frozen=20",
    "image underexposed": "image_underexposed=0.4",
    "image noisy": "image_noise=40",
    "image occluded": "image_occluded=12",
    "image delayed 5 steps": "delay=image:steps=5",
    "image shifted 3 px": "image_shift=3",
    "force bias 5 N": "force_bias=5",
    "force noisy": "force_noise=5",
    "force drifting": "force_drift=1",
    "force saturated at 2 N": "force_saturation=2",
    "force axis stuck": "force_stuck=x:from=20",
    "force sign inverted": "force_gain=-1",
    "force x and y exchanged": "force_axes=yxz",
    "end-effector offset 2 cm": "effector_offset=0.02",
    "contact flag inverted": "contact_inverted",
    "contact flag stuck at 0": "contact_stuck=0",
    "contact flag delayed 5 steps": "contact_delayed=5",
    "haptics delayed 5 steps": "delay=haptics:steps=5",
    "haptics lost": "drop=haptics:from=20",
    "controls delayed 3 steps": "control_delay=3",
    "controls scaled by 0.5": "control_scale=0.5",
}
"""Label -> faults as text: suggested fault injections."""

RENAMED_FAULTS = {
    "image_darker": "image_underexposed",
    "image_patch": "image_occluded",
    "contact_late": "contact_delayed",
    "contact_flipped": "contact_inverted",
}
"""Fault name in files of earlier versions -> current name."""


def apply_to(text: str, task: Task) -> bool:
    """Whether faults as text are valid and apply to the sensors of a task."""
    with suppress(BadInput):
        Faults.parse(text).check(task)
        return True
    return False


def available_presets(task: Task) -> dict[str, str]:
    """``FAULT_PRESETS`` that apply to the sensors of the task, and faults of its other sensors and modalities."""
    presets = {name: text for name, text in FAULT_PRESETS.items() if apply_to(text, task)}
    common = {key for text in presets.values() for key in Faults.parse(text).sequence[0].keys(task)}
    for key in (key for key in task.observations if key not in common):
        if key in task.images:
            presets[f"40 % {display_name(key)} blackout"] = f"blackout=0.4:key={key}"
        presets[f"{display_name(key)} frozen"] = f"sensor_frozen={key}:from=20"
    for name in (name for name in task.modalities if name not in ("image", "haptics")):
        presets[f"{display_name(name)} lost"] = f"drop={name}:from=20"
        presets[f"{display_name(name)} delayed 5 steps"] = f"delay={name}:steps=5"
    return presets


def read_faults(text: str, task: Task) -> Faults:
    """Faults from text, JSON, or the path of a JSON file (ends in .json or has a separator).

    Raises BadInput for an unreadable file and for faults that do not apply to the task.
    """
    if not text.lstrip().startswith(("{", "[")) and (text.endswith(".json") or os.sep in text):
        try:
            text = Path(text).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            raise BadInput(f"faults {text!r} is not a readable file") from None
    faults = Faults.parse(text)
    faults.check(task)
    return faults


@dataclass(frozen=True)
class FaultParameter:
    """A parameter of a fault."""

    name: str
    default: Any
    unit: str
    meaning: str


@dataclass(frozen=True)
class FaultInfo:
    """A kind of fault."""

    fault: str
    meaning: str
    parameters: Sequence[FaultParameter]


def fault_catalog() -> list[FaultInfo]:
    """All faults."""
    catalog = []
    for name, fault in FAULTS.items():
        described = [
            FaultParameter(key, p.default, p.metadata["unit"], p.metadata["meaning"])
            for key, p in parameters(fault).items()
        ]
        catalog.append(FaultInfo(name, (fault.__doc__ or "").split("\n")[0], described))
    return catalog


def faulty_copies(faults: Faults, episodes: Iterable[Episode], seed: int) -> list[Episode]:
    """Return a faulty copy of each training episode."""
    return [faults.apply(episode, seed) for episode in episodes if episode.split == "train"]


def _create(name: Any, values: Mapping[str | None, Any]) -> Fault:
    """Create a fault. The key None stands for its ``first_parameter``."""
    name = RENAMED_FAULTS.get(str(name), name)
    if not isinstance(name, str) or name not in FAULTS:
        raise unknown_name("fault", str(name), FAULTS)
    available = parameters(FAULTS[name])
    arguments: dict[str, Any] = {}
    for key, value in values.items():
        key = first_parameter(FAULTS[name]) if key is None else key
        if key not in available:
            raise unknown_name(f"parameter of {name}", key, available)
        if available[key].name in arguments:
            raise BadInput(f"{name}'s {key!r} is given twice")
        arguments[available[key].name] = value
    return FAULTS[name](**arguments)


def _parse_fault(text: str) -> Fault:
    """Parse ``name`` or ``name=value``, followed by any number of ``:parameter=value``."""
    head, *rest = text.split(":")
    name, _, first = head.partition("=")
    values: dict[str | None, Any] = {None: _parse_value(first)} if first else {}
    for part in rest:
        key, equals, value = part.partition("=")
        if not equals or key in values:
            raise BadInput(f"{part!r} in {text!r} is not parameter=value, each parameter once")
        values[key] = _parse_value(value)
    return _create(name, values)


def _parse_value(text: str) -> float | int | str:
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


def derived_controls(episode: Episode, observations: Mapping[str, Readings]) -> FloatArray:
    """Controls recomputed from other readings, if the episode's controls derive from its readings."""
    keys = ("effector_position", "contact")
    if not all(key in episode.observations for key in keys):
        return episode.controls
    if not np.array_equal(hand_controls(*(episode.observations[key] for key in keys)), episode.controls):
        return episode.controls
    return hand_controls(*(observations[key] for key in keys))
