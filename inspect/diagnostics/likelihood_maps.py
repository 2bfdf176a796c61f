"""Statistics of the likelihood maps of all steps: area, divergence and ridge orientation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics.base import Diagnostic, Entry
from beliefscope.inspect.diagnostics.views import Curve, Table, Value
from beliefscope.inspect.likelihood import COARSE, MapEngine, no_maps
from beliefscope.inspect.maps.statistics import MapStatistics, measure_maps
from beliefscope.inspect.statistics.measures import blackout, phases
from beliefscope.inspect.trace import Trace

Mask = NDArray[np.bool_]
ROUND = 1.3
"""Elongation below which the principal axis of a map is not meaningful."""

STEPS_AT_ONCE = 64
"""Number of maps processed together; limits memory to a few MB."""


@dataclass(frozen=True)
class MapSurvey(Diagnostic):
    """Statistics of the maps of all steps of one or more concatenated traces.

    Attributes:
        numbers: statistics of B steps.
        ridge_layers: modalities that observe the end effector, whose ridge orientation is evaluated.
        phases: phase -> mask (B,) without warm-up steps.
        trajectories: number of traces.
        size: cells per side.
        contact, blackout: (B,) masks including warm-up steps.
    """

    numbers: MapStatistics
    ridge_layers: tuple[str, ...]
    phases: dict[str, Mask]
    trajectories: int
    size: int
    contact: Mask
    blackout: Mask

    @property
    def verdict(self) -> str:
        if not self.ridge_layers:
            return "No modality observes the end effector, so there is no ridge orientation to evaluate."
        sentences = [self._ridge(layer) for layer in self.ridge_layers]
        return " ".join([*sentences, "A random orientation has a median of 45°."])

    def _ridge(self, layer: str) -> str:
        index, parts = self.numbers.layers.index(layer), []
        for phase in ("contact", "free motion"):
            mask = self.phases[phase]
            if not mask.any():
                continue
            low, median, high = np.percentile(np.degrees(self.numbers.off_line[mask, index]), (25, 50, 75))
            elongation = float(np.median(self.numbers.elongation[mask, index]))
            note = ", no distinct ridge" if elongation < ROUND else ""
            parts.append(
                f"{phase} {median:.0f}° (quartiles {low:.0f}° to {high:.0f}°) over {mask.sum()} steps, "
                f"elongation {elongation:.1f}{note}"
            )
        return (
            f"Median angle between the principal axis of the {layer} map and the line from the true position to the "
            f"end effector: {'; '.join(parts)}."
        )

    def tables(self) -> list[Table]:
        n = self.numbers
        rows: list[tuple[Value, ...]] = []
        fused = len(n.layers) - 1
        for i, layer in enumerate(n.layers):
            for phase, mask in self.phases.items():
                if not mask.any():
                    continue
                values = (
                    np.degrees(n.off_line[:, i]),
                    n.elongation[:, i],
                    1e4 * n.area50[:, i],
                    1e4 * n.area95[:, i],
                    n.entropy[:, i] + np.log(1e4),
                    n.truth[:, i],
                    n.divergence[:, i, fused],
                    n.overlap[:, i, fused],
                )
                medians = [round(float(np.median(value[mask])), 3) for value in values]
                rows.append((layer, phase, int(mask.sum()), *(v if np.isfinite(v) else None for v in medians)))
        columns = ("map", "phase", "steps", "angle to line (deg)", "elongation", "50 % area (cm²)", "95 % area (cm²)")
        more = ("entropy (nats, per cm²)", "ln p(true position) / max", "KL to fused (nats)", "overlap with fused")
        return [Table("Medians over steps", (*columns, *more), tuple(rows))]

    def curves(self) -> list[Curve]:
        if self.trajectories > 1:
            return []
        n, curves = self.numbers, []
        for layer in self.ridge_layers:
            angle = np.degrees(n.off_line[:, n.layers.index(layer)])
            curves.append(
                Curve(
                    layer, angle, "Angle between principal axis and line to the end effector", "°", layer, (0.0, 45.0)
                )
            )
        for i, layer in enumerate(n.layers):
            curves.append(Curve(layer, 1e4 * n.area95[:, i], "95 % area", "cm²", layer))
        for i, layer in enumerate(n.layers[:-1]):
            curves.append(Curve(layer, n.divergence[:, i, -1], "KL divergence to the fused map", "nats", layer))
        return curves

    def bands(self) -> dict[str, Mask]:
        return {} if self.trajectories > 1 else {"contact": self.contact, "blackout": self.blackout}


def maps(
    traces: Sequence[Trace],
    checkpoint: Checkpoint,
    size: int = COARSE,
    progress: Callable[[float], None] | None = None,
) -> MapSurvey:
    """Evaluate the maps of all steps at the true angle. Raises BadInput for a filter without maps."""
    parts, masks = [], []
    for i, trace in enumerate(traces):
        engine = MapEngine(checkpoint, trace)
        for first in range(0, len(trace), STEPS_AT_ONCE):
            steps = range(first, min(first + STEPS_AT_ONCE, len(trace)))
            parts.append(measure_maps(list(engine.maps(steps, size)), trace))
            if progress is not None:
                progress((i + steps.stop / len(trace)) / len(traces))
        masks.append(phases(trace))
    joined = {
        f.name: np.concatenate([getattr(part, f.name) for part in parts])
        for f in fields(MapStatistics)
        if f.name != "layers"
    }
    keys = checkpoint.task.modalities
    ridge_layers = tuple(
        name for name in parts[0].layers[:-1] if any("effector_position" in keys.get(m, ()) for m in name.split("+"))
    )
    pooled = {phase: np.concatenate([mask[phase] for mask in masks]) for phase in masks[0]}
    contact = np.concatenate([trace.episode.contact.astype(bool) for trace in traces])
    blackouts = np.concatenate([blackout(trace) for trace in traces])
    return MapSurvey(
        MapStatistics(layers=parts[0].layers, **joined), ridge_layers, pooled, len(traces), size, contact, blackouts
    )


ENTRY = Entry(
    name="maps",
    title="Likelihood maps",
    question="Which positions does each modality consider likely, and does the haptics map have a ridge towards the "
    "end effector?",
    run=maps,
    why_not=lambda trace, checkpoint: None if checkpoint is None else no_maps(checkpoint, trace),
    needs="checkpoint",
    slow=True,
    options={"size": "cells per side, 41 by default"},
)
