"""Data slices: subsets of steps, sensor faults and modalities that are evaluated and trained on separately.

As text, ``NAME:faults=FAULTS:contact=yes:only=MODALITY+MODALITY``; everything but the name is optional. The text after
``faults=``, up to ``contact=`` or ``only=``, is that of the faults, colons included.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults, read_faults
from beliefscope.datasets.task import Task
from beliefscope.filters import legacy_names
from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Evidence

CONTACT = {"yes": True, "no": False}
KEYS = ("name", "faults", "contact", "only")


@dataclass(frozen=True)
class Slice:
    """Sensor faults, a condition on the steps, and the modalities to use.

    Attributes:
        name: displayed; without ``:`` and ``=``. faults: injected into the sensors.
        contact: restricts to steps in true contact (True) or in free motion (False); None: all steps.
        only: the measurement models whose evidence is used; empty: all.
    """

    name: str
    faults: Faults = NO_FAULTS
    contact: bool | None = None
    only: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Raises BadInput for a name that ``parse`` could not read."""
        if not self.name.strip() or self.name != self.name.strip() or set(self.name) & set(":=\n"):
            raise BadInput(f"a slice's name is {self.name!r}; it must not be empty or contain : or =")

    @classmethod
    def parse(cls, text: str, standard: Iterable[Slice] = ()) -> Slice:
        """Reads a slice's text, or the name of one of the ``standard`` slices.

        Raises BadInput for an unknown name or key, and for an invalid value.
        """
        name, *parts = text.split(":")
        if not parts:
            by_name = {slice_.name: slice_ for slice_ in standard}
            name = legacy_names.slice_name(name.strip())
            if name not in by_name:
                error = unknown_name("slice", name, by_name)
                raise BadInput(f"{error} To define a new one, write {name}:faults=...:contact=yes")
            return by_name[name]
        values: dict[str, str] = {}
        for part in parts:
            key, equals, value = part.partition("=")
            if key.strip() in KEYS[1:] and equals and key.strip() not in values:
                values[key.strip()] = value
            elif values and next(reversed(values)) == "faults":
                values["faults"] += f":{part}"
            else:
                raise BadInput(
                    f"{part!r} in slice {text!r} is not one of faults=..., contact=yes|no, only=..., each once"
                )
        contact = values.get("contact")
        if contact is not None and contact not in CONTACT:
            raise BadInput(f"contact is {contact!r} in slice {text!r}, expected yes or no")
        only = values.get("only")
        return cls(
            name=name.strip(),
            faults=Faults.parse(values.get("faults", "")),
            contact=None if contact is None else CONTACT[contact],
            only=() if only is None else tuple(modality.strip() for modality in only.split("+")),
        )

    @classmethod
    def from_json(cls, value: Any) -> Slice:
        """Reads a slice's text or the values of ``to_json``; only the name is required. Raises BadInput for others."""
        if isinstance(value, str):
            return cls.parse(value)
        if not isinstance(value, Mapping) or not isinstance(value.get("name"), str):
            raise BadInput(f'slice is {value!r}, not an object such as {{"name": "contact", "contact": true}}')
        value = legacy_names.slice_json(value)
        for key in value:
            if key not in KEYS:
                raise unknown_name("slice key", str(key), KEYS)
        contact, only = value.get("contact"), value.get("only", [])
        if contact not in (None, True, False) or isinstance(contact, int) != isinstance(contact, bool):
            raise BadInput(f"contact of a slice is {contact!r}, expected true, false or null")
        if not isinstance(only, list) or not all(isinstance(modality, str) for modality in only):
            raise BadInput(f"only of a slice is {only!r}, not a list of modalities")
        return cls(value["name"], Faults.from_json(value.get("faults", [])), contact, tuple(only))

    def to_json(self) -> dict[str, Any]:
        """The inverse of ``from_json``."""
        return {
            "name": self.name,
            "faults": self.faults.to_json(),
            "contact": self.contact,
            "only": list(self.only),
        }

    def __str__(self) -> str:
        """The inverse of ``parse``."""
        parts = [f"faults={self.faults}"] if self.faults else []
        parts += [] if self.contact is None else [f"contact={'yes' if self.contact else 'no'}"]
        parts += [f"only={'+'.join(self.only)}"] if self.only else []
        return ":".join([self.name, *(parts or ["faults="])])

    def check(self, task: Task, models: Sequence[str]) -> None:
        """Raises BadInput if the task lacks a sensor or contact, or the ``models`` one of the slice's modalities."""
        self.faults.check(task)
        if self.contact is not None and "contact" not in task.covariates:
            raise BadInput(f"slice {self.name!r} selects steps by contact, which task {task.name!r} does not declare")
        for name in self.only:
            if name not in models:
                raise unknown_name(f"modality of slice {self.name!r}", name, models)

    def apply_faults(self, episodes: Iterable[Episode], seed: int) -> list[Episode]:
        """Copies of episodes with the slice's faults."""
        return [self.faults.apply(episode, seed) for episode in episodes]

    def mask(self, batch: Batch) -> Tensor:
        """(T, N) bool: the steps of the slice."""
        return torch.ones_like(batch.contact) if self.contact is None else batch.contact == self.contact

    def select_evidence(self, evidence: Evidence, models: Sequence[str]) -> Evidence:
        """The evidence of the slice's modalities, as if the other ``models`` were absent."""
        if not self.only:
            return evidence
        present = torch.tensor([name in self.only for name in models], device=evidence.control.device)
        return evidence.select_models(present.expand(*evidence.control.shape[:2], -1))


CLEAN = Slice("clean")
"""All steps, all modalities, no faults."""


def standard_slices(task: Task) -> tuple[Slice, ...]:
    """The slices evaluated by default: clean, contact, free motion, 80 % image blackout, each single modality."""
    slices = [
        CLEAN,
        Slice("contact", contact=True),
        Slice("free motion", contact=False),
        Slice("blackout 0.8", Faults.parse("blackout=0.8")),
    ]
    if len(task.modalities) > 1:
        slices += [Slice(f"{modality} only", only=(modality,)) for modality in task.modalities]
    return tuple(slice_ for slice_ in slices if _fits(slice_, task))


OCCLUDED_IMAGES = Slice("image occluded", Faults.parse("image_occluded=12"))
NOISY_IMAGES = Slice("image noisy", Faults.parse("image_noise=40"))
NOISY_HAPTICS = Slice("haptics noisy", Faults.parse("force_noise=5,contact_inverted=0.3"))

FAULT_SLICES = {OCCLUDED_IMAGES: "image", NOISY_IMAGES: "image", NOISY_HAPTICS: "haptics"}
"""Slice of all steps with a fault that the training data lack -> modality."""


def fault_slices(task: Task, models: Sequence[str]) -> list[Slice]:
    """The ``FAULT_SLICES`` whose modalities a filter's models use and whose sensors the task has."""
    used = {modality for model in models for modality in model.split("+")}
    return [slice_ for slice_, modality in FAULT_SLICES.items() if modality in used and _fits(slice_, task)]


def fault_slice(faults: Faults) -> Slice:
    """The slice of all steps with these faults, named after them."""
    return Slice(str(faults).replace("=", " ").replace(":", " "), faults)


def parse_slices(texts: Iterable[str], fault_sets: Iterable[str], task: Task) -> list[Slice]:
    """Slices from their text, and slices of all steps with faults, given as text or file. Raises BadInput."""
    named = (*standard_slices(task), *fault_slices(task, tuple(task.modalities)))
    texts = list(texts)
    groups = {group for name, covariate in task.covariates.items() for group in covariate.group_names(name)}
    if other := sorted(groups.intersection(texts) - {slice_.name for slice_ in named}):
        raise BadInput(
            f"slices select steps by contact only, not by {other[0]!r}; a sweep has the errors in its steps, as a "
            "phase (docs/sweep.md)"
        )
    slices = [Slice.parse(text, named) for text in texts]
    for text in fault_sets:
        faults = read_faults(text, task)
        slices.append(fault_slice(faults))
    return slices


def _fits(slice_: Slice, task: Task) -> bool:
    with suppress(BadInput):
        slice_.check(task, tuple(task.modalities))
        return True
    return False
