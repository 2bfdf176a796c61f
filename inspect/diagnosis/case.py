"""Episodes under diagnosis: their statistics compared with the healthy profile, and what the alarms concern."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.text import plural
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnosis.adjustment import with_adjusted
from beliefscope.inspect.diagnosis.catalog import causes_in
from beliefscope.inspect.diagnosis.cause import Cause
from beliefscope.inspect.diagnosis.checks.episode_statistics import episode_statistics, with_scatter, with_slopes
from beliefscope.inspect.diagnosis.checks.modules import reports_estimates_only
from beliefscope.inspect.diagnosis.checks.readings import without_explained
from beliefscope.inspect.diagnosis.checks.sensors import localise, sensor_statistics
from beliefscope.inspect.diagnosis.checks.windows import RANGE
from beliefscope.inspect.diagnosis.scoring import Explanation, applicable, explain
from beliefscope.inspect.diagnosis.undo.run_inputs import RunInputs
from beliefscope.inspect.diagnostics.healthy_comparison import (
    MIN_HEALTHY,
    Deviation,
    compare,
    scaled_values,
    with_critical_values,
)
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.diagnostics.views import Array
from beliefscope.inspect.trace import Trace

ALARM_RATE = 0.02
"""Default probability that a healthy filter raises an alarm."""

SHARED = 0.25
"""Mean deviation of episodes, relative to that of others, from which a fault affects them as well."""

CERTAIN = 2.0
"""Ratio to its critical value from which a deviation of most episodes is significant by itself. The test by divisions
cannot show it if the record is small: too many divisions hold all episodes with the fault."""

OF_ERRORS = ("error/", "angle error/", "component error/", "nees/fused/all")
"""Starts of the names of statistics that a single episode far outside of the record shows."""

FAR, OWN_GAPS = 1.5, 2.0
"""Smallest distance of an episode from the record's range that is a fault by itself, in widths of this range, and in
distances of the record's own extreme value from the next one."""

REPEATED = ("frozen/", "stuck/")
"""Statistics of the share of repeated readings of a sensor in an episode."""

MOST, RARE = 0.5, 0.1
"""Share of repeated readings in an episode that is a fault by itself, if that of all healthy episodes is at most the
second: the permutation test cannot distinguish one of six episodes from an unusual one."""

Rows = Sequence[Mapping[str, float]]


def checked_alarm_rate(healthy: int, count: int, alarm_rate: float | None = None, total: int | None = None) -> float:
    """The alarm rate of a diagnosis of ``count`` episodes with a record of ``healthy`` episodes.

    A single episode has a p-value of at least 1 / (healthy + 1). Default: ``ALARM_RATE``, or that p-value if it is
    larger. Raises BadInput for a lower rate, and for a record of fewer than ``MIN_HEALTHY`` episodes.

    total: number of all episodes in the data of the record; only the held-out ones are used.
    """
    if healthy < MIN_HEALTHY:
        part, kind = ("", "") if total in (None, healthy) else (f", the held-out part of {total},", " held-out ones")
        raise BadInput(
            f"a healthy record of {plural(healthy, 'episode')}{part} is too small; "
            f"measure it from at least {MIN_HEALTHY}{kind}"
        )
    smallest = 1 / (healthy + 1) if count == 1 else 0.0
    if alarm_rate is not None and alarm_rate < smallest:
        raise BadInput(
            f"a healthy record of {healthy} episodes cannot show a fault in a single one: an alarm rate of "
            f"{alarm_rate:g} needs {math.ceil(1 / alarm_rate) - 1}; diagnose several episodes, or use a rate of "
            f"{math.ceil(1000 * smallest) / 1000:g} or more"
        )
    return max(ALARM_RATE, smallest) if alarm_rate is None else alarm_rate


@dataclass(frozen=True)
class Case:
    """Episodes of a filter and their deviations from the healthy profile.

    Attributes:
        rows: statistics by episode. sensors: those of sensors only. grouped: all that are compared
            (``without_explained``), statistics adjusted for the readings (``with_adjusted``), and statistics relative
            to the other episodes (``with_scatter``).
        deviations: with t-values relative to their critical values, largest first.
        p_value: probability of deviations of this size in a healthy filter.
    """

    inputs: RunInputs
    traces: Sequence[Trace]
    rows: Rows
    sensors: Rows
    grouped: Rows
    profile: HealthyProfile
    deviations: Sequence[Deviation]
    p_value: float
    alarm_rate: float

    @property
    def causes(self) -> tuple[Cause, ...]:
        """All causes of the filter."""
        return causes_in(self.inputs.checkpoint, all(map(reports_estimates_only, self.traces)))

    @property
    def by_statistic(self) -> dict[str, Deviation]:
        """The deviations by statistic."""
        return {deviation.statistic: deviation for deviation in self.deviations}

    @property
    def alarms(self) -> list[Deviation]:
        """Significant deviations, largest first; none if all deviations together are not significant."""
        return [deviation for deviation in self.deviations if deviation.alarm and self.p_value <= self.alarm_rate]


def observe(trace: Trace, checkpoint: Checkpoint, profile: HealthyProfile) -> tuple[dict[str, float], dict[str, float]]:
    """All statistics of a run, and those of its sensors only."""
    sensors = sensor_statistics(trace.episode, profile.reference, profile.readings)
    return episode_statistics(trace, checkpoint, sensors, profile.readings), sensors


def examine_again(case: Case, inputs: RunInputs, traces: Sequence[Trace]) -> Case:
    """Another run of the episodes of a case; statistics of sensors remain where the readings are the same."""
    sensors_by_episode = {id(trace.episode): sensors for trace, sensors in zip(case.traces, case.sensors, strict=True)}
    profile = case.profile
    rows, sensors = [], []
    for trace in traces:
        same = sensors_by_episode.get(id(trace.episode))
        if same is None:
            same = sensor_statistics(trace.episode, profile.reference, profile.readings)
        sensors.append(same)
        rows.append(episode_statistics(trace, inputs.checkpoint, same, profile.readings))
    return compared(inputs, traces, rows, sensors, profile, case.alarm_rate)


def compared(
    inputs: RunInputs, traces: Sequence[Trace], rows: Rows, sensors: Rows, profile: HealthyProfile, alarm_rate: float
) -> Case:
    """The statistics of traces, compared with a healthy profile."""
    scattered, grouped = with_scatter(*with_slopes(*with_adjusted(profile, rows, sensors)))
    known = scattered.statistics.keys()  # a record of an earlier version may have the level of readings only
    grouped = [without_explained({n: value for n, value in row.items() if n in known}) for row in grouped]
    comparison = compare(scattered, grouped, task=inputs.checkpoint.task)
    deviations = with_critical_values(scattered, comparison, alarm_rate)
    certain = _repeats_readings(profile, rows) or _most_deviate(scattered, grouped, deviations)
    p_value = 0.0 if certain else comparison.p_value
    return Case(inputs, traces, rows, sensors, grouped, profile, deviations, p_value, alarm_rate)


def _repeats_readings(profile: HealthyProfile, rows: Rows) -> bool:
    """Whether a sensor repeats most of its readings in an episode, which no healthy one does."""
    healthy = {
        n: np.nanmax(v) for n, v in profile.statistics.items() if n.startswith(REPEATED) and np.isfinite(v).any()
    }
    return any(row.get(name, 0.0) >= MOST for name, most in healthy.items() if most <= RARE for row in rows)


def _most_deviate(profile: HealthyProfile, rows: Rows, deviations: Sequence[Deviation]) -> bool:
    """Whether more than half of several episodes are outside of the record's range in a large deviation."""
    if len(rows) < 2:
        return False
    for deviation in (d for d in deviations if d.alarm and abs(d.t) >= CERTAIN):
        record = profile.statistics[deviation.statistic]
        values = np.array([row.get(deviation.statistic, np.nan) for row in rows])
        outside = (values < np.nanmin(record)) | (values > np.nanmax(record))
        if outside.mean() > 0.5:
            return True
    return False


def focus(case: Case) -> Case:
    """The episodes with the largest alarm, if it does not concern the others; otherwise all of them."""
    alarm = case.alarms[0]
    hit = affected_episodes(case, case.alarms)
    values = [row.get(alarm.statistic, np.nan) for row, chosen in zip(case.grouped, hit, strict=True) if not chosen]
    others = [value for value in values if np.isfinite(value)]
    if not others or not alarm.low <= np.mean(others) <= alarm.high:
        return case
    part = replace(_part(case, hit), p_value=case.p_value)
    return part if part.alarms else case


def _part(case: Case, chosen: np.ndarray) -> Case:
    """Some of the episodes, by a mask (E,), with deviations of their own and a p-value of 0."""
    traces = list(compress(case.traces, chosen))
    rows, sensors = (list(compress(rows, chosen)) for rows in (case.rows, case.sensors))
    episodes = {trace.episode_index: case.inputs.episodes[trace.episode_index] for trace in traces}
    inputs = replace(case.inputs, episodes=episodes, affected=frozenset(episodes))
    return replace(compared(inputs, traces, rows, sensors, case.profile, case.alarm_rate), p_value=0.0)


def outlying(case: Case) -> Case | None:
    """The episodes with errors or NEES far outside of the record's range, as a case with alarms; None without.

    A test by divisions cannot find one faulty episode among many: it is among the tested ones in too many divisions.
    Other statistics have healthy values far from all others too often.
    """
    names = [n for n in case.by_statistic if n.startswith(OF_ERRORS) and n in case.profile.statistics]
    tested = np.array([[row.get(name, np.nan) for name in names] for row in case.grouped])
    record = np.stack([case.profile.statistics[name] for name in names], axis=1) if names else tested[:0]
    values, floor, rising = scaled_values(names, np.concatenate([record, tested]))
    far = np.asarray(_far_outside(values[: len(record)], values[len(record) :], floor, rising).any(1))
    if not far.any() or far.all():
        return None
    part = _part(case, far)
    return part if part.alarms else None


def _far_outside(record: Array, values: Array, floor: Array, rising: np.ndarray) -> np.ndarray:
    """(E, S): values further outside of the range of the record (R, S) than ``FAR`` times its width.

    Of statistics with rare large values, the width includes the distance of the record's own extreme from the others.
    """
    ordered = np.sort(record, axis=0)  # NaN last
    count = np.isfinite(record).sum(0)
    known = count >= MIN_HEALTHY
    columns = np.arange(record.shape[1])
    low, second = ordered[0], ordered[1]
    high, last = ordered[np.maximum(count - 1, 0), columns], ordered[np.maximum(count - 2, 0), columns]
    width = FAR * np.maximum(high - low, floor)
    above = values - high > width + OWN_GAPS * (high - last)
    below = (low - values > width + OWN_GAPS * (second - low)) & ~rising
    return np.asarray(known & (above | below))


def explain_all(case: Case) -> dict[str, Explanation]:
    """How well each cause that can be observed explains all deviations, by name."""
    causes = applicable(case.causes, case.by_statistic)
    return {cause.name: explain(cause, case.deviations) for cause in causes}


def symptoms_of(cause: Cause, deviations: Iterable[Deviation]) -> list[Deviation]:
    """The deviations of statistics that are symptoms of a cause, in their order."""
    return [d for d in deviations if any(s.matches(d.statistic) for s in cause.symptoms)]


def affected_episodes(case: Case, alarms: Sequence[Deviation]) -> np.ndarray:
    """(E,) mask of episodes that alarms concern.

    Episodes that deviate in the first alarm by at least half as much as the most deviating one. All of them, if it is
    unknown in some, or if the others deviate as well: one is outside of the range of healthy episodes, or their mean
    deviation is more than ``SHARED`` of that of the affected ones.
    """
    everything = np.ones(len(case.rows), dtype=bool)
    if not alarms:
        return everything
    name, sign = alarms[0].statistic, np.sign(alarms[0].value - alarms[0].healthy)
    values = np.array([row.get(name, np.nan) for row in case.grouped])
    distance = (values - alarms[0].healthy) * sign
    hit = distance >= 0.5 * np.nanmax(distance)
    if hit.all() or not np.isfinite(values).all():
        return everything
    record = case.profile.statistics.get(name, values)
    outside = (values[~hit] < np.nanmin(record)) | (values[~hit] > np.nanmax(record))
    shared = np.abs(distance[~hit]).mean() > SHARED * np.abs(distance[hit]).mean()
    return everything if shared or outside.any() else hit


def affected_steps(case: Case, deviation: Deviation, affected: np.ndarray) -> tuple[int, int] | None:
    """First step that shows a deviation and the first step after it, over the affected episodes; None if unknown.

    affected: (E,) mask of the episodes of the case.
    """
    episodes = [trace.episode for trace, hit in zip(case.traces, affected, strict=True) if hit]
    localisations = [located(case, deviation, episode) for episode in episodes]
    intervals = [steps for steps in localisations if steps is not None]
    return (min(first for first, _ in intervals), 1 + max(last for _, last in intervals)) if intervals else None


def located(case: Case, deviation: Deviation, episode: Episode) -> tuple[int, int] | None:
    """First and last step of an episode that shows a deviation; None if unknown."""
    start, _, phase = deviation.statistic.rpartition("/")
    healthy: float | None = deviation.healthy
    if phase == RANGE:  # its windows have values of the other phases
        record = case.profile.statistics.items()
        others = (v for name, v in record if name.startswith(f"{start}/") and name != deviation.statistic)
        healthy = next((float(np.nanmedian(v)) for v in others if np.isfinite(v).any()), None)
    return localise(deviation.statistic, episode, case.profile.reference, healthy, case.profile.readings)
