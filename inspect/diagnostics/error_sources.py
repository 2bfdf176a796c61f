"""Sources of the error: which part of it the errors of each sensor, of the start and of the dynamics cause.

The filter runs again with virtual observations of one modality at the true state, with their covariances unchanged, or
from the true state. The part of a source is the estimate of the original run minus that of the run without its errors.
Kalman updates are linear in the observations, so the parts add up to the error, except for the nonlinearity of the
dynamics; the rest is the part of the dynamics, with the errors of all predictions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from beliefscope.datasets.covariate import in_phase
from beliefscope.datasets.task import Task, display_name
from beliefscope.datasets.text import percent
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.engine import Progress, one_thread
from beliefscope.filters.models.common_random_numbers import Common
from beliefscope.filters.rollout import rollout
from beliefscope.inspect.diagnostics.base import Entry, RunDiagnostic, drawn_steps, fields_of
from beliefscope.inspect.diagnostics.views import Array, Curve, Line, Plot, Table
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import part_of
from beliefscope.inspect.traces.replay import Replay

START, DYNAMICS = "start", "dynamics"

MIN_SHARE = 0.1
"""Share of an error, positive or negative, from which a source is named."""


MAX_STEPS = 5000
"""Largest number of steps of a run: a step takes about 2 ms."""


@dataclass(frozen=True)
class PhaseSources:
    """Mean parts of the squared error of the main error in one phase.

    Attributes:
        phase, steps: name and number of counted steps.
        rmse: m or rad, of the main error.
        shares: (S,) shares of the mean squared error by source; sum 1, negative if a source reduces the error.
    """

    phase: str
    steps: int
    rmse: float
    shares: Array


@dataclass(frozen=True)
class ErrorSources(RunDiagnostic):
    """Result of ``error_sources``.

    Attributes:
        sources: S names: the modalities, ``start`` unless all runs start at the true state, and ``dynamics``.
        phases: by phase.
        worst_episode, worst_step: of the largest main error of all steps.
        worst: (S,) m or rad: its parts along its direction, which add up to its size.
        parts: (T, S) the same of every step of a single trace; (0, S) for several.
    """

    sources: tuple[str, ...]
    phases: tuple[PhaseSources, ...]
    worst_episode: int
    worst_step: int
    worst: Array
    parts: Array

    @property
    def verdict(self) -> str:
        episode = f" of episode {self.worst_episode}" if self.trajectories > 1 else ""
        main = self.task.main_error
        sentences = [
            f"Largest {main.name} error at step {self.worst_step}{episode}: {main.text(self.worst.sum())} "
            f"({parts_text(self.task, self.sources, self.worst)})."
        ]
        shares = [
            ("" if phase.phase == "all" else f"{in_phase(phase.phase, self.task.covariates)} ")
            + ", ".join(f"{title} {percent(share)}" for title, share in named_parts(self.sources, phase.shares))
            for phase in self.phases
        ]
        sentences += [f"Shares of the mean squared error: {'; '.join(shares)}."] if shares else []
        return " ".join(sentences)

    def tables(self) -> list[Table]:
        main = self.task.main_error
        rows = [
            {
                "phase": entry.phase,
                "steps": entry.steps,
                f"RMSE, {main.unit}".rstrip(", "): main.factor * entry.rmse,
                **{
                    f"{_title(name)} (%)": 100.0 * share for name, share in zip(self.sources, entry.shares, strict=True)
                },
            }
            for entry in self.phases
        ]
        title = f"Shares of the mean squared {main.name} error by source"
        return [Table.from_rows(title, rows, "A large share may be that of a large weight: see the weight audit.")]

    def curves(self) -> list[Curve]:
        main = self.task.main_error
        chart = f"Parts of the {main.name} error along its direction"
        values = main.factor * self.parts
        curves = [
            Curve(_title(name), values[:, s], chart, main.unit, _layer(name)) for s, name in enumerate(self.sources)
        ]
        return [Curve("error", values.sum(1), chart, main.unit, "fused"), *curves] if len(self.parts) else []

    def plots(self) -> list[Plot]:
        phases, at = [entry.phase for entry in self.phases], np.arange(len(self.phases), dtype=np.float64)
        lines = tuple(
            Line(_title(name), at, np.array([100.0 * entry.shares[s] for entry in self.phases]), _layer(name))
            for s, name in enumerate(self.sources)
        )
        title = f"Sources of the {self.task.main_error.name} error"
        return [Plot(title, "", "% of the mean squared error", lines, "bars", names=tuple(phases))]


def _layer(source: str) -> str:
    """Layer that determines the colour of a source."""
    return "" if source == START else source


def _title(source: str) -> str:
    return {START: "first belief"}.get(source, display_name(source))


def named_parts(sources: Sequence[str], parts: Array) -> list[tuple[str, float]]:
    """Titles and parts of the sources with a share of at least ``MIN_SHARE``, largest parts first."""
    order = [s for s in np.argsort(-parts) if abs(parts[s]) >= MIN_SHARE * abs(parts.sum())]
    return [(_title(sources[s]), float(parts[s])) for s in order]


def parts_text(task: Task, sources: Sequence[str], parts: Array) -> str:
    """``image 2.41 cm, dynamics -0.30 cm``: the named parts (S,) of a main error."""
    return ", ".join(f"{title} {task.main_error.text(part)}" for title, part in named_parts(sources, parts))


def names_of(trace: Trace) -> tuple[str, ...]:
    """The S sources of ``parts_of_error``."""
    return (*trace.modalities, START, DYNAMICS)


@one_thread()
@torch.no_grad()
def parts_of_error(checkpoint: Checkpoint, trace: Trace, progress: Progress = None) -> Array:
    """(T, S, n) m, rad: parts of the estimate's error due to each modality, to the start and to the dynamics."""
    replay = Replay(checkpoint, trace, progress)
    filter_, names, task = checkpoint.filter, trace.modalities, trace.task
    truth = filter_.statistics.standardise("state", replay.batch.states)  # (T, 1, n)
    count = 1 + len(names) + 1  # the original, and without the errors of each modality and of the start
    evidence = replay.evidence.repeated(count)
    observation = evidence.observation.clone()  # (T, N, K, n)
    for run, name in enumerate(names, 1):
        observation[:, run, filter_.names.index(name)] = truth[:, 0]
    mean = replay.start.mean.repeat(count, 1)
    mean[-1] = filter_.statistics.standardise("state", replay.batch.previous)[0]
    start = Gaussian(mean, replay.start.covariance.repeat(count, 1, 1))
    particles = int(trace.settings["particles"])
    generator = Common().manual_seed(trace.seed)
    result = rollout(filter_, replace(evidence, observation=observation), start, generator, particles)
    estimates = filter_.statistics.state_to_si(result.estimate.mean).double().numpy()  # (T, N, n)
    caused = task.difference(estimates[:, :1], estimates[:, 1:])
    error = measures.errors(trace)[:, -1:]
    rest = measures.wrapped(task, error - caused.sum(1, keepdims=True))
    return np.concatenate([caused, rest], axis=1)


def along_error(checkpoint: Checkpoint, trace: Trace, progress: Progress = None) -> Array:
    """(T, S) m or rad: ``parts_of_error`` along the direction of the main error, which add up to its size."""
    where = list(trace.task.main_error.indices)
    error = measures.errors(trace)[:, -1, where]
    size = np.linalg.norm(error, axis=-1, keepdims=True)
    parts = parts_of_error(checkpoint, trace, progress)[..., where]
    return np.einsum("tsn,tn->ts", parts, error / np.where(size > 0.0, size, 1.0))


def error_sources(traces: Sequence[Trace], checkpoint: Checkpoint, progress: Progress = None) -> ErrorSources:
    """Attribute the main error of one filter over one or more episodes to its sources."""
    progresses = [part_of(progress, i, len(traces)) for i in range(len(traces))]
    parts = [along_error(checkpoint, trace, each) for trace, each in zip(traces, progresses, strict=True)]
    pooled, masks = np.concatenate(parts), measures.pooled_phases(traces)
    sources = names_of(traces[0])
    used = [s for s, name in enumerate(sources) if name != START or pooled[:, s].any()]
    pooled, sources = pooled[:, used], tuple(sources[s] for s in used)
    squared = pooled * pooled.sum(1, keepdims=True)
    phases = []
    for phase, mask in masks.items():
        if total := float(squared[mask].sum()):
            shares = squared[mask].sum(0) / total
            phases.append(PhaseSources(phase, int(mask.sum()), math.sqrt(total / mask.sum()), shares))
    worst = int(pooled.sum(1).argmax())
    index = measures.trace_indices(traces)[worst]
    return ErrorSources(
        **fields_of(traces),
        sources=sources,
        phases=tuple(phases),
        worst_episode=traces[index].episode_index,
        worst_step=worst - sum(len(trace) for trace in traces[:index]),
        worst=pooled[worst],
        parts=pooled[: drawn_steps(traces)],
    )


def why_not(trace: Trace, checkpoint: Checkpoint | None = None) -> str | None:
    """One-line reason why the diagnostic does not apply, or None."""
    if trace.kind == "external":
        return f"filter {trace.filter} is external: its virtual observations cannot be replaced"
    if trace.observation_mean is None:
        return f"filter {trace.filter} has no virtual observations, whose errors could be removed"
    if not np.isfinite(trace.episode.states).all():
        return "the true state is unknown at some steps"
    return f"the run has {len(trace)} steps; at most {MAX_STEPS} are repeated" if len(trace) > MAX_STEPS else None


ENTRY = Entry(
    name="sources",
    title="Sources of the error",
    question="Which sensor, or the dynamics, causes the error?",
    run=error_sources,
    why_not=why_not,
    needs="filter",
)
