"""The conclusion of a diagnosis: ranked causes with their evidence, and one headline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from beliefscope.datasets.task import display_name
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnosis.case import (
    ALARM_RATE,
    Case,
    affected_episodes,
    affected_steps,
    checked_alarm_rate,
    located,
    symptoms_of,
)
from beliefscope.inspect.diagnosis.cause import (
    SHOWN,
    Candidate,
    Cause,
    Diagnosis,
    Evidence,
    matches,
    probability_text,
)
from beliefscope.inspect.diagnosis.causes.external_filters import EFFECTS, LATE
from beliefscope.inspect.diagnosis.checks.sensors import covers_episode
from beliefscope.inspect.diagnosis.error_conditions import error_condition
from beliefscope.inspect.diagnosis.largest_error import largest_error
from beliefscope.inspect.diagnosis.laws import defect_of, turned_text
from beliefscope.inspect.diagnosis.next_action import CONVENTIONS, is_unused, next_action, search_action
from beliefscope.inspect.diagnosis.scoring import Explanation, probabilities
from beliefscope.inspect.diagnosis.unmeasured import (
    missing_statistics,
    sensor_statistic_names,
    statistics_by_subject,
    unmeasured,
)
from beliefscope.inspect.diagnosis.visibility import Effect, is_visible
from beliefscope.inspect.diagnosis.wrong_noise import too_small
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.diagnostics.statistic_kinds import channel_of

SURE = 0.5
"""Smallest probability of the first cause with which the state is ``fault`` rather than ``unsure``."""

COMPARABLE = 0.3
"""Smallest ratio of their probabilities for two causes that cannot be separated."""

EQUAL = 0.8
"""As ``COMPARABLE``, if the first cause is as probable as all others together."""

LISTED = 5
"""Maximum number of listed causes."""

EVIDENCE = 5
"""Maximum number of listed deviations by cause."""

LARGEST = 3
"""Maximum number of listed deviations without an alarm."""

MAX_NEES = 2.0
"""Largest ratio of a healthy record's NEES to 1, and of 1 to it, that the headline does not mention."""

WRONG_NEES = 10.0
"""As ``MAX_NEES``, from which the filter is not called healthy, although it does not deviate from its record."""

BY_MODALITY = (LATE.name, "weights.ignores_likelihood", "weights.repeats_likelihood")
"""Causes that concern some modalities, which their names do not tell."""


def healthy(case: Case) -> Diagnosis:
    """The diagnosis without an alarm."""
    count, record = len(case.deviations), case.profile.episodes
    is_small = checked_alarm_rate(record, len(case.traces)) > ALARM_RATE
    small = "; a larger record shows smaller faults" if is_small else ""
    text = f"no significant deviation from the record of {record} healthy episodes in {count} statistics{small}."
    largest = tuple(_evidence(case, deviation) for deviation in case.deviations[:LARGEST])
    nees = _nees(case.profile)
    headline = f"Healthy: {text}"
    if _is_miscalibrated(nees):
        overconfident = f"{'over' if nees > 1 else 'under'}confident (median NEES/n {nees:.2g})"
        headline = f"Healthy, though {overconfident}: {text}"
        if not 1 / WRONG_NEES <= nees <= WRONG_NEES:
            noise = too_small(case.profile, case.inputs.checkpoint) if nees > 1 else None
            reason, action = (f": {noise.finding}", noise.action) if noise else ("", CONVENTIONS)
            headline = f"Always {overconfident}, even in its healthy record{reason}; {text[:-1]}; try: {action}."
    error = largest_error(case.inputs.checkpoint, case.traces)
    if error is not None and error.overconfident and len(case.traces) == 1 and headline.startswith("Healthy: "):
        headline = f"No fault, but the filter is overconfident at step {error.step}: {error.text}; otherwise {text}"
    if defect := defect_of(case):
        headline = f"{defect}; otherwise {text}"
    provenance = _provenance(case, defect) | ({} if error is None else {"largest_error": error.to_json()})
    return Diagnosis("healthy", False, headline, (), largest, provenance)


def _nees(profile: HealthyProfile) -> float:
    """Median NEES of the record; 1 if unknown. No comparison with it shows that a filter has never been consistent."""
    values = profile.statistics.get("nees/fused/all", np.empty(0))
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else 1.0


def _is_miscalibrated(nees: float) -> bool:
    return not 1 / MAX_NEES <= nees <= MAX_NEES


def conclude(
    case: Case, affected: Case, explanations: Mapping[str, Explanation], effects: Mapping[str, Effect] | None
) -> Diagnosis:
    """The diagnosis of a case with alarms.

    Args:
        affected: the episodes that the largest alarm concerns.
        effects: of undone causes, by name. None before any cause is undone: whether the filter is affected is unknown
            unless it does not use the sensor.
    """
    by_name = {cause.name: cause for cause in case.causes}
    ranked = sorted(probabilities(explanations).items(), key=lambda item: -item[1])[:LISTED]
    candidates = tuple(_candidate(affected, by_name[name], p, (effects or {}).get(name)) for name, p in ranked)
    sure = bool(candidates) and candidates[0].probability >= SURE
    state: Literal["fault", "unsure"] = "fault" if sure else "unsure"
    unused = sure and is_unused(candidates[0].cause, case.inputs.checkpoint)
    is_effect_known = effects is not None or unused
    effect = (effects or {}).get(candidates[0].cause.name) if sure else None
    masked = is_effect_known and not is_visible(case.by_statistic, effect)
    is_known = unused or (effect is not None and effect.shows_healthy_run)
    headline = _headline(affected, candidates, masked, len(case.rows), is_known)
    if candidates and effects is not None and isinstance(case.inputs.checkpoint, ExternalFilter):
        where = error_condition(affected.traces, case.inputs.checkpoint, candidates[0].cause)
        candidates = (replace(candidates[0], next=f"{candidates[0].next} {where}".strip()), *candidates[1:])
    deviations = tuple(_evidence(affected, alarm) for alarm in affected.alarms[:EVIDENCE])
    causes = tuple(candidate for candidate in candidates if candidate.evidence)
    return Diagnosis(state, masked, headline, causes, deviations, _provenance(case, turned_text(case)))


def _candidate(case: Case, cause: Cause, probability: float, effect: Effect | None) -> Candidate:
    alarms = symptoms_of(cause, case.alarms)
    affected = affected_episodes(case, alarms)
    return Candidate(
        cause=cause,
        probability=probability,
        episodes=tuple(trace.episode_index for trace, hit in zip(case.traces, affected, strict=True) if hit),
        steps=affected_steps(case, alarms[0], affected) if alarms else None,
        evidence=tuple(_evidence(case, alarm) for alarm in alarms[:EVIDENCE]),
        recovered=None if effect is None else effect.recovery,
        next=next_action(cause, case.inputs.checkpoint),
    )


def _evidence(case: Case, deviation: Deviation) -> Evidence:
    """A deviation and the episode that shows it most."""
    distance = [abs(row.get(deviation.statistic, np.nan) - deviation.healthy) for row in case.grouped]
    trace = case.traces[int(np.nanargmax(distance))]
    steps = located(case, deviation, trace.episode)
    step = None if steps is None else steps[0]
    time = None if step is None else trace.episode.time_of(step)
    sensor = sensor_about(case, deviation.statistic)
    values = (deviation.value, deviation.low, deviation.high)
    return Evidence(deviation.text, *values, trace.episode_index, step, time, sensor)


def sensor_about(case: Case, statistic: str) -> str:
    """Observation key of the sensor that a statistic is about, or ``control``; empty if it is about something else.

    The subject of a statistic may start with the modality: ``haptics force x``.
    """
    if statistic not in sensor_statistic_names(case):
        return ""
    subject = f" {statistic.split('/')[1]} "
    keys = [key for key in (*case.inputs.checkpoint.task.observations, "control") if f" {key} " in subject]
    return max(keys, key=len, default="")


def _headline(case: Case, candidates: Sequence[Candidate], masked: bool, count: int, is_known: bool) -> str:
    """The first cause, or two, with their probability; two that cannot be separated; or the largest deviation.

    Of deviations, those of the readings come first, as others follow from them. It names the next action unless the
    first cause is sure.

    Args:
        count: number of all episodes.
        is_known: whether the same episodes without the fault are known, or the filter does not use the sensor.
    """
    if not candidates or not candidates[0].evidence or candidates[0].probability < SHOWN:
        sure = bool(candidates) and candidates[0].probability >= SURE
        of_sensors = [alarm for alarm in case.alarms if alarm.statistic in sensor_statistic_names(case)]
        symptom = (of_sensors or case.alarms)[0].text  # a faulty sensor changes the belief as well
        action = search_action(
            case.inputs.checkpoint, count, any(s.startswith(("nis/", "particles/")) for s in case.by_statistic)
        )
        return f"{'Fault of unknown cause' if sure else 'No cause stands out'}: {symptom}; try: {action}"
    first, *others = (candidate for candidate in candidates if candidate.evidence)
    similar = [c for c in others[:2] if c.probability >= max(SHOWN, COMPARABLE * first.probability)]
    if similar and (first.probability < SURE or _are_equal(first, similar[0])):
        *titles, last = (first.cause.title, *(_lower(c.cause.title) for c in similar))
        if _are_alike([first, *similar]):
            return f"{', '.join(titles)} and {last}, by one cause or by several; try: {first.next}"
        return f"{', '.join(titles)} or {last}, not separable; try: {first.next}"
    where = f" in at least {len(first.episodes)} of {count} episodes" if len(first.episodes) < count else ""
    where = f" in episode {first.episodes[0]}" if len(first.episodes) == 1 < count else where
    title = first.cause.title if first.probability >= SURE else f"Possibly: {_lower(first.cause.title)}"
    where = channels_text(case, first.cause) + _when(case, first) + where
    text = f"{title}{where}, probability {probability_text(first.probability)}"
    if others and (second := others[0]).probability >= SURE:
        text += f"; and {_lower(second.cause.title)}, probability {probability_text(second.probability)}"
    if masked:
        text += "; the filter is unaffected" if is_known else "; the errors of the filter are in the healthy range"
    return text if first.probability >= SURE else f"{text}; try: {first.next}"


def _are_equal(first: Candidate, second: Candidate) -> bool:
    """Whether one of two causes is present, and about as probably the other one (``EQUAL``)."""
    return first.probability + second.probability < 1.0 + SHOWN and second.probability > EQUAL * first.probability


def _are_alike(candidates: Sequence[Candidate]) -> bool:
    """Whether all have evidence of their own for the same mechanism, such as updates with each of several sensors."""
    evidence = [item.text for candidate in candidates for item in candidate.evidence]
    mechanisms = {candidate.cause.name.rpartition(".")[2] for candidate in candidates}
    return len(mechanisms) == 1 and len(evidence) == len(set(evidence)) and all(c.evidence for c in candidates)


def _lower(title: str) -> str:
    """A title within a sentence; abbreviations such as NLL keep their capitals."""
    return title if title[:2].isupper() else title[0].lower() + title[1:]


def channels_text(case: Case, cause: Cause) -> str:
    """The channels of a sensor or of the controls that a cause concerns: `` (elbow)``. Empty for all, or without names.

    Channels with more than half of the largest deviation; the controls with a wrong effect; of ``BY_MODALITY``, models.
    """
    task, key, alarms = case.inputs.checkpoint.task, cause.component.rpartition(".")[2], symptoms_of(cause, case.alarms)
    if key == "dynamics":
        explained = "|".join([cause.consequences, *(symptom.statistics for symptom in cause.symptoms)])
        key = "control"
        alarms = [a for a in case.alarms if matches(EFFECTS, a.statistic) and matches(explained, a.statistic)]
    largest: dict[str, float] = {}
    for alarm in alarms:
        if channel := channel_of(alarm.statistic.split("/")[1], task):
            largest.setdefault(channel[1].name.removeprefix(f"{key} "), abs(alarm.t))
    limit, names = 0.5 * max(largest.values(), default=0.0), [channel.name for channel in task.channels.get(key, ())]
    if cause.name in BY_MODALITY:
        alarms = [alarm for alarm in alarms if cause.symptoms[0].direction * alarm.t > 0.0]
        limit, names, largest = 0.0, list(task.modalities), {a.statistic.split("/")[1]: abs(a.t) for a in alarms}
    own = [name for name in names if largest.get(name, 0.0) > limit]
    return f" ({', '.join(map(display_name, own))})" if 0 < len(own) < len(names) else ""


def _when(case: Case, candidate: Candidate) -> str:
    """The steps of a cause: all; or the first and, if it ends before the episodes, the last one, with their times.

    Empty if they are unknown, and if the cause occurs from the first to the last step, but not at all steps.
    """
    if candidate.steps is None:
        return ""
    first, last = candidate.steps[0], candidate.steps[1] - 1
    episodes = [trace.episode for trace in case.traces if trace.episode_index in candidate.episodes]
    statistic = symptoms_of(candidate.cause, case.alarms)[0].statistic
    if all(covers_episode(statistic, episode) for episode in episodes):
        return " at all steps"
    longest = max(episodes, key=len)
    if last < len(longest) - 1:
        return f" from step {first} to {last} ({longest.times[first]:.1f} to {longest.times[last]:.1f} s)"
    return f" from step {first} ({longest.times[first]:.1f} s)" if first > 0 else ""


def _provenance(case: Case, defect: str) -> dict[str, Any]:
    """defect: of the filter, whatever the record; empty if there is none."""
    checkpoint, numbers, new = case.inputs.checkpoint, statistics_by_subject(case), missing_statistics(case)
    return {
        "task": checkpoint.task.name,
        "filter": checkpoint.name,
        "checkpoint_hash": checkpoint.hash,
        "episodes": len(case.rows),
        "healthy_episodes": case.profile.episodes,
        "healthy_data": case.profile.data,
        "miscalibrated": _is_miscalibrated(_nees(case.profile)) or bool(defect),
        "statistics": numbers,
        "unmeasured": unmeasured(case, numbers, new),
        "outdated": new > 0,
        "alarm_rate": case.alarm_rate,
    }
