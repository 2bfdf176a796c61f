"""Diagnosis of a filter over episodes: the probable cause of a fault, its evidence, and the next action.

Every statistic of the episodes is compared with the filter's own healthy profile. If any deviates, each cause of the
catalog is scored by how well its signature explains all deviations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnosis.catalog import CAUSES
from beliefscope.inspect.diagnosis.cause import Candidate, Cause, Diagnosis, Evidence
from beliefscope.inspect.diagnosis.scoring import applicable, probabilities, score
from beliefscope.inspect.diagnosis.statistics import episode_statistics, with_scatter
from beliefscope.inspect.diagnostics.healthy_comparison import Comparison, Deviation, compare, critical_value
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile, find_profile
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all

SURE = 0.5
"""Smallest probability of the first cause with which the state is ``fault`` rather than ``unsure``."""

LISTED = 5
"""Maximum number of listed causes."""

EVIDENCE = 5
"""Maximum number of listed deviations by cause."""


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
        base: checkpoint whose modules replace the filter's, one at a time; it must have the same architecture.
        profile: healthy profile; default: that of the checkpoint.
        progress: called with the completed fraction.

    Raises BadInput without episodes, without a healthy profile, and for episodes of another task.
    """
    if not episodes:
        raise BadInput("no episodes to diagnose")
    profile = profile or find_profile(checkpoint.task.name, checkpoint.name, checkpoint.hash, checkpoint)
    if profile is None:
        raise BadInput(
            f"filter {checkpoint.name!r} has no healthy profile; give clean episodes with --profile-from DATA"
        )
    traces = []
    for trace in trace_all(checkpoint, episodes, episodes, seed, particles):
        traces.append(trace)
        if progress is not None:
            progress(0.5 * len(traces) / len(episodes))
    rows = [episode_statistics(trace, checkpoint) for trace in traces]
    extended, extended_rows = with_scatter(profile, rows)
    comparison = compare(extended, extended_rows, significance=alarm_rate)
    provenance = {
        "task": checkpoint.task.name,
        "filter": checkpoint.name,
        "checkpoint_hash": checkpoint.hash,
        "episodes": len(episodes),
        "healthy_episodes": profile.episodes,
        "alarm_rate": alarm_rate,
    }
    if not comparison.alarms:
        text = f"Healthy: all statistics are within the record of {profile.episodes} healthy episodes"
        return Diagnosis("healthy", False, f"{text}.", (), provenance)
    names = [deviation.statistic for deviation in comparison.deviations]
    critical = critical_value(extended, names, len(rows), alarm_rate)
    causes = applicable(CAUSES, names)
    scores = {cause.name: score(cause, comparison.deviations, critical) for cause in causes}
    ranked = sorted(probabilities(scores).items(), key=lambda item: -item[1])[:LISTED]
    by_name = {cause.name: cause for cause in causes}
    candidates = tuple(
        _candidate(by_name[name], probability, comparison, traces, rows, checkpoint) for name, probability in ranked
    )
    state: Literal["fault", "unsure"] = "fault" if candidates and candidates[0].probability >= SURE else "unsure"
    return Diagnosis(state, False, _headline(candidates, comparison), candidates, provenance)


def _candidate(
    cause: Cause,
    probability: float,
    comparison: Comparison,
    traces: Sequence[Trace],
    rows: Sequence[Mapping[str, float]],
    checkpoint: Checkpoint,
) -> Candidate:
    """A cause with its evidence: the alarms among its symptoms, largest first."""
    alarms = [d for d in comparison.alarms if any(s.matches(d.statistic) for s in cause.symptoms)]
    evidence = tuple(_evidence(deviation, traces, rows) for deviation in alarms[:EVIDENCE])
    affected = _affected(alarms[0], rows) if alarms else np.ones(len(rows), dtype=bool)
    return Candidate(
        cause=cause,
        probability=probability,
        episodes=tuple(trace.episode_index for trace, hit in zip(traces, affected, strict=True) if hit),
        steps=None,
        evidence=evidence,
        recovered=None,
        next=cause.next.format(task=checkpoint.task.name, filter=checkpoint.name),
    )


def _evidence(deviation: Deviation, traces: Sequence[Trace], rows: Sequence[Mapping[str, float]]) -> Evidence:
    """A deviation and the episode that shows it most."""
    distance = [abs(row.get(deviation.statistic, np.nan) - deviation.healthy) for row in rows]
    episode = traces[int(np.nanargmax(distance))].episode_index
    return Evidence(deviation.text, deviation.value, deviation.low, deviation.high, episode)


def _affected(deviation: Deviation, rows: Sequence[Mapping[str, float]]) -> np.ndarray:
    """(E,) mask of episodes whose value deviates by at least half of the largest deviation."""
    distance = np.array([row.get(deviation.statistic, np.nan) - deviation.healthy for row in rows])
    distance *= np.sign(deviation.value - deviation.healthy)
    return distance >= 0.5 * np.nanmax(distance)


def _headline(candidates: Sequence[Candidate], comparison: Comparison) -> str:
    """The first cause with its probability; two causes that cannot be separated; or the largest deviation."""
    if not candidates or candidates[0].probability < 0.1:
        return f"Fault of unknown cause: {comparison.alarms[0].text}."
    first = candidates[0]
    if first.probability < SURE and len(candidates) > 1:
        return f"Cannot separate {first.cause.name} from {candidates[1].cause.name}; try: {first.next}"
    place = f" in episode {first.episodes[0]}" if len(first.episodes) == 1 else ""
    return f"{first.cause.title}{place}, probability {first.probability:.2f}"
