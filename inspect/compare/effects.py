"""Effect sizes of the difference between two filters, with confidence intervals, and steps with larger errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Task
from beliefscope.filters.finetuning.slices import Slice
from beliefscope.inspect.failures.events import event_spans
from beliefscope.inspect.failures.step_scores import RECENT
from beliefscope.inspect.statistics.episode_sums import BELIEF_MEASURES, EpisodeSums, Measure, condition
from beliefscope.inspect.statistics.intervals import jackknife
from beliefscope.inspect.statistics.measures import Array

HIGH = 0.95
"""Quantile of the error increase over all steps above which a step is part of a regression event."""

MAX_EVENTS = 20
"""Maximum number of regression events."""

MIN_INCREASE = 0.1
"""Minimum error increase of a regression event, in the unit for display."""

LEVEL = 0.02
"""Minimum relative change that counts as improved or regressed."""


CHANGE_NOTE = (
    "change: negative is better, except of coverage, which should be 95 %. Errors: relative change of the RMSE. NLL: "
    "difference in nats. NEES/n: relative change of the factor by which standard deviations are wrong. Coverage and "
    "miscalibration: difference in percentage points."
)
"""Explains changes in percent, in nats and in points."""

EFFECT_NOTE = (
    "effect (95 % interval: low to high): negative is better. NLL: difference / number of state components. NEES/n: "
    "difference of |ln(NEES/n)| / 2, the logarithm of the factor by which standard deviations are wrong. Coverage and "
    "miscalibration: change of the distance from the ideal, a share."
)
"""Explains ``Difference.effect`` of measures of beliefs."""


@dataclass(frozen=True)
class Difference:
    """A measure of one slice, before and after.

    Attributes:
        slice, measure: names.
        unit, factor: for display: of the component, nats or none; and the factor of before and after.
        before, after: values.
        effect: natural logarithm of the factor of deterioration; negative is better. Errors: log ratio. NLL: increase
            over n, equivalent to scaling all errors and standard deviations. NEES: factor by which standard deviations
            are wrong. Coverage and calibration: increase of the deviation from the ideal, a share.
        low, high: 95 % interval of the effect over episodes; NaN below ``MIN_TRAJECTORIES`` episodes.
        change: ``after - before``, and its 95 % interval.
    """

    slice: str
    measure: str
    unit: str
    factor: float
    before: float
    after: float
    effect: float
    low: float
    high: float
    change: tuple[float, float, float]

    @property
    def improved(self) -> bool:
        """Whether it is better by at least ``LEVEL`` and the interval excludes zero."""
        return self.high < 0.0 and self.effect <= -math.log1p(LEVEL)

    @property
    def regressed(self) -> bool:
        """Whether it is worse by at least ``LEVEL`` and the interval excludes zero."""
        return self.low > 0.0 and self.effect >= math.log1p(LEVEL)

    @property
    def outcome(self) -> str:
        """``improved``, ``regressed`` or empty."""
        return "improved" if self.improved else "regressed" if self.regressed else ""

    @property
    def is_error(self) -> bool:
        return self.measure not in BELIEF_MEASURES

    @property
    def display(self) -> tuple[float, float, str]:
        """Before and after in display units, and the unit."""
        return self.factor * self.before, self.factor * self.after, self.unit


@dataclass(frozen=True)
class Regression:
    """Consecutive steps with a larger error than before.

    Attributes:
        slice: first slice with this condition.
        faults, only: condition of the slice: sensor faults, and modalities that are used.
        episode: index in the data set.
        first, last, step: first and last step, and the step of the largest increase (peak).
        time: s from the first step of the episode to the peak; None without timestamps.
        contact: whether there is contact at the peak.
        before, after: main error at the peak, in the unit of its components.
    """

    slice: str
    faults: str
    only: tuple[str, ...]
    episode: int
    first: int
    last: int
    step: int
    time: float | None
    contact: bool
    before: float
    after: float


def differences(sums: Array, slices: Sequence[str], measures: Sequence[Measure]) -> tuple[Difference, ...]:
    """Compute the difference of every measure in every slice.

    Slices without steps and measures that a filter does not have are omitted.

    Args:
        sums: (E, 2, S, Q), see ``EpisodeSums``.
    """
    total = sums.sum(0)
    rows = []
    for s, name in enumerate(slices):
        with_steps = sums[sums[:, 0, s, 0] > 0.0, :, s]
        for measure in measures:
            before, after = (float(value) for value in measure.value(total[:, s]))
            if not (math.isfinite(before) and math.isfinite(after)):
                continue
            effect, low, high = map(float, jackknife(with_steps, partial(_change, measure.loss_of)))
            change, lowest, highest = map(float, jackknife(with_steps, partial(_change, measure.value)))
            rows.append(
                Difference(
                    slice=name,
                    measure=measure.name,
                    unit=measure.unit,
                    factor=measure.factor,
                    before=before,
                    after=after,
                    effect=effect,
                    low=low,
                    high=high,
                    change=(change, lowest, highest),
                )
            )
    return tuple(rows)


def _change(function: Callable[[Array], Array], sums: Array) -> Array:
    """Sums (..., 2, Q) to (...): increase of a function of them."""
    values = function(sums)
    difference: Array = values[..., 1] - values[..., 0]
    return difference


def find_regressions(
    sums: EpisodeSums, slices: Sequence[Slice], indices: Sequence[int], episodes: Sequence[Episode], task: Task
) -> tuple[Regression, ...]:
    """Find intervals of steps with a larger main error, largest increase first."""
    episode = np.concatenate([np.full(len(e), i) for i, e in enumerate(episodes)])
    step = np.concatenate([np.arange(len(e)) for e in episodes])
    first = np.concatenate([np.full(len(e), task.first_counted(len(e))) for e in episodes])
    contact = np.concatenate([e.contact.astype(bool) for e in episodes])
    counted = step >= first
    gap = max(1, round(RECENT / task.dt))
    position = np.concatenate([e.positions for e in episodes])
    events: list[Regression] = []
    for (faults, only), distance in sums.distance.items():
        before, after = np.concatenate(distance, axis=1)
        increase = np.where(counted, after - before, -np.inf)
        high = increase > max(MIN_INCREASE / task.main_error.factor, float(np.quantile(increase[counted], HIGH)))
        name = next(slice_.name for slice_ in slices if condition(slice_) == (faults, only))
        for a, b in event_spans(high, episode, gap, position):
            at = a + int(np.argmax(increase[a : b + 1]))
            events.append(
                Regression(
                    slice=name,
                    faults=faults,
                    only=only,
                    episode=indices[episode[at]],
                    first=int(step[a]),
                    last=int(step[b]),
                    step=int(step[at]),
                    time=episodes[episode[at]].time_of(int(step[at])),
                    contact=bool(contact[at]),
                    before=float(before[at]),
                    after=float(after[at]),
                )
            )
    return tuple(sorted(events, key=lambda event: event.before - event.after)[:MAX_EVENTS])
