"""Modalities as updates and standalone: what each contributes to the fused filter, and what it is worth by itself.

The update of a modality starts at every step from the fused prior, which other modalities have informed; the standalone
filter never uses them (``inspect/standalone.py``). Only the latter shows if fusion is better than one sensor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beliefscope.datasets.task import display_name
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.engine import Progress
from beliefscope.filters.subsets import modalities_of
from beliefscope.inspect.diagnostics.base import Entry, RunDiagnostic, drawn_steps, fields_of
from beliefscope.inspect.diagnostics.views import Array, Curve, Table
from beliefscope.inspect.standalone import removal_note, standalone_errors
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.intervals import jackknife, too_few
from beliefscope.inspect.trace import Trace


@dataclass(frozen=True)
class PhaseErrors:
    """Root mean square errors in one phase, of the position and of each component, m and rad.

    Attributes:
        phase: phase name.
        trajectories, steps: number of episodes and steps in the phase.
        fused: (1 + n,) of the filter.
        updates: (K, 1 + n) of the single-modality updates; NaN for a modality without one.
        standalone: (K, 1 + n) of the standalone filters.
        ratio: (K,) position RMSE of the filter over that of each standalone filter: below 1, fusion is better.
        low, high: (K,) 95 % intervals of ``ratio`` over episodes; NaN for too few of them.
    """

    phase: str
    trajectories: int
    steps: int
    fused: Array
    updates: Array
    standalone: Array
    ratio: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class StandaloneModalities(RunDiagnostic):
    """Result of ``standalone_modalities``; K modalities, n components, T steps of a single trace (0 for several).

    Attributes:
        modalities: K names.
        phases: errors by phase.
        fused: (T,) m, position error of the filter.
        updates, standalone: (T, K) m, position errors of the updates and of the standalone filters.
        note: ``removal_note`` of the filter.
    """

    modalities: tuple[str, ...]
    phases: tuple[PhaseErrors, ...]
    fused: Array
    updates: Array
    standalone: Array
    note: str = ""

    @property
    def verdict(self) -> str:
        return f"{self._result()} {self.note}".strip()

    def _result(self) -> str:
        total, main = self.phases[0], self.task.main_error
        numbers = []
        for name, update, alone in zip(self.modalities, total.updates[:, 0], total.standalone[:, 0], strict=True):
            parts = [] if math.isnan(update) else [f"{main.text(update)} for the {measures.layer_label(name)}"]
            numbers.append(" and ".join([*parts, f"{main.text(alone)} for {display_name(name)} standalone"]))
        k = int(total.standalone[:, 0].argmin())
        sentences = [f"{main.title} RMSE {main.text(total.fused[0])} fused; {'; '.join(numbers)}."]
        ratio = f"fused / {display_name(self.modalities[k])} standalone {total.ratio[k]:.2f}"
        if math.isnan(total.low[k]):
            sentences.append(f"Ratio {ratio}; no interval: {too_few(total.trajectories)}.")
            return " ".join(sentences)
        low, high = total.low[k], total.high[k]
        result = (
            f"Fusion is more accurate than {display_name(self.modalities[k])}, the best standalone modality"
            if high < 1.0
            else f"Standalone {display_name(self.modalities[k])} is more accurate than fusion"
            if low > 1.0
            else f"Fusion and {display_name(self.modalities[k])} standalone do not differ significantly"
        )
        sentences.append(f"{result} ({ratio}, 95 % interval {low:.2f} to {high:.2f}).")
        return " ".join(sentences)

    def tables(self) -> list[Table]:
        rows, ratios = [], []
        for entry in self.phases:
            for q, name, factor in measures.quantities(self.task):
                row = {"phase": entry.phase, "steps": entry.steps, "quantity": name, "fused": factor * entry.fused[q]}
                for k, modality in enumerate(self.modalities):
                    row[measures.layer_label(modality)] = factor * entry.updates[k, q]
                    row[f"{display_name(modality)} standalone"] = factor * entry.standalone[k, q]
                rows.append(row)
            for name, *values in zip(self.modalities, entry.ratio, entry.low, entry.high, strict=True):
                ratios.append((entry.phase, entry.steps, display_name(name), *values))
        title = f"Fused / standalone, {self.task.main_error.name} RMSE"
        return [
            Table.from_rows("RMSE of updates and standalone filters", rows),
            Table(title, ("phase", "steps", "standalone modality", "ratio", "95 % from", "to"), ratios),
        ]

    def curves(self) -> list[Curve]:
        if not len(self.fused):
            return []
        main = self.task.main_error
        chart, scale, unit = f"{main.title} error", main.factor, main.unit
        curves = [Curve("fused", scale * self.fused, chart, unit, "fused")]
        for k, name in enumerate(self.modalities):
            if np.isfinite(self.updates[:, k]).any():
                curves.append(Curve(measures.layer_label(name), scale * self.updates[:, k], chart, unit, name))
            curves.append(Curve(f"{display_name(name)} standalone", scale * self.standalone[:, k], chart, unit, name))
        return curves


def of_standalone_run(trace: Trace) -> str | None:
    """Reason against a trace of a single modality, or None."""
    name = trace.settings.get("standalone")
    return None if name is None else f"the trace is of a standalone run of {name}"


def why_not(trace: Trace, checkpoint: Checkpoint | None) -> str | None:
    """One-line reason why the diagnostic does not apply, or None."""
    if why := of_standalone_run(trace):
        return why
    if checkpoint is not None and len(modalities_of(checkpoint)) < 2:
        return f"filter {trace.filter} has one modality: it is the standalone filter"
    return None


def standalone_modalities(
    traces: Sequence[Trace], checkpoint: Checkpoint, progress: Progress = None
) -> StandaloneModalities:
    """Run the standalone filter of every modality over the episodes of one or more traces, and compare all errors."""
    modalities = modalities_of(checkpoint)
    alone = standalone_errors(traces, checkpoint, progress)
    errors = [_with_position(trace, modalities, values) for trace, values in zip(traces, alone, strict=True)]
    position = errors[0][: drawn_steps(traces), :, 0]
    return StandaloneModalities(
        **fields_of(traces),
        modalities=modalities,
        phases=_phases(traces, errors, len(modalities)),
        fused=position[:, 0],
        updates=position[:, 1 : 1 + len(modalities)],
        standalone=position[:, 1 + len(modalities) :],
        note=removal_note(checkpoint),
    )


def _with_position(trace: Trace, modalities: Sequence[str], alone: Array) -> Array:
    """(T, 1 + 2 K, 1 + n): absolute position and component errors of filter, updates and standalone runs."""
    error = measures.errors(trace)
    updates = np.full((len(trace), len(modalities), error.shape[-1]), np.nan)
    for k, modality in enumerate(modalities):
        if modality in trace.modalities_with_posterior:
            updates[:, k] = error[:, trace.modalities.index(modality)]
    both = np.concatenate([error[:, -1:], updates, alone], axis=1)
    return np.abs(measures.with_main(trace.task, both))


def _phases(traces: Sequence[Trace], errors: Sequence[Array], count: int) -> tuple[PhaseErrors, ...]:
    """RMSE pooled over the steps of all traces, by phase."""
    result = []
    for phase, (steps, sums) in measures.phase_sums(traces, [np.square(e) for e in errors]).items():
        rmse = np.sqrt(sums.sum(0) / steps.sum())
        alone = rmse[1 + count :]
        logarithms = jackknife(sums[:, :, 0], lambda s: 0.5 * np.log(s[..., :1] / s[..., 1 + count :]))
        ratio, low, high = (np.exp(value) for value in logarithms)
        result.append(
            PhaseErrors(phase, len(steps), int(steps.sum()), rmse[0], rmse[1 : 1 + count], alone, ratio, low, high)
        )
    return tuple(result)


ENTRY = Entry(
    name="standalone",
    title="Standalone modalities",
    question="How accurate is each modality by itself, and is fusion more accurate?",
    run=standalone_modalities,
    why_not=why_not,
    needs="filter",
    slow=True,
)
