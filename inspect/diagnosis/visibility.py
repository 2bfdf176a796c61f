"""Whether a fault affects a filter, or is masked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from beliefscope.inspect.diagnosis.cause import Recovery
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation

VISIBLE = {"error//all": 1.2, "angle error//all": 1.2, "nees/fused/all": 2.0}
"""Statistic -> ratio to its healthy value, or inverse ratio of the NEES, from which a fault affects the filter."""


@dataclass(frozen=True)
class Effect:
    """Effect of undoing a cause.

    Attributes:
        restored: share of all deviations that disappears.
        ratios: statistic of ``VISIBLE`` -> value with the fault relative to that without it; empty if the cause cannot
            be undone completely.
    """

    recovery: Recovery
    restored: float
    ratios: Mapping[str, float]


def is_visible(deviations: Mapping[str, Deviation], effect: Effect | None) -> bool:
    """Whether a fault affects the filter: its error or calibration differ from those without the fault.

    If it was undone, these are known for the same episodes, and other faults must show as alarms. Otherwise errors and
    calibration must be outside of the healthy range, or the error decrease without the faulty sensor.

    Args:
        deviations: by statistic.
        effect: of undoing the fault; None if it was not undone.
    """
    undone = effect is not None and bool(effect.ratios)
    if effect is not None:
        changes = effect.ratios or {"error//all": 1.0 / max(1.0 - effect.recovery.error, 1e-9)}
        if any(_large(name, ratio) for name, ratio in changes.items()):
            return True
    found = (deviations.get(name) for name in VISIBLE)
    return any(
        _large(d.statistic, d.value / d.healthy) and (d.alarm if undone else not d.low <= d.value <= d.high)
        for d in found
        if d is not None
    )


def _large(statistic: str, ratio: float) -> bool:
    """Whether a statistic of ``VISIBLE`` changes by its limit; errors that decrease do not count."""
    limit = VISIBLE[statistic]
    return ratio > limit or (statistic.startswith("nees") and ratio < 1.0 / limit)
