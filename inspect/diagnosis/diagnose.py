"""Diagnosis of a filter over episodes: the probable cause of a fault, its evidence, and the next action.

Every statistic of the episodes is compared with the filter's own healthy profile. If any deviates, each cause of the
catalog is scored by how well its signature explains all deviations; the best ones are undone and the episodes replayed
with the same random numbers. The right undo restores the healthy statistics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task_json import check_names
from beliefscope.datasets.text import capitalised
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.engine import Engine, Progress, run_all, run_blocks
from beliefscope.filters.external.adapter import MIN_STEPS, FailedStep
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.filters.names import is_code
from beliefscope.inspect.diagnosis.case import (
    Case,
    affected_episodes,
    affected_steps,
    checked_alarm_rate,
    compared,
    examine_again,
    explain_all,
    focus,
    observe,
    outlying,
    symptoms_of,
)
from beliefscope.inspect.diagnosis.cause import Diagnosis
from beliefscope.inspect.diagnosis.conclusion import conclude, healthy
from beliefscope.inspect.diagnosis.scoring import Explanation, burden, probabilities
from beliefscope.inspect.diagnosis.undo.confirmation import recovery, replay_without
from beliefscope.inspect.diagnosis.undo.run_inputs import RunInputs
from beliefscope.inspect.diagnosis.undo.undo import brings_back
from beliefscope.inspect.diagnosis.visibility import Effect, effect_ratios
from beliefscope.inspect.diagnostics.healthy_comparison import no_diagnosis
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile, find_profile
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all
from beliefscope.inspect.traces.restarts import FAILURE, RESTARTS, trace_with_restarts

BLOCK = 16
"""Number of episodes that run together. It does not depend on the number of workers, so neither do the values."""

UNDONE = 3
"""Maximum number of causes that are undone."""

WORTH_UNDOING = 0.02
"""Smallest probability of a cause that is undone."""

DIVERGED = 1e4
"""Error of an external filter that is restarted (``trace_with_restarts``)."""

RESTORED = 0.3
"""Weight of the restored share of all deviations in the score of a cause that was undone."""


def diagnose(
    checkpoint: Checkpoint,
    episodes: Mapping[int, Episode],
    *,
    seed: int = 0,
    particles: int = 300,
    alarm_rate: float | None = None,
    base: Checkpoint | None = None,
    profile: HealthyProfile | None = None,
    engine: Engine = "local",
    workers: int = 1,
    progress: Callable[[float], None] | None = None,
) -> Diagnosis:
    """Diagnose a filter over episodes.

    Args:
        episodes: by index in their data set.
        alarm_rate: probability that a healthy filter is not called healthy; default: see ``checked_alarm_rate``.
        base: checkpoint of the same architecture whose modules replace suspected ones.
        profile: healthy profile; default: that of the checkpoint.
        engine, workers: where to run, as for ``filters.engine.run_blocks``. The values do not depend on them.
        progress: called with the completed fraction.

    An external filter that fails at a step is restarted at the true state, and episodes in which it fails before it can
    be restarted are left out; the headline says so.

    Raises BadInput without episodes, if the filter fails so early in all of them, without a healthy profile or with too
    small a one, for episodes of another task, and for several workers with an external filter without build function.
    """
    report = progress or (lambda fraction: None)
    if not episodes:
        raise BadInput("no episodes to diagnose")
    profile = profile or required_profile(checkpoint)
    checked_alarm_rate(profile.episodes, len(episodes), alarm_rate)
    items = list(episodes.items())
    blocks = [items[i : i + BLOCK] for i in range(0, len(items), BLOCK)]
    observed: dict[int, Observed | FailedStep] = {}
    run = partial(_observed, checkpoint, profile, seed, particles)
    for _, results in run_blocks(run, blocks, engine, workers, lambda share: report(0.6 * share)):
        observed |= results
    failed = {index: result for index in episodes if isinstance(result := observed[index], FailedStep)}
    if len(failed) == len(episodes):
        raise failed[items[0][0]]
    known = [result for index in episodes if not isinstance(result := observed[index], FailedStep)]
    traces, rows, sensors = zip(*known, strict=True)
    alarm_rate = checked_alarm_rate(profile.episodes, len(traces), alarm_rate)
    inputs = _run_inputs(checkpoint, traces, particles, profile)
    case = compared(inputs, traces, rows, sensors, profile, alarm_rate)
    diagnosis = _diagnosed(case, seed, base, engine, workers, lambda share: report(0.6 + 0.4 * share))
    return _with_failures(_with_restarts(diagnosis, traces), failed, len(episodes))


Observed = tuple[Trace, dict[str, float], dict[str, float]]
"""A run, all its statistics, and those of its sensors."""


def _observed(
    checkpoint: Checkpoint,
    profile: HealthyProfile,
    seed: int,
    particles: int,
    block: Sequence[tuple[int, Episode]],
    progress: Progress,
) -> dict[int, Observed | FailedStep]:
    """Of the episodes of a block, by index; the error where an external filter fails before it can be restarted."""
    observed: dict[int, Observed | FailedStep] = {}
    for index, run in _runs(checkpoint, dict(block), seed, particles):
        observed[index] = run if isinstance(run, FailedStep) else (run, *observe(run, checkpoint, profile))
        if progress is not None:
            progress(len(observed) / len(block))
    return observed


def _runs(
    checkpoint: Checkpoint, episodes: Mapping[int, Episode], seed: int, particles: int
) -> Iterator[tuple[int, Trace | FailedStep]]:
    """Index and run of all episodes, of external filters with restarts."""
    if not isinstance(checkpoint, ExternalFilter):
        for trace in trace_all(checkpoint, episodes, episodes, seed, particles):
            yield trace.episode_index, trace
        return
    for index, episode in episodes.items():
        try:
            yield index, trace_with_restarts(checkpoint, episode, index, seed, largest=DIVERGED)
        except FailedStep as error:
            yield index, error


def _with_restarts(diagnosis: Diagnosis, traces: Sequence[Trace]) -> Diagnosis:
    """The diagnosis, whose headline states in how many episodes the filter was restarted, and why."""
    settings = {trace.episode_index: trace.settings for trace in traces if RESTARTS in trace.settings}
    if not settings:
        return diagnosis
    lost = {index: values[RESTARTS] for index, values in settings.items()}
    index = min(lost, key=lambda i: lost[i][0])
    where = f" in {len(lost)} of {len(traces)} episodes, first at" if len(traces) > 1 else " at"
    of_episode = f" of episode {index}" if len(traces) > 1 else ""
    failure, at = settings[index][FAILURE], f"{where} step {lost[index][0]}{of_episode}"
    diverges = failure.endswith((" diverges", " is not finite"))
    text = f"the filter diverges{at}, and is restarted" if diverges else f"the filter is restarted{at}: {failure}"
    return replace(_failing(diagnosis, text), provenance={**diagnosis.provenance, RESTARTS: lost})


def _with_failures(diagnosis: Diagnosis, failed: Mapping[int, FailedStep], count: int) -> Diagnosis:
    """The diagnosis, whose headline states in how many of all episodes the filter fails before it can be restarted."""
    if not failed:
        return diagnosis
    index = next(iter(failed))
    where = f"{len(failed)} of {count} episodes are left out, as the filter fails within {MIN_STEPS} steps of a start"
    return _failing(diagnosis, f"{where}: {failed[index]}, in episode {index}")


def _failing(diagnosis: Diagnosis, text: str) -> Diagnosis:
    """The diagnosis of a filter that fails, with a text about it in the headline."""
    headline, state = diagnosis.headline.removesuffix("."), diagnosis.state
    if state == "fault":
        return replace(diagnosis, headline=f"{headline}; {text}")
    # the failure is all that is certain
    other = headline.replace("Healthy: ", "otherwise ", 1) if state == "healthy" else headline
    return replace(diagnosis, state="unsure", headline=f"{capitalised(text)}; {other[0].lower()}{other[1:]}")


def diagnose_traces(
    checkpoint: Checkpoint,
    traces: Sequence[Trace],
    *,
    seed: int = 0,
    particles: int = 300,
    alarm_rate: float | None = None,
    base: Checkpoint | None = None,
    profile: HealthyProfile | None = None,
    progress: Callable[[float], None] | None = None,
) -> Diagnosis:
    """Diagnose a filter from its runs over different episodes, with the arguments and errors of ``diagnose``."""
    case = _examined(checkpoint, traces, particles, profile or required_profile(checkpoint), alarm_rate)
    return _diagnosed(case, seed, base, "local", 1, progress or (lambda fraction: None))


def preliminary(
    checkpoint: Checkpoint, trace: Trace, particles: int = 300, alarm_rate: float | None = None
) -> Diagnosis:
    """The diagnosis of one run before any cause is undone, within a fraction of a second; final if it is healthy.

    Raises BadInput without a healthy profile, or with too small a one.
    """
    case = _examined(checkpoint, [trace], particles, required_profile(checkpoint), alarm_rate)
    diagnosis = conclude(case, case, explain_all(case), None) if case.alarms else healthy(case)
    return _with_restarts(diagnosis, [trace])


def _examined(
    checkpoint: Checkpoint, traces: Sequence[Trace], particles: int, profile: HealthyProfile, alarm_rate: float | None
) -> Case:
    alarm_rate = checked_alarm_rate(profile.episodes, len(traces), alarm_rate)
    rows, sensors = zip(*(observe(trace, checkpoint, profile) for trace in traces), strict=True)
    inputs = _run_inputs(checkpoint, traces, particles, profile)
    return compared(inputs, traces, rows, sensors, profile, alarm_rate)


def _run_inputs(checkpoint: Checkpoint, traces: Sequence[Trace], particles: int, profile: HealthyProfile) -> RunInputs:
    """The inputs of traces."""
    episodes = {trace.episode_index: trace.episode for trace in traces}
    return RunInputs(checkpoint, episodes, particles, frozenset(episodes), healthy=profile)


def _diagnosed(
    case: Case,
    seed: int,
    base: Checkpoint | None,
    engine: Engine,
    workers: int,
    progress: Callable[[float], None],
) -> Diagnosis:
    """Confirm the probable causes of a case by undoing them."""
    affected = focus(case) if case.alarms else outlying(case)
    if affected is None:
        progress(1.0)
        return healthy(case)
    if not case.alarms:
        case = replace(case, deviations=affected.deviations, p_value=affected.p_value)
    explanations = explain_all(affected)
    effects = confirm(case, affected, explanations, seed, base, engine, workers, progress)
    progress(1.0)
    return conclude(case, affected, explanations, effects)


def required_profile(checkpoint: Checkpoint) -> HealthyProfile:
    """The healthy profile of a filter. Raises BadInput without one, and for a task whose names have a slash."""
    check_names(checkpoint.task)
    profile = find_profile(checkpoint.task.name, checkpoint.name, checkpoint.hash, checkpoint)
    if profile is None and isinstance(checkpoint, UnavailableFilter):
        raise BadInput(no_diagnosis(checkpoint) or "")
    if profile is None:
        source = str(checkpoint.path or checkpoint.name)
        if isinstance(checkpoint, ExternalFilter):  # its name is no command line's, such as that of a live run
            source = checkpoint.source if is_code(checkpoint.source) else "FILE.py:FUNCTION"
        raise BadInput(
            f"{no_diagnosis(checkpoint)}; compare it with clean episodes: beliefscope diagnose "
            f"{checkpoint.task.name} --filter {source} --data DATA --profile-from CLEAN_DATA; add "
            "--profile-filter OLD if only an earlier version OLD is known to be right"
        )
    return profile


def confirm(
    case: Case,
    affected: Case,
    explanations: dict[str, Explanation],
    seed: int,
    base: Checkpoint | None,
    engine: Engine,
    workers: int,
    progress: Callable[[float], None],
) -> dict[str, Effect]:
    """Undo the most probable causes; adds the share of all deviations that disappears to their support.

    Args:
        affected: the episodes of the case that the largest alarm concerns.
    """
    likely = sorted(((p, name) for name, p in probabilities(explanations).items() if p >= WORTH_UNDOING), reverse=True)
    names = [name for _, name in likely[:UNDONE]]
    effects: dict[str, Effect] = {}
    run = partial(_undone, case, affected, seed, base)
    for number, (name, effect) in enumerate(run_all(run, names, engine, workers), 1):
        if effect is not None:
            effects[name] = effect
            support = explanations[name].support + RESTORED * effect.restored
            explanations[name] = replace(explanations[name], support=support)
        progress(number / len(names))
    return effects


def _undone(everything: Case, case: Case, seed: int, base: Checkpoint | None, name: str) -> Effect | None:
    """Effect of undoing a cause; None if it cannot be undone."""
    cause = next(cause for cause in case.causes if cause.name == name)
    alarms = symptoms_of(cause, case.alarms)
    hit = affected_episodes(case, alarms)
    steps = affected_steps(case, alarms[0], hit) if alarms else None
    indices = [trace.episode_index for trace, affected in zip(case.traces, hit, strict=True) if affected]
    inputs = replace(case.inputs, affected=frozenset(indices), steps=steps)
    try:
        replay = replay_without(cause, inputs, case.by_statistic, seed, base)
    except FailedStep:  # the filter diverges nevertheless
        return None
    if replay is None:
        return None
    action, traces = replay
    after = examine_again(case, inputs, traces)
    restored = max(0.0, 1.0 - burden(after.deviations) / burden(case.deviations))
    others = [trace for trace in everything.traces if trace.episode_index not in case.inputs.episodes]
    ratios = effect_ratios(everything.traces, [*traces, *others])
    return Effect(recovery(case.traces, traces), restored, ratios, brings_back(action, base))
