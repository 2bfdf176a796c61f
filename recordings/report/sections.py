"""What a report is made of: its moments, its numbers, and the parts that its page and its folder share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.evaluate import UNITS, metrics
from beliefscope.inspect.diagnostics.base import Diagnostic, Table, Value
from beliefscope.inspect.likelihood import LikelihoodMap
from beliefscope.inspect.maps.statistics import measure_maps
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace

WORST = 3
"""Moments that are shown where none are chosen."""

APART = 2.0
"""s that the worst moments of an episode lie apart at least: else they were all one."""


@dataclass(frozen=True)
class Moment:
    """One step of one trace, as a report shows it. trace: its index. link: to reopen it on the page, or none."""

    trace: int
    step: int
    link: str = ""


@dataclass(frozen=True)
class Shown:
    """A figure or table of the report and the files that hold it, paths within the folder."""

    caption: str
    files: tuple[str, ...]
    table: Table | None = None
    svg: str = ""


@dataclass(frozen=True)
class Section:
    """What is under one heading. anchor: its id on the page. text: the verdict, or what there is to say."""

    anchor: str
    title: str
    question: str
    text: str
    shown: tuple[Shown, ...]
    link: str = ""


@dataclass(frozen=True)
class Report:
    """What a report is made of.

    Attributes:
        traces: of one filter. checkpoint: of it, where it is there. found: diagnostics by name, with their titles and
            questions in ``asked``. refused: title -> why there is none. moments: as shown. chosen: how they
            were chosen. links: how their links are opened, or why there are none. commands: that make it again.
            sources: of each trace, where it came from, for the manifest.
    """

    title: str
    traces: tuple[Trace, ...]
    checkpoint: Checkpoint | None
    found: Mapping[str, Diagnostic]
    asked: Mapping[str, tuple[str, str]]
    refused: Mapping[str, str]
    moments: tuple[Moment, ...]
    chosen: str = ""
    links: str = ""
    commands: tuple[str, ...] = ()
    sources: tuple[Mapping[str, Any], ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)


def worst_moments(traces: Sequence[Trace], count: int = WORST) -> list[Moment]:
    """The steps with the largest fused position error, the worst first, each ``APART`` from the others of its trace."""
    errors = [np.where(measures.counted(t), measures.position_error(t)[:, -1], -np.inf) for t in traces]
    found: list[Moment] = []
    while len(found) < count:
        index = int(np.argmax([error.max() for error in errors]))
        step = int(errors[index].argmax())
        if not np.isfinite(errors[index][step]):
            break
        found.append(Moment(index, step))
        gap = round(APART / traces[index].episode.dt)
        errors[index][max(0, step - gap) : step + gap + 1] = -np.inf
    return found


def accuracy(traces: Sequence[Trace]) -> Table:
    """As ``beliefscope evaluate`` has them, of each modality alone and fused, over the counted steps of all traces."""
    task, first = measures.task_of(traces[0]), traces[0]
    keep = [measures.counted(trace) for trace in traces]
    error = torch.from_numpy(np.concatenate([measures.errors(t)[k] for t, k in zip(traces, keep, strict=True)]))
    stated = [
        np.concatenate([trace.modality_covariance, trace.estimate_covariance[:, None]], axis=1)[k].astype(np.float64)
        for trace, k in zip(traces, keep, strict=True)
    ]
    covariance = torch.from_numpy(np.concatenate(stated))
    rows: list[tuple[Value, ...]] = []
    columns = ["layer"]
    for i, layer in enumerate(measures.layers(first)):
        if layer != "fused" and layer not in first.alone:
            continue
        found = metrics(task, error[:, i], covariance[:, i])
        numbers: dict[str, Value] = {f"{c.name} ({UNITS[c.unit][0]})": 0.0 for c in task.components}
        numbers = dict(zip((*numbers, "position (cm)"), found.rmse.values(), strict=True))
        if first.has_covariance:
            numbers |= {"NEES/n": found.nees, "coverage of 95 %": found.coverage95, "NLL (nats)": found.nll}
        columns = ["layer", *numbers]
        rows.append((layer, *numbers.values()))
    return Table("RMSE, and how true the covariance is", tuple(columns), tuple(rows))


def moment_table(trace: Trace, step: int, map_: LikelihoodMap | None) -> Table:
    """Each layer's error, weights and map at one step."""
    task = measures.task_of(trace)
    units, factors = measures.shown_units(task)
    error, nees = measures.errors(trace)[step] * factors, measures.nees(trace)[step]
    distance = 100.0 * measures.position_error(trace)[step]
    numbers = None if map_ is None else measure_maps([map_], trace)
    columns = ["layer", *(f"{c.name} error ({u})" for c, u in zip(task.components, units, strict=True))]
    columns += ["position error (cm)"]
    columns += ["NEES/n"] if trace.has_covariance else []
    for name, share in (("beta", trace.weights), ("acting share", trace.acting)):
        if share is not None:
            columns.append(name if share.shape[-1] == 1 else f"{name} (mean)")
    columns += ["map: peak off truth (cm)", "map: 95 % region (cm²)"] if numbers is not None else []
    rows: list[tuple[Value, ...]] = []
    for i, layer in enumerate(measures.layers(trace)):
        alone = layer == "fused" or layer in trace.alone
        row: list[Value] = [
            layer,
            *((*map(float, error[i]), float(distance[i])) if alone else [None] * (len(units) + 1)),
        ]
        row += [float(nees[i]) if np.isfinite(nees[i]) else None] if trace.has_covariance else []
        for share in (trace.weights, trace.acting):
            if share is not None:
                row.append(float(share[step, i].mean()) if i < share.shape[1] else None)
        if numbers is not None:
            row += [100.0 * float(np.hypot(*numbers.peak[0, i])), 1e4 * float(numbers.area95[0, i])]
        rows.append(tuple(row))
    return Table(f"Step {step} of episode {trace.episode_index}", tuple(columns), tuple(rows))


def happening(trace: Trace, step: int) -> str:
    """What was going on at a step, in a sentence."""
    contact = "in contact" if trace.episode.contact[step] else "not in contact"
    said = [f"{step * trace.episode.dt:.1f} s after the start, {contact}"]
    if measures.blackout(trace)[step]:
        said.append("the picture is black")
    if trace.effective_sample_size is not None and trace.particles is not None:
        said.append(f"{trace.effective_sample_size[step]:.0f} of {trace.particles.shape[1]} particles are effective")
    return "; ".join(said) + "."
