"""Likelihood maps of every step as a diagnostic: how wide they are, how they differ, and where their ridges point."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics.base import Curve, Diagnostic, Entry, Table, Value
from beliefscope.inspect.likelihood import COARSE, MapEngine, no_maps
from beliefscope.inspect.maps.statistics import MapNumbers, measure_maps
from beliefscope.inspect.statistics.measures import blackout, splits
from beliefscope.inspect.trace import Trace

Mask = NDArray[np.bool_]
ROUND = 1.3
"""Times as long as wide below which a map's long axis says little."""

STEPS_AT_ONCE = 64
"""Maps measured together: their sorted cells stay in a few MB."""


@dataclass(frozen=True)
class Maps(Diagnostic):
    """Numbers of the maps of all steps of one or more traces, end to end.

    Attributes:
        numbers: of B steps. felt: the layers whose ridge is spoken of: modalities that know where the hand is.
        kinds: kind of step -> mask (B,), first steps of each trace left out. trajectories: traces. size: cells a side.
        contact, blackout: (B,), first steps as well.
    """

    numbers: MapNumbers
    felt: tuple[str, ...]
    kinds: dict[str, Mask]
    trajectories: int
    size: int
    contact: Mask
    blackout: Mask

    @property
    def verdict(self) -> str:
        lines = [self._ridge(layer) for layer in self.felt]
        return (
            " ".join([*lines, "45° is chance."]) if lines else "No modality knows where the hand is: no ridge to judge."
        )

    def _ridge(self, layer: str) -> str:
        index, said = self.numbers.layers.index(layer), []
        for kind in ("contact", "no contact"):
            mask = self.kinds[kind]
            if not mask.any():
                continue
            low, median, high = np.percentile(np.degrees(self.numbers.off_line[mask, index]), (25, 50, 75))
            long = float(np.median(self.numbers.elongation[mask, index]))
            flat = ", hardly a ridge" if long < ROUND else ""
            said.append(
                f"{kind} {median:.0f}° (median; quartiles {low:.0f}° to {high:.0f}°) over {mask.sum()} steps, "
                f"{long:.1f} times as long as wide{flat}"
            )
        return f"Long axis of the {layer} map off the line from the truth to the hand: {'; '.join(said)}."

    def tables(self) -> list[Table]:
        n = self.numbers
        rows: list[tuple[Value, ...]] = []
        fused = len(n.layers) - 1
        for i, layer in enumerate(n.layers):
            for kind, mask in self.kinds.items():
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
                rows.append((layer, kind, int(mask.sum()), *(v if np.isfinite(v) else None for v in medians)))
        columns = ("map", "steps", "number", "axis off line (deg)", "elongation", "50 % area (cm²)", "95 % area (cm²)")
        more = ("entropy (nats, per cm²)", "ln truth / max", "KL to fused (nats)", "overlap with fused")
        return [Table("Medians over steps", (*columns, *more), tuple(rows))]

    def curves(self) -> list[Curve]:
        if self.trajectories > 1:
            return []
        n, shown = self.numbers, []
        for layer in self.felt:
            off = np.degrees(n.off_line[:, n.layers.index(layer)])
            shown.append(Curve(layer, off, "Long axis against the line truth - hand", "°", layer, (0.0, 45.0)))
        for i, layer in enumerate(n.layers):
            shown.append(Curve(layer, 1e4 * n.area95[:, i], "Area that holds 95 %", "cm²", layer))
        for i, layer in enumerate(n.layers[:-1]):
            shown.append(Curve(layer, n.divergence[:, i, -1], "Divergence to the fused map", "nats", layer))
        return shown

    def bands(self) -> dict[str, Mask]:
        return {} if self.trajectories > 1 else {"contact": self.contact, "blackout": self.blackout}


def maps(
    traces: Sequence[Trace],
    checkpoint: Checkpoint,
    size: int = COARSE,
    progress: Callable[[float], None] | None = None,
) -> Maps:
    """Maps of every step at the true angle, ``size`` cells a side. Raises BadInput for a filter without maps."""
    parts, kinds = [], []
    for i, trace in enumerate(traces):
        engine = MapEngine(checkpoint, trace)
        for first in range(0, len(trace), STEPS_AT_ONCE):
            steps = range(first, min(first + STEPS_AT_ONCE, len(trace)))
            parts.append(measure_maps(list(engine.maps(steps, size)), trace))
            if progress is not None:
                progress((i + steps.stop / len(trace)) / len(traces))
        kinds.append(splits(trace))
    joined = {
        f.name: np.concatenate([getattr(part, f.name) for part in parts])
        for f in fields(MapNumbers)
        if f.name != "layers"
    }
    keys = checkpoint.task.modalities
    felt = tuple(
        name for name in parts[0].layers[:-1] if any("effector_position" in keys.get(m, ()) for m in name.split("+"))
    )
    together = {kind: np.concatenate([each[kind] for each in kinds]) for kind in kinds[0]}
    contact = np.concatenate([trace.episode.contact.astype(bool) for trace in traces])
    black = np.concatenate([blackout(trace) for trace in traces])
    return Maps(MapNumbers(layers=parts[0].layers, **joined), felt, together, len(traces), size, contact, black)


ENTRY = Entry(
    name="maps",
    title="Likelihood maps",
    question="What does each modality find likely, how sharply, and does touch see a ridge along the line to the hand?",
    run=maps,
    why_not=lambda trace, checkpoint: None if checkpoint is None else no_maps(checkpoint, trace),
    needs="checkpoint",
    slow=True,
    options={"size": "cells along a side, 41 by default"},
)
