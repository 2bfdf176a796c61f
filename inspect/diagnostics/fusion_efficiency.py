"""Fusion efficiency: achieved error against the best that the modalities' own errors and their correlation allow.

The standalone filters (``inspect/standalone.py``) measure the accuracy of each modality. The best linear
combination of their estimates, with constant weights in contact and free motion, each with and without image blackout,
is the reference. ``fusion_gaps.py`` measures the reasons for a gap.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.task import display_name
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.engine import Progress
from beliefscope.filters.subsets import modalities_of
from beliefscope.inspect.diagnostics.base import Entry, RunDiagnostic, drawn_steps, fields_of
from beliefscope.inspect.diagnostics.fusion_gaps import Reason, reasons_of
from beliefscope.inspect.diagnostics.standalone_modalities import why_not
from beliefscope.inspect.diagnostics.views import Array, Curve, Table
from beliefscope.inspect.standalone import removal_note, standalone_errors
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.intervals import jackknife, too_few
from beliefscope.inspect.statistics.measures import GROUPS, Mask
from beliefscope.inspect.statistics.oracle import squared_error, unbiased_weights
from beliefscope.inspect.trace import Trace

GAIN = 0.95
"""Ratio of the fused error to that of the best standalone filter from which fusion gains little."""


@dataclass(frozen=True)
class PhaseEfficiency:
    """Root mean square errors in one phase, of the position and of each component, m and rad.

    Attributes:
        phase: phase name.
        trajectories, steps: number of episodes and steps in the phase.
        fused: (1 + n,) of the filter.
        standalone: (K, 1 + n) of the standalone filters.
        best: (1 + n,) of the best linear combination of the standalone estimates.
        independent: (1 + n,) of the best combination if the standalone errors were not correlated.
        correlation: (1 + n,) of the standalone errors about zero, mean over pairs of modalities.
        efficiency: (1 + n,) ``best / fused``.
        low, high: (1 + n,) 95 % intervals of ``efficiency`` over episodes; NaN for too few of them.
    """

    phase: str
    trajectories: int
    steps: int
    fused: Array
    standalone: Array
    best: Array
    independent: Array
    correlation: Array
    efficiency: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class FusionEfficiency(RunDiagnostic):
    """Result of ``fusion_efficiency``; K modalities, T steps of a single trace (0 for several).

    Attributes:
        modalities: K names.
        phases: efficiencies by phase.
        reasons: all measured reasons for a gap, contributing or not.
        fused, best: (T,) m, position errors of the filter and of the best combination.
        standalone: (T, K) m, position errors of the standalone filters.
        note: ``removal_note`` of the filter.
    """

    modalities: tuple[str, ...]
    phases: tuple[PhaseEfficiency, ...]
    reasons: tuple[Reason, ...]
    fused: Array
    best: Array
    standalone: Array
    note: str = ""

    @property
    def verdict(self) -> str:
        return f"{self._result()} {self.note}".strip()

    def _result(self) -> str:
        total = self.phases[0]
        main = self.task.main_error
        alone = [
            f"{display_name(name)} {main.text(x)}"
            for name, x in zip(self.modalities, total.standalone[:, 0], strict=True)
        ]
        errors = f"{', '.join(alone)}; correlation {total.correlation[0]:z.2f}"
        sentence = (
            f"{main.title} RMSE {main.text(total.fused[0])}{self._gain()}; the standalone errors ({errors}) allow "
            f"{main.text(total.best[0])}: efficiency {total.efficiency[0]:.2f}"
        )
        if math.isnan(total.low[0]):
            return f"{sentence}. No interval and no reasons: {too_few(self.trajectories)}."
        sentence = f"{sentence} (95 % interval {total.low[0]:.2f} to {total.high[0]:.2f})."
        if total.high[0] >= 1.0:
            return f"{sentence} No significant gap."
        texts = [reason.headline for reason in self.reasons if reason.contributes]
        if not texts:
            return f"{sentence} None of the {len(self.reasons)} measured reasons is significant."
        return f"{sentence} Reasons: {'; '.join(texts)}."

    def _gain(self) -> str:
        """That the fused error is hardly below that of the best standalone filter; empty if it is well below."""
        total = self.phases[0]
        best = int(np.argmin(total.standalone[:, 0]))
        ratio = float(total.fused[0] / total.standalone[best, 0])
        if not ratio > GAIN:
            return ""
        gain = "little" if ratio < 1.0 else "nothing"
        return f", {ratio:.2f} times that of the {display_name(self.modalities[best])}-only filter: fusion gains {gain}"

    def tables(self) -> list[Table]:
        standalone = [f"{display_name(name)} standalone" for name in self.modalities]
        rows = [
            {
                "phase": entry.phase,
                "steps": entry.steps,
                "quantity": name,
                "fused": factor * entry.fused[q],
                **dict(zip(standalone, factor * entry.standalone[:, q], strict=True)),
                "best combination": factor * entry.best[q],
                "if uncorrelated": factor * entry.independent[q],
                "correlation": entry.correlation[q],
                "efficiency": entry.efficiency[q],
                "95 % from": entry.low[q],
                "to": entry.high[q],
            }
            for entry in self.phases
            for q, name, factor in measures.quantities(self.task)
        ]
        tables = [Table.from_rows("Errors of fusion and of the best combination", rows)]
        reasons = [reason.row() for reason in self.reasons]
        return [*tables, *([Table.from_rows("Reasons for a gap", reasons)] if reasons else [])]

    def curves(self) -> list[Curve]:
        if not len(self.fused):
            return []
        main = self.task.main_error
        chart = f"{main.title} error"
        alone = [
            Curve(f"{display_name(name)} standalone", main.factor * self.standalone[:, k], chart, main.unit, name)
            for k, name in enumerate(self.modalities)
        ]
        best = Curve("best combination", main.factor * self.best, chart, main.unit, "truth")
        return [Curve("fused", main.factor * self.fused, chart, main.unit, "fused"), *alone, best]


def fusion_efficiency(traces: Sequence[Trace], checkpoint: Checkpoint, progress: Progress = None) -> FusionEfficiency:
    """Run the standalone filter of every modality over the episodes of one or more traces, and compare all errors."""
    return efficiency_of(traces, checkpoint, standalone_errors(traces, checkpoint, progress))


def efficiency_of(traces: Sequence[Trace], checkpoint: Checkpoint, alone: Sequence[Array]) -> FusionEfficiency:
    """The result, given the errors (T, K, n) of the standalone filters by trace."""
    first, where = traces[0], list(traces[0].task.main_error.indices)
    errors = [
        np.concatenate([measures.errors(trace)[:, -1:], e], axis=1) for trace, e in zip(traces, alone, strict=True)
    ]
    groups = [measures.group_masks(trace) for trace in traces]
    moments = np.stack([_moments(e, mask, where) for e, mask in zip(errors, groups, strict=True)])
    steps = np.stack([mask.sum(-1) for mask in groups])
    keep = drawn_steps(traces)
    weights = unbiased_weights(moments[0, 0, :, 1:, 1:])[measures.group_index(first)]  # (T, K), of the position
    best = np.einsum("tk,tkn->tn", weights, errors[0][:, 1:])
    position = np.linalg.norm(errors[0][..., where], axis=-1)[:keep]
    return FusionEfficiency(
        **fields_of(traces),
        modalities=modalities_of(checkpoint),
        phases=tuple(
            _phase(name, moments, steps, list(members))
            for name, members in GROUPS.items()
            if name in measures.phases(first)
            if steps[:, list(members)].any()
        ),
        reasons=reasons_of(traces, checkpoint),
        fused=position[:, 0],
        best=np.linalg.norm(best[..., where], axis=-1)[:keep],
        standalone=position[:, 1:],
        note=removal_note(checkpoint),
    )


def _moments(errors: Array, groups: Mask, where: list[int]) -> Array:
    """(1 + n, G, 1 + K, 1 + K): products of errors (T, 1 + K, n) summed over groups (G, T)."""
    products = np.einsum("gt,tan,tbn->ngab", groups, errors, errors, optimize=True)
    return np.concatenate([products[where].sum(0, keepdims=True), products])


@np.errstate(divide="ignore", invalid="ignore")  # a few steps can be combined without an error
def _phase(name: str, moments: Array, steps: NDArray[np.int64], members: list[int]) -> PhaseEfficiency:
    """Efficiency in a phase. Args: moments (R, 1 + n, G, 1 + K, 1 + K), steps (R, G), members: groups of the phase."""
    has = steps[:, members].any(-1)
    sums, count = moments[has][:, :, members], int(steps[:, members].sum())
    logarithm, low, high = jackknife(sums, lambda s: 0.5 * np.log(_best(s) / s[..., 0, 0].sum(-1)))
    total = sums.sum(0)
    pooled = total.sum(1)  # (1 + n, 1 + K, 1 + K)
    rmse = np.sqrt(np.einsum("qkk->qk", pooled) / count)
    own = np.einsum("qgkk->qgk", total)[..., 1:]
    scale = np.einsum("qkk->qk", pooled[:, 1:, 1:])
    correlation = pooled[:, 1:, 1:] / np.sqrt(scale[:, :, None] * scale[:, None])
    pairs = np.triu_indices(correlation.shape[-1], 1)
    return PhaseEfficiency(
        phase=name,
        trajectories=int(has.sum()),
        steps=count,
        fused=rmse[:, 0],
        standalone=rmse[:, 1:].T,
        best=np.sqrt(_best(total) / count),
        independent=np.sqrt(_best(own[..., None] * np.eye(own.shape[-1]), 0) / count),
        correlation=correlation[:, pairs[0], pairs[1]].mean(-1),
        efficiency=np.exp(logarithm),
        low=np.exp(low),
        high=np.exp(high),
    )


def _best(moments: Array, first: int = 1) -> Array:
    """(...) sum over groups of the squared error of the best combination; moments (..., G, L, L), K from ``first``."""
    gram = moments[..., first:, first:]
    return squared_error(unbiased_weights(gram), gram).sum(-1)


ENTRY = Entry(
    name="efficiency",
    title="Fusion efficiency",
    question="How close is the fused error to the best that the modalities allow, and which property causes the gap?",
    run=fusion_efficiency,
    why_not=why_not,
    needs="filter",
    slow=True,
)
