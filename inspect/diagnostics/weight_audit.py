"""Weight audit: what the fusion weights were, what they should have been, and what they follow.

An oracle that knows the truth chooses convex weights, step by step, so that the fused mean comes nearest to it. No
filter can know them; how far its own are from them, and what that costs, tells whether weighing better would help.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.catalog import find_task
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics.base import Curve, Diagnostic, Entry, Table, Value
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.bootstrap import FEWEST, correlate, sums_of
from beliefscope.inspect.trace import Trace

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LITTLE = 0.05
"""Regret as a share of the error, below which weighing better would not help."""

OTHERS = {"oracle": "the oracle's", "contact": "contact", "blackout": "blackout"}
"""What weights are correlated with, and how it is said."""

TIE = 1e-9
"""Weight of being near to what acted, against squared errors scaled to 1: decides only between weights equally good."""


@dataclass(frozen=True)
class SplitWeights:
    """Means over one kind of step.

    Attributes:
        split: kind of step. trajectories, steps: that have it.
        beta, acting, oracle: (K, W) mean weights; beta is None where the filter has no weight model.
        fused, hindsight: (1 + n,) m, rad: RMSE of the position on the map and of each component, of the filter and with
            the oracle's weights. alone: (K, 1 + n) of each modality's own estimate.
    """

    split: str
    trajectories: int
    steps: int
    acting: Array
    oracle: Array
    fused: Array
    hindsight: Array
    alone: Array
    beta: Array | None = None

    @property
    def regret(self) -> Array:
        """(1 + n,) m, rad: by how much the oracle's weights lower each RMSE."""
        return self.fused - self.hindsight


@dataclass(frozen=True)
class Correlation:
    """Of a modality's weight with what happens, over all counted steps.

    Attributes:
        weight: ``beta``, ``acting`` or ``oracle``. modality, component: whose; component is None of a scalar weight.
        other: ``contact`` or ``blackout`` (point-biserial), or ``oracle``, the oracle's weight.
        value: NaN where one of the two never changes. low, high: 95 % bootstrap interval over trajectories, NaN where
            there are fewer than ``FEWEST``.
    """

    weight: str
    modality: str
    component: str | None
    other: str
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class WeightAudit(Diagnostic):
    """Result of ``weights``.

    Attributes:
        task, filter: names. modalities: K names. trajectories: how many traces.
        splits: the means, by kind of step. correlations: with contact, blackout and the oracle.
        beta, acting, oracle: (T, K, W) at the steps of a lone trace, (0, K, W) of several; beta is None without a
            weight model. regret: (T, W) m, rad: by how much the oracle comes nearer to the truth, by component;
            of a scalar weight, in position. contact, blackout: (T,) its steps.
    """

    task: str
    filter: str
    modalities: tuple[str, ...]
    trajectories: int
    splits: tuple[SplitWeights, ...]
    correlations: tuple[Correlation, ...]
    beta: Array | None
    acting: Array
    oracle: Array
    regret: Array
    contact: Mask
    blackout: Mask

    @property
    def as_given(self) -> bool:
        """Whether the weights acted as the network gave them."""
        return all(one.beta is not None and np.allclose(one.beta, one.acting, atol=1e-3) for one in self.splits)

    def of(self, split: str) -> SplitWeights | None:
        """The means over a kind of step; None where there is no such step."""
        return {one.split: one for one in self.splits}.get(split)

    def correlation(self, weight: str, modality: str, other: str) -> Correlation | None:
        """The strongest of a modality's components. None where there is none."""
        found = [
            one
            for one in self.correlations
            if (one.weight, one.modality, one.other) == (weight, modality, other) and math.isfinite(one.value)
        ]
        return max(found, key=lambda one: abs(one.value), default=None)

    @property
    def verdict(self) -> str:
        whole = self.splits[0]
        k = int(whole.acting.mean(-1).argmax())
        name = self.modalities[k]
        kinds = [one for split in ("no contact", "contact", "blackout") if (one := self.of(split))]

        def said(source: str) -> str:
            each = [f"{getattr(one, source)[k].mean():.2f} in {one.split}" for one in kinds]
            return ", ".join(each) or f"{getattr(whole, source)[k].mean():.2f}"

        fused, best, alone = 100.0 * whole.fused[0], 100.0 * whole.hindsight[0], 100.0 * whole.alone[:, 0]
        better = int(alone.argmin())
        gain = (
            "so weighing better would hardly help" if fused - best < LITTLE * fused else "so weighing better would help"
        )
        parts = [
            f"Leans on {name}: {said('acting')}{' (mean over components)' if len(self._columns) > 1 else ''}; "
            f"an oracle would: {said('oracle')}.",
            f"Regret {fused - best:.3f} cm: a position RMSE of {fused:.3f} cm, {best:.3f} cm with the oracle's "
            f"weights, {alone[better]:.3f} cm by {self.modalities[better]} alone, {gain}.",
        ]
        source = "beta" if self.as_given else "acting"
        found = [pair for other in OTHERS if (pair := self.correlation(source, name, other))]
        if found:
            parts.append(f"Its weight correlates {', '.join(map(_said, found))}.")
        if self.trajectories < FEWEST:
            parts.append(f"Intervals need {FEWEST} trajectories.")
        return " ".join(parts)

    @property
    def _columns(self) -> tuple[str | None, ...]:
        """Names of the W columns: components, or None of a scalar weight."""
        names = tuple(c.name for c in find_task(self.task).components)
        return names if self.oracle.shape[-1] == len(names) else (None,)

    @property
    def _sources(self) -> tuple[str, ...]:
        """Kinds of weights that differ."""
        given = () if self.splits[0].beta is None else ("beta",)
        return (*given, "oracle") if self.as_given else (*given, "acting", "oracle")

    @property
    def _telling(self) -> tuple[str, ...]:
        """Modalities whose weights say all: of two, the second's are what the first's leave."""
        return self.modalities[:1] if len(self.modalities) == 2 else self.modalities

    def tables(self) -> list[Table]:
        task = find_task(self.task)
        units, scale = measures.shown_units(task)
        quantities = [("position", "cm", 100.0), *zip([c.name for c in task.components], units, scale, strict=True)]
        means: list[tuple[Value, ...]] = []
        errors: list[tuple[Value, ...]] = []
        for one in self.splits:
            for w, column in enumerate(self._columns):
                each = [getattr(one, s)[k, w] for k in range(len(self.modalities)) for s in self._sources]
                means.append((one.split, one.steps, column or "all", *map(float, each)))
            for q, (name, unit, factor) in enumerate(quantities):
                values = (one.fused[q], one.hindsight[q], one.regret[q], *one.alone[:, q])
                errors.append((one.split, f"{name} ({unit})", *(float(factor * value) for value in values)))
        heads = [f"{modality}: {source}" for modality in self.modalities for source in self._sources]
        alone = [f"{modality} alone" for modality in self.modalities]
        tables = [
            Table("Mean weights", ("steps", "count", "component", *heads), tuple(means)),
            Table("RMSE", ("steps", "of", "fused", "with the oracle's weights", "regret", *alone), tuple(errors)),
        ]
        rows = [
            (one.modality, one.weight, one.component or "all", one.other, one.value, *_interval(one))
            for one in self.correlations
            if math.isfinite(one.value) and one.modality in self._telling and one.weight in self._sources
        ]
        if rows:
            heads = ["modality", "weight", "component", "with", "r", "95 % from", "to"]
            tables.append(Table("Correlations of the weights", tuple(heads), tuple(rows)))
        return tables

    def curves(self) -> list[Curve]:
        """Weights by component, then regrets. Of two modalities only the first's: the other's are what is left to 1."""
        if not len(self.oracle):
            return []
        task = find_task(self.task)
        units, scale = measures.shown_units(task)
        curves, regrets = [], []
        for w, column in enumerate(self._columns):
            chart = "Weight" + (f" of {column}" if column else "")
            for source in self._sources:
                values = getattr(self, source)
                for k, modality in enumerate(self._telling):
                    name = f"{modality} {source}" + (f" {column}" if column else "")
                    curves.append(Curve(name, values[:, k, w], chart, "", modality))
            unit, factor = (units[w], scale[w]) if column else ("cm", 100.0)
            name = f"regret {column or 'position'}"
            regrets.append(Curve(name, factor * self.regret[:, w], f"Regret ({unit})", unit))
        # Charts are groups of neighbours: components of one unit share theirs.
        return curves + sorted(regrets, key=lambda curve: curve.unit)

    def bands(self) -> dict[str, Mask]:
        return {"contact": self.contact, "blackout": self.blackout} if len(self.oracle) else {}


def why_not(trace: Trace, checkpoint: Checkpoint | None = None) -> str | None:
    """In one line; None where it can be made."""
    if trace.acting is not None:
        missing = np.isnan(trace.modality_mean).all()
        return f"what each modality of {trace.filter} alone believes is not known" if missing else None
    if not trace.modalities:
        return f"{trace.filter} does not weigh its modalities: one network sees them all"
    if len(trace.modalities) > 1:
        return f"how much each modality of {trace.filter} decided is not known"
    return f"{trace.filter} has one measurement model, {trace.modalities[0]}, and nothing to weigh it against"


def audit(traces: Sequence[Trace]) -> WeightAudit:
    """Weight audit of one filter, over one or several trajectories."""
    first = traces[0]
    made = [_steps(trace) for trace in traces]
    pooled = {name: np.concatenate([one[name] for one in made]) for name in made[0]}
    owner = measures.owners(traces)
    splits = []
    for split, where in measures.pooled_splits(traces).items():
        if where.any():
            steps = {name: values[where] for name, values in pooled.items()}
            rmse = {name: np.sqrt(np.square(steps[name]).mean(0)) for name in ("fused", "hindsight", "alone")}
            weights: dict[str, Any] = {
                name: steps[name].mean(0) for name in ("beta", "acting", "oracle") if name in steps
            }
            trajectories = len(np.unique(owner[where]))
            splits.append(
                SplitWeights(split=split, trajectories=trajectories, steps=int(where.sum()), **weights, **rmse)
            )
    keep = len(first) if len(traces) == 1 else 0
    return WeightAudit(
        task=first.episode.task,
        filter=first.filter,
        modalities=first.modalities,
        trajectories=len(traces),
        splits=tuple(splits),
        correlations=tuple(_correlations(traces, made)),
        beta=pooled["beta"][:keep] if "beta" in pooled else None,
        acting=pooled["acting"][:keep],
        oracle=pooled["oracle"][:keep],
        regret=pooled["regret"][:keep],
        contact=first.episode.contact.astype(bool)[:keep],
        blackout=measures.blackout(first)[:keep],
    )


def oracle_weights(errors: Array, near: Array) -> Array:
    """Convex weights of K estimates whose mean comes nearest to the truth.

    ``min |sum_k w_k e_k|^2`` over ``w_k >= 0, sum w_k = 1``. Exact: on each face of the simplex the minimum has a
    closed form, and the best feasible one wins. Two scalar errors give ``w_1 = e_2 / (e_2 - e_1)``, clipped to 0..1.
    Where several weights do equally well, the ones closest to ``near``.

    Args:
        errors: (..., d, K) of the K estimates in d components. near: (..., K).

    Returns:
        (..., K).
    """
    count = errors.shape[-1]
    gram = np.swapaxes(errors, -1, -2) @ errors
    size = np.trace(gram, axis1=-2, axis2=-1)[..., None, None]
    gram = np.divide(gram, size, out=np.zeros_like(gram), where=size > 0)
    best, least = np.zeros_like(near), np.full(near.shape[:-1], np.inf)
    for members in (list(face) for size in range(count, 0, -1) for face in combinations(range(count), size)):
        inverse = np.linalg.inv(gram[..., members, :][..., members] + TIE * np.eye(len(members)))
        towards, ones = TIE * (inverse @ near[..., members, None])[..., 0], inverse.sum(-1)
        free = (1.0 - towards.sum(-1, keepdims=True)) / ones.sum(-1, keepdims=True)
        weights = np.zeros_like(near)
        weights[..., members] = towards + free * ones
        cost = (weights[..., None, :] @ gram @ weights[..., None])[..., 0, 0]
        cost = cost + TIE * np.square(weights - near).sum(-1)
        better = (weights >= -1e-12).all(-1) & (cost < least)
        best = np.where(better[..., None], weights, best)
        least = np.where(better, cost, least)
    best = np.maximum(best, 0.0)
    return best / best.sum(-1, keepdims=True)


def position_regret(trace: Trace) -> Array:
    """(T,) m: the fused position's error less that with the oracle's weights; below zero where the filter does better
    than any convex weights, as a product of experts can.
    """
    steps = _steps(trace)
    return steps["fused"][:, 0] - steps["hindsight"][:, 0]


def _steps(trace: Trace) -> dict[str, Array]:
    """By step: weights (T, K, W), regret (T, W), errors of position and components (T, 1 + n), alone (T, K, 1 + n)."""
    assert trace.acting is not None
    acting = trace.acting.astype(np.float64)
    error, where = measures.errors(trace), list(measures.task_of(trace).map_indices)
    alone, fused = error[:, :-1], error[:, -1]
    per_component = acting.shape[-1] == error.shape[-1]
    if per_component:
        given = np.swapaxes(acting, 1, 2)
        oracle = np.swapaxes(oracle_weights(np.swapaxes(alone, 1, 2)[:, :, None], given), 1, 2)
    else:  # one weight for all components: the one that puts the position nearest
        oracle = oracle_weights(np.swapaxes(alone[..., where], 1, 2), acting[..., 0])[..., None]
    hindsight = (oracle * alone).sum(1)
    both = (fused, hindsight)
    nearer = [np.abs(e) if per_component else np.linalg.norm(e[:, where], axis=-1, keepdims=True) for e in both]
    made = {
        "acting": acting,
        "oracle": oracle,
        # A product of experts carries errors across components and may do better than any weights: no regret then.
        "regret": np.maximum(nearer[0] - nearer[1], 0.0),
        "fused": _with_position(fused, where),
        "hindsight": _with_position(hindsight, where),
        "alone": _with_position(alone, where),
    }
    return made if trace.weights is None else {"beta": trace.weights.astype(np.float64), **made}


def _with_position(error: Array, where: list[int]) -> Array:
    """(..., 1 + n): the distance on the map before the errors (..., n)."""
    return np.concatenate([np.linalg.norm(error[..., where], axis=-1, keepdims=True), error], axis=-1)


def _correlations(traces: Sequence[Trace], made: Sequence[dict[str, Array]]) -> list[Correlation]:
    names = [name for name in ("beta", "acting", "oracle") if name in made[0]]
    task, modalities = measures.task_of(traces[0]), traces[0].modalities
    width = made[0]["oracle"].shape[-1]
    columns = [c.name for c in task.components] if width == len(task.components) else [None]
    labels: list[tuple[str, str, str | None, str]] = []
    sums = []
    for trace, steps in zip(traces, made, strict=True):
        keep = measures.counted(trace)
        others = {"contact": trace.episode.contact, "blackout": measures.blackout(trace)}
        pairs = []
        labels = []
        for name in names:
            for k, modality in enumerate(modalities):
                for w, column in enumerate(columns):
                    x = steps[name][keep, k, w]
                    pairs += [(x, other[keep].astype(np.float64)) for other in others.values()]
                    labels += [(name, modality, column, other) for other in others]
                    if name != "oracle":
                        pairs.append((x, steps["oracle"][keep, k, w]))
                        labels.append((name, modality, column, "oracle"))
        x, y = (np.stack(side) for side in zip(*pairs, strict=True))
        sums.append(sums_of(x, y))
    value, low, high = correlate(np.stack(sums))
    return [
        Correlation(*label, *map(float, v)) for label, v in zip(labels, zip(value, low, high, strict=True), strict=True)
    ]


def _said(one: Correlation) -> str:
    where = f" in {one.component}" if one.component else ""
    interval = "" if math.isnan(one.low) else f" (95 % {one.low:.2f} to {one.high:.2f})"
    return f"{one.value:.2f} with {OTHERS[one.other]}{where}{interval}"


def _interval(one: Correlation) -> tuple[Value, Value]:
    return (None, None) if math.isnan(one.low) else (one.low, one.high)


ENTRY = Entry(
    name="weights",
    title="Weight audit",
    question="Does the filter trust the right modality at the right time, and what does it cost where it does not?",
    run=audit,
    why_not=why_not,
)
