"""Weight audit: comparison of fusion weights with an oracle's, and their correlation with contact and blackout.

The oracle knows the true state and chooses, step by step, the convex weights whose fused mean is closest to it. The
excess error relative to the oracle (regret) bounds the benefit of better weights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.catalog import find_task
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics.base import Diagnostic, Entry
from beliefscope.inspect.diagnostics.views import Curve, Table, Value
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.bootstrap import MIN_TRAJECTORIES, correlate, correlation_sums
from beliefscope.inspect.statistics.oracle import oracle_weights
from beliefscope.inspect.trace import Trace

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_REGRET = 0.05
"""Regret relative to the error above which better weights would help."""

OTHERS = {"oracle": "the oracle weight", "contact": "contact", "blackout": "blackout"}
"""Signals that weights are correlated with, and their display names."""

LABELS = {"beta": "beta", "effective_weights": "effective weight", "oracle": "oracle"}
"""Display names of the weight fields."""


@dataclass(frozen=True)
class PhaseWeights:
    """Means over one phase.

    Attributes:
        phase: phase name.
        trajectories, steps: number of trajectories and steps in the phase.
        beta, effective_weights, oracle: (K, W) mean weights; beta is None without a weight model.
        fused, hindsight: (1 + n,) m, rad: RMSE of the position and of each component, of the filter and with the
            oracle's weights.
        unimodal: (K, 1 + n) RMSE of the unimodal estimates.
    """

    phase: str
    trajectories: int
    steps: int
    effective_weights: Array
    oracle: Array
    fused: Array
    hindsight: Array
    unimodal: Array
    beta: Array | None = None

    @property
    def regret(self) -> Array:
        """(1 + n,) m, rad: excess of each RMSE over that with the oracle's weights."""
        return self.fused - self.hindsight


@dataclass(frozen=True)
class Correlation:
    """Correlation of a modality's weight with another signal over all counted steps.

    Attributes:
        weight: ``beta``, ``effective_weights`` or ``oracle``.
        modality, component: of the weight; component is None for a scalar weight.
        other: ``contact`` or ``blackout`` (point-biserial), or ``oracle``, the oracle's weight.
        value: NaN if one of the signals is constant.
        low, high: 95 % bootstrap interval over trajectories; NaN below ``MIN_TRAJECTORIES`` trajectories.
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
    """Result of ``audit``.

    Attributes:
        task, filter: names.
        modalities: K names.
        trajectories: number of traces.
        phases: means by phase.
        correlations: correlations with contact, blackout and the oracle.
        beta, effective_weights, oracle: (T, K, W) by step of a single trace, (0, K, W) for several; beta is None
            without a weight model.
        regret: (T, W) m, rad: decrease of the error with the oracle's weights by component; of the position error for
            a scalar weight.
        contact, blackout: (T,) masks.
    """

    task: str
    filter: str
    modalities: tuple[str, ...]
    trajectories: int
    phases: tuple[PhaseWeights, ...]
    correlations: tuple[Correlation, ...]
    beta: Array | None
    effective_weights: Array
    oracle: Array
    regret: Array
    contact: Mask
    blackout: Mask

    @property
    def beta_is_effective(self) -> bool:
        """Whether effective weights equal the network output beta."""
        return all(
            entry.beta is not None and np.allclose(entry.beta, entry.effective_weights, atol=1e-3)
            for entry in self.phases
        )

    def entry(self, phase: str) -> PhaseWeights | None:
        """Means over a phase; None if it has no steps."""
        return {entry.phase: entry for entry in self.phases}.get(phase)

    def correlation(self, weight: str, modality: str, other: str) -> Correlation | None:
        """The strongest correlation over the components of a modality, or None."""
        candidates = [
            entry
            for entry in self.correlations
            if (entry.weight, entry.modality, entry.other) == (weight, modality, other) and math.isfinite(entry.value)
        ]
        return max(candidates, key=lambda entry: abs(entry.value), default=None)

    @property
    def verdict(self) -> str:
        total = self.phases[0]
        k = int(total.effective_weights.mean(-1).argmax())
        name = self.modalities[k]
        phases = [entry for phase in ("free motion", "contact", "blackout") if (entry := self.entry(phase))]

        def mean_weights(source: str) -> str:
            texts = [f"{getattr(entry, source)[k].mean():.2f} in {entry.phase}" for entry in phases]
            return ", ".join(texts) or f"{getattr(total, source)[k].mean():.2f}"

        fused, best, unimodal = 100.0 * total.fused[0], 100.0 * total.hindsight[0], 100.0 * total.unimodal[:, 0]
        strongest = int(unimodal.argmin())
        regret = fused - best
        parts = [
            f"The posterior is dominated by {name}: effective weight {mean_weights('effective_weights')}"
            f"{' (mean over components)' if len(self._columns) > 1 else ''}; oracle: {mean_weights('oracle')}.",
            f"Regret {regret:.3f} cm: position RMSE {fused:.3f} cm, {best:.3f} cm with the oracle's weights, "
            f"{unimodal[strongest]:.3f} cm with {self.modalities[strongest]} only. Better weights would "
            f"{'hardly reduce' if regret < MIN_REGRET * fused else 'reduce'} the error.",
        ]
        source = "beta" if self.beta_is_effective else "effective_weights"
        correlations = [pair for other in OTHERS if (pair := self.correlation(source, name, other))]
        if correlations:
            parts.append(f"Correlation of its weight: {', '.join(map(_description, correlations))}.")
        if self.trajectories < MIN_TRAJECTORIES:
            parts.append(f"Intervals need {MIN_TRAJECTORIES} trajectories.")
        return " ".join(parts)

    @property
    def _columns(self) -> tuple[str | None, ...]:
        """Names of the W columns: components, or None for a scalar weight."""
        names = tuple(c.name for c in find_task(self.task).components)
        return names if self.oracle.shape[-1] == len(names) else (None,)

    @property
    def _sources(self) -> tuple[str, ...]:
        """Weight fields without duplicates."""
        beta = () if self.phases[0].beta is None else ("beta",)
        return (*beta, "oracle") if self.beta_is_effective else (*beta, "effective_weights", "oracle")

    @property
    def _independent(self) -> tuple[str, ...]:
        """Modalities with independent weights: with two modalities, the weights of the second are redundant."""
        return self.modalities[:1] if len(self.modalities) == 2 else self.modalities

    def tables(self) -> list[Table]:
        task = find_task(self.task)
        units, scale = measures.display_units(task)
        quantities = [("position", "cm", 100.0), *zip([c.name for c in task.components], units, scale, strict=True)]
        means: list[tuple[Value, ...]] = []
        errors: list[tuple[Value, ...]] = []
        for entry in self.phases:
            for w, column in enumerate(self._columns):
                weights = [getattr(entry, s)[k, w] for k in range(len(self.modalities)) for s in self._sources]
                means.append((entry.phase, entry.steps, column or "all", *map(float, weights)))
            for q, (name, unit, factor) in enumerate(quantities):
                values = (entry.fused[q], entry.hindsight[q], entry.regret[q], *entry.unimodal[:, q])
                errors.append((entry.phase, f"{name} ({unit})", *(float(factor * value) for value in values)))
        heads = [f"{modality}: {LABELS[source]}" for modality in self.modalities for source in self._sources]
        unimodal = [f"{modality}-only" for modality in self.modalities]
        tables = [
            Table("Mean weights", ("phase", "steps", "component", *heads), tuple(means)),
            Table(
                "RMSE", ("phase", "quantity", "fused", "with the oracle's weights", "regret", *unimodal), tuple(errors)
            ),
        ]
        rows = [
            (c.modality, LABELS[c.weight], c.component or "all", c.other, c.value, *_interval(c))
            for c in self.correlations
            if math.isfinite(c.value) and c.modality in self._independent and c.weight in self._sources
        ]
        if rows:
            heads = ["modality", "weight", "component", "with", "r", "95 % from", "to"]
            tables.append(Table("Correlations of the weights", tuple(heads), tuple(rows)))
        return tables

    def curves(self) -> list[Curve]:
        """Weights by component, then regrets. With two modalities, only the weights of the first."""
        if not len(self.oracle):
            return []
        task = find_task(self.task)
        units, scale = measures.display_units(task)
        curves, regrets = [], []
        for w, column in enumerate(self._columns):
            chart = "Weight" + (f" of {column}" if column else "")
            for source in self._sources:
                values = getattr(self, source)
                for k, modality in enumerate(self._independent):
                    name = f"{modality} {LABELS[source]}" + (f" {column}" if column else "")
                    curves.append(Curve(name, values[:, k, w], chart, "", modality))
            unit, factor = (units[w], scale[w]) if column else ("cm", 100.0)
            name = f"regret {column or 'position'}"
            regrets.append(Curve(name, factor * self.regret[:, w], f"Regret ({unit})", unit))
        # Curves of one chart must be consecutive: components with equal units share a chart.
        return curves + sorted(regrets, key=lambda curve: curve.unit)

    def bands(self) -> dict[str, Mask]:
        return {"contact": self.contact, "blackout": self.blackout} if len(self.oracle) else {}


def why_not(trace: Trace, checkpoint: Checkpoint | None = None) -> str | None:
    """One-line reason why the diagnostic does not apply, or None."""
    if trace.effective_weights is not None:
        missing = np.isnan(trace.modality_mean).all()
        return f"{trace.filter} reports no unimodal posteriors" if missing else None
    if not trace.modalities:
        return f"{trace.filter} has no fusion weights: one network processes all modalities"
    if len(trace.modalities) > 1:
        return f"{trace.filter} reports no effective weights"
    return f"{trace.filter} has only one measurement model, {trace.modalities[0]}"


def audit(traces: Sequence[Trace]) -> WeightAudit:
    """Audit the weights of one filter over one or more trajectories."""
    first = traces[0]
    step_values = [_steps(trace) for trace in traces]
    pooled = {name: np.concatenate([steps[name] for steps in step_values]) for name in step_values[0]}
    index = measures.trace_indices(traces)
    phases = []
    for phase, where in measures.pooled_phases(traces).items():
        if where.any():
            steps = {name: values[where] for name, values in pooled.items()}
            rmse = {name: np.sqrt(np.square(steps[name]).mean(0)) for name in ("fused", "hindsight", "unimodal")}
            weights: dict[str, Any] = {
                name: steps[name].mean(0) for name in ("beta", "effective_weights", "oracle") if name in steps
            }
            trajectories = len(np.unique(index[where]))
            phases.append(
                PhaseWeights(phase=phase, trajectories=trajectories, steps=int(where.sum()), **weights, **rmse)
            )
    keep = len(first) if len(traces) == 1 else 0
    return WeightAudit(
        task=first.episode.task,
        filter=first.filter,
        modalities=first.modalities,
        trajectories=len(traces),
        phases=tuple(phases),
        correlations=tuple(_correlations(traces, step_values)),
        beta=pooled["beta"][:keep] if "beta" in pooled else None,
        effective_weights=pooled["effective_weights"][:keep],
        oracle=pooled["oracle"][:keep],
        regret=pooled["regret"][:keep],
        contact=first.episode.contact.astype(bool)[:keep],
        blackout=measures.blackout(first)[:keep],
    )


def position_regret(trace: Trace) -> Array:
    """(T,) m: fused position error minus the error with the oracle's weights.

    Negative if the filter is better than any convex combination, which is possible for a product of experts.
    """
    steps = _steps(trace)
    return steps["fused"][:, 0] - steps["hindsight"][:, 0]


def _steps(trace: Trace) -> dict[str, Array]:
    """By step: weights (T, K, W), regret (T, W), position and component errors (T, 1 + n), unimodal (T, K, 1 + n)."""
    assert trace.effective_weights is not None
    effective_weights = trace.effective_weights.astype(np.float64)
    error, where = measures.errors(trace), list(measures.task_of(trace).map_indices)
    unimodal, fused = error[:, :-1], error[:, -1]
    per_component = effective_weights.shape[-1] == error.shape[-1]
    if per_component:
        near = np.swapaxes(effective_weights, 1, 2)
        oracle = np.swapaxes(oracle_weights(np.swapaxes(unimodal, 1, 2)[:, :, None], near), 1, 2)
    else:  # a scalar weight minimises the position error
        oracle = oracle_weights(np.swapaxes(unimodal[..., where], 1, 2), effective_weights[..., 0])[..., None]
    hindsight = (oracle * unimodal).sum(1)
    distances = [
        np.abs(e) if per_component else np.linalg.norm(e[:, where], axis=-1, keepdims=True) for e in (fused, hindsight)
    ]
    steps = {
        "effective_weights": effective_weights,
        "oracle": oracle,
        # A product of experts may be better than any convex weights; the regret is zero then.
        "regret": np.maximum(distances[0] - distances[1], 0.0),
        "fused": _with_position(fused, where),
        "hindsight": _with_position(hindsight, where),
        "unimodal": _with_position(unimodal, where),
    }
    return steps if trace.weights is None else {"beta": trace.weights.astype(np.float64), **steps}


def _with_position(error: Array, where: list[int]) -> Array:
    """(..., 1 + n): position error followed by the component errors (..., n)."""
    return np.concatenate([np.linalg.norm(error[..., where], axis=-1, keepdims=True), error], axis=-1)


def _correlations(traces: Sequence[Trace], step_values: Sequence[dict[str, Array]]) -> list[Correlation]:
    names = [name for name in ("beta", "effective_weights", "oracle") if name in step_values[0]]
    task, modalities = measures.task_of(traces[0]), traces[0].modalities
    width = step_values[0]["oracle"].shape[-1]
    columns = [c.name for c in task.components] if width == len(task.components) else [None]
    labels: list[tuple[str, str, str | None, str]] = []
    sums = []
    for trace, steps in zip(traces, step_values, strict=True):
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
        sums.append(correlation_sums(x, y))
    value, low, high = correlate(np.stack(sums))
    return [
        Correlation(*label, *map(float, v)) for label, v in zip(labels, zip(value, low, high, strict=True), strict=True)
    ]


def _description(correlation: Correlation) -> str:
    where = f" in {correlation.component}" if correlation.component else ""
    interval = (
        "" if math.isnan(correlation.low) else f" (95 % interval {correlation.low:.2f} to {correlation.high:.2f})"
    )
    return f"{correlation.value:.2f} with {OTHERS[correlation.other]}{where}{interval}"


def _interval(correlation: Correlation) -> tuple[Value, Value]:
    return (None, None) if math.isnan(correlation.low) else (correlation.low, correlation.high)


ENTRY = Entry(
    name="weights",
    title="Weight audit",
    question="Does the filter weight the modalities appropriately, and how much accuracy do suboptimal weights cost?",
    run=audit,
    why_not=why_not,
)
