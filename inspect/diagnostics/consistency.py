"""Consistency: whether errors match the predicted covariance, by layer and phase.

The covariance S is consistent if ``e^T S^-1 e`` averages to n. If the average is larger, the filter is overconfident:
its standard deviations are too small by the root of the ratio.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.catalog import find_task
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.evaluate import nees_bounds
from beliefscope.inspect.diagnostics.base import Diagnostic, Entry
from beliefscope.inspect.diagnostics.views import Curve, Line, Plot, Table, Value
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.calibration import (
    LEVELS,
    calibration_curve,
    gaussian_crps,
    gaussian_level,
    particle_crps,
    particle_level,
)
from beliefscope.inspect.statistics.innovations import Whiteness, innovations, whiteness_of
from beliefscope.inspect.trace import Trace

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ALL, FUSED, CONSISTENT = "all", "fused", "consistent"

MIN_TRAJECTORIES = 5
"""Minimum number of trajectories for an unqualified verdict of consistency."""

MIN_STEPS = 10
"""Minimum number of steps of a phase in the verdict."""


@dataclass(frozen=True)
class LayerConsistency:
    """Consistency of one layer in one phase.

    Attributes:
        layer: modality or ``fused``.
        phase: phase name.
        trajectories, steps: number of trajectories and steps in the phase.
        nees: mean of ``e^T S^-1 e / n``.
        bounds: 95 % bounds of ``nees`` for a consistent filter, assuming one independent error per trajectory.
        nis: mean of the normalised innovation squared over n; NaN without innovations.
        coverage95: share of steps with the true state in the 95 % region.
        calibration: (P,) share of steps with the true state in the region of each of ``LEVELS``.
        miscalibration: mean absolute difference between ``calibration`` and ``LEVELS``.
        nll: mean negative log density of the true state, nats in m and rad.
        rmse, sharpness, crps: (n,) m, rad: root mean square error, root mean predicted variance, mean CRPS.
    """

    layer: str
    phase: str
    trajectories: int
    steps: int
    nees: float
    bounds: tuple[float, float]
    nis: float
    coverage95: float
    calibration: Array
    miscalibration: float
    nll: float
    rmse: Array
    sharpness: Array
    crps: Array

    @property
    def factor(self) -> float:
        """Factor by which predicted standard deviations are too small; below 1 if too large."""
        return math.sqrt(self.nees)

    @property
    def assessment(self) -> str:
        """``consistent`` within the bounds, otherwise over- or underconfident with the factor."""
        low, high = self.bounds
        if self.nees > high:
            return f"overconfident by a factor of {_number(self.factor)}"
        return f"underconfident by a factor of {_number(1.0 / self.factor)}" if self.nees < low else CONSISTENT

    @property
    def evidence(self) -> str:
        """NEES / n and its bounds."""
        low, high = self.bounds
        return f"NEES/n {_number(self.nees)}, 95 % bounds {low:.2f} to {high:.2f}"


@dataclass(frozen=True)
class Consistency(Diagnostic):
    """Result of ``consistency``.

    Attributes:
        task, filter: names.
        trajectories: number of traces.
        by_layer: all layers in all phases with steps.
        whiteness: by modality and component; Kalman filters only.
        levels: (P,) levels of the calibration curves.
        nees, nis: (T, L), (T, K) NEES / n and NIS / n by step of a single trace; (0, L), (0, K) for several.
        contact, blackout: (T,) masks of a single trace.
    """

    task: str
    filter: str
    trajectories: int
    by_layer: tuple[LayerConsistency, ...]
    whiteness: tuple[Whiteness, ...]
    levels: Array
    nees: Array
    nis: Array
    contact: Mask
    blackout: Mask

    def entry(self, layer: str, phase: str = ALL) -> LayerConsistency:
        """Consistency of a layer in a phase. Raises KeyError if the phase has no steps."""
        return {(entry.layer, entry.phase): entry for entry in self.by_layer}[layer, phase]

    @property
    def layers(self) -> tuple[str, ...]:
        """The modalities, then ``fused``."""
        return tuple(dict.fromkeys(entry.layer for entry in self.by_layer))

    @property
    def phases(self) -> tuple[str, ...]:
        """Phases with steps."""
        return tuple(dict.fromkeys(entry.phase for entry in self.by_layer))

    @property
    def verdict(self) -> str:
        fused = self.entry(FUSED)
        assessment = fused.assessment
        if assessment == CONSISTENT and self.trajectories < MIN_TRAJECTORIES:
            assessment += f", based on {self.trajectories} trajector{'y' if self.trajectories == 1 else 'ies'} only"
        parts = [_sentence(f"{assessment} ({fused.evidence})")]
        candidates = [entry for entry in self.by_layer if entry.steps >= MIN_STEPS]
        phases = [entry for entry in candidates if entry.layer == FUSED and entry.phase != ALL]
        worst = max(phases, key=_inconsistency, default=fused)
        if worst.assessment != CONSISTENT and _inconsistency(worst) > _inconsistency(fused) + 2.0 * math.log(1.1):
            parts.append(f"Least consistent phase: {worst.phase}, {worst.assessment} ({worst.evidence}).")
        elif phases and all(entry.assessment == CONSISTENT for entry in (fused, *phases)):
            parts.append(f"Also consistent in each phase: {', '.join(entry.phase for entry in phases)}.")
        unimodal = [entry for entry in candidates if entry.layer != FUSED]
        if len(self.layers) > 2 and unimodal:
            parts.append(self._unimodal_sentence(max(unimodal, key=_inconsistency)))
        if self.whiteness:
            parts.append(self._innovation_sentence())
        return " ".join(parts)

    def _unimodal_sentence(self, worst: LayerConsistency) -> str:
        if worst.assessment == CONSISTENT:
            return "All unimodal posteriors are consistent."
        where = "all steps" if worst.phase == ALL else worst.phase
        return (
            f"Least consistent unimodal posterior: {worst.layer} in {where}, {worst.assessment} "
            f"(NEES/n {_number(worst.nees)})."
        )

    def _innovation_sentence(self) -> str:
        strongest = max(self.whiteness, key=lambda test: abs(test.autocorrelation))
        if min(test.p_value for test in self.whiteness) > 0.05 / len(self.whiteness):
            return "Innovations are white."
        size = _number(math.sqrt(self.entry(strongest.modality).nis))
        where = f"{strongest.modality}, {strongest.component}: autocorrelation {strongest.autocorrelation:.2f} at lag 1"
        text = f"Innovations are not white ({where}) and {size} times as large as predicted"
        if strongest.autocorrelation > 0.2:
            text += ": errors persist over steps, but the filter treats them as independent"
        return f"{text}."

    def tables(self) -> list[Table]:
        task = find_task(self.task)
        units, scale = measures.display_units(task)
        rows: list[tuple[Value, ...]] = []
        error_rows: list[tuple[Value, ...]] = []
        for entry in self.by_layer:
            low, high = entry.bounds
            nis = None if math.isnan(entry.nis) else entry.nis
            head = (entry.layer, entry.phase)
            values = (entry.trajectories, entry.steps, entry.nees, f"{low:.2f} to {high:.2f}", nis, entry.coverage95)
            rows.append((*head, *values, entry.miscalibration, entry.nll, entry.assessment))
            components = zip(entry.rmse * scale, entry.sharpness * scale, entry.crps * scale, strict=True)
            error_rows.append((*head, *(float(value) for component in components for value in component)))
        columns = ("layer", "phase", "trajectories", "steps", "NEES/n", "95 % bounds", "NIS/n", "95 % coverage")
        tables = [Table("Consistency", (*columns, "miscalibration", "NLL (nats)", "result"), tuple(rows))]
        names = [
            f"{c.name} ({unit}): {quantity}"
            for c, unit in zip(task.components, units, strict=True)
            for quantity in ERROR_QUANTITIES
        ]
        title = "Errors and predicted standard deviations"
        tables.append(Table(title, ("layer", "phase", *names), tuple(error_rows)))
        if self.whiteness:
            tests = tuple(
                (test.modality, test.component, test.autocorrelation, test.statistic, test.degrees, test.p_value)
                for test in self.whiteness
            )
            heads = (
                "modality",
                "component",
                "autocorrelation at lag 1",
                "Ljung-Box Q",
                "degrees of freedom",
                "p-value",
            )
            tables.append(Table("Whiteness of the innovations", heads, tests))
        return tables

    def curves(self) -> list[Curve]:
        """Roots of NEES / n and NIS / n: errors in predicted standard deviations, with 95 % bounds."""
        if not len(self.nees):
            return []
        low, high = nees_bounds(len(find_task(self.task).components), 1)
        bounds = (math.sqrt(low), math.sqrt(high))
        charts = [("Error in predicted standard deviations (root of NEES/n)", "error", self.nees, self.layers)]
        if self.nis.size:
            title = "Innovation in predicted standard deviations (root of NIS/n)"
            charts.append((title, "innovation", self.nis, self.layers[:-1]))
        return [
            Curve(f"{layer} {quantity}", np.sqrt(values[:, k]), chart, "standard deviations", layer, bounds)
            for chart, quantity, values, names in charts
            for k, layer in enumerate(names)
        ]

    def bands(self) -> dict[str, Mask]:
        return {"contact": self.contact, "blackout": self.blackout} if len(self.nees) else {}

    def plots(self) -> list[Plot]:
        plots = []
        for phase in self.phases:
            lines = [
                Line(entry.layer, self.levels, entry.calibration, entry.layer)
                for entry in self.by_layer
                if entry.phase == phase
            ]
            title = f"Calibration, {'all steps' if phase == ALL else phase}"
            plots.append(Plot(title, "level of the region", "share of true states inside", tuple(lines), diagonal=True))
        return plots


ERROR_QUANTITIES = ("RMSE", "predicted", "CRPS")


def why_not(trace: Trace, checkpoint: Checkpoint | None = None) -> str | None:
    """One-line reason why the diagnostic does not apply, or None."""
    if not trace.has_covariance or not np.isfinite(trace.estimate_covariance).any():
        return f"{trace.filter} has no covariance to compare its errors with"
    return None


def consistency(traces: Sequence[Trace]) -> Consistency:
    """Evaluate the consistency of one filter over one or more trajectories."""
    first = traces[0]
    steps_of = [_step_measures(trace) for trace in traces]
    pooled = {name: np.concatenate([steps[name] for steps in steps_of]) for name in steps_of[0]}
    owner, phases = measures.trace_indices(traces), measures.pooled_phases(traces)
    by_layer = []
    for k, layer in enumerate(measures.layers(first)):
        for phase, where in phases.items():
            steps = {name: values[where, k] for name, values in pooled.items()}
            # An external filter may not report unimodal posteriors.
            if np.isfinite(steps["nees"]).any():
                by_layer.append(_summarise(layer, phase, len(np.unique(owner[where])), steps))
    keep = len(first) if len(traces) == 1 else 0
    has_nis = first.observation_mean is not None
    return Consistency(
        task=first.episode.task,
        filter=first.filter,
        trajectories=len(traces),
        by_layer=tuple(by_layer),
        whiteness=tuple(whiteness_of(traces)),
        levels=LEVELS,
        nees=pooled["nees"][:keep],
        nis=pooled["nis"][:keep, : len(first.modalities) if has_nis else 0],
        contact=first.episode.contact.astype(bool)[:keep],
        blackout=measures.blackout(first)[:keep],
    )


def _step_measures(trace: Trace) -> dict[str, Array]:
    """Measures by step and layer, (T, L, ...)."""
    task = measures.task_of(trace)
    error, covariance = measures.errors(trace), measures.covariances(trace)
    n = error.shape[-1]
    nees = measures.nees(trace)
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    nis = np.full(nees.shape, np.nan)
    if (pair := innovations(trace)) is not None:
        nu, s = pair
        nis[:, :-1] = np.einsum("tkn,tkn->tk", nu, np.linalg.solve(s, nu[..., None])[..., 0]) / n
    if trace.log_likelihood is None or trace.prior_log_weights is None:
        level = gaussian_level(n * nees, n)
        crps = gaussian_crps(error, np.sqrt(variance))
    else:
        assert trace.particles is not None
        level, crps = np.empty(nees.shape), np.empty(error.shape)
        deviation = measures.wrapped(task, trace.particles - trace.episode.states[:, None])
        weights = np.exp(measures.particle_log_weights(trace))
        for k in range(error.shape[1]):  # one layer at a time limits memory to (T, M, n)
            from_mean = measures.wrapped(task, deviation - error[:, k, None])
            level[:, k] = particle_level(from_mean, weights[:, k], error[:, k], covariance[:, k])
            crps[:, k] = particle_crps(np.swapaxes(deviation, 1, 2), weights[:, k, None])
    nll = 0.5 * (n * nees + np.linalg.slogdet(covariance)[1] + n * math.log(2.0 * math.pi))
    return {"error": error, "variance": variance, "nees": nees, "nis": nis, "level": level, "nll": nll, "crps": crps}


def _summarise(layer: str, phase: str, trajectories: int, steps: dict[str, Array]) -> LayerConsistency:
    error, level = steps["error"], steps["level"]
    curve = calibration_curve(level)
    return LayerConsistency(
        layer=layer,
        phase=phase,
        trajectories=trajectories,
        steps=len(error),
        nees=float(steps["nees"].mean()),
        bounds=nees_bounds(error.shape[-1], trajectories),
        nis=float(steps["nis"].mean()),
        coverage95=float((level <= 0.95).mean()),
        calibration=curve,
        miscalibration=float(np.abs(curve - LEVELS).mean()),
        nll=float(steps["nll"].mean()),
        rmse=np.sqrt(np.square(error).mean(0)),
        sharpness=np.sqrt(steps["variance"].mean(0)),
        crps=steps["crps"].mean(0),
    )


def _inconsistency(entry: LayerConsistency) -> float:
    """Absolute logarithm of NEES / n."""
    return abs(math.log(entry.nees)) if entry.nees > 0 else math.inf


def _number(value: float) -> str:
    return f"{value:.2g}" if value < 10 else f"{value:.0f}"


def _sentence(text: str) -> str:
    return text[0].upper() + text[1:] + "."


ENTRY = Entry(
    name="consistency",
    title="Consistency",
    question="Do the errors match the predicted covariance, and in which phases do they not?",
    run=consistency,
    why_not=why_not,
)
