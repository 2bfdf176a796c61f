"""Ingredients of simulated tasks: sources of variation that can be switched off."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Ingredient:
    """A source of variation between the episodes of a simulated task, which can be switched off.

    Attributes:
        meaning: one line, with units. ranges: parameter -> smallest and largest value, drawn uniformly per episode.
        units: parameter -> SI unit; others have none. Data files do not contain them.
    """

    meaning: str
    ranges: Mapping[str, tuple[float, float]]
    units: Mapping[str, str] = field(default_factory=dict, compare=False)
