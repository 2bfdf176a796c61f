"""Two runs over one episode, side by side: two filters, or one filter with its sensors broken in two ways.

What an edit over a few steps changes is the counterfactual's question (``inspect/compare/counterfactual.py``).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.training.study import nees_bounds
from beliefscope.inspect.diagnostics.base import Array, Curve, Diagnostic, Table, Value
from beliefscope.inspect.statistics.measures import (
    blackout,
    covariances,
    errors,
    means,
    nees,
    position_error,
    shown_units,
    splits,
    task_of,
    wrapped,
)
from beliefscope.inspect.trace import Trace

LEVEL = 0.02
"""A smaller change of the error, as a share of it, is none."""

MORE = 1.2
"""A kind of step is named where its part of the change is so many times its part of the steps."""

FEWEST_STEPS = 10
"""Of a kind before the verdict speaks of it."""


@dataclass(frozen=True)
class Comparison(Diagnostic):
    """One run and another over the same T steps; n components, S kinds of step, K modalities that both have.

    Arrays have a last axis of two: this run, the other. m and rad.

    Attributes:
        task: its name. names: what the runs are called. modalities: those that both have.
        splits: kinds of step that there are. steps: (S,) how many; the first ones are left out, as in all metrics.
        rmse: (S, n, 2) root mean square error of the fused estimate by component. position: (S, 2) the same on the map.
        nees: (S, 2) mean of ``e^T S^-1 e / n``. nll: (S, 2) mean negative log-density of the truth, nats in m and rad.
            NaN for a run without a covariance.
        share: (S, K, 2) mean share of each modality in the fused result; None where a run has none.
        distance: (T,) m on the map, between the fused estimates.
        modality_distance: (T, K) m, between what each modality believes by itself.
        error: (T, 2) m on the map; component_error: (T, n, 2) from the truth. nees_at: (T, 2).
        share_at: (T, K, 2) or None. contact, blackout: (T,) bool; black in either.
    """

    task: str
    names: tuple[str, str]
    modalities: tuple[str, ...]
    splits: tuple[str, ...]
    steps: NDArray[np.int64]
    rmse: Array
    position: Array
    nees: Array
    nll: Array
    share: Array | None
    distance: Array
    modality_distance: Array
    error: Array
    component_error: Array
    nees_at: Array
    share_at: Array | None
    contact: NDArray[np.bool_]
    blackout: NDArray[np.bool_]

    @property
    def verdict(self) -> str:
        if not self.distance.any() and np.array_equal(*np.moveaxis(self.component_error, -1, 0)):
            return f"{self.names[1]} estimates exactly what {self.names[0]} does."
        first, second = (100 * float(value) for value in self.position[0])
        change = second / first - 1.0 if first else math.inf
        text = f"{self.names[0]}: {first:.2f} cm RMSE over {self.steps[0]} steps; {self.names[1]}: {second:.2f}"
        parts = [f"{text}, {_change(change)}{self._of_others()}."]
        if abs(change) >= LEVEL and (kind := self._worst()) is not None:
            before, after = (100 * float(value) for value in self.position[kind])
            parts.append(f"Most so in {self.splits[kind]}: {before:.2f} -> {after:.2f} over {self.steps[kind]} steps.")
        parts.append(self._of_confidence())
        farthest = int(self.distance.argmax())
        parts.append(f"At most {100 * self.distance[farthest]:.2f} cm apart (step {farthest}).")
        return " ".join(filter(None, parts))

    def _of_others(self) -> str:
        """The components that are not on the map."""
        task = find_task(self.task)
        units, factors = shown_units(task)
        return "".join(
            f"; {c.name} {factors[i] * self.rmse[0, i, 0]:.2f} -> {factors[i] * self.rmse[0, i, 1]:.2f} {units[i]}"
            for i, c in enumerate(task.components)
            if i not in task.map_indices
        )

    def _worst(self) -> int | None:
        """The kind of step with most of the change in squared error, and more of it than of the steps; else None."""
        part = self.steps * (self.position[:, 1] ** 2 - self.position[:, 0] ** 2)
        kinds = [s for s in range(1, len(self.splits)) if self.steps[s] >= FEWEST_STEPS]
        shares = {s: float(part[s] / part[0]) for s in kinds if part[0]}
        worst = max(shares, key=lambda s: shares[s], default=None)
        if worst is None or shares[worst] < max(0.5, MORE * self.steps[worst] / self.steps[0]):
            return None
        return worst

    def _of_confidence(self) -> str:
        first, second = (float(value) for value in self.nees[0])
        if not (first > 0.0 and second > 0.0):  # NaN where a run states no covariance
            return ""
        text = f"NEES/n {first:.2f} -> {second:.2f}"
        if abs(math.log(second / first)) < LEVEL:
            return f"{text}."
        nearer = abs(math.log(second)) < abs(math.log(first))
        return f"{text}, {'nearer to' if nearer else 'farther from'} the 1 of a true covariance."

    def tables(self) -> list[Table]:
        task = find_task(self.task)
        units, factors = shown_units(task)
        rows: list[tuple[Value, ...]] = []
        for s, split in enumerate(self.splits):
            kind = f"{split} ({self.steps[s]})"
            rows += [
                _row(kind, "position RMSE (cm)", 100 * self.position[s], relative=True),
                *(
                    _row(kind, f"{c.name} RMSE ({units[i]})", factors[i] * self.rmse[s, i], relative=True)
                    for i, c in enumerate(task.components)
                ),
                _row(kind, "NEES/n", self.nees[s]),
                _row(kind, "NLL (nats)", self.nll[s]),
            ]
            if self.share is not None:
                rows += [_row(kind, f"share of {m}", self.share[s, k]) for k, m in enumerate(self.modalities)]
        columns = ("steps", "measure", *self.names, "difference", "difference, %")
        return [Table("By kind of step", columns, tuple(rows))]

    def curves(self) -> list[Curve]:
        task = find_task(self.task)
        units, factors = shown_units(task)
        chart = "How far apart the estimates are"
        curves = [Curve("fused", 100 * self.distance, chart, "cm", "fused")]
        if len(self.modalities) > 1:
            curves += [
                Curve(f"{m} by itself", 100 * self.modality_distance[:, k], chart, "cm", m)
                for k, m in enumerate(self.modalities)
            ]

        def both(values: Array, chart: str, unit: str = "", layer: str = "fused", of: str = "") -> list[Curve]:
            bounds = self._bounds() if chart == CONFIDENCE else None
            return [Curve(f"{of}{name}", values[:, i], chart, unit, layer, bounds) for i, name in enumerate(self.names)]

        curves += both(100 * self.error, "Position error", "cm")
        for i, component in enumerate(task.components):
            if i not in task.map_indices:
                curves += both(factors[i] * np.abs(self.component_error[:, i]), f"{component.name} error", units[i])
        if np.isfinite(self.nees_at).any():
            curves += both(np.sqrt(self.nees_at), CONFIDENCE, "standard deviations")
        if self.share_at is not None:
            for k, m in enumerate(self.modalities):
                curves += both(self.share_at[:, k], "Share in the result", layer=m, of=f"{m}, ")
        return curves

    def _bounds(self) -> tuple[float, float]:
        low, high = nees_bounds(len(find_task(self.task).components), 1)
        return math.sqrt(low), math.sqrt(high)

    def bands(self) -> dict[str, NDArray[np.bool_]]:
        return {"contact": self.contact, "blackout": self.blackout}


CONFIDENCE = "Error in stated standard deviations (root of NEES/n)"


def compare_runs(this: Trace, other: Trace, names: tuple[str, str] | None = None) -> Comparison:
    """This run and the other, of one episode. names: what they are called; their filters' names, or their faults.

    Raises BadInput for runs of two episodes.
    """
    runs = (this, other)
    if this.data_hash != other.data_hash or len(this) != len(other):
        raise BadInput(
            f"the runs are of two episodes: {this.data_hash[:12]} with {len(this)} steps, "
            f"{other.data_hash[:12]} with {len(other)}"
        )
    task = task_of(this)
    black = blackout(this) | blackout(other)
    masks = splits(this)
    masks["blackout"] = masks["all"] & black
    masks = {kind: mask for kind, mask in masks.items() if mask.any()}
    shared = tuple(name for name in this.alone if name in other.alone)
    layers = np.stack([_layers(run, shared) for run in runs], axis=-1)  # (T, K + 1, n, 2)
    apart = np.linalg.norm(wrapped(task, layers[..., 1] - layers[..., 0])[..., list(task.map_indices)], axis=-1)
    error = np.stack([errors(run)[:, -1] for run in runs], axis=-1)
    on_map = np.stack([position_error(run)[:, -1] for run in runs], axis=-1)
    nees_at = np.stack([nees(run)[:, -1] for run in runs], axis=-1)
    nll = np.stack([_nll(run) for run in runs], axis=-1)
    share = None
    if this.acting is not None and other.acting is not None and this.modalities == other.modalities:
        share = np.stack([run.acting.mean(-1, dtype=np.float64) for run in runs if run.acting is not None], axis=-1)

    def by_kind(of: Callable[[NDArray[np.bool_]], Array]) -> Array:
        return np.stack([of(mask) for mask in masks.values()])

    return Comparison(
        task=task.name,
        names=names or _names(this, other),
        modalities=shared if share is None else this.modalities,
        splits=tuple(masks),
        steps=np.array([int(mask.sum()) for mask in masks.values()]),
        rmse=by_kind(lambda mask: np.sqrt(np.square(error[mask]).mean(0))),
        position=by_kind(lambda mask: np.sqrt(np.square(on_map[mask]).mean(0))),
        nees=by_kind(lambda mask: nees_at[mask].mean(0)),
        nll=by_kind(lambda mask: nll[mask].mean(0)),
        share=None if share is None else by_kind(lambda mask: share[mask].mean(0)),
        distance=apart[:, -1],
        modality_distance=apart[:, :-1],
        error=on_map,
        component_error=error,
        nees_at=nees_at,
        share_at=share,
        contact=this.episode.contact.astype(bool),
        blackout=black,
    )


def _layers(run: Trace, shared: tuple[str, ...]) -> Array:
    """(T, K + 1, n): what the shared modalities believe, then the fused estimate."""
    return means(run)[:, [*(run.modalities.index(name) for name in shared), -1]]


def _nll(run: Trace) -> Array:
    """(T,) ``-ln N(truth; m, S)`` of the fused belief, nats in m and rad; NaN without a covariance."""
    if not run.has_covariance:
        return np.full(len(run), np.nan)
    n = run.estimate_mean.shape[-1]
    volume = np.linalg.slogdet(covariances(run)[:, -1]).logabsdet
    return 0.5 * (n * nees(run)[:, -1] + volume + n * math.log(2.0 * math.pi))


def _names(this: Trace, other: Trace) -> tuple[str, str]:
    """What tells the two apart: filter, faults, or both."""
    fault_sets = [str(run.faults) or "as recorded" for run in (this, other)]
    if this.filter == other.filter:
        return fault_sets[0], fault_sets[1]
    if fault_sets[0] == fault_sets[1]:
        return this.filter, other.filter
    return f"{this.filter}, {fault_sets[0]}", f"{other.filter}, {fault_sets[1]}"


def _row(kind: str, measure: str, both: Array, relative: bool = False) -> tuple[Value, ...]:
    """Both values, the other less this one and, where asked for, in % of this one."""
    first, second = (float(value) for value in both)
    change = 100.0 * (second - first) / first if relative and first else math.nan
    return (kind, measure, *(_number(value) for value in (first, second, second - first, change)))


def _change(share: float) -> str:
    if not math.isfinite(share):
        return "from none"
    if share > 1.0:
        return f"{1.0 + share:.1f} times as much"
    return "level" if abs(share) < LEVEL else f"{abs(100 * share):.0f} % {'more' if share > 0 else 'less'}"


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
