"""Contents of a report: events, tables, and the sections shared by its page and its folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from beliefscope.datasets.episode import step_text
from beliefscope.datasets.task import with_unit
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.evaluate import metrics
from beliefscope.inspect.diagnostics.base import Diagnostic
from beliefscope.inspect.diagnostics.views import Table, Value
from beliefscope.inspect.maps.map_engine import LikelihoodMap, Quantity
from beliefscope.inspect.maps.map_statistics import measure_maps
from beliefscope.inspect.maps.plane import area_unit
from beliefscope.inspect.maps.shape import SHAPES
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.report.diagnosis import ReportedDiagnosis

DEFAULT_EVENTS = 3
"""Number of events if none are given."""

MIN_DISTANCE = 2.0
"""s between two default events of an episode."""


@dataclass(frozen=True)
class Event:
    """One step of a trace that the report shows in detail.

    Attributes:
        trace: index of the trace.
        step: index of the step.
        link: permalink, or empty.
    """

    trace: int
    step: int
    link: str = ""


@dataclass(frozen=True)
class Item:
    """A figure (svg) or table of the report. files: paths within the folder."""

    caption: str
    files: tuple[str, ...]
    table: Table | None = None
    svg: str = ""


@dataclass(frozen=True)
class Section:
    """Contents under a heading. anchor: id on the page. text: verdict or description."""

    anchor: str
    title: str
    question: str
    text: str
    items: tuple[Item, ...]
    link: str = ""


@dataclass(frozen=True)
class Report:
    """Contents of a report.

    Attributes:
        traces: of one filter.
        checkpoint: of the filter, if available.
        diagnosis: probable cause of a fault.
        results: diagnostics by name.
        titles: diagnostic -> title and question.
        reasons: title of an omitted diagnostic -> reason.
        events: steps shown in detail.
        events_note: how the events were selected.
        links_note: how to open permalinks, or why there are none.
        commands: command lines that reproduce the report.
        quantity: of the maps; None for the first one that the filter has.
        sources: file of each trace, for the manifest.
        versions: of the packages that affect the results.
    """

    title: str
    traces: tuple[Trace, ...]
    checkpoint: Checkpoint | None
    diagnosis: ReportedDiagnosis
    results: Mapping[str, Diagnostic]
    titles: Mapping[str, tuple[str, str]]
    reasons: Mapping[str, str]
    events: tuple[Event, ...]
    events_note: str = ""
    links_note: str = ""
    commands: tuple[str, ...] = ()
    quantity: Quantity | None = None
    sources: tuple[Mapping[str, Any], ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)


def worst_events(traces: Sequence[Trace], count: int = DEFAULT_EVENTS) -> list[Event]:
    """Steps with the largest fused position error in descending order, at least ``MIN_DISTANCE`` apart per trace."""
    errors = [np.where(measures.counted(t), measures.main_error(t)[:, -1], -np.inf) for t in traces]
    events: list[Event] = []
    while len(events) < count:
        index = int(np.argmax([error.max() for error in errors]))
        step = int(errors[index].argmax())
        if not np.isfinite(errors[index][step]):
            break
        events.append(Event(index, step))
        gap = round(MIN_DISTANCE / traces[index].episode.dt)
        errors[index][max(0, step - gap) : step + gap + 1] = -np.inf
    return events


def accuracy(traces: Sequence[Trace], standalone: Mapping[str, Sequence[Trace]] | None = None) -> Table:
    """Metrics of ``beliefscope evaluate`` of the updates and the fused estimate, over the counted steps.

    Args:
        standalone: modality -> its standalone runs over the same episodes, with a row each.
    """
    rows = _accuracy(traces)
    rows += [_accuracy(runs)[-1] | {"estimate": f"{name} standalone"} for name, runs in (standalone or {}).items()]
    columns = dict.fromkeys([*rows[0], *rows[-1]])
    return Table.from_rows(
        "RMSE and calibration of the covariance", [{name: row.get(name) for name in columns} for row in rows]
    )


def _accuracy(traces: Sequence[Trace]) -> list[dict[str, Value]]:
    """A row for each estimate."""
    task, first = traces[0].task, traces[0]
    counted = [measures.counted(trace) for trace in traces]
    error = torch.from_numpy(np.concatenate([measures.errors(t)[c] for t, c in zip(traces, counted, strict=True)]))
    covariances = [
        np.concatenate([trace.modality_covariance, trace.estimate_covariance[:, None]], axis=1)[c].astype(np.float64)
        for trace, c in zip(traces, counted, strict=True)
    ]
    covariance = torch.from_numpy(np.concatenate(covariances))
    rows: list[dict[str, Value]] = []
    for i, layer in enumerate(measures.layers(first)):
        if layer != "fused" and layer not in first.modalities_with_posterior:
            continue
        result = metrics(task, error[:, i], covariance[:, i])
        titles = {c.key: with_unit(c.label, c.conversion[0]) for c in task.components}
        titles[task.main_error.key] = task.main_error.label
        values: dict[str, Value] = {titles[key]: value for key, value in result.rmse.items()}
        if first.has_covariance:
            values |= {"NEES/n": result.nees, "95 % coverage": result.coverage95, "NLL (nats)": result.nll}
        rows.append({"estimate": measures.layer_label(layer), **values})
    return rows


def text_columns(table: Table) -> list[bool]:
    """Whether each column contains text; other columns are right-aligned."""
    return [any(isinstance(row[i], str) for row in table.rows) for i in range(len(table.columns))]


def number_text(value: float) -> str:
    """Three significant digits."""
    return f"{value:z#.3g}".rstrip(".") if abs(value) < 1000.0 else f"{value:.0f}"


def _reach(map_: LikelihoodMap) -> NDArray[Any]:
    """(2,) largest offset of a map along its axes; 0 along the missing one of a curve."""
    return np.array([np.abs(offsets).max() for offsets in (map_.offsets_x, map_.offsets_y)])


def event_table(trace: Trace, step: int, map_: LikelihoodMap | None) -> Table:
    """Error, weights and map statistics at one step of each layer that has any."""
    task = trace.task
    units, factors = measures.display_units(task)
    error, nees = measures.errors(trace)[step] * factors, measures.nees(trace)[step]
    main = task.main_error
    distance = main.factor * measures.main_error(trace)[step]
    statistics = None if map_ is None else measure_maps([map_], trace)
    columns = ["estimate", *(with_unit(f"{c.label} error", u) for c, u in zip(task.components, units, strict=True))]
    columns += [with_unit(f"{main.name} error", main.unit)] if len(main.indices) > 1 else []
    columns += ["NEES/n"] if trace.has_covariance else []
    for name, weights in (("beta", trace.weights), ("effective weight", trace.effective_weights)):
        if weights is not None:
            columns.append(name if weights.shape[-1] == 1 else f"{name} (mean)")
    where = task.map_indices
    same_unit = len({task.components[i].unit for i in where}) == 1
    area, factor = area_unit(task, where)
    if statistics is not None:
        columns += [with_unit("map: peak to truth", main.unit)] if same_unit else []
        columns += [with_unit("map: 95 % region", area)]
        columns += ["map: shape"] if same_unit and len(where) == 2 else []
    rows: list[tuple[Value, ...]] = []
    for i, layer in enumerate(measures.layers(trace)):
        has_estimate = layer == "fused" or layer in trace.modalities_with_posterior
        row: list[Value] = [measures.layer_label(layer)]
        row += map(float, error[i]) if has_estimate else [None] * len(units)
        row += [float(distance[i]) if has_estimate else None] if len(main.indices) > 1 else []
        row += [float(nees[i]) if np.isfinite(nees[i]) else None] if trace.has_covariance else []
        for weights in (trace.weights, trace.effective_weights):
            if weights is not None:
                row.append(float(weights[step, i].mean()) if i < weights.shape[1] else None)
        if statistics is not None and layer in statistics.layers:
            at = statistics.layers.index(layer)
            assert map_ is not None
            # With the maximum at the border, the peak and a part of the region are outside.
            cut = bool((np.abs(statistics.peak[0, at]) >= _reach(map_))[: len(where)].any())
            row += [None if cut else main.factor * float(np.hypot(*statistics.peak[0, at]))] if same_unit else []
            row += [None if cut else factor * float(statistics.area95[0, at])]
            row += [SHAPES[statistics.shape[0, at]]] if same_unit and len(where) == 2 else []
        row += [None] * (len(columns) - len(row))
        if any(value is not None for value in row[1:]):
            rows.append(tuple(row))
    title = f"{step_text(step, trace.episode.time_of(step)).capitalize()} of episode {trace.episode_index}"
    title += "" if map_ is None else f". Maps: {map_.title}"
    return Table(title, tuple(columns), tuple(rows))


def event_summary(trace: Trace, step: int) -> str:
    """Time, groups of the task's covariates, image blackout and effective sample size at a step."""
    groups = [
        "in contact" if group == "contact" else group
        for name, covariate in trace.task.covariates.items()
        for group, mask in covariate.masks(name, trace.episode.group_values(name))
        if mask[step]
    ]
    parts = [", ".join([f"{trace.episode.times[step]:.1f} s after the start", *groups])]
    if measures.blackout(trace)[step]:
        parts.append("image blacked out")
    if trace.effective_sample_size is not None and trace.particles is not None:
        parts.append(f"{trace.effective_sample_size[step]:.0f} of {trace.particle_count} particles are effective")
    return "; ".join(parts) + "."
