"""Ensembles and particles of equal weight: spread compared with error, rank histograms, collapse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beliefscope.datasets.task import Task, display_name
from beliefscope.datasets.text import percent, plural
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics.base import Diagnostic, Entry, drawn_steps
from beliefscope.inspect.diagnostics.views import Array, Curve, Line, Plot, Table
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace

EQUAL = 1e-4
"""Largest difference of log weights that are equal."""

LIMIT = 1.25
"""Ratio of error to spread, or its inverse, from which the spread does not match."""

BINS = 20
"""Largest number of bins of a rank histogram."""

COLLAPSED = 0.1
"""Ratio of the spread to the RMSE below which an ensemble has collapsed."""


@dataclass(frozen=True)
class ComponentEnsemble:
    """Ensemble statistics of one state component, SI units.

    Attributes:
        spread: root mean variance of the ensemble, times ``sqrt((M + 1) / M)``.
        error: root mean square error of the ensemble mean; equals the spread of a reliable ensemble (Fortin et al.,
            Why Should Ensemble Spread Match the RMSE of the Ensemble Mean?, 2014).
        correlation: between the logarithms of spread and absolute error over the steps: whether the spread predicts
            the error.
        outside: share of steps whose true value is outside of all members; 2 / (M + 1) if reliable.
        ranks: (B,) shares of steps by the rank of the true value among the members; flat if reliable.
        collapsed: share of steps whose spread is below ``COLLAPSED`` times the RMSE.
    """

    component: str
    spread: float
    error: float
    correlation: float
    outside: float
    ranks: Array
    collapsed: float

    @property
    def ratio(self) -> float:
        """Error over spread."""
        return self.error / max(self.spread, 1e-300)


@dataclass(frozen=True)
class Ensemble(Diagnostic):
    """Result of ``ensemble``.

    Attributes:
        task, filter, members, trajectories: names, M and number of traces.
        components: statistics by component.
        error, spread: (T, n) absolute error and spread by step of a single trace; (0, n) for several.
    """

    task: Task
    filter: str
    members: int
    trajectories: int
    components: tuple[ComponentEnsemble, ...]
    error: Array
    spread: Array

    @property
    def ratio(self) -> float:
        """Geometric mean over components of error over spread."""
        return float(np.exp(np.mean([np.log(max(c.ratio, 1e-300)) for c in self.components])))

    @property
    def status(self) -> str:
        """``reliable``, ``under-dispersed`` or ``over-dispersed``."""
        if self.ratio > LIMIT:
            return "under-dispersed"
        return "over-dispersed" if self.ratio < 1.0 / LIMIT else "reliable"

    @property
    def alarms(self) -> tuple[str, ...]:
        collapsed = [display_name(c.component) for c in self.components if c.collapsed]
        texts = [f"the ensemble collapses: {', '.join(collapsed)}"] if collapsed else []
        return (*(() if self.status == "reliable" else (f"the ensemble is {self.status}",)), *texts)

    @property
    def verdict(self) -> str:
        outside = float(np.mean([c.outside for c in self.components]))
        text = (
            f"The ensemble of {self.members} is {self.status}: its error is {self.ratio:.2g} times its spread. "
            f"The true state is outside of all members in {percent(outside, '.1f')} of steps "
            f"({200.0 / (self.members + 1):.1f} % if reliable)."
        )
        worst = max(self.components, key=lambda c: c.collapsed)
        if worst.collapsed:
            text += f" It collapses in {percent(worst.collapsed, '.1f')} of steps ({display_name(worst.component)})."
        best = max(self.components, key=lambda c: c.correlation)
        predictive = best.correlation > 0.3
        text += " Its spread " + ("predicts" if predictive else "does not predict") + " which steps have large errors"
        return f"{text} (correlation {best.correlation:z.2f})."

    def tables(self) -> list[Table]:
        rows = [
            {
                "component": display_name(c.component),
                "unit": unit,
                "spread": c.spread * factor,
                "RMSE": c.error * factor,
                "RMSE/spread": c.ratio,
                "spread-error correlation": c.correlation,
                "outside (% of steps)": 100.0 * c.outside,
                "collapsed (% of steps)": 100.0 * c.collapsed,
            }
            for c, unit, factor in zip(self.components, *measures.display_units(self.task), strict=True)
        ]
        return [Table.from_rows(f"Spread and skill, {plural(self.members, 'member')}", rows)]

    def plots(self) -> list[Plot]:
        bins = len(self.components[0].ranks)
        at = (np.arange(bins) + 0.5) / bins
        lines = [Line(display_name(c.component), at, bins * c.ranks) for c in self.components]
        flat = Line("reliable", np.array([0.0, 1.0]), np.ones(2), "truth")
        return [Plot("Rank histogram", "rank of the true value among the members", "density", (*lines, flat))]

    def curves(self) -> list[Curve]:
        units, scale = measures.display_units(self.task)
        return [
            Curve(name, values[:, i] * scale[i], display_name(c.component), units[i], layer)
            for i, c in enumerate(self.components)
            for name, values, layer in (("error", self.error, "truth"), ("spread", self.spread, "fused"))
            if len(values)
        ]


def why_not(trace: Trace, checkpoint: Checkpoint | None = None) -> str | None:
    """One-line reason why the diagnostic does not apply, or None."""
    if not has_equal_weights(trace):
        return f"filter {trace.filter} has no ensemble: particles of equal weight"
    if not np.isfinite(trace.episode.states).any():
        return "the true state is unknown"
    return None


def has_equal_weights(trace: Trace) -> bool:
    """Whether the trace has particles, all of the same weight."""
    if trace.particles is None or trace.log_weights is None or trace.particles.shape[1] < 2:
        return False
    return bool(np.ptp(trace.log_weights, axis=1).max(initial=0.0) < EQUAL)


def ensemble(traces: Sequence[Trace]) -> Ensemble:
    """Evaluate the ensembles of one filter over one or more episodes."""
    first, parts = traces[0], [_steps(trace) for trace in traces]
    where = np.concatenate([measures.counted(trace) for trace in traces])
    error, spread, rank = (np.concatenate(columns)[where] for columns in zip(*parts, strict=True))
    assert first.particles is not None
    members, keep = first.particles.shape[1], drawn_steps(traces)
    return Ensemble(
        task=first.task,
        filter=first.filter,
        members=members,
        trajectories=len(traces),
        components=tuple(
            _component(c.name, error[:, i], spread[:, i], rank[:, i], members)
            for i, c in enumerate(first.task.components)
        ),
        error=np.abs(parts[0][0][:keep]),
        spread=parts[0][1][:keep],
    )


def _steps(trace: Trace) -> tuple[Array, Array, Array]:
    """Error of the ensemble mean, spread and rank of the true value, (T, n) each; NaN where the truth is unknown."""
    assert trace.particles is not None
    task, truth = trace.task, trace.episode.states[:, None].astype(np.float64)
    deviation = task.difference(trace.particles.astype(np.float64), truth)
    centre = deviation.mean(1, keepdims=True)
    members = trace.particles.shape[1]
    spread = np.sqrt(np.square(deviation - centre).sum(1) / (members - 1) * (members + 1) / members)
    rank = np.where(np.isnan(centre[:, 0]), np.nan, (deviation < 0.0).sum(1))
    return centre[:, 0], spread, rank


def _component(name: str, error: Array, spread: Array, rank: Array, members: int) -> ComponentEnsemble:
    finite = np.isfinite(rank)
    error, spread, rank = error[finite], spread[finite], rank[finite]
    bins = min(BINS, members + 1)
    ranks, _ = np.histogram((rank + 0.5) / (members + 1), bins=bins, range=(0.0, 1.0))
    widths, _ = np.histogram((np.arange(members + 1) + 0.5) / (members + 1), bins=bins, range=(0.0, 1.0))
    density = ranks / max(len(rank), 1) / (widths * bins / (members + 1))
    logs = np.log(np.maximum(np.stack([np.abs(error), spread]), 1e-12))
    varies = len(error) > 2 and (logs.std(1) > 1e-9).all()
    return ComponentEnsemble(
        component=name,
        spread=float(np.sqrt(np.square(spread).mean())),
        error=float(np.sqrt(np.square(error).mean())),
        correlation=float(np.corrcoef(logs)[0, 1]) if varies else 0.0,
        outside=float(np.mean((rank == 0) | (rank == members))),
        ranks=density / density.sum(),
        collapsed=float(np.mean(spread < COLLAPSED * np.sqrt(np.square(error).mean()))),
    )


ENTRY = Entry(
    name="ensemble",
    title="Ensemble",
    question="Does the spread of the ensemble match its error, and does it collapse?",
    run=ensemble,
    why_not=why_not,
)
