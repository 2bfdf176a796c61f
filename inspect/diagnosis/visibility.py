"""Whether a fault affects a filter, or is masked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from beliefscope.inspect.diagnosis.cause import Recovery
from beliefscope.inspect.diagnosis.checks.modules import component_errors
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation
from beliefscope.inspect.statistics.measures import counted, errors, known_mean, nees
from beliefscope.inspect.trace import Trace

NEES = "nees/fused/all"

VISIBLE_ERROR, VISIBLE_NEES = 1.2, 2.0
"""Ratios of errors, and of the NEES or its inverse, to healthy values from which a fault affects the filter."""

BY_UNIT = {"m": "error//all", "rad": "angle error//all"}
"""Unit of state components -> statistic of their errors; the others have one each."""

UNUSED = 1.05
"""Largest ratio of these statistics with and without a sensor that a filter hardly uses."""


@dataclass(frozen=True)
class Effect:
    """Effect of undoing a cause.

    Attributes:
        restored: share of all deviations that disappears.
        ratios: statistic of an error, or ``NEES`` -> value with the fault relative to that without, over all episodes.
        complete: whether the undo brings back healthy readings, modules or equations; else it removes a sensor.
    """

    recovery: Recovery
    restored: float
    ratios: Mapping[str, float]
    complete: bool

    @property
    def failed(self) -> bool:
        """Whether errors are clearly larger after undoing the cause, which does not show the run without it."""
        return any(ratio < 1.0 / VISIBLE_ERROR for name, ratio in self.ratios.items() if name != NEES)

    @property
    def is_large(self) -> bool:
        """Whether errors or, without the fault known, the NEES change by their limits."""
        return any(_large(name, ratio) for name, ratio in self.ratios.items() if self.complete or name != NEES)

    @property
    def shows_healthy_run(self) -> bool:
        """Whether the run without the fault is known: the undo is complete, or removing the sensor changes nothing."""
        unused = bool(self.ratios) and all(1.0 / UNUSED < ratio < UNUSED for ratio in self.ratios.values())
        return not self.failed and (self.complete or unused)


def effect_ratios(before: Sequence[Trace], after: Sequence[Trace]) -> dict[str, float]:
    """Ratios of the root mean square errors by unit, and of the mean NEES, over the counted steps of all episodes.

    before, after: runs with and without the fault. Statistics that are unknown are absent.
    """
    pairs = zip(_totals(before).items(), _totals(after).values(), strict=True)
    ratios = {name: a / b for (name, a), b in pairs if np.isfinite(a) and np.isfinite(b) and b > 0.0}
    return {name: ratio if name == NEES else float(np.sqrt(ratio)) for name, ratio in ratios.items()}


def _totals(traces: Sequence[Trace]) -> dict[str, float]:
    """Statistic of an error, or ``NEES`` -> sum of the squared errors or mean of the NEES over the counted steps."""
    task = traces[0].task
    units = np.array([component.unit for component in task.components])
    squares = sum(np.square(errors(trace)[counted(trace), -1]).sum(0) for trace in traces)
    totals = {name: float(np.sum(squares[units == unit])) for unit, name in BY_UNIT.items() if unit in units}
    totals |= {name: float(squares[i]) for name, i in component_errors(task).items()}
    if all(trace.has_covariance for trace in traces):
        totals[NEES] = known_mean(np.concatenate([nees(trace)[counted(trace), -1] for trace in traces]))
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
    if effect is not None and not effect.failed and effect.is_large:
        return True
    explained = effect is not None and effect.shows_healthy_run
    return any(
        _large(name, d.value / d.healthy) and (d.alarm if explained else not d.low <= d.value <= d.high)
        for name, d in deviations.items()
        if name in (NEES, *BY_UNIT.values()) or name.startswith("component error/")
    )


def _large(statistic: str, ratio: float) -> bool:
    """Whether an error or the NEES changes by its limit; errors that decrease do not count."""
    if statistic == NEES:
        return not 1.0 / VISIBLE_NEES <= ratio <= VISIBLE_NEES
    return ratio > VISIBLE_ERROR
