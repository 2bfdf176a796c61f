"""Weight audit: comparison of fusion weights with the best ones, and their correlation with contact and blackout.

The oracle knows the true state and chooses, step by step, the convex weights whose fused mean is closest to it. The
excess error relative to the oracle (regret) bounds the benefit of better weights. No filter can reach it, so the
verdict compares with the best constant weights by phase, and with the filter's healthy record.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from beliefscope.datasets.task import display_name, with_unit
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics.base import NO_RECORD, Entry, RunDiagnostic, drawn_steps, fields_of
from beliefscope.inspect.diagnostics.healthy_comparison import Comparison
from beliefscope.inspect.diagnostics.views import Array, Curve, Table
from beliefscope.inspect.diagnostics.weight_steps import (
    Correlation,
    add_constant,
    excess_error,
    trajectory_statistics,
    weight_correlations,
    weight_steps,
)
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.intervals import too_few
from beliefscope.inspect.trace import Trace

MIN_REGRET = 0.05
"""Relative decrease of the error above which better weights would help."""

ERRORS = ("fused", "hindsight", "constant", "unimodal")
"""Fields of ``PhaseWeights`` that are root mean squares of errors."""

OTHERS = {"oracle": "the oracle weight", "contact": "contact", "blackout": "blackout"}
"""Signals that weights are correlated with, and their display names."""

LABELS = {"beta": "beta", "effective_weights": "effective weight", "oracle": "oracle"}
"""Display names of the weight fields."""


@dataclass(frozen=True)
class PhaseWeights:
    """Means over one phase.

    Attributes:
        phase: phase name.
        trajectories, steps: number of episodes and steps in the phase.
        beta, effective_weights, oracle: (K, W) mean weights; beta is None without a weight model.
        fused, hindsight: (1 + n,) m, rad: RMSE of the position and of each component, of the filter and with the
            oracle's weights.
        constant: (1 + n,) RMSE with the best constant weights by phase; NaN for one episode.
        unimodal: (K, 1 + n) RMSE of the single-modality updates, which are not standalone (``inspect/standalone.py``).
    """

    phase: str
    trajectories: int
    steps: int
    effective_weights: Array
    oracle: Array
    fused: Array
    hindsight: Array
    constant: Array
    unimodal: Array
    beta: Array | None = None

    @property
    def regret(self) -> Array:
        """(1 + n,) m, rad: excess of each RMSE over that with the oracle's weights."""
        return self.fused - self.hindsight


@dataclass(frozen=True)
class WeightAudit(RunDiagnostic):
    """Result of ``audit``.

    Attributes:
        modalities: K names.
        phases: means by phase.
        correlations: correlations with contact, blackout and the oracle.
        beta, effective_weights, oracle: (T, K, W) by step of a single trace, (0, K, W) for several; beta is None
            without a weight model.
        regret: (T, W) m, rad: decrease of the error with the oracle's weights by component; of the position error for
            a scalar weight.
        excess: relative excess of the position error over that with the best constant weights by phase, and its 95 %
            interval over episodes; NaN for too few of them.
        healthy: comparison with the filter's healthy record, if it has one.
        updates_note: of the verdict on single-modality updates.
    """

    modalities: tuple[str, ...]
    phases: tuple[PhaseWeights, ...]
    correlations: tuple[Correlation, ...]
    beta: Array | None
    effective_weights: Array
    oracle: Array
    regret: Array
    excess: tuple[float, float, float]
    healthy: Comparison | None = None
    updates_note: str = measures.UPDATES_NOTE

    @property
    def alarms(self) -> tuple[str, ...]:
        if self.healthy is not None:
            return tuple(alarm.text for alarm in self.healthy.alarms)
        return ("better weights would reduce the error",) if self.excess[1] > MIN_REGRET else ()

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

        main, unimodal = self.task.main_error, total.unimodal[:, 0]
        strongest = int(unimodal.argmin())
        parts = [NO_RECORD if self.healthy is None else self.healthy.sentence]
        parts += [
            f"Mean effective weight of {display_name(name)}: {mean_weights('effective_weights')}"
            f"{' (mean over components)' if len(self._columns) > 1 else ''}; oracle: {mean_weights('oracle')}.",
            f"{main.title} RMSE {main.text(total.fused[0], 3)}, {main.text(unimodal[strongest], 3)} for the "
            f"{measures.layer_label(self.modalities[strongest])}, {main.text(total.hindsight[0], 3)} with the oracle's "
            f"weights, which no filter can reach. {self.updates_note}".strip(),
            self._comparison_with_constant_weights(),
        ]
        source = "beta" if self.beta_is_effective else "effective_weights"
        correlations = [pair for other in OTHERS if (pair := self.correlation(source, name, other))]
        if correlations:
            parts.append(
                f"Correlation of the weight of {display_name(name)}: {', '.join(map(_description, correlations))}."
            )
        return " ".join(parts)

    def _comparison_with_constant_weights(self) -> str:
        if why := too_few(self.trajectories):
            return f"Comparison with the best constant weights: {why}."
        value, low, high = (100.0 * x for x in self.excess)
        best = self.task.main_error.text(self.phases[0].constant[0], 3)
        effect = "would" if low > 100.0 * MIN_REGRET else "might" if high > 100.0 * MIN_REGRET else "would hardly"
        return (
            f"The best constant weights by phase {effect} reduce the error: {best} "
            f"with them, from which the filter's differs by {value:+z.1f} % "
            f"(95 % interval {low:+z.1f} to {high:+z.1f} %)."
        )

    @property
    def _columns(self) -> tuple[str | None, ...]:
        """Names of the W columns: components, or None for a scalar weight."""
        names = tuple(c.label for c in self.task.components)
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
        unimodal = [measures.layer_label(modality) for modality in self.modalities]
        means, errors = [], []
        for entry in self.phases:
            for w, column in enumerate(self._columns):
                weights = {
                    f"{display_name(modality)}: {LABELS[source]}": getattr(entry, source)[k, w]
                    for k, modality in enumerate(self.modalities)
                    for source in self._sources
                }
                means.append({"phase": entry.phase, "steps": entry.steps, "component": column or "all"} | weights)
            for q, name, factor in measures.quantities(self.task):
                errors.append(
                    {
                        "phase": entry.phase,
                        "quantity": name,
                        "fused": factor * entry.fused[q],
                        "with the oracle's weights": factor * entry.hindsight[q],
                        "regret": factor * entry.regret[q],
                        "with constant weights": factor * entry.constant[q],
                        **dict(zip(unimodal, factor * entry.unimodal[:, q], strict=True)),
                    }
                )
        tables = [Table.from_rows("Mean weights", means), Table.from_rows("RMSE", errors)]
        rows = [
            (c.modality, LABELS[c.weight], display_name(c.component or "all"), c.other, c.value, c.low, c.high)
            for c in self.correlations
            if math.isfinite(c.value) and c.modality in self._independent and c.weight in self._sources
        ]
        if rows:
            heads = ("modality", "weight", "component", "with", "r", "95 % from", "to")
            tables.append(Table("Correlations of the weights", heads, rows))
        return tables if self.healthy is None else [*tables, self.healthy.table()]

    def curves(self) -> list[Curve]:
        """Weights by component, then regrets. With two modalities, only the weights of the first."""
        if not len(self.oracle):
            return []
        task = self.task
        units, scale = measures.display_units(task)
        curves, regrets = [], []
        for w, column in enumerate(self._columns):
            chart = "Weight" + (f" of {column}" if column else "")
            for source in self._sources:
                values = getattr(self, source)
                for k, modality in enumerate(self._independent):
                    name = f"{display_name(modality)} {LABELS[source]}" + (f" {column}" if column else "")
                    curves.append(Curve(name, values[:, k, w], chart, "", modality))
            unit, factor = (units[w], scale[w]) if column else (task.main_error.unit, task.main_error.factor)
            name = f"regret {column or task.main_error.name}"
            regrets.append(Curve(name, factor * self.regret[:, w], with_unit("Regret", unit), unit))
        # Curves of one chart must be consecutive: components with equal units share a chart.
        return curves + sorted(regrets, key=lambda curve: curve.unit)


def why_not(trace: Trace, checkpoint: Checkpoint | None = None) -> str | None:
    """One-line reason why the diagnostic does not apply, or None."""
    if trace.effective_weights is not None:
        if np.isnan(trace.modality_mean).all():
            return f"filter {trace.filter} reports no single-modality updates"
        return None if np.isfinite(measures.main_error(trace)[:, -1]).any() else measures.UNKNOWN_TRUTH
    if not trace.modalities and trace.kind == "external":
        return f"filter {trace.filter} reports no fusion weights"
    if not trace.modalities:
        return f"filter {trace.filter} has no fusion weights: one network processes all modalities"
    if len(trace.modalities) > 1:
        return f"filter {trace.filter} reports no effective weights"
    return f"filter {trace.filter} has only one measurement model, {trace.modalities[0]}"


def audit(traces: Sequence[Trace], healthy: Comparison | None = None) -> WeightAudit:
    """Audit the weights of one filter over one or more episodes."""
    step_values = add_constant([weight_steps(trace) for trace in traces], traces)
    pooled = {name: np.concatenate([steps[name] for steps in step_values]) for name in step_values[0]}
    index = measures.trace_indices(traces)
    phases = []
    for phase, where in measures.pooled_phases(traces).items():
        if where.any():
            steps = {name: values[where] for name, values in pooled.items()}
            rmse = {name: np.sqrt(np.square(steps[name]).mean(0)) for name in ERRORS}
            weights: dict[str, Any] = {
                name: steps[name].mean(0) for name in ("beta", "effective_weights", "oracle") if name in steps
            }
            trajectories = len(np.unique(index[where]))
            phases.append(
                PhaseWeights(phase=phase, trajectories=trajectories, steps=int(where.sum()), **weights, **rmse)
            )
    keep = drawn_steps(traces)
    return WeightAudit(
        **fields_of(traces),
        modalities=traces[0].modalities,
        phases=tuple(phases),
        correlations=tuple(weight_correlations(traces, step_values)),
        beta=pooled["beta"][:keep] if "beta" in pooled else None,
        effective_weights=pooled["effective_weights"][:keep],
        oracle=pooled["oracle"][:keep],
        regret=pooled["regret"][:keep],
        excess=excess_error(traces, step_values),
        healthy=healthy,
        updates_note=measures.updates_note(traces[0]),
    )


def _description(correlation: Correlation) -> str:
    where = f" in {display_name(correlation.component)}" if correlation.component else ""
    interval = (
        "" if math.isnan(correlation.low) else f" (95 % interval {correlation.low:z.2f} to {correlation.high:z.2f})"
    )
    return f"{correlation.value:z.2f} with {OTHERS[correlation.other]}{where}{interval}"


ENTRY = Entry(
    name="weights",
    title="Weight audit",
    question="Does the filter weight the modalities appropriately, and how much accuracy do suboptimal weights cost?",
    run=audit,
    why_not=why_not,
    statistics=trajectory_statistics,
)
