"""Exact Shapley values of the modalities: their contributions to the error and to the estimate."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import display_name
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.engine import Progress
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.models.common_random_numbers import Common
from beliefscope.filters.rollout import rollout
from beliefscope.filters.subsets import modalities_of, subset_evidence
from beliefscope.inspect.diagnostics.base import Entry, RunDiagnostic, drawn_steps, fields_of
from beliefscope.inspect.diagnostics.views import Array, Curve, Table
from beliefscope.inspect.standalone import removal_note
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.intervals import MIN_TRAJECTORIES, jackknife, too_few
from beliefscope.inspect.statistics.measures import Mask
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import part_of
from beliefscope.inspect.traces.data import check_origin
from beliefscope.inspect.traces.external_replay import run_with
from beliefscope.inspect.traces.replay import Replay

MAX_MODALITIES = 6
"""K modalities have 2^K subsets, with one run each."""

REPLAY_TIME = 0.3
"""Approximate share of the computing time for the replay of the original run."""

PHASE_NAMES = {"contact": "In contact", "free motion": "In free motion", "blackout": "During image blackout"}


@dataclass(frozen=True)
class PhaseValues:
    """Shapley values in one phase.

    Attributes:
        phase: phase name.
        trajectories, steps: number of episodes and steps in the phase.
        rmse: (2^K, 1 + n) m, rad: RMSE of the position and of each component, by subset.
        shapley: (K, 1 + n) m, rad: Shapley values of the RMSE; negative if a modality lowers it.
        low, high: 95 % intervals over episodes; NaN below ``MIN_TRAJECTORIES`` episodes.
    """

    phase: str
    trajectories: int
    steps: int
    rmse: Array
    shapley: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class Shapley(RunDiagnostic):
    """Result of ``shapley``; K modalities, n components, T steps of a single trace (0 for several); m and rad.

    Attributes:
        kind: of the filter.
        modalities: K names.
        offset: initial error of the runs in standard deviations of the initial belief.
        at_truth: whether the runs start at the true state.
        subsets: 2^K subsets of modalities, the empty one first and the complete one last.
        phases: values by phase.
        position_error: (T, 2^K) position error of each subset.
        position_values: (T, K) Shapley values of the position error.
        estimate_values: (T, K, n) Shapley values of the estimate.
        note: ``removal_note`` of the filter.
    """

    kind: str
    modalities: tuple[str, ...]
    offset: float
    at_truth: bool
    subsets: tuple[tuple[str, ...], ...]
    phases: tuple[PhaseValues, ...]
    position_error: Array
    position_values: Array
    estimate_values: Array
    note: str = ""

    @property
    def verdict(self) -> str:
        main = self.task.main_error
        by_name = {values.phase: values for values in self.phases}
        phases = [by_name[phase] for phase in PHASE_NAMES if phase in by_name] or [self.phases[0]]
        sentences = []
        for values in phases:
            changes = [self._change(*pair) for pair in zip(self.modalities, values.shapley[:, 0], strict=True)]
            parts = changes[0].format(f"the {main.name} RMSE"), *(change.format("it") for change in changes[1:])
            empty, complete = main.text(values.rmse[0, 0]), main.text(values.rmse[-1, 0])
            sentences.append(
                f"{PHASE_NAMES.get(values.phase, 'Over all steps')}, {', '.join(parts)} "
                f"({empty} with {self.baseline}, {complete} with "
                f"{'all modalities' if len(self.modalities) > 1 else display_name(self.modalities[0])})."
            )
        if len(self.modalities) > 1:
            total = self.phases[0].rmse[:, 0]
            without = [
                f"{main.text(total[-1 - 2**k])} without {display_name(name)}" for k, name in enumerate(self.modalities)
            ]
            sentences.append(f"All steps: {main.text(total[-1])}, {', '.join(without)}.")
        if self.at_truth:
            sentences.append(f"Runs start at the true state, which favours {self.baseline}.")
        if why := too_few(self.trajectories):
            sentences.append(f"No intervals: {why}.")
        return " ".join(sentences + [self.note] * bool(self.note))

    def _change(self, modality: str, value: float) -> str:
        """What a modality does to the RMSE, which is named in place of ``{}``. value: its Shapley value, m or rad."""
        name, size = display_name(modality), self.task.main_error.text(abs(value))
        if size == self.task.main_error.text(0.0):
            return f"{name} hardly changes {{}}"
        return f"{name} {'lowers' if value < 0 else 'raises'} {{}} by {size}"

    @property
    def baseline(self) -> str:
        """Name of the empty subset."""
        return "controls only" if self.kind in ("lstm", "transformer") else "dynamics only"

    def _title(self, subset: tuple[str, ...]) -> str:
        return " + ".join(map(display_name, subset)) or self.baseline

    def tables(self) -> list[Table]:
        # With many modalities, list single modalities and leave-one-out subsets only.
        listed = [
            i
            for i, subset in enumerate(self.subsets)
            if len(subset) in (0, 1, len(self.modalities) - 1, len(self.subsets[-1]))
        ]
        names = [display_name(modality) for modality in self.modalities]
        has_intervals = self.trajectories >= MIN_TRAJECTORIES
        values: list[dict[str, Any]] = []
        by_subset: list[dict[str, Any]] = []
        for phase in self.phases:
            for q, title, factor in measures.quantities(self.task):
                rmse, phi, low, high = (
                    factor * getattr(phase, name)[:, q] for name in ("rmse", "shapley", "low", "high")
                )
                head = {"phase": phase.phase, "steps": phase.steps, "RMSE of": title}
                contributions = dict(zip(names, phi, strict=True))
                row = head | {self.baseline: rmse[0]} | contributions | {"all modalities": rmse[-1]}
                for name, first, last in zip(names, low, high, strict=True) if has_intervals else ():
                    row |= {f"{name}: 95 % from": first, f"{name}: 95 % to": last}
                values.append(row)
                by_subset.append(head | {self._title(self.subsets[i]): rmse[i] for i in listed})
        return [
            Table.from_rows("Shapley values of the RMSE", values),
            Table.from_rows("RMSE by subset of modalities", by_subset),
        ]

    def curves(self) -> list[Curve]:
        if not len(self.position_values):
            return []
        task = self.task
        main = task.main_error
        chart = f"Shapley values of the {main.name} error"
        curves = [
            Curve(display_name(name), main.factor * self.position_values[:, k], chart, main.unit, name)
            for k, name in enumerate(self.modalities)
        ]
        for i, subset in enumerate(self.subsets):
            if len(subset) <= 1 or i == len(self.subsets) - 1:
                layer = subset[0] if len(subset) == 1 else "fused" if subset else ""
                chart = f"{main.title} error by subset"
                curves.append(
                    Curve(self._title(subset), main.factor * self.position_error[:, i], chart, main.unit, layer)
                )
        for c, (component, unit, factor) in enumerate(zip(task.components, *measures.display_units(task), strict=True)):
            chart = f"Shapley values of the estimate: {component.label}"
            curves += [
                Curve(display_name(name), factor * self.estimate_values[:, k, c], chart, unit, name)
                for k, name in enumerate(self.modalities)
            ]
        return curves


def members(count: int) -> Mask:
    """(2^K, K) membership of K modalities in each subset; the first row is empty, the last complete."""
    return (np.arange(2**count)[:, None] >> np.arange(count) & 1).astype(bool)


def shapley_weights(count: int) -> Array:
    """(K, 2^K) matrix that maps values of the subsets, in the order of ``members``, to Shapley values.

    ``phi_k = sum over S without k of |S|! (K - |S| - 1)! / K! (v(S + k) - v(S))`` (Shapley, 1953).
    """
    member = members(count)
    size = member.sum(-1)
    factorial = np.array([math.factorial(i) for i in range(count + 1)], dtype=np.float64)
    with_member = factorial[np.maximum(size - 1, 0)] * factorial[count - size]
    without_member = factorial[np.minimum(size, count - 1)] * factorial[np.maximum(count - size - 1, 0)]
    return np.where(member.T, with_member, -without_member) / factorial[count]


@torch.no_grad()
def run_subsets(
    checkpoint: Checkpoint,
    trace: Trace,
    offset: float = 0.0,
    progress: Progress = None,
    subsets: Mask | None = None,
) -> Array:
    """(T, S, n) m, rad: estimates of the trace's filter with subsets of its modalities.

    All subsets run side by side in one rollout, with the random numbers of the trace.

    Args:
        offset: initial error in standard deviations of the initial belief, times a normal random vector determined by
            the trace's seed and episode.
        subsets: (S, K) membership; default: all 2^K, in the order of ``members``.
    """
    member = members(len(modalities_of(checkpoint))) if subsets is None else subsets
    report = progress or (lambda share: None)
    if isinstance(checkpoint, ExternalFilter):
        return _external_subsets(checkpoint, trace, offset, report, member)
    replay = Replay(checkpoint, trace, lambda share: report(REPLAY_TIME * share))
    filter_, start = checkpoint.filter, replay.start
    count, mean = len(member), _offset_mean(start, trace, offset)
    start = Gaussian(mean.expand(count, -1), start.covariance.expand(count, -1, -1))
    result = rollout(
        filter_,
        subset_evidence(filter_, replay.batch, replay.evidence, torch.from_numpy(member)),
        start,
        Common().manual_seed(trace.seed),
        int(trace.settings["particles"]),
        progress=lambda share: report(REPLAY_TIME + (1.0 - REPLAY_TIME) * share),
    )
    return filter_.statistics.state_to_si(result.estimate.mean).double().numpy()


def _offset_mean(start: Gaussian, trace: Trace, offset: float) -> Tensor:
    """Mean (1, n) of the initial belief with its error."""
    if not offset:
        return start.mean
    noise = np.random.default_rng([trace.seed, trace.episode_index]).standard_normal(start.mean.shape)
    shift = torch.linalg.cholesky(start.covariance) @ torch.from_numpy(noise).to(start.mean)[..., None]
    return start.mean + offset * shift[..., 0]


def _external_subsets(
    external: ExternalFilter, trace: Trace, offset: float, report: Callable[[float], None], member: Mask
) -> Array:
    """As ``run_subsets``, one run by subset: absent sensors carry no information (``filters/external/ablation.py``)."""
    check_origin(external, trace)
    modalities, start = np.array(modalities_of(external)), external.start([trace.episode])
    start = Gaussian(_offset_mean(start, trace, offset), start.covariance)
    estimates = []
    for has in member:
        estimates.append(run_with(external, trace, tuple(modalities[has]), start))
        report(len(estimates) / len(member))
    return np.stack(estimates, axis=1)


def shapley(
    traces: Sequence[Trace],
    checkpoint: Checkpoint,
    offset: float = 0.0,
    progress: Progress = None,
) -> Shapley:
    """Compute the Shapley values of the modalities of one filter over one or more episodes.

    For ``offset`` see ``run_subsets``. Raises BadInput if it is negative or not finite.
    """
    if not 0.0 <= offset < math.inf:
        raise BadInput(f"offset must be a finite number of standard deviations, at least 0, not {offset:g}")
    first, task = traces[0], traces[0].task
    modalities = modalities_of(checkpoint)
    weights = shapley_weights(len(modalities))
    errors = []
    for i, trace in enumerate(traces):
        estimates = run_subsets(checkpoint, trace, offset, part_of(progress, i, len(traces)))
        errors.append(task.difference(estimates, trace.episode.states[:, None]))
    position, keep = [task.main_error.norm(error) for error in errors], drawn_steps(traces)
    return Shapley(
        **fields_of(traces),
        kind=first.kind,
        modalities=modalities,
        offset=offset,
        at_truth=not offset and all(measures.starts_at_truth(trace) for trace in traces),
        subsets=tuple(tuple(np.array(modalities)[has].tolist()) for has in members(len(modalities))),
        phases=_phases(traces, errors, position, weights),
        position_error=position[0][:keep],
        position_values=position[0][:keep] @ weights.T,
        # The true state cancels between subsets, so values of the error equal those of the estimate.
        estimate_values=np.einsum("ks,tsn->tkn", weights, errors[0][:keep]),
        note=removal_note(checkpoint),
    )


def _phases(
    traces: Sequence[Trace], errors: Sequence[Array], position: Sequence[Array], weights: Array
) -> tuple[PhaseValues, ...]:
    """RMSE pooled over the steps of all traces, and its Shapley values, by phase."""
    squares = [
        np.square(np.concatenate([distance[..., None], error], axis=-1))
        for distance, error in zip(position, errors, strict=True)
    ]
    values = []
    for phase, (counts, sums) in measures.phase_sums(traces, squares).items():
        rmse = np.sqrt(sums.sum(0) / counts.sum())
        steps = np.broadcast_to(counts[:, None, None], (*sums.shape[:-1], 1))
        phi, low, high = jackknife(
            np.concatenate([sums, steps], axis=-1), lambda table: weights @ np.sqrt(table[..., :-1] / table[..., -1:])
        )
        values.append(PhaseValues(phase, len(counts), int(counts.sum()), rmse, phi, low, high))
    return tuple(values)


def why_not(trace: Trace, checkpoint: Checkpoint | None) -> str | None:
    """One-line reason why the diagnostic does not apply, or None."""
    if checkpoint is None:
        return None
    count = len(modalities_of(checkpoint))
    return (
        f"filter {trace.filter} has {count} modalities; at most {MAX_MODALITIES} are supported"
        if count > MAX_MODALITIES
        else None
    )


ENTRY = Entry(
    name="shapley",
    title="Shapley values",
    question="How much does each modality lower or raise the error, overall and by phase?",
    run=shapley,
    why_not=why_not,
    needs="filter",
    slow=True,
    options={
        "offset": "initial error in standard deviations of the initial belief, 0 by default; direction by seed and "
        "episode"
    },
)
