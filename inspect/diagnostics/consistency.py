"""Consistency: whether errors match the predicted covariance, by layer and phase.

The covariance S is consistent if ``e^T S^-1 e`` averages to n. If the average is larger, the filter is overconfident:
its standard deviations are too small by the root of the ratio.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.covariate import in_phase
from beliefscope.datasets.task import display_name
from beliefscope.datasets.text import capitalised, plural
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.covariance_floor import is_indefinite
from beliefscope.filters.evaluate import nees_bounds
from beliefscope.inspect.diagnostics.base import NO_RECORD, Entry, RunDiagnostic, drawn_steps, fields_of
from beliefscope.inspect.diagnostics.healthy_comparison import Comparison
from beliefscope.inspect.diagnostics.layer_consistency import LayerConsistency, inconsistency, number
from beliefscope.inspect.diagnostics.views import Curve, Line, Plot, Table
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.calibration import (
    LEVELS,
    calibration_curve,
    gaussian_crps,
    gaussian_level,
    particle_crps,
    particle_level,
)
from beliefscope.inspect.statistics.innovations import Whiteness, autocorrelations, nis_of, whiteness_of
from beliefscope.inspect.statistics.intervals import LEVEL, mean_interval, nees_limit, too_few
from beliefscope.inspect.statistics.measures import Array
from beliefscope.inspect.trace import Trace

ALL, FUSED = "all", "fused"


@dataclass(frozen=True)
class Consistency(RunDiagnostic):
    """Result of ``consistency``.

    Attributes:
        by_layer: all layers in all phases with steps.
        whiteness: by modality and component; Kalman filters only.
        levels: (P,) levels of the calibration curves.
        nees, nis: (T, L), (T, K) NEES / n and NIS / n by step of a single trace; (0, L), (0, K) for several.
        healthy: comparison with the filter's healthy record, if it has one.
        updates_note: of the verdict on single-modality updates.
        indefinite: number of counted steps of all traces whose fused covariance is not positive definite.
    """

    by_layer: tuple[LayerConsistency, ...]
    whiteness: tuple[Whiteness, ...]
    levels: Array
    nees: Array
    nis: Array
    healthy: Comparison | None = None
    updates_note: str = measures.UPDATES_NOTE
    indefinite: int = 0

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
        parts = [_sentence(text) for text in self._of_covariances]
        if self.healthy is not None:
            return " ".join((*parts, f"{self.healthy.sentence} {fused.evidence}; 1 in theory."))
        parts += [f"{NO_RECORD} {_sentence(f'{fused.assessment} ({fused.evidence})')}"]
        candidates = [entry for entry in self.by_layer if entry.refusal is None]
        few = too_few(self.trajectories)
        phases = [entry for entry in candidates if entry.layer == FUSED and entry.phase != ALL]
        worst = max(phases, key=inconsistency, default=fused)
        if worst.inconsistent and inconsistency(worst) > inconsistency(fused) + 2.0 * math.log(1.1):
            parts.append(f"Least consistent phase: {worst.phase}, {worst.assessment} ({worst.evidence}).")
        elif phases and not few and not any(entry.inconsistent for entry in (fused, *phases)):
            parts.append(f"Also consistent in each phase: {', '.join(entry.phase for entry in phases)}.")
        unimodal = [entry for entry in candidates if entry.layer != FUSED]
        if len(self.layers) > 2 and unimodal and not few:
            parts.append(self._unimodal_sentence(unimodal))
        if self.whiteness and not few:
            parts.append(self._innovation_sentence())
        return " ".join(parts)

    @property
    def _of_covariances(self) -> tuple[str, ...]:
        steps = plural(self.indefinite, "step")
        return (f"the covariance is not positive definite in {steps}",) if self.indefinite else ()

    @property
    def alarms(self) -> tuple[str, ...]:
        steps = self._of_covariances
        if self.healthy is not None:
            return (*steps, *(alarm.text for alarm in self.healthy.alarms))
        entries = [entry for entry in self.by_layer if entry.inconsistent]
        texts = [f"{display_name(entry.layer)}, {entry.phase}: {entry.assessment}" for entry in entries]
        colored = [display_name(test.modality) for test in self.whiteness if not test.white]
        return (*steps, *texts, *(f"innovations of {name} are not white" for name in colored))

    def _unimodal_sentence(self, entries: Sequence[LayerConsistency]) -> str:
        worst = max((entry for entry in entries if entry.inconsistent), key=inconsistency, default=None)
        if worst is None:
            return "All single-modality updates are consistent."
        where = "in all steps" if worst.phase == ALL else in_phase(worst.phase, self.task.covariates)
        return (
            f"Least consistent single-modality update: {display_name(worst.layer)} {where}, {worst.assessment} "
            f"(NEES/n {number(worst.nees)}). {self.updates_note}"
        ).strip()

    def _innovation_sentence(self) -> str:
        colored = [test for test in self.whiteness if not test.white]
        if not colored:
            return "Innovations are white."
        strongest = max(colored, key=lambda test: abs(test.autocorrelation))
        size = number(math.sqrt(self.entry(strongest.modality).nis))
        subject = ", ".join(dict.fromkeys(map(display_name, (strongest.modality, strongest.component))))
        where = f"{subject}: autocorrelation {strongest.autocorrelation:z.2f} at lag 1"
        text = f"Innovations are not white ({where}) and {size} times as large as predicted"
        if strongest.autocorrelation > 0.2:
            text += ": errors persist over steps, but the filter treats them as independent"
        return f"{text}."

    def tables(self) -> list[Table]:
        rows: list[dict[str, Any]] = []
        errors: list[dict[str, Any]] = []
        for entry in self.by_layer:
            low, high = entry.interval
            limits = f"at least {_bound(low)}" if math.isinf(high) else f"{_bound(low)} to {_bound(high)}"
            head = {"layer": measures.layer_label(entry.layer), "phase": entry.phase}
            sizes = {"episodes": entry.trajectories, "steps": entry.steps}
            nees = {"NEES/n": entry.nees, "95 % interval": "" if math.isnan(low) else limits, "NIS/n": entry.nis}
            calibration = {"95 % coverage": entry.coverage95, "miscalibration": entry.miscalibration}
            rows.append(head | sizes | nees | calibration | {"NLL (nats)": entry.nll, "result": entry.assessment})
            quantities = {"RMSE": entry.rmse, "predicted": entry.sharpness, "CRPS": entry.crps}
            errors.append(head | measures.by_component(self.task, quantities))
        tables = [
            Table.from_rows("Consistency", rows),
            Table.from_rows("Errors and predicted standard deviations", errors),
        ]
        if self.whiteness:
            tests = [
                {
                    "modality": t.modality,
                    "component": display_name(t.component),
                    "autocorrelation at lag 1": t.autocorrelation,
                    "95 % from": t.low,
                    "to": t.high,
                    "Ljung-Box Q": t.statistic,
                    "p-value if white": t.p_value,
                }
                for t in self.whiteness
            ]
            tables.append(Table.from_rows("Whiteness of the innovations", tests))
        return tables if self.healthy is None else [*tables, self.healthy.table()]

    def curves(self) -> list[Curve]:
        """Roots of NEES / n and NIS / n: errors in predicted standard deviations, with 95 % bounds."""
        if not len(self.nees):
            return []
        low, high = nees_bounds(int(np.isfinite(self.entry(FUSED).rmse).sum()), 1)  # of the known components
        bounds = (math.sqrt(low), math.sqrt(high))
        title = "Error in predicted standard deviations (root of NEES/n)"
        charts: list[tuple[str, str, Array, tuple[str, ...], Callable[[str], str]]]
        charts = [(title, "error", self.nees, self.layers, measures.layer_label)]
        if self.nis.size:
            title = "Innovation in predicted standard deviations (root of NIS/n)"
            charts.append((title, "innovation", self.nis, self.layers[:-1], str))
        return [
            Curve(f"{name(layer)} {quantity}", measures.root(values[:, k]), chart, "standard deviations", layer, bounds)
            for chart, quantity, values, names, name in charts
            for k, layer in enumerate(names)
        ]

    def plots(self) -> list[Plot]:
        plots = []
        for phase in self.phases:
            lines = [
                Line(measures.layer_label(entry.layer), self.levels, entry.calibration, entry.layer)
                for entry in self.by_layer
                if entry.phase == phase
            ]
            title = f"Calibration, {'all steps' if phase == ALL else phase}"
            plots.append(Plot(title, "level of the region", "share of true states inside", tuple(lines), diagonal=True))
        return plots


def why_not(trace: Trace, checkpoint: Checkpoint | None = None) -> str | None:
    """One-line reason why the diagnostic does not apply, or None."""
    if not trace.has_covariance or not np.isfinite(trace.estimate_covariance).any():
        return f"filter {trace.filter} has no covariance to compare its errors with"
    if not measures.known_components(trace):
        return measures.UNKNOWN_TRUTH
    return None if (reason := measures.no_covariance(trace)) is None else f"filter {trace.filter} {reason}"


def consistency(traces: Sequence[Trace], healthy: Comparison | None = None) -> Consistency:
    """Evaluate the consistency of one filter over one or more episodes."""
    first = traces[0]
    steps_of = [_step_measures(trace) for trace in traces]
    pooled = {name: np.concatenate([steps[name] for steps in steps_of]) for name in steps_of[0]}
    owner, phases = measures.trace_indices(traces), measures.pooled_phases(traces)
    # An external filter may not report single-modality updates.
    cells = [
        (k, layer, phase, where)
        for k, layer in enumerate(measures.layers(first))
        for phase, where in phases.items()
        if np.isfinite(pooled["nees"][where, k]).any()
    ]
    by_layer = []
    for k, layer, phase, where in cells:
        known = where & ~np.isnan(pooled["nees"][:, k])
        steps = {name: values[known, k] for name, values in pooled.items()}
        by_layer.append(_summarise(layer, phase, owner[known], steps, len(cells)))
    keep, has_nis = drawn_steps(traces), nis_of(first) is not None
    return Consistency(
        **fields_of(traces),
        by_layer=tuple(by_layer),
        whiteness=tuple(test for test in whiteness_of(traces) if any(test.modality == e.layer for e in by_layer)),
        levels=LEVELS,
        nees=pooled["nees"][:keep],
        nis=pooled["nis"][:keep, : len(first.modalities) if has_nis else 0],
        healthy=healthy,
        updates_note=measures.updates_note(first),
        indefinite=sum(
            int(is_indefinite(trace.estimate_covariance[measures.counted(trace)].astype(float)).sum())
            for trace in traces
        ),
    )


def trajectory_statistics(trace: Trace) -> dict[str, float]:
    """Statistics of a healthy profile: NEES/n by layer and phase, NIS/n and autocorrelation of the innovations."""
    nees, nis = measures.nees(trace), nis_of(trace)
    phases = measures.long_phases(trace)
    values = {
        f"nees/{layer}/{phase}": measures.known_mean(nees[mask, k])
        for k, layer in enumerate(measures.layers(trace))
        for phase, mask in phases.items()
    }
    if nis is not None and ALL in phases:
        values |= {f"nis/{m}/{ALL}": measures.known_mean(nis[phases[ALL], k]) for k, m in enumerate(trace.modalities)}
    values |= {f"autocorrelation/{m} {c}/{ALL}": r for (m, c), r in autocorrelations(trace).items()}
    return {name: value for name, value in values.items() if math.isfinite(value)}


def _step_measures(trace: Trace) -> dict[str, Array]:
    """Measures by step and layer, (T, L, ...)."""
    task = trace.task
    error, covariance, known = measures.errors(trace), measures.covariances(trace), measures.known_components(trace)
    of_known, nees = measures.of_components(covariance, known), measures.nees(trace)
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    nis = np.full(nees.shape, np.nan)
    if (values := nis_of(trace)) is not None:
        nis[:, :-1] = values
    if trace.log_likelihood is None or trace.prior_log_weights is None:
        level = gaussian_level(len(known) * nees, len(known))
        crps = gaussian_crps(error, np.sqrt(np.where(variance < 0.0, np.nan, variance)))
    else:
        assert trace.particles is not None
        level, crps = np.empty(nees.shape), np.empty(error.shape)
        deviation = task.difference(trace.particles, trace.episode.states[:, None])
        weights = np.exp(measures.particle_log_weights(trace))
        for k in range(error.shape[1]):  # one layer at a time limits memory to (T, M, n)
            from_mean = measures.wrapped(task, deviation - error[:, k, None])
            level[:, k] = particle_level(from_mean[..., known], weights[:, k], error[:, k, known], of_known[:, k])
            crps[:, k] = particle_crps(np.swapaxes(deviation, 1, 2), weights[:, k, None])
    beliefs = {"variance": variance, "nees": nees, "nis": nis, "nll": measures.nll(trace)}
    return {"error": error, **beliefs, "level": level, "crps": crps}


def _summarise(
    layer: str, phase: str, owner: NDArray[np.int64], steps: dict[str, Array], cells: int
) -> LayerConsistency:
    """``owner``: (S,) index of each step's episode. ``cells``: number of layers and phases, for ``adjusted``."""
    error, level = steps["error"], steps["level"]
    curve = calibration_curve(level)
    _, index, counts = np.unique(owner, return_inverse=True, return_counts=True)
    sums = np.bincount(index, steps["nees"])
    nees, levels = float(steps["nees"].mean()), (LEVEL, 1.0 - (1.0 - LEVEL) / cells)
    intervals = [(float(low), float(high)) for _, low, high in (mean_interval(sums, counts, each) for each in levels)]
    rmse = np.sqrt(np.square(error).mean(0))
    if too_few(len(counts)):
        lowest = [nees / nees_limit(int(np.isfinite(rmse).sum()), each) for each in levels]
        intervals = [(low, math.inf) if low > 1.0 else (math.nan, math.nan) for low in lowest]
    return LayerConsistency(
        layer=layer,
        phase=phase,
        trajectories=len(counts),
        steps=len(error),
        nees=nees,
        interval=intervals[0],
        adjusted=intervals[1],
        nis=measures.known_mean(steps["nis"]),
        coverage95=float((level <= 0.95).mean()),
        calibration=curve,
        miscalibration=float(np.abs(curve - LEVELS).mean()),
        nll=float(steps["nll"].mean()),
        rmse=rmse,
        sharpness=np.sqrt(np.maximum(steps["variance"].mean(0), 0.0)),
        crps=steps["crps"].mean(0),
    )


def _sentence(text: str) -> str:
    return capitalised(text) + "."


ENTRY = Entry(
    name="consistency",
    title="Consistency",
    question="Do the errors match the predicted covariance, and in which phases do they not?",
    run=consistency,
    why_not=why_not,
    statistics=trajectory_statistics,
)


def _bound(value: float) -> str:
    """A bound of NEES / n, that of a filter that diverges with an exponent."""
    return f"{value:.2f}" if value < 1e6 else f"{value:.3g}"
