"""Diagnosis of a filter over episodes: the probable cause of a fault, its evidence, and the next action.

Every statistic of the episodes is compared with the filter's own healthy profile. If any deviates, each cause of the
catalog is scored by how well its signature explains all deviations; the best ones are undone and the episodes replayed
with the same random numbers. The right undo restores the healthy statistics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import Any, Literal

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnosis.catalog import CAUSES
from beliefscope.inspect.diagnosis.cause import Candidate, Cause, Diagnosis, Evidence
from beliefscope.inspect.diagnosis.interventions import ratios, recovery, replay_without
from beliefscope.inspect.diagnosis.scoring import Explanation, applicable, burden, explain, probabilities
from beliefscope.inspect.diagnosis.sensor_checks import localise, sensor_statistics
from beliefscope.inspect.diagnosis.setting import Setting
from beliefscope.inspect.diagnosis.statistics import episode_statistics, with_scatter
from beliefscope.inspect.diagnosis.visibility import VISIBLE, Effect, is_visible
from beliefscope.inspect.diagnostics.healthy_comparison import MIN_HEALTHY, Deviation, compare, with_critical_values
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile, find_profile, profile_document
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all

SURE = 0.5
"""Smallest probability of the first cause with which the state is ``fault`` rather than ``unsure``."""

COMPARABLE = 0.3
"""Smallest ratio of their probabilities for two causes that cannot be separated."""

LISTED = 5
"""Maximum number of listed causes."""

EVIDENCE = 5
"""Maximum number of listed deviations by cause."""

UNDONE = 3
"""Maximum number of causes that are undone."""

WORTH_UNDOING = 0.02
"""Smallest probability of a cause that is undone."""

RESTORED = 0.3
"""Weight of the restored share of all deviations in the score of a cause that was undone."""

Rows = Sequence[Mapping[str, float]]


@dataclass(frozen=True)
class Case:
    """Episodes of a filter and their deviations from the healthy profile.

    Attributes:
        rows: statistics by episode. sensors: those of sensors only.
        deviations: with t-values relative to their critical values, largest first.
        p_value: probability of deviations of this size in a healthy filter.
    """

    setting: Setting
    traces: Sequence[Trace]
    rows: Rows
    sensors: Rows
    profile: HealthyProfile
    deviations: Sequence[Deviation]
    p_value: float
    alarm_rate: float

    @property
    def by_statistic(self) -> dict[str, Deviation]:
        """The deviations by statistic."""
        return {deviation.statistic: deviation for deviation in self.deviations}

    @property
    def alarms(self) -> list[Deviation]:
        """Significant deviations, largest first; none if all deviations together are not significant."""
        return [deviation for deviation in self.deviations if deviation.alarm and self.p_value <= self.alarm_rate]


def diagnose(
    checkpoint: Checkpoint,
    episodes: Mapping[int, Episode],
    *,
    seed: int = 0,
    particles: int = 300,
    alarm_rate: float = 0.05,
    base: Checkpoint | None = None,
    profile: HealthyProfile | None = None,
    progress: Callable[[float], None] | None = None,
) -> Diagnosis:
    """Diagnose a filter over episodes.

    Args:
        episodes: by index in their data set.
        alarm_rate: probability that a healthy filter is not called healthy.
        base: checkpoint of the same architecture whose modules replace suspected ones.
        profile: healthy profile; default: that of the checkpoint.
        progress: called with the completed fraction.

    Raises BadInput without episodes, without a healthy profile, and for episodes of another task.
    """
    report = progress or (lambda fraction: None)
    if not episodes:
        raise BadInput("no episodes to diagnose")
    profile = profile or required_profile(checkpoint)
    traces = []
    for trace in trace_all(checkpoint, episodes, episodes, seed, particles):
        traces.append(trace)
        report(0.4 * len(traces) / len(episodes))
    return diagnose_traces(
        checkpoint,
        traces,
        seed=seed,
        particles=particles,
        alarm_rate=alarm_rate,
        base=base,
        profile=profile,
        progress=lambda share: report(0.4 + 0.6 * share),
    )


def diagnose_traces(
    checkpoint: Checkpoint,
    traces: Sequence[Trace],
    *,
    seed: int = 0,
    particles: int = 300,
    alarm_rate: float = 0.05,
    base: Checkpoint | None = None,
    profile: HealthyProfile | None = None,
    progress: Callable[[float], None] | None = None,
) -> Diagnosis:
    """Diagnose a filter from its runs over different episodes, with the arguments and errors of ``diagnose``."""
    report = progress or (lambda fraction: None)
    episodes = {trace.episode_index: trace.episode for trace in traces}
    setting = Setting(checkpoint, episodes, particles, frozenset(episodes))
    case = examine(setting, traces, profile or required_profile(checkpoint), alarm_rate)
    report(0.2)
    if not case.alarms:
        report(1.0)
        return _healthy(case)
    affected = focus(case)
    explanations = explain_all(affected)
    effects = confirm(affected, explanations, seed, base, lambda share: report(0.2 + 0.8 * share))
    report(1.0)
    return _conclude(case, affected, explanations, effects)


def preliminary(checkpoint: Checkpoint, trace: Trace, particles: int = 300, alarm_rate: float = 0.05) -> Diagnosis:
    """The diagnosis of one run before any cause is undone, within a fraction of a second; final if it is healthy.

    Raises BadInput without a healthy profile.
    """
    setting = Setting(checkpoint, {trace.episode_index: trace.episode}, particles, frozenset({trace.episode_index}))
    case = examine(setting, [trace], required_profile(checkpoint), alarm_rate)
    return _conclude(case, case, explain_all(case), None) if case.alarms else _healthy(case)


def required_profile(checkpoint: Checkpoint) -> HealthyProfile:
    """The healthy profile of a filter. Raises BadInput without one."""
    profile = find_profile(checkpoint.task.name, checkpoint.name, checkpoint.hash, checkpoint)
    if profile is None:
        raise BadInput(no_diagnosis(checkpoint) or "")
    return profile


def no_diagnosis(checkpoint: Checkpoint) -> str | None:
    """Reason why a filter has no diagnosis, and what it needs; None if it has one."""
    lacking = "no healthy record"
    if (document := profile_document(checkpoint.task.name, checkpoint.name, checkpoint.hash, checkpoint)) is not None:
        count = document.get("episodes") if isinstance(document, dict) else None
        if not isinstance(count, int) or count >= MIN_HEALTHY:  # a malformed record is reported by the diagnosis
            return None
        lacking = f"a healthy record of {count} episodes, fewer than the {MIN_HEALTHY} needed"
    source = checkpoint.source if isinstance(checkpoint, ExternalFilter) else checkpoint.name
    return (
        f"filter {checkpoint.name!r} has {lacking}; compare it with clean episodes: beliefscope diagnose "
        f"{checkpoint.task.name} --filter {source} --data DATA --profile-from CLEAN_DATA"
    )


def examine(
    setting: Setting, traces: Sequence[Trace], profile: HealthyProfile, alarm_rate: float, earlier: Case | None = None
) -> Case:
    """Compare all statistics of traces with the healthy profile.

    earlier: case of the same episodes, whose statistics of sensors remain where the readings are the same.
    """
    known = {} if earlier is None else {id(t.episode): s for t, s in zip(earlier.traces, earlier.sensors, strict=True)}
    sensors = [
        known[id(trace.episode)] if id(trace.episode) in known else sensor_statistics(trace.episode, profile.reference)
        for trace in traces
    ]
    pairs = zip(traces, sensors, strict=True)
    rows = [episode_statistics(trace, setting.checkpoint, of_sensors) for trace, of_sensors in pairs]
    return _compared(setting, traces, rows, sensors, profile, alarm_rate)


def _compared(
    setting: Setting, traces: Sequence[Trace], rows: Rows, sensors: Rows, profile: HealthyProfile, alarm_rate: float
) -> Case:
    scattered, all_rows = with_scatter(profile, rows)
    comparison = compare(scattered, all_rows)
    deviations = with_critical_values(scattered, comparison, alarm_rate)
    return Case(setting, traces, all_rows, sensors, profile, deviations, comparison.p_value, alarm_rate)


def focus(case: Case) -> Case:
    """The episodes with the largest alarm, if it does not concern the others; otherwise all of them."""
    alarm = case.alarms[0]
    hit = _affected(case, case.alarms)
    values = [row.get(alarm.statistic, np.nan) for row, chosen in zip(case.rows, hit, strict=True) if not chosen]
    others = [value for value in values if np.isfinite(value)]
    if not others or not alarm.low <= np.mean(others) <= alarm.high:
        return case
    traces = list(compress(case.traces, hit))
    rows, sensors = (list(compress(rows, hit)) for rows in (case.rows, case.sensors))
    episodes = {trace.episode_index: case.setting.episodes[trace.episode_index] for trace in traces}
    setting = replace(case.setting, episodes=episodes, affected=frozenset(episodes))
    part = _compared(setting, traces, rows, sensors, case.profile, case.alarm_rate)
    part = replace(part, p_value=case.p_value)
    return part if part.alarms else case


def explain_all(case: Case) -> dict[str, Explanation]:
    """How well each cause that can be observed explains all deviations, by name."""
    return {c.name: explain(c, case.deviations) for c in applicable(CAUSES, case.by_statistic)}


def confirm(
    case: Case,
    explanations: dict[str, Explanation],
    seed: int,
    base: Checkpoint | None,
    progress: Callable[[float], None],
) -> dict[str, Effect]:
    """Undo the most probable causes; adds the share of all deviations that disappears to their support."""
    by_name = {cause.name: cause for cause in CAUSES}
    likely = sorted(((p, name) for name, p in probabilities(explanations).items() if p >= WORTH_UNDOING), reverse=True)
    before = burden(case.deviations)
    effects: dict[str, Effect] = {}
    for number, (_, name) in enumerate(likely[:UNDONE], 1):
        alarms = _symptoms(by_name[name], case.alarms)
        affected = _affected(case, alarms)
        steps = _steps(case, alarms[0], affected) if alarms else None
        indices = [trace.episode_index for trace, hit in zip(case.traces, affected, strict=True) if hit]
        setting = replace(case.setting, affected=frozenset(indices), steps=steps)
        if (replay := replay_without(by_name[name], setting, case.by_statistic, seed, base)) is not None:
            after = examine(setting, replay, case.profile, case.alarm_rate, case)
            restored = max(0.0, 1.0 - burden(after.deviations) / before)
            left = _symptoms(by_name[name], (d for d in after.deviations if d.alarm))
            changes = {} if left or by_name[name].undo.startswith("drop") else ratios(VISIBLE, case.rows, after.rows)
            effects[name] = Effect(recovery(case.traces, replay), restored, changes)
            old = explanations[name]
            explanations[name] = replace(old, support=old.support + RESTORED * restored)
        progress(number / min(UNDONE, len(likely)))
    return effects


def _healthy(case: Case) -> Diagnosis:
    text = f"Healthy: all statistics are within the record of {case.profile.episodes} healthy episodes."
    return Diagnosis("healthy", False, text, (), _provenance(case))


def _conclude(
    case: Case, affected: Case, explanations: Mapping[str, Explanation], effects: Mapping[str, Effect] | None
) -> Diagnosis:
    """effects: None before any cause is undone; whether the filter is affected is then unknown."""
    by_name = {cause.name: cause for cause in CAUSES}
    ranked = sorted(probabilities(explanations).items(), key=lambda item: -item[1])[:LISTED]
    candidates = tuple(_candidate(affected, by_name[name], p, (effects or {}).get(name)) for name, p in ranked)
    sure = bool(candidates) and candidates[0].probability >= SURE
    state: Literal["fault", "unsure"] = "fault" if sure else "unsure"
    masked = effects is not None and not is_visible(
        case.by_statistic, effects.get(candidates[0].cause.name) if sure else None
    )
    headline = _headline(affected, candidates, masked, len(case.rows))
    return Diagnosis(state, masked, headline, candidates, _provenance(case))


def _candidate(case: Case, cause: Cause, probability: float, effect: Effect | None) -> Candidate:
    alarms = _symptoms(cause, case.alarms)
    affected = _affected(case, alarms)
    task, name = case.setting.checkpoint.task.name, case.setting.checkpoint.name
    return Candidate(
        cause=cause,
        probability=probability,
        episodes=tuple(trace.episode_index for trace, hit in zip(case.traces, affected, strict=True) if hit),
        steps=_steps(case, alarms[0], affected) if alarms else None,
        evidence=tuple(_evidence(case, alarm) for alarm in alarms[:EVIDENCE]),
        recovered=None if effect is None else effect.recovery,
        next=cause.next.format(task=task, filter=name),
    )


def _symptoms(cause: Cause, deviations: Iterable[Deviation]) -> list[Deviation]:
    """The deviations of statistics that are symptoms of a cause, in their order."""
    return [d for d in deviations if any(s.matches(d.statistic) for s in cause.symptoms)]


def _evidence(case: Case, deviation: Deviation) -> Evidence:
    """A deviation and the episode that shows it most."""
    distance = [abs(row.get(deviation.statistic, np.nan) - deviation.healthy) for row in case.rows]
    trace = case.traces[int(np.nanargmax(distance))]
    steps = localise(deviation.statistic, trace.episode, case.profile.reference)
    step = None if steps is None else steps[0]
    return Evidence(deviation.text, deviation.value, deviation.low, deviation.high, trace.episode_index, step)


def _steps(case: Case, deviation: Deviation, affected: np.ndarray) -> tuple[int, int] | None:
    """First step that shows a deviation and the first step after it, over the affected episodes; None if unknown."""
    episodes = [trace.episode for trace, hit in zip(case.traces, affected, strict=True) if hit]
    found = [localise(deviation.statistic, episode, case.profile.reference) for episode in episodes]
    known = [steps for steps in found if steps is not None]
    return (min(first for first, _ in known), 1 + max(last for _, last in known)) if known else None


def _affected(case: Case, alarms: Sequence[Deviation]) -> np.ndarray:
    """(E,) mask of episodes whose value of the first alarm deviates by at least half as much as the most deviating."""
    if not alarms:
        return np.ones(len(case.rows), dtype=bool)
    name, healthy = alarms[0].statistic, alarms[0].healthy
    distance = np.array([row.get(name, np.nan) - healthy for row in case.rows])
    distance *= np.sign(alarms[0].value - healthy)
    return np.asarray(distance >= 0.5 * np.nanmax(distance))


def _headline(case: Case, candidates: Sequence[Candidate], masked: bool, count: int) -> str:
    """The first cause, or two, with their probability; two that cannot be separated; or the largest deviation.

    count: number of all episodes.
    """
    if not candidates or not candidates[0].evidence:
        return f"Fault of unknown cause: {case.alarms[0].text}."
    first = candidates[0]
    if first.probability < SURE and len(candidates) > 1 and candidates[1].probability > COMPARABLE * first.probability:
        return f"{first.cause.title} or {_lower(candidates[1].cause.title)}, not separable; try: {first.next}"
    since = _since(case, first)
    where = f" in {len(first.episodes)} of {count} episodes" if len(first.episodes) < count else ""
    where = f" in episode {first.episodes[0]}" if len(first.episodes) == 1 < count else where
    title = first.cause.title if first.probability >= SURE else f"Possibly: {first.cause.title}"
    text = f"{title}{since}{where}, probability {first.probability:.2f}"
    if len(candidates) > 1 and (second := candidates[1]).probability >= SURE:
        text += f"; and {_lower(second.cause.title)}, probability {second.probability:.2f}"
    return f"{text}; the filter is unaffected" if masked else text


def _lower(title: str) -> str:
    """A title within a sentence; abbreviations such as NLL keep their capitals."""
    return title if title[:2].isupper() else title[0].lower() + title[1:]


def _since(case: Case, candidate: Candidate) -> str:
    """The first step of a cause and its time; empty without steps, and for causes of the whole episode."""
    if candidate.steps is None or candidate.steps[0] <= 0:
        return ""
    step = candidate.steps[0]
    episodes = [t.episode for t in case.traces if t.episode_index in candidate.episodes[:1]] or [case.traces[0].episode]
    return f" from step {step} ({episodes[0].times[step]:.1f} s)"


def _provenance(case: Case) -> dict[str, Any]:
    checkpoint = case.setting.checkpoint
    return {
        "task": checkpoint.task.name,
        "filter": checkpoint.name,
        "checkpoint_hash": checkpoint.hash,
        "episodes": len(case.rows),
        "healthy_episodes": case.profile.episodes,
        "alarm_rate": case.alarm_rate,
    }
