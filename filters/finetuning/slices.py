"""Slices: parts of what a filter meets, to be measured and trained apart. ``blackout in contact`` is one.

In text, ``NAME:faults=FAULTS:contact=yes:only=MODALITY+MODALITY``, of which all but the name may be left out. What
stands behind ``faults=`` up to ``contact=`` or ``only=`` is the faults's own text, colons included.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.datasets.faults.injection import WHOLE, Faults
from beliefscope.datasets.task import Task
from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Evidence

CONTACT = {"yes": True, "no": False}


@dataclass(frozen=True)
class Slice:
    """What is broken, which steps count, and who may speak.

    Attributes:
        name: as shown; without ``:`` and ``=``. faults: how the sensors are broken.
        contact: only steps that truly are in contact (True) or out of it (False); None: all steps.
        only: the measurement models whose evidence is used; empty: all of them.
    """

    name: str
    faults: Faults = WHOLE
    contact: bool | None = None
    only: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Raises BadInput for a name that could not be read back."""
        if not self.name.strip() or self.name != self.name.strip() or set(self.name) & set(":=\n"):
            raise BadInput(f"a slice's name is {self.name!r}; give it some text without : and =")

    @classmethod
    def parse(cls, text: str, standard: Iterable[Slice] = ()) -> Slice:
        """From its text, or from the bare name of one of the ``standard`` slices.

        Raises BadInput for a name that is not among them, a key that there is not, or a value that does not fit.
        """
        name, *parts = text.split(":")
        known = {one.name: one for one in standard}
        if not parts:
            if name.strip() not in known:
                raise BadInput(f"{one_of('slice', name, known)} A new one is written {name}:faults=...:contact=yes")
            return known[name.strip()]
        values: dict[str, str] = {}
        for part in parts:
            key, equals, value = part.partition("=")
            if key.strip() in ("faults", "contact", "only") and equals and key.strip() not in values:
                values[key.strip()] = value
            elif values and next(reversed(values)) == "faults":
                values["faults"] += f":{part}"
            else:
                raise BadInput(f"{part!r} in slice {text!r} is not a new one of faults=..., contact=yes|no, only=...")
        contact = values.get("contact")
        if contact is not None and contact not in CONTACT:
            raise BadInput(f"contact is {contact!r} in slice {text!r}; it is yes or no")
        only = values.get("only")
        return cls(
            name=name.strip(),
            faults=Faults.parse(values.get("faults", "")),
            contact=None if contact is None else CONTACT[contact],
            only=() if only is None else tuple(one.strip() for one in only.split("+")),
        )

    @classmethod
    def of(cls, value: Any) -> Slice:
        """From its text or from ``to_json``'s values, all but the name may be left out. Raises BadInput for others."""
        if isinstance(value, str):
            return cls.parse(value)
        if not isinstance(value, Mapping) or not isinstance(value.get("name"), str):
            raise BadInput(f'slice is {value!r}, not an object such as {{"name": "contact", "contact": true}}')
        for key in value:
            if key not in ("name", "faults", "recipe", "contact", "only"):  # recipe: files of earlier versions
                raise one_of("key of a slice", str(key), ("name", "faults", "contact", "only"))
        contact, only = value.get("contact"), value.get("only", [])
        if contact not in (None, True, False) or isinstance(contact, int) != isinstance(contact, bool):
            raise BadInput(f"slice's contact is {contact!r}; it is true, false or null")
        if not isinstance(only, list) or not all(isinstance(one, str) for one in only):
            raise BadInput(f"slice's only is {only!r}, not a list of modalities")
        return cls(value["name"], Faults.of(value.get("faults", value.get("recipe", []))), contact, tuple(only))

    def to_json(self) -> dict[str, Any]:
        """``Slice.of`` makes the same of it."""
        return {
            "name": self.name,
            "faults": self.faults.to_json(),
            "contact": self.contact,
            "only": list(self.only),
        }

    def __str__(self) -> str:
        """``Slice.parse`` makes the same of it."""
        parts = [f"faults={self.faults}"] if self.faults else []
        parts += [] if self.contact is None else [f"contact={'yes' if self.contact else 'no'}"]
        parts += [f"only={'+'.join(self.only)}"] if self.only else []
        return ":".join([self.name, *(parts or ["faults="])])

    def check(self, task: Task, models: Sequence[str]) -> None:
        """Raises BadInput where the task lacks a sensor, or the filter one of ``models`` that the slice names."""
        self.faults.check(task)
        for name in self.only:
            if name not in models:
                raise one_of(f"modality of slice {self.name!r}", name, models)

    def broken(self, episodes: Iterable[Episode], seed: int) -> list[Episode]:
        """Copies of episodes with the slice's faults."""
        return [self.faults.apply(episode, seed) for episode in episodes]

    def mask(self, batch: Batch) -> Tensor:
        """(T, N) bool: the steps that count."""
        return torch.ones_like(batch.contact) if self.contact is None else batch.contact == self.contact

    def heard(self, evidence: Evidence, models: Sequence[str]) -> Evidence:
        """The evidence of those who may speak: as if the rest of ``models`` were not there."""
        if not self.only:
            return evidence
        present = torch.tensor([name in self.only for name in models], device=evidence.control.device)
        return evidence.of(present.expand(*evidence.control.shape[:2], -1))


NOMINAL = Slice("nominal")
"""Everything as it is."""


def slices_of(task: Task) -> tuple[Slice, ...]:
    """What is always looked at: nominal, contact and not, 80 % black pictures, each modality alone."""
    found = [
        NOMINAL,
        Slice("contact", contact=True),
        Slice("no contact", contact=False),
        Slice("blackout 0.8", Faults.parse("blackout=0.8")),
    ]
    if len(task.modalities) > 1:
        found += [Slice(f"{modality} alone", only=(modality,)) for modality in task.modalities]
    return tuple(one for one in found if _fits(one, task))


def _fits(one: Slice, task: Task) -> bool:
    with suppress(BadInput):
        one.check(task, tuple(task.modalities))
        return True
    return False
