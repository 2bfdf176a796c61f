"""Shapley values of the modalities: how much of the error, and of the estimate, each one accounts for. Exact."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Evidence, Gaussian
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.filter import Filter
from beliefscope.filters.models.common_random_numbers import Common
from beliefscope.filters.rollout import rollout
from beliefscope.inspect.diagnostics.base import Array, Curve, Diagnostic, Entry, Table, Value
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.bootstrap import FEWEST, resampled
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.replay import Replay

Mask = NDArray[np.bool_]

MOST = 6
"""Modalities: of K there are 2^K subsets, each a run of its own."""

REPLAYED = 0.3
"""Share of the time, roughly, that the run as it was takes before those of the subsets."""

WHEN = {"contact": "In contact", "no contact": "Without contact", "blackout": "Under black pictures"}


@dataclass(frozen=True)
class SplitValues:
    """Over one kind of step.

    Attributes:
        split: kind of step. trajectories, steps: that have it.
        rmse: (2^K, 1 + n) m, rad: of the position on the map and of each component, by subset.
        shapley: (K, 1 + n) m, rad: each modality's value of that RMSE; below zero where it lowers it.
        low, high: its 95 % bootstrap interval over trajectories, NaN where there are fewer than ``FEWEST``.
    """

    split: str
    trajectories: int
    steps: int
    rmse: Array
    shapley: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class Shapley(Diagnostic):
    """Result of ``shapley``. K modalities, n components, T steps of a lone trace (0 of several); m and rad.

    Attributes:
        task, filter, kind: of the traces. modalities: K names. trajectories: how many traces.
        off: how far off the truth the runs started, in standard deviations of the first belief.
        subsets: 2^K of them, the empty one first and all of them last.
        splits: by kind of step.
        position_error: (T, 2^K) distance of each subset's estimate from the truth on the map.
        of_position: (T, K) Shapley values of that error. of_estimate: (T, K, n) of the estimate itself.
        contact, blackout: (T,).
    """

    task: str
    filter: str
    kind: str
    modalities: tuple[str, ...]
    trajectories: int
    off: float
    subsets: tuple[tuple[str, ...], ...]
    splits: tuple[SplitValues, ...]
    position_error: Array
    of_position: Array
    of_estimate: Array
    contact: Mask
    blackout: Mask

    @property
    def verdict(self) -> str:
        by_name = {one.split: one for one in self.splits}
        kinds = [by_name[split] for split in WHEN if split in by_name] or [self.splits[0]]
        sentences = []
        for one in kinds:
            changes = [
                f"{name} {'lowers' if value < 0 else 'raises'} {{}} by {abs(value):.2f} cm"
                for name, value in zip(self.modalities, 100.0 * one.shapley[:, 0], strict=True)
            ]
            said = changes[0].format("the position RMSE"), *(change.format("it") for change in changes[1:])
            none, every = 100.0 * one.rmse[0, 0], 100.0 * one.rmse[-1, 0]
            sentences.append(
                f"{WHEN.get(one.split, 'Over all steps')} {', '.join(said)} ({none:.2f} cm by {self.nothing}, "
                f"{every:.2f} cm with {'all' if len(self.modalities) > 1 else 'it'})."
            )
        if len(self.modalities) > 1:
            whole = 100.0 * self.splits[0].rmse[:, 0]
            missed = [f"{whole[-1 - 2**k]:.2f} cm without {name}" for k, name in enumerate(self.modalities)]
            sentences.append(f"All steps: {whole[-1]:.2f} cm, {', '.join(missed)}.")
        if not self.off:
            sentences.append(f"Runs start at the truth, which favours {self.nothing}.")
        if self.trajectories < FEWEST:
            sentences.append(f"Intervals need {FEWEST} trajectories.")
        return " ".join(sentences)

    @property
    def nothing(self) -> str:
        """What is left where no modality is seen."""
        return "controls alone" if self.kind == "lstm" else "dynamics alone"

    def _title(self, subset: tuple[str, ...]) -> str:
        return " + ".join(subset) or self.nothing

    def tables(self) -> list[Table]:
        task = find_task(self.task)
        units, scale = measures.shown_units(task)
        names = ["position", *(component.name for component in task.components)]
        titles = [f"{name} ({unit})" for name, unit in zip(names, ("cm", *units), strict=True)]
        factors = np.array([100.0, *scale])
        # Of many modalities only the subsets that say what one does alone, and what is missed without it.
        few = [
            i
            for i, one in enumerate(self.subsets)
            if len(one) in (0, 1, len(self.modalities) - 1, len(self.subsets[-1]))
        ]
        values: list[tuple[Value, ...]] = []
        runs: list[tuple[Value, ...]] = []
        for split in self.splits:
            for q, title in enumerate(titles):
                rmse, phi, low, high = (
                    factors[q] * getattr(split, name)[:, q] for name in ("rmse", "shapley", "low", "high")
                )
                ends = [number for pair in zip(low, high, strict=True) for number in pair if self._bounded]
                each = [None if math.isnan(v) else float(v) for v in (rmse[0], *phi, rmse[-1], *ends)]
                values.append((split.split, split.steps, title, *each))
                runs.append((split.split, split.steps, title, *map(float, rmse[few])))
        ends_of = [f"{m}: 95 % {end}" for m in self.modalities for end in ("from", "to") if self._bounded]
        head = ("steps", "count", "RMSE of")
        return [
            Table(
                "Shapley values of the RMSE",
                (*head, self.nothing, *self.modalities, "with all", *ends_of),
                tuple(values),
            ),
            Table("RMSE with each subset", (*head, *(self._title(self.subsets[i]) for i in few)), tuple(runs)),
        ]

    @property
    def _bounded(self) -> bool:
        return self.trajectories >= FEWEST

    def curves(self) -> list[Curve]:
        if not len(self.of_position):
            return []
        task = find_task(self.task)
        shown = [
            Curve(name, 100.0 * self.of_position[:, k], "Shapley values of the position error", "cm", name)
            for k, name in enumerate(self.modalities)
        ]
        for i, subset in enumerate(self.subsets):
            if len(subset) <= 1 or i == len(self.subsets) - 1:
                layer = subset[0] if len(subset) == 1 else "fused" if subset else ""
                chart = "Position error with each alone, and with all"
                shown.append(Curve(self._title(subset), 100.0 * self.position_error[:, i], chart, "cm", layer))
        for c, (component, unit, factor) in enumerate(zip(task.components, *measures.shown_units(task), strict=True)):
            chart = f"Shapley values of the estimate: {component.name}"
            shown += [
                Curve(name, factor * self.of_estimate[:, k, c], chart, unit, name)
                for k, name in enumerate(self.modalities)
            ]
        return shown

    def bands(self) -> dict[str, Mask]:
        return {"contact": self.contact, "blackout": self.blackout} if len(self.of_position) else {}


def seen(filter_: Filter) -> tuple[str, ...]:
    """The modalities that a filter sees, also those that several share a model."""
    return tuple(dict.fromkeys(modality for model in filter_.names for modality in model.split("+")))


def members(count: int) -> Mask:
    """(2^K, K): which of K modalities each subset has; row 0 is the empty one, the last has all."""
    return (np.arange(2**count)[:, None] >> np.arange(count) & 1).astype(bool)


def shapley_weights(count: int) -> Array:
    """(K, 2^K): Shapley values are these times a function of the subsets, in the order of ``members``.

    ``phi_k = sum over S without k of |S|! (K - |S| - 1)! / K! (v(S + k) - v(S))`` (Shapley, 1953).
    """
    member = members(count)
    size = member.sum(-1)
    factorial = np.array([math.factorial(i) for i in range(count + 1)], dtype=np.float64)
    joined = factorial[np.maximum(size - 1, 0)] * factorial[count - size]
    before = factorial[np.minimum(size, count - 1)] * factorial[np.maximum(count - size - 1, 0)]
    return np.where(member.T, joined, -before) / factorial[count]


def subset_evidence(replay: Replay, member: Mask) -> Evidence:
    """Evidence of all subsets of ``seen(filter)``, (T, 2^K, ...), as the replayed run had it.

    A model whose modalities are all missing is not there (``Evidence.of``). To one that sees several and lacks some,
    and to an LSTM, what is missing is a black picture or the training mean. Beta is what the network gave in the run
    as it was, what is left of it in the same proportions.
    """
    filter_ = replay.checkpoint.filter
    models = [model.split("+") for model in filter_.names]
    sees = torch.tensor([[modality in model for modality in seen(filter_)] for model in models])
    has = torch.from_numpy(member)
    present = (has[:, None] & sees).any(-1)
    evidence = replay.evidence
    if any(len(model) > 1 for model in models):
        weights = evidence.log_weights
        evidence = replace(
            filter_.encode(_without(replay.batch, filter_, has)),
            log_weights=None if weights is None else weights.expand(-1, len(member), -1, -1),
        )
    return evidence.of(present.expand(len(evidence), -1, -1))


def _without(batch: Batch, filter_: Filter, has: Tensor) -> Batch:
    """A batch of one trajectory once a subset; modalities that ``has`` (S, K) lacks black, or at the training mean."""

    def wide(values: Tensor) -> Tensor:
        return values.expand(-1, len(has), *values.shape[2:])

    observations = {modality: wide(values) for modality, values in batch.observations.items()}
    for k, modality in enumerate(seen(filter_)):
        values = observations[modality]
        there = has[:, k].reshape(-1, *(1,) * (values.ndim - 2))
        nothing = values.new_zeros(()) if values.ndim == 4 else filter_.statistics.mean_std(modality)[0]
        observations[modality] = torch.where(there, values, nothing)
    return Batch(
        observations=observations,
        controls=wide(batch.controls),
        states=wide(batch.states),
        contact=wide(batch.contact),
        previous=batch.previous.expand(len(has), -1),
    )


@torch.no_grad()
def run_subsets(
    checkpoint: Checkpoint, trace: Trace, off: float = 0.0, progress: Callable[[float], None] | None = None
) -> Array:
    """(T, 2^K, n) m, rad: what the filter of a trace would have estimated with every subset of its modalities.

    One rollout, subsets side by side, each with the trace's own random numbers.

    Args:
        off: the first belief's mean is off the truth by so many of its standard deviations times a normal draw that
            depends on the trace's seed and episode.
    """
    say = progress or (lambda share: None)
    replay = Replay(checkpoint, trace, lambda share: say(REPLAYED * share))
    filter_, member = checkpoint.filter, members(len(seen(checkpoint.filter)))
    start = replay.start
    draw = np.random.default_rng([trace.seed, trace.episode_index]).standard_normal(start.mean.shape)
    shift = torch.linalg.cholesky(start.covariance) @ torch.from_numpy(draw).to(start.mean)[..., None]
    count = len(member)
    start = Gaussian((start.mean + off * shift[..., 0]).expand(count, -1), start.covariance.expand(count, -1, -1))
    result = rollout(
        filter_,
        subset_evidence(replay, member),
        start,
        Common().manual_seed(trace.seed),
        int(trace.settings["particles"]),
        progress=lambda share: say(REPLAYED + (1.0 - REPLAYED) * share),
    )
    return filter_.statistics.state_to_si(result.estimate.mean).double().numpy()


def shapley(
    traces: Sequence[Trace],
    checkpoint: Checkpoint,
    off: float = 0.0,
    progress: Callable[[float], None] | None = None,
) -> Shapley:
    """Shapley values of the modalities of one filter, over one or several trajectories.

    ``off`` as in ``run_subsets``; raises BadInput where it is below 0 or not finite.
    """
    if not 0.0 <= off < math.inf:
        raise BadInput(f"off is {off:g} standard deviations: it must be 0 or more, and finite")
    first, task = traces[0], measures.task_of(traces[0])
    modalities = seen(checkpoint.filter)
    weights = shapley_weights(len(modalities))
    errors = []
    for i, trace in enumerate(traces):

        def share(done: float, i: int = i) -> None:
            if progress is not None:
                progress((i + done) / len(traces))

        estimates = run_subsets(checkpoint, trace, off, share)
        errors.append(measures.wrapped(task, estimates - trace.episode.states[:, None]))
    position = [np.linalg.norm(error[..., list(task.map_indices)], axis=-1) for error in errors]
    lone = len(first) if len(traces) == 1 else 0
    return Shapley(
        task=task.name,
        filter=first.filter,
        kind=first.kind,
        modalities=modalities,
        trajectories=len(traces),
        off=off,
        subsets=tuple(tuple(np.array(modalities)[has].tolist()) for has in members(len(modalities))),
        splits=_splits(traces, errors, position, weights),
        position_error=position[0][:lone],
        of_position=position[0][:lone] @ weights.T,
        # The truth is the same in all subsets, so that the error's values are the estimate's.
        of_estimate=np.einsum("ks,tsn->tkn", weights, errors[0][:lone]),
        contact=first.episode.contact.astype(bool)[:lone],
        blackout=measures.blackout(first)[:lone],
    )


def _splits(
    traces: Sequence[Trace], errors: Sequence[Array], position: Sequence[Array], weights: Array
) -> tuple[SplitValues, ...]:
    """RMSE pooled over the steps of all traces, and its Shapley values."""
    squares = [
        np.square(np.concatenate([away[..., None], error], axis=-1))
        for away, error in zip(position, errors, strict=True)
    ]
    masks = [measures.splits(trace) for trace in traces]
    found = []
    for split in masks[0]:
        counts = np.array([mask[split].sum() for mask in masks], dtype=np.float64)
        have = counts > 0
        if not have.any():
            continue
        sums = np.stack([square[mask[split]].sum(0) for square, mask in zip(squares, masks, strict=True)])[have]
        rmse = np.sqrt(sums.sum(0) / counts.sum())
        low = high = np.full((len(weights), rmse.shape[-1]), np.nan)
        if have.sum() >= FEWEST:
            of_steps = resampled(counts[have])[:, None, None]
            low, high = np.percentile(weights @ np.sqrt(resampled(sums) / of_steps), [2.5, 97.5], axis=0)
        found.append(SplitValues(split, int(have.sum()), int(counts.sum()), rmse, weights @ rmse, low, high))
    return tuple(found)


def why_not(trace: Trace, checkpoint: Checkpoint | None) -> str | None:
    """In one line; None where it can be made."""
    if checkpoint is None:
        return None
    count = len(seen(checkpoint.filter))
    return (
        f"{trace.filter} has {count} modalities: {2**count} subsets are more runs than {2**MOST}"
        if count > MOST
        else None
    )


ENTRY = Entry(
    name="shapley",
    title="Shapley values",
    question="Which modality lowers the error, or raises it, and by how much, in contact and without?",
    run=shapley,
    why_not=why_not,
    needs="checkpoint",
    slow=True,
    options={
        "off": "by how many standard deviations of the first belief the runs start off the truth, drawn by seed and "
        "episode; 0, the default: at the truth, as the trace did"
    },
)
