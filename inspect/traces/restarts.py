"""Runs of external filters that diverge: restarted at the true state, they can be displayed and diagnosed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.datasets.text import plural
from beliefscope.filters.engine import Progress
from beliefscope.filters.external.adapter import MIN_STEPS, FailedStep
from beliefscope.filters.external.calls import takes_start
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.external.step_values import joined
from beliefscope.inspect.traces.data import Trace
from beliefscope.inspect.traces.external import trace_external

LOST = 3.0
"""Error of an estimate that has lost the true state, in standard deviations of the true states, or of the first belief
if these are larger."""

RESTARTS, FAILURE = "restarts", "failure"
"""Settings of a trace: the steps at which its filter was restarted, and the first reason."""


def trace_with_restarts(
    external: ExternalFilter,
    episode: Episode,
    episode_index: int = 0,
    seed: int = 0,
    faults: Faults = NO_FAULTS,
    progress: Progress = None,
    largest: float = math.inf,
) -> Trace:
    """The run over an episode; a filter that fails at a step is restarted at the true state where it has lost it.

    It also fails if it returns a number that is not finite, or with an error of more than ``largest`` standard
    deviations (``LOST``). The trace then has the settings ``RESTARTS`` and ``FAILURE``. Filters that cannot start at a
    given belief are not restarted, nor are those of episodes without ground truth.

    Raises BadInput as ``trace``, and if the filter fails within ``MIN_STEPS`` of a start.
    """
    external.check_task(episode)
    faults.check(external.task, len(episode))
    if not takes_start(external.adapter.module) or not np.isfinite(episode.states).all():
        return trace_external(external, episode, episode_index, seed, faults, progress)
    seen, start = faults.apply(episode, seed), external.start([episode]).covariance[0].numpy()
    # Some components, such as a bias, do not change in an episode.
    std = np.fmax(episode.states.std(0), np.sqrt(np.fmax(np.diagonal(start), 1e-24)))
    runs: list[Trace] = []
    starts, reason = [0], ""
    while starts[-1] < len(episode):
        part = seen.part(starts[-1], len(episode))
        run, failure = _until_lost(external, part, seed, None if runs else progress, std, LOST if runs else largest)
        runs.append(run)
        starts.append(starts[-1] + len(run))
        reason = reason or failure
    run = _joined(runs, seen, {RESTARTS: starts[1:-1], FAILURE: reason}) if reason else runs[0]
    return replace(run, episode=seen, episode_index=episode_index, faults=faults, data_hash=episode.digest())


def restarts_text(trace: Trace) -> str:
    """``restarted at the true state 3 times: REASON``; empty for a run without restarts."""
    if FAILURE not in trace.settings:
        return ""
    return f"restarted at the true state {plural(len(trace.settings[RESTARTS]), 'time')}: {trace.settings[FAILURE]}"


def restarted_runs_text(restarted: int, runs: int) -> str:
    """A sentence that states in how many of some runs the filter was restarted."""
    where = "this run" if runs == 1 else f"{restarted} of {runs} runs"
    return f"The filter fails and is restarted at the true state in {where}."


def _until_lost(
    external: ExternalFilter,
    episode: Episode,
    seed: int,
    progress: Progress,
    std: NDArray[Any],
    largest: float,
) -> tuple[Trace, str]:
    """The run up to the step at which the filter has lost the true state, if it fails, and the reason; else all of it.

    Args:
        std: (n,) of ``LOST``. largest: error of a filter that does not fail, relative to it.
    """
    reason = f"{external.source} diverges"
    try:
        run = trace_external(external, episode, seed=seed, progress=progress)
    except FailedStep as error:
        if error.step < MIN_STEPS:
            raise
        run, reason = trace_external(external, episode.part(0, error.step), seed=seed), str(error)
    with np.errstate(all="ignore"):  # single precision overflows before the filter fails
        difference = episode.task.difference(run.estimate_mean, run.episode.states)
        size = np.abs(difference) / std
    if len(run) == len(episode) and (size <= largest).all():
        return run, ""
    steps = max(MIN_STEPS, int(np.argmin(np.append((size <= LOST).all(-1), False))))
    return _joined([run], episode.part(0, steps), {}), reason


def _joined(runs: Sequence[Trace], episode: Episode, settings: Mapping[str, Any]) -> Trace:
    """Runs over the parts of an episode, as one, without values beyond its end."""
    first, steps = runs[0], len(episode)
    arrays = {f.name: [getattr(run, f.name) for run in runs] for f in fields(Trace) if not f.name.startswith("start_")}
    extra = {name: np.concatenate([run.extra[name] for run in runs])[:steps] for name in first.extra}
    by_step: dict[str, Any] = {
        name: joined(name, [torch.from_numpy(value) for value in values]).numpy()[:steps]
        for name, values in arrays.items()
        if all(isinstance(value, np.ndarray) for value in values)
    }
    return replace(first, episode=episode, extra=extra, settings={**first.settings, **settings}, **by_step)
