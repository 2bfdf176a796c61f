"""Covariates: what is known about each step besides state and sensors, such as contact, a GPS fix or the speed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Kind = Literal["boolean", "categorical", "continuous"]


@dataclass(frozen=True)
class Covariate:
    """A covariate and the groups of steps that it defines. A value NaN is unknown and belongs to no group.

    Attributes:
        kind: ``boolean`` (0 or 1), ``categorical`` (0, 1, ...: index in ``groups``) or ``continuous``.
        groups: names of the groups: of 0 and 1, of the categories, or of the intervals between the cuts. May be empty
            for a boolean or continuous covariate.
        cuts: of a continuous covariate: ascending limits of its intervals [-inf, cut), [cut, ...); without any, it
            defines no groups.
        unit: of a continuous covariate, for display.
    """

    kind: Kind
    groups: tuple[str, ...] = ()
    cuts: tuple[float, ...] = ()
    unit: str = ""

    @property
    def shaded(self) -> int | None:
        """Number of groups to shade in plots over time: of a boolean covariate only that of 1; None: all."""
        return 1 if self.kind == "boolean" else None

    def group_names(self, name: str) -> tuple[str, ...]:
        """Names of the groups of the covariate with this name."""
        if self.groups or self.kind == "categorical":
            return self.groups
        if self.kind == "boolean":
            return f"no {name}", name
        if not self.cuts:
            return ()
        ends = [f"{cut:g}" for cut in self.cuts]
        inner = [f"{name} {low} to {high}" for low, high in pairwise(ends)]
        names = [f"{name} below {ends[0]}", *inner, f"{name} from {ends[-1]}"]
        return tuple(f"{text} {self.unit}".rstrip() for text in names)

    def group_index(self, values: NDArray[np.float32]) -> NDArray[np.int64]:
        """(T,) index of the group of each value; -1 for an unknown one, and if there are no groups."""
        if self.kind == "continuous":
            index = np.digitize(values, self.cuts) if self.cuts else np.full(len(values), -1)
        else:
            index = np.where(np.isnan(values), -1, values)
        return np.where(np.isnan(values), -1, index).astype(np.int64)

    def masks(self, name: str, values: NDArray[np.float32]) -> Iterator[tuple[str, NDArray[np.bool_]]]:
        """Name and mask (T,) of each group; of a boolean covariate first that of 1."""
        groups, index = list(enumerate(self.group_names(name))), self.group_index(values)
        for number, group in reversed(groups) if self.kind == "boolean" else groups:
            yield group, index == number


CONTACT = Covariate("boolean", ("free motion", "contact"))
"""Whether the robot touches the object."""

STATES = frozenset({"contact", "free motion", "blackout"})
"""Phases whose names follow *in*."""


def in_phase(phase: str, covariates: Mapping[str, Covariate]) -> str:
    """Where a phase is, for sentences: ``in contact``, ``at steps with no fix``; ``in phase`` with the name of a group.

    covariates: of the task, by name.
    """
    if phase in STATES:
        return f"in {phase}"
    is_derived = any(not c.groups and phase in c.group_names(name) for name, c in covariates.items())
    return f"at steps with {phase}" if is_derived else f"in phase {phase}"
