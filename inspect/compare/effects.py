"""Two filters over the same episodes, measure by measure and moment by moment: how much worse, and how surely."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.filters.evaluate import LEFT_OUT, UNITS
from beliefscope.filters.finetuning.slices import Slice
from beliefscope.inspect.diagnostics.base import Array
from beliefscope.inspect.failures.moments import stretches
from beliefscope.inspect.failures.step_scores import RECENT
from beliefscope.inspect.statistics.bootstrap import FEWEST, resampled
from beliefscope.inspect.statistics.episode_sums import Measure, Tally, condition

HIGH = 0.95
"""A moment got worse where the error's rise is above this quantile of all steps' rises."""

KEPT = 20
"""Moments that got worse most."""

RISE = 1e-3
"""m: less is no moment."""

LEVEL = 0.02
"""A smaller change of an error, as a share of it, is neither mending nor damage."""


@dataclass(frozen=True)
class Difference:
    """One measure in one slice, before and after.

    Attributes:
        slice, measure: their names. unit: of before and after: m, rad, nats or none.
        effect: natural logarithm of the factor by which it is worse; below zero it is better. Of an error: ln of the
            ratio. Of the NLL: its rise over n, as if all errors and deviations had grown by that factor. Of the NEES:
            of the factor that deviations are wrong by. Of coverage and calibration: how much farther off, as a share.
        low, high: 95 % bootstrap interval of the effect over episodes; NaN of fewer than ``FEWEST``.
    """

    slice: str
    measure: str
    unit: str
    before: float
    after: float
    effect: float
    low: float
    high: float

    @property
    def mended(self) -> bool:
        """Better by ``LEVEL`` or more, and the interval excludes no change."""
        return self.high < 0.0 and self.effect <= -math.log1p(LEVEL)

    @property
    def damaged(self) -> bool:
        """Worse by ``LEVEL`` or more, and the interval excludes no change."""
        return self.low > 0.0 and self.effect >= math.log1p(LEVEL)

    @property
    def is_error(self) -> bool:
        return self.unit in UNITS

    @property
    def shown(self) -> tuple[float, float, str]:
        """Before and after as people read them, and their unit."""
        unit, factor = UNITS.get(self.unit, (self.unit, 1.0))
        return factor * self.before, factor * self.after, unit


@dataclass(frozen=True)
class Worsening:
    """A stretch of steps at which the error rose, and its peak.

    Attributes:
        slice: the first one in whose run it is. faults: how the sensors were broken. only: who spoke.
        episode: index in the data set. first, last, step: its steps, and the peak among them. contact: at the peak.
        before, after: m, distance of the estimate from the truth on the map, at the peak.
    """

    slice: str
    faults: str
    only: tuple[str, ...]
    episode: int
    first: int
    last: int
    step: int
    contact: bool
    before: float
    after: float


def differences(sums: Array, slices: Sequence[str], measures: Sequence[Measure]) -> tuple[Difference, ...]:
    """Every measure in every slice with its interval. sums: (E, 2, S, Q), as in ``Tally``.

    Slices without a step, and measures that one of the filters does not have, are left out.
    """
    whole = sums.sum(0)
    drawn = resampled(sums) if len(sums) >= FEWEST else None
    rows = []
    for s, name in enumerate(slices):
        for measure in measures:
            before, after = (float(value) for value in measure.of(whole[:, s]))
            if not (math.isfinite(before) and math.isfinite(after)):
                continue
            effect = float(np.subtract(*measure.off(np.array([after, before]))))
            low = high = math.nan
            if drawn is not None:
                off = measure.off(measure.of(drawn[:, :, s]))
                # A resample without a step of the slice says nothing.
                low, high = (float(x) for x in np.nanpercentile(off[:, 1] - off[:, 0], [2.5, 97.5]))
            rows.append(Difference(name, measure.name, measure.unit, before, after, effect, low, high))
    return tuple(rows)


def worsenings(
    found: Tally, slices: Sequence[Slice], indices: Sequence[int], episodes: Sequence[Episode], dt: float
) -> tuple[Worsening, ...]:
    """Stretches of steps at which the error on the map rose, one moment each, the greatest rise first."""
    episode = np.concatenate([np.full(len(e), i) for i, e in enumerate(episodes)])
    step = np.concatenate([np.arange(len(e)) for e in episodes])
    last = np.concatenate([np.full(len(e), len(e) - 1) for e in episodes])
    contact = np.concatenate([e.contact.astype(bool) for e in episodes])
    counted = step >= np.minimum(LEFT_OUT, last)
    bridge = max(1, round(RECENT / dt))
    moments: list[Worsening] = []
    for (faults, only), distance in found.distance.items():
        before, after = np.concatenate(distance, axis=1)
        rise = np.where(counted, after - before, -np.inf)
        high = rise > max(RISE, float(np.quantile(rise[counted], HIGH)))
        name = next(one.name for one in slices if condition(one) == (faults, only))
        for a, b in stretches(high, episode, bridge):
            at = a + int(np.argmax(rise[a : b + 1]))
            moments.append(
                Worsening(
                    slice=name,
                    faults=faults,
                    only=only,
                    episode=indices[episode[at]],
                    first=int(step[a]),
                    last=int(step[b]),
                    step=int(step[at]),
                    contact=bool(contact[at]),
                    before=float(before[at]),
                    after=float(after[at]),
                )
            )
    return tuple(sorted(moments, key=lambda m: m.before - m.after)[:KEPT])
