"""Whether a fault affects a filter, or is masked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from beliefscope.inspect.diagnosis.cause import Recovery
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation

VISIBLE = {"error//all": 1.2, "angle error//all": 1.2, "nees/fused/all": 2.0}
"""Statistic -> ratio to its healthy value, or inverse ratio of the NEES, from which a fault affects the filter."""

UNUSED = 1.05
"""Largest ratio of these statistics with and without a sensor that a filter hardly uses."""


@dataclass(frozen=True)
class Effect:
    """Effect of undoing a cause.

    Attributes:
        restored: share of all deviations that disappears.
        ratios: statistic of ``VISIBLE`` -> value with the fault relative to that without it.
        complete: whether the undo brings back healthy readings, modules or equations; else it removes a sensor.
    """

    recovery: Recovery
    restored: float
    ratios: Mapping[str, float]
    complete: bool


def is_visible(deviations: Mapping[str, Deviation], effect: Effect | None) -> bool:
    """Whether a fault affects the filter: its error or calibration differ from those without the fault.

    If it was undone, these are known for the same episodes. A sensor that could only be removed affects the filter if
    the error decreases without it. Beyond that, errors and calibration must be outside of the healthy range or, if the
    fault was undone or removing the sensor changes nothing, show as alarms, because episodes differ.

    Args:
        deviations: by statistic.
        effect: of undoing the fault; None if it was not undone.
    """
    explained = False
    if effect is not None:
        removed = {"error//all": 1.0 / max(1.0 - effect.recovery.error, 1e-9)}
        changes = effect.ratios if effect.complete else removed
        if any(_large(name, ratio) for name, ratio in changes.items()):
            return True
        unused = bool(effect.ratios) and all(1.0 / UNUSED < ratio < UNUSED for ratio in effect.ratios.values())
        explained = effect.complete or unused
    found = (deviations.get(name) for name in VISIBLE)
    return any(
        _large(d.statistic, d.value / d.healthy) and (d.alarm if explained else not d.low <= d.value <= d.high)
        for d in found
        if d is not None
    )


def _large(statistic: str, ratio: float) -> bool:
    """Whether a statistic of ``VISIBLE`` changes by its limit; errors that decrease do not count."""
    limit = VISIBLE[statistic]
    return ratio > limit or (statistic.startswith("nees") and ratio < 1.0 / limit)
