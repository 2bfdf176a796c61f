"""Runs of filters that diverge: restarted at the true state, they still show the cause."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.text import plural
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.adapter import FailedStep
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnosis.cause import Diagnosis
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.measures import Array
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all
from beliefscope.inspect.traces.run import trace

MIN_STEPS = 5
"""Smallest number of steps between two restarts."""

FAR, LOST = 1e4, 3.0
"""Error of an estimate that has diverged, and of one that has lost the state before, in standard deviations of the true
states."""

RESTARTS = "restarts"
"""Setting of a trace: the steps at which its filter was restarted."""


def traces_with_restarts(
    checkpoint: Checkpoint, episodes: Mapping[int, Episode], seed: int, particles: int
) -> Iterator[Trace]:
    """The runs of all episodes.

    An external filter that diverges, fails at a step, or returns a number that is not finite, is restarted at the true
    state where it has lost it. Raises BadInput as ``trace``, and if it fails within ``MIN_STEPS`` of a start.
    """
    if not isinstance(checkpoint, ExternalFilter):
        yield from trace_all(checkpoint, episodes, episodes, seed, particles)
        return
    for index, episode in episodes.items():
        std, starts = np.maximum(episode.states.std(0), 1e-12), [0]
        runs: list[Trace] = []
        while starts[-1] < len(episode):
            largest = LOST if runs else FAR
            runs.append(_until_lost(checkpoint, episode.part(starts[-1], len(episode)), index, seed, std, largest))
            starts.append(starts[-1] + len(runs[-1]))
        yield runs[0] if len(runs) == 1 else _joined(runs, episode, {RESTARTS: starts[1:-1]})


def _until_lost(
    checkpoint: ExternalFilter, episode: Episode, index: int, seed: int, std: Array, largest: float
) -> Trace:
    """The run up to the step at which the filter has lost the true state, if it diverges; else the complete run.

    std: (n,) of the true states. largest: error of a filter that does not diverge, relative to it.
    """
    try:
        run = trace(checkpoint, episode, index, seed)
    except FailedStep as error:
        if error.step < MIN_STEPS:
            raise
        run = trace(checkpoint, episode.part(0, error.step), index, seed)
    with np.errstate(all="ignore"):  # single precision overflows before the filter fails
        size = np.abs(measures.errors(run)[:, -1]) / std
    if len(run) == len(episode) and (size <= largest).all():
        return run
    steps = max(MIN_STEPS, int(np.argmin(np.append((size <= LOST).all(-1), False))))
    return _joined([run], episode.part(0, steps), {})


def _joined(runs: Sequence[Trace], episode: Episode, settings: Mapping[str, Any]) -> Trace:
    """Runs over the parts of an episode, as one, without values beyond its end."""
    first, steps = runs[0], len(episode)
    arrays = {f.name: [getattr(run, f.name) for run in runs] for f in fields(Trace) if not f.name.startswith("start_")}
    extra = {name: np.concatenate([run.extra[name] for run in runs])[:steps] for name in first.extra}
    by_step: dict[str, Any] = {
        name: np.concatenate(values)[:steps]
        for name, values in arrays.items()
        if all(isinstance(value, np.ndarray) for value in values)
    }
    return replace(first, episode=episode, extra=extra, settings={**first.settings, **settings}, **by_step)


def with_restarts(diagnosis: Diagnosis, traces: Sequence[Trace]) -> Diagnosis:
    """The diagnosis, whose headline states in how many episodes the filter was restarted."""
    lost = {trace.episode_index: trace.settings[RESTARTS] for trace in traces if RESTARTS in trace.settings}
    if not lost:
        return diagnosis
    index = min(lost, key=lambda i: lost[i][0])
    count = plural(len(traces), "episode")
    text = f"the filter diverges in {len(lost)} of {count}, first at step {lost[index][0]} of episode {index}"
    provenance = {**diagnosis.provenance, RESTARTS: lost}
    return replace(diagnosis, headline=f"{diagnosis.headline}; {text}", provenance=provenance)
