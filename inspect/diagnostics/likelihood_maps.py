"""Statistics of the likelihood maps of all steps: area, divergence, shape and ridge orientation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from beliefscope.datasets.task import Task, with_unit
from beliefscope.datasets.text import percent
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.engine import Progress
from beliefscope.inspect.diagnostics.base import Diagnostic, Entry
from beliefscope.inspect.diagnostics.views import Curve, Table
from beliefscope.inspect.maps.availability import no_maps
from beliefscope.inspect.maps.map_engine import COARSE, MapEngine, Quantity
from beliefscope.inspect.maps.map_statistics import MapStatistics, measure_maps
from beliefscope.inspect.maps.plane import area_unit
from beliefscope.inspect.maps.shape import SHAPES
from beliefscope.inspect.statistics.measures import Array, Mask, blackout, pooled_phases, trace_indices
from beliefscope.inspect.trace import Trace

NOUNS = {
    "flat": "flat",
    "round": "a round peak",
    "ridge": "a ridge",
    "ring": "a ring",
    "cut by border": "cut by the border",
}
"""Shape -> description."""

SHARES = tuple(f"{shape} (% of steps)" for shape in SHAPES)
"""Columns of the shares of ``SHAPES``."""

MIN_TRAJECTORIES, RESAMPLES = 5, 2000
"""Minimum number of episodes for an interval; bootstrap samples."""

VALUES_AT_ONCE = 10_000_000

STEPS_AT_ONCE = 64
"""Number of maps processed together; limits memory to a few MB."""


@dataclass(frozen=True)
class MapSurvey(Diagnostic):
    """Statistics of the maps of all B steps that have one, of one or more concatenated traces.

    Attributes:
        numbers: statistics of the maps.
        title: quantity of the maps and rule of the fused one (``LikelihoodMap.title``).
        ridge_layers: modalities that observe the end effector, whose shape is evaluated.
        phases: phase -> mask (B,) without warm-up steps.
        trajectories: number of traces. trajectory: (B,) index of each step's trace.
        size: cells per side.
        task, components: of the maps.
        contact, blackout: masks of all steps, with and without maps.
    """

    numbers: MapStatistics
    title: str
    ridge_layers: tuple[str, ...]
    phases: dict[str, Mask]
    trajectories: int
    trajectory: NDArray[np.int64]
    size: int
    task: Task
    components: tuple[int, ...]
    contact: Mask
    blackout: Mask

    @property
    def _length(self) -> tuple[str, float]:
        """Unit for display of distances on the map, and its factor."""
        return self.task.components[self.components[0]].conversion

    @property
    def quantity(self) -> str:
        return self.title[:1].lower() + self.title[1:].split(".", 1)[0]

    @property
    def verdict(self) -> str:
        sentences = [
            self._shape(layer, phase)
            for layer in self.ridge_layers
            for phase in ("contact", "free motion")
            if phase in self.phases and self.phases[phase].any()
        ]
        if sentences and np.isfinite(self.numbers.expected).any():
            sentences.append("A random orientation is 45° off in the median.")
        return " ".join(sentences) or self._regions()

    @property
    def has_shapes(self) -> bool:
        """Whether directions and distances on the map are those of the state: two components of one unit."""
        return len(self.components) == 2 and len({self.task.components[i].unit for i in self.components}) == 1

    @property
    def _region(self) -> str:
        """Name of a region's size: that of a curve is a length."""
        return "area" if len(self.components) == 2 else "region"

    def _regions(self) -> str:
        """Median 95 % region of the fused map, and the smallest and the largest one of the modalities."""
        unit, factor = area_unit(self.task, self.components)
        mask = next(iter(self.phases.values()))
        *single, fused = factor * np.median(self.numbers.area95[mask], axis=0)
        text = f"The median 95 % {self._region} of the fused {self.quantity} is {_text(fused, unit)}"
        if len(single) < 2:
            return f"{text}."
        low, high = int(np.argmin(single)), int(np.argmax(single))
        layers = self.numbers.layers
        ends = (f"{_text(single[i], unit)} ({layers[i]})" for i in (low, high))
        return f"{text}; of single modalities, {' to '.join(ends)}."

    def _shape(self, layer: str, phase: str) -> str:
        """Most frequent shape of a layer's map in a phase, and its measures."""
        n, i, mask = self.numbers, self.numbers.layers.index(layer), self.phases[phase]
        counts = np.bincount(n.shape[mask, i], minlength=len(SHAPES))
        shape = SHAPES[int(counts.argmax())]
        text = f"In {phase}, the {layer} {self.quantity} is {NOUNS[shape]} in {counts.max()} of {mask.sum()} steps"
        of_shape = mask & (n.shape[:, i] == SHAPES.index(shape))
        if shape == "ring":
            radius, coverage = (float(np.median(a[of_shape, i])) for a in (n.ring_radius, n.ring_coverage))
            unit, factor = self._length
            return f"{text}, median radius {factor * radius:.1f} {unit}, over {percent(coverage)} of the circle."
        if shape != "ridge":
            return f"{text}."
        text += f", median elongation {np.median(n.elongation[of_shape, i]):.1f}"
        has_direction = mask & np.isfinite(n.expected)
        if not has_direction.any():
            return f"{text}; the task expects no direction."
        return f"{text}; its long axis is {self._deviation(i, has_direction)} off the direction that the task expects."

    def _deviation(self, layer: int, mask: Mask) -> str:
        """Median deviation over steps, with a 95 % interval over episodes if there are enough."""
        median, low, high = median_interval(np.degrees(self.numbers.deviation[mask, layer]), self.trajectory[mask])
        if np.isnan(low):
            return f"{median:.1f}°"
        return f"{median:.1f}° (95 % interval {low:.1f}° to {high:.1f}°)"

    def tables(self) -> list[Table]:
        rows = []
        for i, layer in enumerate(self.numbers.layers):
            columns = (self._shape_columns(i) if self.has_shapes else {}) | self._region_columns(i)
            for phase, mask in self.phases.items():
                if mask.any():
                    # Of a shape, the part of the steps; the radius is the median over rings.
                    medians = {
                        name: round(float((np.mean if name in SHARES else _median)(values[mask])), 3)
                        for name, values in columns.items()
                    }
                    rows.append({"map": layer, "phase": phase, "steps": int(mask.sum())} | medians)
        return [Table.from_rows(f"{self.title}. Medians over steps", rows)]

    def _shape_columns(self, i: int) -> dict[str, Array]:
        """Name -> values (B,) of a layer's shape and direction."""
        n, (unit, factor) = self.numbers, self._length
        shares = {name: 100.0 * (n.shape[:, i] == k) for k, name in enumerate(SHARES)}
        radius = np.where(n.shape[:, i] == SHAPES.index("ring"), n.ring_radius[:, i], np.nan)
        directions = {"off expected ridge (deg)": np.degrees(n.deviation[:, i]), "elongation": n.elongation[:, i]}
        return directions | shares | {with_unit("ring radius", unit): factor * radius}

    def _region_columns(self, i: int) -> dict[str, Array]:
        """Name -> values (B,) of a layer's regions, and of its comparison with the truth and the fused map."""
        n, (unit, factor) = self.numbers, area_unit(self.task, self.components)
        return {
            with_unit(f"50 % {self._region}", unit): factor * n.area50[:, i],
            with_unit(f"95 % {self._region}", unit): factor * n.area95[:, i],
            f"entropy (nats, per {unit or 'unit'})": n.entropy[:, i] + np.log(factor),
            "ln p(true state) / max": n.truth[:, i],
            "KL to fused (nats)": n.divergence[:, i, -1],
            "overlap with fused": n.overlap[:, i, -1],
        }

    def curves(self) -> list[Curve]:
        if self.trajectories > 1:
            return []
        n, curves, (area, factor) = self.numbers, [], area_unit(self.task, self.components)

        def at_all_steps(values: Array) -> Array:
            """NaN at steps without a map."""
            result = np.full(len(self.contact), np.nan)
            result[n.steps] = values
            return result

        for layer in self.ridge_layers if np.isfinite(n.expected).any() else ():
            angle = at_all_steps(np.degrees(n.deviation[:, n.layers.index(layer)]))
            curves.append(
                Curve(layer, angle, "Angle between principal axis and expected ridge", "°", layer, (0.0, 45.0))
            )
        for i, layer in enumerate(n.layers):
            curves.append(Curve(layer, at_all_steps(factor * n.area95[:, i]), f"95 % {self._region}", area, layer))
        for i, layer in enumerate(n.layers[:-1]):
            divergence = at_all_steps(n.divergence[:, i, -1])
            curves.append(Curve(layer, divergence, "KL divergence to the fused map", "nats", layer))
        return curves

    def bands(self) -> dict[str, Mask]:
        return {} if self.trajectories > 1 else {"contact": self.contact, "blackout": self.blackout}


def _text(value: float, unit: str) -> str:
    """A number with three significant digits and its unit."""
    return f"{value:z.3g} {unit}".rstrip()


def _median(values: Array) -> float:
    """Median without NaN; NaN if there is no value."""
    values = values[~np.isnan(values)]
    return float(np.median(values)) if len(values) else np.nan


def median_interval(values: Array, trajectory: NDArray[np.int64]) -> tuple[float, float, float]:
    """Median of S values with its 95 % interval, by bootstrap over the episodes (S,) that they belong to.

    Expanded percentile interval (Hesterberg, "What Teachers Should Know About the Bootstrap", 2015): the level is that
    of Student's t with R - 1 degrees of freedom at ``sqrt(R / (R - 1))`` standard deviations, since the percentiles
    are too narrow for few episodes R.

    Returns:
        Median, low and high; the last two are NaN below ``MIN_TRAJECTORIES`` episodes.
    """
    order = np.argsort(values)
    ordered, (names, member) = values[order], np.unique(trajectory[order], return_inverse=True)
    count = len(names)
    if count < MIN_TRAJECTORIES:
        return float(np.median(values)), np.nan, np.nan
    draws = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), RESAMPLES)
    at_once = max(1, VALUES_AT_ONCE // len(values))
    medians = []
    for first in range(0, RESAMPLES, at_once):
        cumulative = draws[first : first + at_once, member].cumsum(axis=1)
        medians.append(ordered[(2 * cumulative >= cumulative[:, -1:]).argmax(axis=1)])
    tail = float(ndtr(np.sqrt(count / (count - 1)) * stdtrit(count - 1, 0.025)))
    low, high = np.quantile(np.concatenate(medians), [tail, 1.0 - tail])
    return float(np.median(values)), float(low), float(high)


def maps(
    traces: Sequence[Trace],
    checkpoint: Checkpoint,
    size: int = COARSE,
    quantity: Quantity | None = None,
    progress: Progress = None,
) -> MapSurvey:
    """Evaluate the maps of all steps that have one, at the true angle. Raises BadInput for a filter without maps."""
    parts, title, has_map = [], "", []
    for i, trace in enumerate(traces):
        engine = MapEngine(checkpoint, trace)
        for first in range(0, len(trace), STEPS_AT_ONCE):
            steps = range(first, min(first + STEPS_AT_ONCE, len(trace)))
            computed = list(engine.maps(steps, size, quantity=quantity))
            has_map.append(np.isin(steps, [map_.step for map_ in computed]))
            if computed:
                title = computed[0].title
                parts.append(measure_maps(computed, trace))
            if progress is not None:
                progress((i + steps.stop / len(trace)) / len(traces))
    joined = {
        f.name: np.concatenate([getattr(part, f.name) for part in parts])
        for f in fields(MapStatistics)
        if f.name != "layers"
    }
    keys = checkpoint.task.modalities
    ridge_layers = tuple(
        name for name in parts[0].layers[:-1] if any("effector_position" in keys.get(m, ()) for m in name.split("+"))
    )
    kept = np.concatenate(has_map)
    contact = np.concatenate([trace.episode.contact.astype(bool) for trace in traces])
    blackouts = np.concatenate([blackout(trace) for trace in traces])
    return MapSurvey(
        numbers=MapStatistics(layers=parts[0].layers, **joined),
        title=title,
        ridge_layers=ridge_layers,
        phases={phase: mask[kept] for phase, mask in pooled_phases(traces).items()},
        trajectories=len(traces),
        trajectory=trace_indices(traces)[kept],
        size=size,
        task=checkpoint.task,
        components=checkpoint.task.map_indices,
        contact=contact,
        blackout=blackouts,
    )


ENTRY = Entry(
    name="maps",
    title="Likelihood maps",
    question="Which positions are likely under each modality, is its map round, a ridge or a ring, and does a "
    "ridge have the direction that the task expects?",
    run=maps,
    why_not=lambda trace, checkpoint: None if checkpoint is None else no_maps(checkpoint, trace),
    needs="filter",
    slow=True,
    options={
        "size": "cells per side, 41 by default",
        "quantity": "likelihood or posterior; likelihood by default, if the filter has one",
    },
)
