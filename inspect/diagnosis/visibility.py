"""Whether a fault affects a filter, or is masked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from beliefscope.inspect.diagnosis.cause import Recovery
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation
from beliefscope.inspect.statistics.measures import counted, errors, nees
from beliefscope.inspect.trace import Trace

NEES = "nees/fused/all"

VISIBLE = {"error//all": 1.2, "angle error//all": 1.2, NEES: 2.0}
"""Statistic -> ratio to its healthy value, or inverse ratio of the NEES, from which a fault affects the filter."""

BY_UNIT = {"m": "error//all", "rad": "angle error//all"}
"""Unit of state components -> statistic of ``VISIBLE``."""

UNUSED = 1.05
"""Largest ratio of these statistics with and without a sensor that a filter hardly uses."""


@dataclass(frozen=True)
class Effect:
    """Effect of undoing a cause.

    Attributes:
        restored: share of all deviations that disappears.
        ratios: statistic of ``VISIBLE`` -> value with the fault relative to that without it, over all episodes.
        complete: whether the undo brings back healthy readings, modules or equations; else it removes a sensor.
    """

    recovery: Recovery
    restored: float
    ratios: Mapping[str, float]
    complete: bool

    @property
    def failed(self) -> bool:
        """Whether errors are clearly larger after undoing the cause, which does not show the run without it."""
        return any(ratio < 1.0 / VISIBLE[name] for name, ratio in self.ratios.items() if name != NEES)


def effect_ratios(before: Sequence[Trace], after: Sequence[Trace]) -> dict[str, float]:
    """Ratios of the root mean square errors by unit, and of the mean NEES, over the counted steps of all episodes.

    before, after: runs with and without the fault. Statistics that are unknown are absent.
    """
    pairs = zip(_totals(before).items(), _totals(after).values(), strict=True)
    ratios = {name: a / b for (name, a), b in pairs if np.isfinite(a) and np.isfinite(b) and b > 0.0}
    return {name: ratio if name == NEES else float(np.sqrt(ratio)) for name, ratio in ratios.items()}


def _totals(traces: Sequence[Trace]) -> dict[str, float]:
    """Statistic of ``VISIBLE`` -> sum of the squared errors or of the NEES over the counted steps."""
    units = np.array([component.unit for component in traces[0].task.components])
    squares = sum(np.square(errors(trace)[counted(trace), -1]).sum(0) for trace in traces)
    totals = {name: float(np.sum(squares[units == unit])) for unit, name in BY_UNIT.items() if unit in units}
    if all(trace.has_covariance for trace in traces):
        totals[NEES] = float(sum(nees(trace)[counted(trace), -1].sum() for trace in traces))
    return totals


def is_visible(deviations: Mapping[str, Deviation], effect: Effect | None) -> bool:
    """Whether a fault affects the filter: its error or calibration differ from those without the fault.

    If it was undone, these are known for the same episodes, unless the undo failed. A sensor that could only be
    removed affects the filter if an error decreases without it. Beyond that, errors and calibration must be outside of
    the healthy range or, if the fault was undone or removing the sensor changes nothing, show as alarms, because
    episodes differ.

    Args:
        deviations: by statistic.
        effect: of undoing the fault; None if it was not undone.
    """
    explained = False
    if effect is not None and not effect.failed:
        if any(_large(name, ratio) for name, ratio in effect.ratios.items() if effect.complete or name != NEES):
            return True
        unused = bool(effect.ratios) and all(1.0 / UNUSED < ratio < UNUSED for ratio in effect.ratios.values())
        explained = effect.complete or unused
    candidates = (deviations.get(name) for name in VISIBLE)
    return any(
        _large(d.statistic, d.value / d.healthy) and (d.alarm if explained else not d.low <= d.value <= d.high)
        for d in candidates
        if d is not None
    )


def _large(statistic: str, ratio: float) -> bool:
    """Whether a statistic of ``VISIBLE`` changes by its limit; errors that decrease do not count."""
    limit = VISIBLE[statistic]
    return ratio > limit or (statistic == NEES and ratio < 1.0 / limit)
