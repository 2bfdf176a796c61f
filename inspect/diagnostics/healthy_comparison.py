"""Comparison of episodes with a healthy profile by a permutation test over all statistics at once.

If the episodes are healthy, they are exchangeable with those of the profile, whatever their distribution. So the
probability of an alarm is at most ``SIGNIFICANCE`` for any number of episodes, tails and dependent statistics.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task, with_unit
from beliefscope.datasets.task_json import check_names
from beliefscope.datasets.text import plural
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile, profile_document
from beliefscope.inspect.diagnostics.statistic_kinds import (
    KINDS,
    LEVER,
    LOST,
    RISING,
    label_of,
    unit_of,
)
from beliefscope.inspect.diagnostics.views import Array, Table

SIGNIFICANCE = 0.01
"""Probability of an alarm of one diagnostic for healthy episodes."""

SINGLE_SIGNIFICANCE = 0.02
"""The same for one episode, whose p-value is at least 1 / (1 + number of healthy episodes)."""

PERMUTATIONS = 1999
"""Number of random divisions into tested and healthy episodes."""

TAIL = 0.99
"""Quantile of a statistic's t-values over healthy samples to which its critical value is proportional."""

CRITICAL = 0.05
"""Share of healthy samples with a deviation above its critical value, for which causes are calibrated."""

SMALLEST_T = 2.0
"""Lower limit of this quantile."""

OF_AXES = frozenset({"level", "drift", "change", "noise"})
"""Kinds of statistics of an axis of a sensor, in the unit of its readings (per s for drifts)."""

SMALLEST_SHARE = 0.02
"""Smallest standard deviation of these statistics relative to the size of the readings, where that is known."""

SMALLEST_REST = 0.005
"""Smallest share of remaining readings that is distinguished from none."""

MIN_HEALTHY = 10
"""Minimum number of healthy episodes with a value of a statistic."""

COMPARE_RUNS = "beliefscope diagnose DIR --profile-from HEALTHY_DIR --workspace WORKSPACE"
"""Diagnosis of a filter that is not available."""

COUNTED = ("steps", "gray levels")
"""Units with a singular."""

LARGE = 1e6
"""Magnitude from which numbers have an exponent, such as those of a filter that diverges."""

MIN_EFFECT, MIN_EFFECT_OF_CONTROLS = 0.5, 1.5
"""Minimum difference of an alarm, in standard deviations between healthy episodes; and that of controls from the ones
that the labels let expect: those of a controller, which episodes of the same speed or load do not vary around."""

OF_CONTROLS = {"reading gain": 0.05, "reading ratio": 0.05, "reading noise": 0.2}
"""Smallest standard deviations of statistics of controls that other motions change: the expected controls are linear in
the changes of the state, with coefficients that are means over the motions of the record."""


@dataclass(frozen=True)
class Deviation:
    """A statistic of the tested episodes compared with its healthy values.

    Attributes:
        statistic: ``KIND/SUBJECT/PHASE``.
        value, healthy: means over the tested and over the healthy episodes.
        low, high: 95 % range of means over as many healthy episodes as were tested.
        p_value: probability of a deviation of this size in any statistic, if the episodes are healthy.
        alarm: whether it is significant and at least ``MIN_EFFECT``.
        t: difference of the means over its standard error; of ``with_critical_values``, relative to its critical value.
        task: gives the unit and the names for display; without one, there is no unit.
    """

    statistic: str
    value: float
    healthy: float
    low: float
    high: float
    p_value: float
    alarm: bool
    t: float
    task: Task | None = field(default=None, repr=False)

    @property
    def label(self) -> str:
        """Display name of the statistic."""
        return label_of(self.statistic, self.task)

    @property
    def conversion(self) -> tuple[str, float]:
        """Unit for display, and the factor from the unit of the values."""
        return ("", 1.0) if self.task is None else unit_of(self.statistic, self.task)

    @property
    def text(self) -> str:
        """Label, value and healthy range, in the unit for display, without digits far below the range's width.

        A value that differs from both ends of the range has enough digits, up to six, to show it.

        The healthy mean is within the range, from which a few values may move it.
        """
        unit, factor = self.conversion
        width = abs(factor * (self.high - self.low))
        digits = 1 - math.floor(math.log10(width)) if 0.0 < width < math.inf else 12
        mean = min(max(self.healthy, self.low), self.high)
        numbers = (round(factor * x, digits) + 0.0 for x in (self.value, mean, self.low, self.high))
        value, healthy, low, high = _numbers(*numbers)
        return f"{self.label} is {_amount(value, unit)}, healthy {_amount(healthy, unit)} ({low} to {high})"


@dataclass(frozen=True)
class Comparison:
    """Result of ``compare``, largest deviation first.

    Attributes:
        trajectories, healthy_trajectories: number of tested episodes, and of those in the profile.
        data: of the profile.
        deviations: by statistic.
        p_value: probability of a deviation of this size in any statistic, each relative to a high quantile of its own
            t-values over the divisions.
    """

    trajectories: int
    healthy_trajectories: int
    data: str
    deviations: tuple[Deviation, ...]
    p_value: float = 1.0

    @property
    def alarms(self) -> tuple[Deviation, ...]:
        """Deviations with an alarm."""
        return tuple(deviation for deviation in self.deviations if deviation.alarm)

    @property
    def sentence(self) -> str:
        """``No alarm`` or the largest alarms. One episode alone is no evidence of a fault and at most unusual."""
        if self.trajectories == 1 and 1.0 / (self.healthy_trajectories + 1) > SINGLE_SIGNIFICANCE:
            return "Too few episodes (1; at least 2 needed) to compare with the healthy record."
        if not self.deviations:
            return "Too few steps to compare with the healthy record."
        alarms = self.alarms
        record = f"the healthy record of {self.healthy_trajectories} episodes"
        if not alarms:
            return f"No alarm: within {record}."
        more = f", and {len(alarms) - 3} more" if len(alarms) > 3 else ""
        texts = f"compared with {record}: {'; '.join(alarm.text for alarm in alarms[:3])}{more}."
        if self.trajectories > 1:
            return f"Alarm, {texts}"
        rarity = f"as up to 1 in {1.0 / SINGLE_SIGNIFICANCE:.0f} healthy ones"
        return f"Unusual episode ({rarity}), {texts} Test several episodes before you conclude that there is a fault."

    def table(self) -> Table:
        """One row per statistic."""
        verdict = "alarm" if self.trajectories > 1 else "unusual"
        columns = ("statistic", "value", "healthy", "95 % range from", "to", "p-value", verdict)
        rows = [
            (
                with_unit(d.label, d.conversion[0]),
                *(d.conversion[1] * value for value in (d.value, d.healthy, d.low, d.high)),
                *(d.p_value, "yes" if d.alarm else ""),
            )
            for d in self.deviations
        ]
        return Table("Comparison with the healthy record", columns, rows)


def compare(
    profile: HealthyProfile, trajectories: Sequence[Mapping[str, float]], seed: int = 0, task: Task | None = None
) -> Comparison:
    """Compare episode statistics with those of a profile; statistics that only one of them has are omitted.

    Max-T test of Westfall and Young: in a division of all episodes into n and the others, each statistic has a
    t-value, the difference of the means over its standard error, with the spread of the others. ``p_value`` is the
    share of divisions whose largest absolute t is at least that of the statistic.

    task: gives the units and names of the deviations.
    """
    names = [name for name in profile.statistics if any(name in values for values in trajectories)]
    count = len(trajectories)
    if not names:
        return Comparison(count, profile.episodes, profile.data, ())
    tested = np.array([[values.get(name, np.nan) for name in names] for values in trajectories]).reshape(count, -1)
    tested = tested[np.lexsort(np.nan_to_num(tested).T)]  # the random divisions must not depend on their order
    values = np.concatenate([tested, np.stack([profile.statistics[name] for name in names], axis=1)])
    keep = (np.isfinite(values[:count]).any(0)) & (np.isfinite(values[count:]).sum(0) >= MIN_HEALTHY)
    names, values = [name for name, kept in zip(names, keep, strict=True) if kept], values[:, keep]
    if not names:
        return Comparison(count, profile.episodes, profile.data, ())
    scaled, floor, rising = scaled_values(names, values)
    divisions = np.concatenate([np.arange(len(values))[None] < count, _divisions(len(values), count, seed)])
    t, effect = _t_values(scaled, divisions, floor, rising)
    # Rounding must not distinguish a division from itself.
    largest = np.abs(t).max(1) * (1.0 + 1e-9)
    at_least = (largest[1:, None] >= np.abs(t[0])).sum(0)
    # All divisions with one tested episode are enumerated, including the actual one.
    p_value = at_least / len(values) if count == 1 else (1.0 + at_least) / len(divisions)
    smallest = np.array([min_effect(name) for name in names])
    alarm = (p_value <= (SINGLE_SIGNIFICANCE if count == 1 else SIGNIFICANCE)) & (np.abs(effect[0]) >= smallest)
    low, high = _ranges(values[count:], count, seed)
    mean, healthy = np.nanmean(values[:count], axis=0), np.nanmean(values[count:], axis=0)
    columns = [column.tolist() for column in (mean, healthy, low, high, p_value, alarm, t[0])]
    rows: Iterable[tuple[Any, ...]] = zip(names, *columns, [task] * len(names), strict=True)
    deviations = [Deviation(*row) for row in rows]
    order = np.argsort(-np.abs(t[0]), kind="stable")
    relative = (np.abs(t) / _own_scale(t[1:], t, count == 1)).max(1)
    extreme = int((relative[1:] * (1.0 + 1e-9) >= relative[0]).sum())
    p_any = extreme / len(values) if count == 1 else (1.0 + extreme) / len(divisions)
    return Comparison(count, profile.episodes, profile.data, tuple(deviations[i] for i in order), p_any)


def _own_scale(distribution: Array, t: Array, single: bool) -> Array:
    """High quantile of absolute t-values of each statistic: (S,), or (B, S) for the t-values (B, S) of one episode.

    The scale of one episode is the largest of the other ones in the distribution (D, S), because it would hide
    itself among few others.
    """
    size = np.abs(distribution)
    if not single:
        return np.maximum(np.quantile(size, TAIL, axis=0), SMALLEST_T)
    second, largest = np.partition(size, -2, axis=0)[-2:]
    return np.maximum(np.where(np.abs(t) >= largest, second, largest), SMALLEST_T)


def with_critical_values(profile: HealthyProfile, comparison: Comparison, alarm_rate: float) -> tuple[Deviation, ...]:
    """The deviations with t-values relative to critical ones, and alarms where the ratio is at least 1; largest first.

    Distributions of t-values differ between statistics; those of rare events have heavy tails. The critical value of a
    statistic is proportional to its own high quantile, so that a share of healthy samples, ``CRITICAL``, exceeds any.
    With a larger ``alarm_rate``, alarms begin at lower ratios.

    Raises BadInput if the profile has no statistic of the compared episodes.
    """
    names = [deviation.statistic for deviation in comparison.deviations]
    if not names:
        raise BadInput(
            f"the healthy record of {profile.episodes} episodes has no statistic in common with the "
            f"{comparison.trajectories} diagnosed ones; measure it from at least {MIN_HEALTHY} healthy episodes"
        )
    values, floor, rising = scaled_values(names, np.stack([profile.statistics[name] for name in names], axis=1))
    count = min(comparison.trajectories, profile.episodes // 2)
    t = np.abs(_t_values(values, _divisions(profile.episodes, count, 0), floor, rising)[0])
    own = _own_scale(t, t, count == 1)
    limit, alarm = np.quantile((t / own).max(1), [1.0 - CRITICAL, 1.0 - max(CRITICAL, alarm_rate)])
    critical = limit * (own if own.ndim == 1 else np.maximum(t.max(0), SMALLEST_T))
    error = math.sqrt(1.0 / comparison.trajectories + 1.0 / profile.episodes)
    result = [
        replace(d, t=d.t / c, alarm=bool(abs(d.t) >= max(c * alarm / limit, min_effect(d.statistic) / error)))
        for d, c in zip(comparison.deviations, critical, strict=True)
    ]
    return tuple(sorted(result, key=lambda deviation: -abs(deviation.t)))


def min_effect(statistic: str) -> float:
    """The smallest difference of an alarm, in standard deviations between healthy episodes."""
    is_of_controls = statistic.startswith("reading ") and _is_of_controls(statistic)
    return MIN_EFFECT_OF_CONTROLS if is_of_controls else MIN_EFFECT


def _is_of_controls(statistic: str) -> bool:
    return statistic.split("/")[1].partition(" ")[0] == "control"


def _smallest_std(statistic: str) -> float:
    """That of the statistic's kind; others of torques, and of controls (``OF_CONTROLS``)."""
    kind = statistic.split("/")[0]
    _, _, smallest = KINDS.get(kind, ("", False, 1e-9))
    if kind in OF_CONTROLS and _is_of_controls(statistic):
        return OF_CONTROLS[kind]
    return smallest * (LEVER if "/torque " in statistic else 1.0)


def scaled_values(names: Sequence[str], values: Array) -> tuple[Array, Array, np.ndarray]:
    """Values (N, S) on the scale of their kind, smallest standard deviations (S,), and whether ``RISING`` (S,)."""
    kinds = [name.split("/")[0] for name in names]
    settings = [KINDS.get(kind, ("", False, 1e-9)) for kind in kinds]
    logarithmic, lost = np.array([s[1] for s in settings]), np.array([kind in LOST for kind in kinds])
    floor = np.array([_smallest_std(name) for name in names])
    for i, (kind, subject, _) in enumerate(name.split("/") for name in names):
        own = (f"size/{subject}/contact", f"size/{subject}/all", f"size/{subject.rpartition(' ')[0]}/all")
        sizes = [values[:, names.index(size)] for size in own if kind in OF_AXES and size in names]
        if known := [np.nanmedian(size) for size in sizes if np.isfinite(size).any()]:
            floor[i] = min(floor[i], SMALLEST_SHARE * known[0])
    rising = np.array([k in RISING or n.endswith("/range") for n, k in zip(names, kinds, strict=True)])
    scaled = np.where(logarithmic, np.log(np.maximum(values, 1e-12)), values)
    return np.where(lost, -np.log(np.maximum(1.0 - values, SMALLEST_REST)), scaled), floor, rising


@lru_cache(maxsize=16)
def _divisions(total: int, count: int, seed: int) -> np.ndarray:
    """(B, total) masks of ``count`` tested of ``total`` episodes: random, or all of them if one is tested."""
    if count == 1:
        return np.eye(total, dtype=bool)
    order = np.random.default_rng(seed).random((PERMUTATIONS, total)).argsort(axis=1)
    return order < count


def _t_values(values: Array, divisions: np.ndarray, floor: Array, rising: np.ndarray) -> tuple[Array, Array]:
    """(B, S) t-values and effects in standard deviations of values (N, S) for divisions (B, N). NaN is missing.

    Both are zero for a decrease of a ``rising`` statistic (S,).
    """
    finite = np.isfinite(values)
    present = finite.astype(np.float64)
    centred = np.where(finite, values - np.nanmean(values, axis=0), 0.0)
    inside = divisions.astype(np.float64)
    count, total = inside @ present, inside @ centred
    others = present.sum(0) - count
    mean = total / np.maximum(count, 1.0)
    rest = (centred.sum(0) - total) / np.maximum(others, 1.0)
    squares = np.square(centred).sum(0) - inside @ np.square(centred)
    variance = np.maximum(squares - others * rest**2, 0.0) / np.maximum(others - 1.0, 1.0)
    effect = (mean - rest) / np.maximum(np.sqrt(variance), floor)
    valid = (count >= 1.0) & (others >= 2.0)
    effect = np.where(valid & ~(rising & (effect < 0.0)), effect, 0.0)
    return effect / np.sqrt(1.0 / np.maximum(count, 1.0) + 1.0 / np.maximum(others, 1.0)), effect


@lru_cache(maxsize=16)
def _draws(total: int, count: int, seed: int) -> Array:
    """(2000, total): how often each of ``total`` episodes is among ``count`` drawn with replacement."""
    return np.random.default_rng(seed).multinomial(count, np.full(total, 1.0 / total), 2000).astype(np.float64)


def _ranges(healthy: Array, count: int, seed: int) -> tuple[Array, Array]:
    """(S,) 95 % range of the mean of ``count`` episodes drawn from the healthy ones (E, S)."""
    drawn = _draws(len(healthy), count, seed)
    finite = np.isfinite(healthy)
    size = drawn @ finite.astype(np.float64)
    means = np.where(size > 0, drawn @ np.where(finite, healthy, 0.0) / np.maximum(size, 1.0), np.nan)
    low, high = np.nanpercentile(means, [2.5, 97.5], axis=0)
    return low, high


def _numbers(value: float, *healthy: float) -> list[str]:
    """Texts with the fewest digits, two to six, in which the value differs from all healthy numbers; else with two."""
    for digits in range(2, 7):
        texts = [_number(x, digits) for x in (value, *healthy)]
        if texts[0] not in texts[1:]:
            return texts
    return [_number(x) for x in (value, *healthy)]


def _number(value: float, digits: int = 2) -> str:
    return f"{value:.0f}" if 10 ** (digits - 1) <= abs(value) < LARGE else f"{value:z.{digits}g}"


def _amount(number: str, unit: str) -> str:
    """A number with its unit: ``1 step``, ``3 steps``."""
    return f"{number} {unit.removesuffix('s') if number in ('1', '-1') and unit in COUNTED else unit}".rstrip()


def no_diagnosis(checkpoint: Checkpoint) -> str | None:
    """Reason why a filter has no diagnosis; None if it has one."""
    try:
        check_names(checkpoint.task)
    except BadInput as error:  # a definition of an earlier version
        return f"{str(error).removesuffix('.')}: rename it to diagnose its runs"
    lacking = "no healthy record"
    if (document := profile_document(checkpoint.task.name, checkpoint.name, checkpoint.hash, checkpoint)) is not None:
        count = document.get("episodes") if isinstance(document, dict) else None
        if not isinstance(count, int) or count >= MIN_HEALTHY:  # a malformed record is reported by the diagnosis
            return None
        lacking = f"a healthy record of {plural(count, 'episode')}, fewer than the {MIN_HEALTHY} needed"
    if isinstance(checkpoint, UnavailableFilter):
        lacking += f"; compare its recorded runs with at least {MIN_HEALTHY} healthy ones, here as well: {COMPARE_RUNS}"
    return f"this filter has {lacking}"
