"""Consistency: whether a filter errs by as much as it says, by layer and by kind of step.

A covariance S is true when ``e^T S^-1 e`` averages to n. Where it is more, the filter is over-confident, by the root
of the ratio: so much too small is the standard deviation that it states.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from beliefscope.datasets.catalog import find_task
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.training.study import nees_bounds
from beliefscope.inspect.diagnostics.base import Curve, Diagnostic, Entry, Line, Plot, Table, Value
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.calibration import (
    LAGS,
    LEVELS,
    calibration_curve,
    gaussian_crps,
    gaussian_level,
    ljung_box,
    particle_crps,
    particle_level,
)
from beliefscope.inspect.trace import Trace

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ALL, FUSED = "all", "fused"

FEWEST = 5
"""Trajectories without which being inside the bounds says little."""

FEWEST_STEPS = 10
"""Of a kind before the verdict speaks of it."""


@dataclass(frozen=True)
class LayerConsistency:
    """One layer on one kind of step.

    Attributes:
        layer: modality or ``fused``. split: kind of step. trajectories, steps: that have it.
        nees: mean of ``e^T S^-1 e / n``. bounds: where 95 % of consistent filters lie, with one independent error a
            trajectory. nis: the same of the innovations over ``P + R``; NaN where there are none.
        coverage95: share of steps whose truth lies in the 95 % region.
        calibration: (P,) the share at each of ``LEVELS``. miscalibration: its mean distance from them.
        nll: mean negative log-density of the truth under the Gaussian, nats in m and rad.
        rmse, sharpness, crps: (n,) m, rad: root mean square error, root mean stated variance, mean CRPS.
    """

    layer: str
    split: str
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
        """How much too small the stated standard deviation is; below 1 where it is too large."""
        return math.sqrt(self.nees)

    @property
    def judgement(self) -> str:
        """``consistent`` inside the bounds; else by how much it is over- or under-confident."""
        low, high = self.bounds
        if self.nees > high:
            return f"over-confident by {_times(self.factor)}"
        return f"under-confident by {_times(1.0 / self.factor)}" if self.nees < low else "consistent"

    @property
    def evidence(self) -> str:
        """The numbers behind it."""
        low, high = self.bounds
        return f"NEES/n {_number(self.nees)}, 95 % bounds {low:.2f} to {high:.2f}"


@dataclass(frozen=True)
class Whiteness:
    """Whether the innovations of one modality in one component carry no news of the next, as those of a right model do.

    Attributes:
        autocorrelation: at lag 1, mean over trajectories. statistic: Ljung and Box's, summed over them.
        freedom: its degrees of freedom where white. p: chance of so large a one.
    """

    modality: str
    component: str
    autocorrelation: float
    statistic: float
    freedom: int
    p: float


@dataclass(frozen=True)
class Consistency(Diagnostic):
    """Result of ``consistency``.

    Attributes:
        task: its name. filter: its name. trajectories: how many traces.
        by_layer: every layer on every kind of step that there is. whiteness: by modality and component; Kalman filters.
        levels: (P,) of the calibration curves.
        nees, nis: (T, L), (T, K) over n, at the steps of a lone trace; (0, L) of several.
        contact, blackout: (T,) its steps.
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

    def of(self, layer: str, split: str = ALL) -> LayerConsistency:
        """The numbers of a layer on a kind of step. Raises KeyError where there is no such step."""
        return {(one.layer, one.split): one for one in self.by_layer}[layer, split]

    @property
    def layers(self) -> tuple[str, ...]:
        """The modalities, then ``fused``."""
        return tuple(dict.fromkeys(one.layer for one in self.by_layer))

    @property
    def splits(self) -> tuple[str, ...]:
        """Kinds of steps that there are."""
        return tuple(dict.fromkeys(one.split for one in self.by_layer))

    @property
    def verdict(self) -> str:
        whole = self.of(FUSED)
        judgement = whole.judgement
        if judgement == "consistent" and self.trajectories < FEWEST:
            judgement += (
                f" as far as {self.trajectories} trajector{'y tells' if self.trajectories == 1 else 'ies tell'}"
            )
        parts = [_sentence(f"{judgement} ({whole.evidence})")]
        enough = [one for one in self.by_layer if one.steps >= FEWEST_STEPS]
        kinds = [one for one in enough if one.layer == FUSED and one.split != ALL]
        worst = max(kinds, key=_strangeness, default=whole)
        if worst.judgement != "consistent" and _strangeness(worst) > _strangeness(whole) + 2.0 * math.log(1.1):
            parts.append(f"Worst in {worst.split}: {worst.judgement} ({worst.evidence}).")
        elif kinds and all(one.judgement == "consistent" for one in (whole, *kinds)):
            parts.append(f"So it is in each kind of step: {', '.join(one.split for one in kinds)}.")
        alone = [one for one in enough if one.layer != FUSED]
        if len(self.layers) > 2 and alone:
            worst = max(alone, key=_strangeness)
            of = "each modality alone is consistent"
            if worst.judgement != "consistent":
                of = (
                    f"worst alone is {worst.layer} in {_steps(worst)}, {worst.judgement} (NEES/n {_number(worst.nees)})"
                )
            parts.append(_sentence(of))
        if self.whiteness:
            parts.append(self._of_innovations())
        return " ".join(parts)

    def _of_innovations(self) -> str:
        one = max(self.whiteness, key=lambda one: abs(one.autocorrelation))
        if min(other.p for other in self.whiteness) > 0.05 / len(self.whiteness):
            return "Innovations are white."
        size = _number(math.sqrt(self.of(one.modality).nis))
        where = f"{one.modality}, {one.component}: autocorrelation {one.autocorrelation:.2f} at lag 1"
        text = f"innovations are not white ({where}) and {size} x as large as stated"
        if one.autocorrelation > 0.2:
            text += ": one error returns at every step, and the filter counts it as new evidence each time"
        return _sentence(text)

    def tables(self) -> list[Table]:
        task = find_task(self.task)
        units, scale = measures.shown_units(task)
        rows: list[tuple[Value, ...]] = []
        wide: list[tuple[Value, ...]] = []
        for one in self.by_layer:
            low, high = one.bounds
            nis = None if math.isnan(one.nis) else one.nis
            head = (one.layer, one.split)
            found = (one.trajectories, one.steps, one.nees, f"{low:.2f} to {high:.2f}", nis, one.coverage95)
            rows.append((*head, *found, one.miscalibration, one.nll, one.judgement))
            each = zip(one.rmse * scale, one.sharpness * scale, one.crps * scale, strict=True)
            wide.append((*head, *(float(value) for three in each for value in three)))
        columns = ("layer", "steps", "trajectories", "count", "NEES/n", "95 % bounds", "NIS/n", "coverage of 95 %")
        tables = [Table("Consistency", (*columns, "miscalibration", "NLL (nats)", "judgement"), tuple(rows))]
        names = [f"{c.name} ({unit}): {what}" for c, unit in zip(task.components, units, strict=True) for what in WIDE]
        tables.append(Table("Errors beside what is stated", ("layer", "steps", *names), tuple(wide)))
        if self.whiteness:
            white = tuple(
                (one.modality, one.component, one.autocorrelation, one.statistic, one.freedom, one.p)
                for one in self.whiteness
            )
            heads = ("modality", "component", "autocorrelation at lag 1", "Ljung-Box Q", "degrees of freedom", "p")
            tables.append(Table("Whiteness of the innovations", heads, white))
        return tables

    def curves(self) -> list[Curve]:
        """Roots of NEES / n and NIS / n: errors in stated standard deviations, within bounds 95 % of the time."""
        if not len(self.nees):
            return []
        low, high = nees_bounds(len(find_task(self.task).components), 1)
        bounds = (math.sqrt(low), math.sqrt(high))
        charts = [("Error in stated standard deviations (root of NEES/n)", "error", self.nees, self.layers)]
        if self.nis.size:
            title = "Innovation in stated standard deviations (root of NIS/n)"
            charts.append((title, "innovation", self.nis, self.layers[:-1]))
        return [
            Curve(f"{layer} {what}", np.sqrt(values[:, k]), chart, "standard deviations", layer, bounds)
            for chart, what, values, names in charts
            for k, layer in enumerate(names)
        ]

    def bands(self) -> dict[str, Mask]:
        return {"contact": self.contact, "blackout": self.blackout} if len(self.nees) else {}

    def plots(self) -> list[Plot]:
        plots = []
        for split in self.splits:
            lines = [
                Line(one.layer, self.levels, one.calibration, one.layer) for one in self.by_layer if one.split == split
            ]
            title = f"Calibration, {'all steps' if split == ALL else split}"
            plots.append(Plot(title, "level of the region", "share of truths in it", tuple(lines), diagonal=True))
        return plots


WIDE = ("RMSE", "stated", "CRPS")


def why_not(trace: Trace, checkpoint: Checkpoint | None = None) -> str | None:
    """In one line; None where it can be made."""
    if not trace.has_covariance or not np.isfinite(trace.estimate_covariance).any():
        return f"{trace.filter} states no covariance, so there is nothing that its errors could be held against"
    return None


def consistency(traces: Sequence[Trace]) -> Consistency:
    """Consistency of one filter, over one or several trajectories."""
    first = traces[0]
    made = [_measured(trace) for trace in traces]
    pooled = {name: np.concatenate([one[name] for one in made]) for name in made[0]}
    owner, splits = measures.owners(traces), measures.pooled_splits(traces)
    by_layer = []
    for k, layer in enumerate(measures.layers(first)):
        for split, where in splits.items():
            steps = {name: values[where, k] for name, values in pooled.items()}
            # Of a filter that is not ours, what a modality alone believes may not be known.
            if np.isfinite(steps["nees"]).any():
                by_layer.append(_of_steps(layer, split, len(np.unique(owner[where])), steps))
    lone = len(traces) == 1
    keep = len(first) if lone else 0
    contact, black = first.episode.contact.astype(bool), measures.blackout(first)
    has_nis = first.observation_mean is not None
    return Consistency(
        task=first.episode.task,
        filter=first.filter,
        trajectories=len(traces),
        by_layer=tuple(by_layer),
        whiteness=tuple(_whiteness(traces)),
        levels=LEVELS,
        nees=pooled["nees"][:keep],
        nis=pooled["nis"][:keep, : len(first.modalities) if has_nis else 0],
        contact=contact[:keep],
        blackout=black[:keep],
    )


def innovations(trace: Trace) -> tuple[Array, Array] | None:
    """``z - H x`` (T, K, n), angles wrapped, and ``P + R`` (T, K, n, n), H = I; None but for Kalman filters."""
    parts = (
        trace.observation_mean,
        trace.predicted_mean,
        trace.observation_covariance,
        trace.predicted_covariance,
    )
    if any(part is None for part in parts):
        return None
    z, predicted, r, p = (np.asarray(part, dtype=np.float64) for part in parts)
    return measures.wrapped(measures.task_of(trace), z - predicted), p + r


def _measured(trace: Trace) -> dict[str, Array]:
    """By step and layer, (T, L, ...): what the numbers are means of."""
    task = measures.task_of(trace)
    error, covariance = measures.errors(trace), measures.covariances(trace)
    n = error.shape[-1]
    nees = measures.nees(trace)
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    nis = np.full(nees.shape, np.nan)
    if (found := innovations(trace)) is not None:
        nu, s = found
        nis[:, :-1] = np.einsum("tkn,tkn->tk", nu, np.linalg.solve(s, nu[..., None])[..., 0]) / n
    if trace.log_likelihood is None or trace.prior_log_weights is None:
        level = gaussian_level(n * nees, n)
        crps = gaussian_crps(error, np.sqrt(variance))
    else:
        assert trace.particles is not None
        level, crps = np.empty(nees.shape), np.empty(error.shape)
        away = measures.wrapped(task, trace.particles - trace.episode.states[:, None])
        weights = np.exp(measures.particle_log_weights(trace))
        for k in range(error.shape[1]):  # layer by layer: (T, M, n) is large enough
            from_mean = measures.wrapped(task, away - error[:, k, None])
            level[:, k] = particle_level(from_mean, weights[:, k], error[:, k], covariance[:, k])
            crps[:, k] = particle_crps(np.swapaxes(away, 1, 2), weights[:, k, None])
    nll = 0.5 * (n * nees + np.linalg.slogdet(covariance)[1] + n * math.log(2.0 * math.pi))
    return {"error": error, "variance": variance, "nees": nees, "nis": nis, "level": level, "nll": nll, "crps": crps}


def _of_steps(layer: str, split: str, trajectories: int, steps: dict[str, Array]) -> LayerConsistency:
    error, level = steps["error"], steps["level"]
    curve = calibration_curve(level)
    return LayerConsistency(
        layer=layer,
        split=split,
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


def _whiteness(traces: Sequence[Trace]) -> list[Whiteness]:
    """Of innovations over their stated standard deviations; trajectories are independent, so their statistics add."""
    found: list[tuple[Array, Array]] = []
    for trace in traces:
        both = innovations(trace)
        keep = measures.counted(trace)
        if both is None or keep.sum() <= 2 * LAGS:
            continue
        nu, s = both
        normalised = nu / np.sqrt(np.diagonal(s, axis1=-2, axis2=-1))
        found.append(ljung_box(normalised[keep].reshape(keep.sum(), -1)))
    if not found:
        return []
    statistic, correlation = np.sum([q for q, _ in found], axis=0), np.mean([r for _, r in found], axis=0)
    freedom = LAGS * len(found)
    pairs = [(m, c.name) for m in traces[0].modalities for c in measures.task_of(traces[0]).components]
    return [
        Whiteness(modality, component, float(r), float(q), freedom, float(chdtrc(freedom, q)))
        for (modality, component), q, r in zip(pairs, statistic, correlation, strict=True)
    ]


def _strangeness(one: LayerConsistency) -> float:
    """How far NEES / n is from 1, over and under alike."""
    return abs(math.log(one.nees)) if one.nees > 0 else math.inf


def _steps(one: LayerConsistency) -> str:
    return "all steps" if one.split == ALL else one.split


def _times(value: float) -> str:
    return f"{_number(value)} x"


def _number(value: float) -> str:
    return f"{value:.2g}" if value < 10 else f"{value:.0f}"


def _sentence(text: str) -> str:
    return text[0].upper() + text[1:] + "."


ENTRY = Entry(
    name="consistency",
    title="Consistency",
    question="Does the filter err by as much as it says, and where not?",
    run=consistency,
    why_not=why_not,
)
