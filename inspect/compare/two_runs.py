"""Comparison of two runs over one episode: different filters or different sensor faults.

For interventions over a range of steps see ``inspect/compare/counterfactual.py``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task, with_unit
from beliefscope.datasets.text import capitalised, plural
from beliefscope.filters.evaluate import nees_bounds
from beliefscope.inspect.diagnostics.base import Diagnostic
from beliefscope.inspect.diagnostics.views import Curve, Table, Value, known_number
from beliefscope.inspect.statistics.measures import (
    Array,
    blackout,
    display_units,
    errors,
    layer_label,
    main_error,
    means,
    nees,
    nll,
    phases,
)
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.restarts import restarts_text

LEVEL = 0.02
"""Minimum relative change of the error that is reported."""

OVER_REPRESENTED = 1.2
"""Minimum ratio of a phase's share of the change to its share of the steps for the phase to be reported."""

MIN_STEPS = 10
"""Minimum number of steps of a reported phase."""


@dataclass(frozen=True)
class Comparison(Diagnostic):
    """Two runs over the same T steps; n components, S phases, K common modalities.

    Arrays have a last axis of two: this run and the comparison run. Units are m and rad.

    Attributes:
        task: definition of the task.
        names: display names of the runs.
        modalities: modalities of both runs.
        phases: phases with steps.
        steps: (S,) number of counted steps by phase.
        rmse: (S, n, 2) root mean square error of the fused estimate by component.
        position: (S, 2) root mean square position error.
        nees: (S, 2) mean of ``e^T S^-1 e / n``.
        nll: (S, 2) mean negative log density of the true state, nats in m and rad; NaN without a covariance.
        effective_weights: (S, K, 2) mean effective weights; None if a run has none.
        distance: (T,) m, distance between the fused position estimates.
        modality_distance: (T, K) m, distance between the positions of the single-modality updates.
        error: (T, 2) m, position error.
        component_error: (T, n, 2) error by component.
        nees_at: (T, 2) NEES / n by step.
        effective_weights_at: (T, K, 2) effective weights by step, or None.
        contact, blackout: (T,) bool; image blackout in either run.
        time: (T,) s, times of the steps; None without timestamps.
        restarts: of both runs (``restarts_text``).
    """

    task: Task
    names: tuple[str, str]
    modalities: tuple[str, ...]
    phases: tuple[str, ...]
    steps: NDArray[np.int64]
    rmse: Array
    position: Array
    nees: Array
    nll: Array
    effective_weights: Array | None
    distance: Array
    modality_distance: Array
    error: Array
    component_error: Array
    nees_at: Array
    effective_weights_at: Array | None
    contact: NDArray[np.bool_]
    blackout: NDArray[np.bool_]
    time: Array | None
    restarts: tuple[str, str] = ("", "")

    @property
    def verdict(self) -> str:
        if not self.distance.any() and np.array_equal(*np.moveaxis(self.component_error, -1, 0)):
            return f"The estimates of {self.names[0]} and {self.names[1]} are identical."
        main = self.task.main_error
        first, second = map(float, self.position[0])
        change = second / first - 1.0 if first else math.inf
        errors = f"{self.names[0]} {main.text(first)}, {self.names[1]} {main.text(second)}"
        parts = [f"{name} is {text}." for name, text in zip(self.names, self.restarts, strict=True) if text]
        parts += [f"RMSE over {plural(self.steps[0], 'step')}: {errors} ({_change(change)}){self._other_components()}."]
        if abs(change) >= LEVEL and (phase := self._dominant_phase()) is not None:
            before, after = map(float, self.position[phase])
            parts.append(
                f"Largest contribution in phase {self.phases[phase]}: {main.factor * before:.2f} -> {main.text(after)} "
                f"over {plural(self.steps[phase], 'step')}."
            )
        parts.append(self._consistency())
        farthest = int(self.distance.argmax())
        at = f"step {farthest}" if self.time is None else f"step {farthest}, {self.time[farthest]:.2f} s"
        parts.append(f"Largest distance between the estimates {main.text(self.distance[farthest])} ({at}).")
        return " ".join(filter(None, parts))

    def _other_components(self) -> str:
        """Errors of components that are not part of the main error."""
        task = self.task
        units, factors = display_units(task)
        return "".join(
            f"; {c.label} {factors[i] * self.rmse[0, i, 0]:.2f} -> {factors[i] * self.rmse[0, i, 1]:.2f} {units[i]}"
            for i, c in enumerate(task.components)
            if i not in task.main_error.indices
        )

    def _dominant_phase(self) -> int | None:
        """The phase with most of the change in squared error, if over-represented, otherwise None."""
        part = self.steps * (self.position[:, 1] ** 2 - self.position[:, 0] ** 2)
        candidates = [s for s in range(1, len(self.phases)) if self.steps[s] >= MIN_STEPS]
        shares = {s: float(part[s] / part[0]) for s in candidates if part[0]}
        worst = max(shares, key=lambda s: shares[s], default=None)
        if worst is None or shares[worst] < max(0.5, OVER_REPRESENTED * self.steps[worst] / self.steps[0]):
            return None
        return worst

    def _consistency(self) -> str:
        first, second = (float(value) for value in self.nees[0])
        if not (first > 0.0 and second > 0.0):  # NaN without a covariance
            return ""
        text = f"NEES/n {first:.2f} -> {second:.2f}"
        if abs(math.log(second / first)) < LEVEL:
            return f"{text}."
        closer = abs(math.log(second)) < abs(math.log(first))
        return f"{text}, {'more' if closer else 'less'} consistent (ideal 1)."

    def tables(self) -> list[Table]:
        task = self.task
        units, factors = display_units(task)
        main = task.main_error
        rows: list[tuple[Value, ...]] = []
        for s, phase in enumerate(self.phases):
            label = f"{phase} ({self.steps[s]})"
            rows += [
                _row(label, with_unit(f"{main.name} RMSE", main.unit), main.factor * self.position[s], relative=True),
                *(
                    _row(label, with_unit(f"{c.label} RMSE", units[i]), factors[i] * self.rmse[s, i], relative=True)
                    for i, c in enumerate(task.components)
                    if (i,) != main.indices
                ),
                _row(label, "NEES/n", self.nees[s]),
                _row(label, "NLL (nats)", self.nll[s]),
            ]
            if self.effective_weights is not None:
                rows += [
                    _row(label, f"effective weight of {m}", self.effective_weights[s, k])
                    for k, m in enumerate(self.modalities)
                ]
        columns = ("phase (steps)", "measure", *self.names, "difference", "difference, %")
        return [Table("By phase", columns, rows)]

    def curves(self) -> list[Curve]:
        task = self.task
        units, factors = display_units(task)
        chart = "Distance between the estimates"
        main = task.main_error
        curves = [Curve("fused", main.factor * self.distance, chart, main.unit, "fused")]
        if len(self.modalities) > 1:
            curves += [
                Curve(layer_label(m), main.factor * self.modality_distance[:, k], chart, main.unit, m)
                for k, m in enumerate(self.modalities)
                if np.isfinite(self.modality_distance[:, k]).any()
            ]

        def both(values: Array, chart: str, unit: str = "", layer: str = "fused", prefix: str = "") -> list[Curve]:
            bounds = self._bounds() if chart == CONSISTENCY else None
            return [
                Curve(f"{prefix}{name}", values[:, i], chart, unit, layer, bounds) for i, name in enumerate(self.names)
            ]

        curves += both(main.factor * self.error, f"{main.title} error", main.unit)
        for i, component in enumerate(task.components):
            if i not in task.main_error.indices:
                title = f"{capitalised(component.label)} error"
                curves += both(factors[i] * np.abs(self.component_error[:, i]), title, units[i])
        if np.isfinite(self.nees_at).any():
            curves += both(np.sqrt(self.nees_at), CONSISTENCY, "standard deviations")
        if self.effective_weights_at is not None:
            for k, m in enumerate(self.modalities):
                curves += both(self.effective_weights_at[:, k], "Effective weights", layer=m, prefix=f"{m}, ")
        return curves

    def _bounds(self) -> tuple[float, float]:
        low, high = nees_bounds(len(self.task.components), 1)
        return math.sqrt(low), math.sqrt(high)

    def bands(self) -> dict[str, NDArray[np.bool_]]:
        return {"contact": self.contact, "blackout": self.blackout}


CONSISTENCY = "Error in predicted standard deviations (root of NEES/n)"


def compare_runs(this: Trace, other: Trace, names: tuple[str, str] | None = None) -> Comparison:
    """Compare two runs over one episode.

    Args:
        names: display names of the runs; by default their filters or faults, whichever differs.

    Raises BadInput for runs over different episodes.
    """
    runs = (this, other)
    if this.data_hash != other.data_hash or len(this) != len(other):
        raise BadInput(
            f"the runs are over different episodes: {this.data_hash[:12]} with {plural(len(this), 'step')}, "
            f"{other.data_hash[:12]} with {len(other)}"
        )
    task = this.task
    either_blackout = blackout(this) | blackout(other)
    masks = phases(this)
    masks["blackout"] = masks["all"] & either_blackout
    masks = {phase: mask for phase, mask in masks.items() if mask.any()}
    # A standalone estimate is not comparable with an update of a prior that other modalities have informed.
    standalone = any("standalone" in run.settings for run in runs)
    shared = (
        ()
        if standalone
        else tuple(name for name in this.modalities_with_posterior if name in other.modalities_with_posterior)
    )
    layers = np.stack([_layers(run, shared) for run in runs], axis=-1)  # (T, K + 1, n, 2)
    distance = task.main_error.norm(task.difference(layers[..., 1], layers[..., 0]))
    error = np.stack([errors(run)[:, -1] for run in runs], axis=-1)
    on_map = np.stack([main_error(run)[:, -1] for run in runs], axis=-1)
    nees_at = np.stack([nees(run)[:, -1] for run in runs], axis=-1)
    nll_at = np.stack([nll(run)[:, -1] for run in runs], axis=-1)
    share = None
    weights = [run.effective_weights.mean(-1, dtype=np.float64) for run in runs if run.effective_weights is not None]
    if len(weights) == 2 and this.modalities == other.modalities:
        share = np.stack(weights, axis=-1)

    def by_phase(statistic: Callable[[NDArray[np.bool_]], Array]) -> Array:
        return np.stack([statistic(mask) for mask in masks.values()])

    return Comparison(
        task=task,
        names=names or _names(this, other),
        modalities=shared if share is None else this.modalities,
        phases=tuple(masks),
        steps=np.array([int(mask.sum()) for mask in masks.values()]),
        rmse=by_phase(lambda mask: np.sqrt(np.square(error[mask]).mean(0))),
        position=by_phase(lambda mask: np.sqrt(np.square(on_map[mask]).mean(0))),
        nees=by_phase(lambda mask: nees_at[mask].mean(0)),
        nll=by_phase(lambda mask: nll_at[mask].mean(0)),
        effective_weights=None if share is None else by_phase(lambda mask: share[mask].mean(0)),
        distance=distance[:, -1],
        modality_distance=distance[:, :-1],
        error=on_map,
        component_error=error,
        nees_at=nees_at,
        effective_weights_at=share,
        contact=this.episode.contact.astype(bool),
        blackout=either_blackout,
        time=this.episode.time,
        restarts=(restarts_text(this), restarts_text(other)),
    )


def _layers(run: Trace, shared: tuple[str, ...]) -> Array:
    """(T, K + 1, n): single-modality updates of the shared modalities, then the fused estimate."""
    return means(run)[:, [*(run.modalities.index(name) for name in shared), -1]]


def _names(this: Trace, other: Trace) -> tuple[str, str]:
    """Filters or faults of the runs, whichever differs, or both."""
    fault_sets = [str(run.faults) or "no faults" for run in (this, other)]
    if this.filter == other.filter:
        return fault_sets[0], fault_sets[1]
    if fault_sets[0] == fault_sets[1]:
        return this.filter, other.filter
    return f"{this.filter}, {fault_sets[0]}", f"{other.filter}, {fault_sets[1]}"


def _row(label: str, measure: str, both: Array, relative: bool = False) -> tuple[Value, ...]:
    """Both values, their difference and, if ``relative``, the difference in % of the first."""
    first, second = (float(value) for value in both)
    change = 100.0 * (second - first) / first if relative and first else math.nan
    return (label, measure, *map(known_number, (first, second, second - first, change)))


def _change(share: float) -> str:
    if not math.isfinite(share):
        return "from zero"
    if share > 1.0:
        return f"{1.0 + share:.1f} times"
    return "unchanged" if abs(share) < LEVEL else f"{abs(100 * share):.0f} % {'more' if share > 0 else 'less'}"
