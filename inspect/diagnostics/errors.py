"""Errors of any estimator: by group of steps, in outages of a sensor and after them, and next to raw readings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.task import Task
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics.base import Diagnostic, Entry
from beliefscope.inspect.diagnostics.views import Array, Curve, Table, Value
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace

Mask = NDArray[np.bool_]

MIN_OUTAGE = 2
"""Fewest steps in succession without a reading that are an outage."""

RECOVERED = 1.5
"""Ratio of the error to its median outside of outages at which an estimate has recovered."""


@dataclass(frozen=True)
class GroupErrors:
    """Errors of a group of steps, SI units.

    Attributes:
        name, steps: group (``measures.phases``) and number of steps.
        position: root mean square of the main error (``Task.main_error``). rmse, bias: (n,) of the components.
        share: of the sum of squared distances of all counted steps.
    """

    name: str
    steps: int
    position: float
    rmse: Array
    bias: Array
    share: float


@dataclass(frozen=True)
class Outages:
    """Outages of a sensor: at least ``MIN_OUTAGE`` steps in succession without a reading.

    A reading is missing if it is NaN or a blank image, or the filter reports no innovation of the modality.

    Attributes:
        modality: of the sensor. count, steps: number of outages and of their steps. longest: in s.
        before, during, end: root mean square distance in the step before, in all steps of, and in the last step of an
            outage; m. before and end are NaN if unknown.
        share: of the sum of squared distances, for the share ``steps`` of all steps.
        recovery: median time from the end of an outage until the error is at most ``RECOVERED`` times its median
            outside of outages, s; NaN without an outage that ends early enough.
        unrecovered: number of outages after which it is not reached before the next one or the end.
    """

    modality: str
    count: int
    steps: float
    longest: float
    before: float
    during: float
    end: float
    share: float
    recovery: float
    unrecovered: int


@dataclass(frozen=True)
class Errors(Diagnostic):
    """Result of ``errors_of``.

    Attributes:
        task, filter, trajectories: names and number of traces.
        groups: all counted steps, then each group of the covariates.
        outages: of each modality that has some.
        readings: observation key that measures the map components (``Task.positions``) -> root mean square distances of
            its readings and of the estimate from the truth, in the steps with a reading, m.
        distance: (T,) m, of a single trace. missing: modality -> (T,) steps of its outages, of a single trace.
    """

    task: Task
    filter: str
    trajectories: int
    groups: tuple[GroupErrors, ...]
    outages: tuple[Outages, ...]
    readings: dict[str, tuple[float, float]]
    distance: Array
    missing: dict[str, Mask]

    @property
    def worse(self) -> tuple[str, ...]:
        """Observation keys whose raw readings are closer to the truth than the estimate."""
        return tuple(key for key, (reading, estimate) in self.readings.items() if reading < estimate)

    @property
    def alarms(self) -> tuple[str, ...]:
        texts = [f"the estimate is worse than the readings of {key}" for key in self.worse]
        slow = [o for o in self.outages if o.unrecovered > o.count / 2]
        return (*texts, *(f"no recovery from most outages of {o.modality}" for o in slow))

    @property
    def verdict(self) -> str:
        unit, scale = self._unit
        total = self.groups[0]
        text = f"{self.task.main_error.title} RMSE {scale * total.position:.3g} {unit}"
        others = [group for group in self.groups[1:] if measures.MIN_STEPS <= group.steps < total.steps]
        if others:
            worst = max(others, key=lambda group: group.position)
            steps = worst.steps / total.steps
            text += f"; largest in {worst.name}: {scale * worst.position:.3g} {unit}"
            text += f" ({worst.share:.0%} of the squared error in {steps:.0%} of the steps)"
        parts = [f"{text}."]
        for outage in sorted(self.outages, key=lambda o: -o.share)[:2]:
            noun, verb = ("outage", "has") if outage.count == 1 else ("outages", "have")
            text = f"{outage.count} {noun} of {outage.modality}, up to {outage.longest:.3g} s, {verb} "
            text += f"{outage.share:.0%} of the squared error in {outage.steps:.0%} of the steps"
            if not math.isnan(outage.recovery):
                text += f"; recovery takes {outage.recovery:.3g} s" if outage.recovery else "; recovery is immediate"
            if outage.unrecovered:
                text += f", and is missing after {outage.unrecovered}"
            parts.append(f"{text}.")
        for key in self.worse:
            reading, estimate = (f"{scale * value:.3g} {unit}" for value in self.readings[key])
            parts.append(f"The readings of {key} are closer to the truth ({reading}) than the estimate ({estimate}).")
        return " ".join(parts)

    @property
    def _unit(self) -> tuple[str, float]:
        """Display unit of distances, and its factor."""
        main = self.task.main_error
        return main.unit, main.factor

    def tables(self) -> list[Table]:
        units, factors = measures.display_units(self.task)
        unit, scale = self._unit
        names = [f"{c.label} ({u})" for c, u in zip(self.task.components, units, strict=True)]
        heads = [f"{name}: {quantity}" for name in names for quantity in ("RMSE", "bias")]
        rows: list[tuple[Value, ...]] = [
            (
                *(g.name, g.steps, scale * g.position, 100.0 * g.share),
                *(float(v) for pair in zip(g.rmse * factors, g.bias * factors, strict=True) for v in pair),
            )
            for g in self.groups
        ]
        columns = ("group", "steps", f"{self.task.main_error.name} RMSE ({unit})", "squared error (%)", *heads)
        tables = [Table("Errors by group", columns, tuple(rows))]
        if self.outages:
            columns = (
                *("sensor", "outages", "steps (%)", "longest (s)", f"before ({unit})", f"during ({unit})"),
                *(f"at the end ({unit})", "squared error (%)", "recovery (s)", "not recovered"),
            )
            numbers = tuple(
                (
                    *(o.modality, o.count, 100.0 * o.steps, o.longest),
                    *(_known(scale * value) for value in (o.before, o.during, o.end)),
                    *(100.0 * o.share, _known(o.recovery), o.unrecovered),
                )
                for o in self.outages
            )
            tables.append(Table("Outages", columns, numbers))
        if self.readings:
            columns = ("observation", f"RMSE of its readings ({unit})", f"RMSE of the estimate there ({unit})")
            numbers = tuple((key, scale * a, scale * b) for key, (a, b) in self.readings.items())
            tables.append(Table("Estimate and raw readings", columns, numbers))
        return tables

    def curves(self) -> list[Curve]:
        unit, scale = self._unit
        chart = f"{self.task.main_error.title} error"
        return [Curve("fused", scale * self.distance, chart, unit, "fused")] if len(self.distance) else []

    def bands(self) -> dict[str, Mask]:
        return {"outage": np.any(list(self.missing.values()), axis=0)} if self.missing else {}


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def why_not(trace: Trace, checkpoint: Checkpoint | None = None) -> str | None:
    """One-line reason why the diagnostic does not apply, or None."""
    return None if _known_steps(trace).any() else "the true state is unknown"


def _known_steps(trace: Trace) -> Mask:
    """(T,): counted steps with a known true state."""
    return measures.counted(trace) & np.isfinite(trace.episode.states).all(1)


def errors_of(traces: Sequence[Trace]) -> Errors:
    """Evaluate the errors of one estimator over one or more trajectories."""
    first, single = traces[0], len(traces) == 1
    error = [measures.errors(trace)[:, -1] for trace in traces]
    distance = [first.task.main_error.norm(e) for e in error]
    missing = [missing_steps(trace) for trace in traces]
    return Errors(
        task=first.task,
        filter=first.filter,
        trajectories=len(traces),
        groups=tuple(_groups(traces, error, distance)),
        outages=tuple(
            outages
            for name in first.task.modalities
            if (outages := _outages(name, traces, distance, [m[name] for m in missing])) is not None
        ),
        readings=_readings(traces, distance),
        distance=distance[0] if single else np.zeros(0),
        missing=missing[0] if single else {},
    )


def missing_steps(trace: Trace) -> dict[str, Mask]:
    """Modality -> (T,): outages, in which no observation of the modality has a reading, or the filter used none."""
    result = {}
    for name, keys in trace.task.modalities.items():
        lost = np.ones(len(trace), dtype=bool)
        for key in keys:
            lost &= _without_reading(trace.episode.observations.get(key), len(trace))
        if trace.innovation is not None and name in trace.modalities:
            lost |= np.isnan(trace.innovation[:, trace.modalities.index(name)]).all(1)
        runs = [(a, b) for a, b in measures.intervals(lost) if b - a >= MIN_OUTAGE]
        result[name] = np.zeros(len(trace), dtype=bool)
        for a, b in runs:
            result[name][a:b] = True
    return result


def _without_reading(readings: NDArray[np.generic] | None, steps: int) -> Mask:
    if readings is None:
        return np.zeros(steps, dtype=bool)
    flat = readings.reshape(steps, -1)
    if flat.dtype.kind == "f":
        return np.isnan(flat).any(1)
    return np.asarray(flat.min(1) == flat.max(1)) if flat.shape[1] > 1 else np.zeros(steps, dtype=bool)


def _groups(traces: Sequence[Trace], error: Sequence[Array], distance: Sequence[Array]) -> list[GroupErrors]:
    known = np.concatenate([_known_steps(trace) for trace in traces])
    every, norm = np.concatenate(error), np.concatenate(distance)
    total = float(np.square(norm[known]).sum())
    groups = []
    for name, mask in measures.pooled_phases(traces).items():
        at = mask & known
        if at.any():
            squares = np.square(norm[at])
            rmse, bias = np.sqrt(np.square(every[at]).mean(0)), every[at].mean(0)
            share = float(squares.sum()) / max(total, 1e-300)
            groups.append(GroupErrors(name, int(at.sum()), float(np.sqrt(squares.mean())), rmse, bias, share))
    return groups


def _outages(name: str, traces: Sequence[Trace], distance: Sequence[Array], missing: Sequence[Mask]) -> Outages | None:
    """Statistics of the outages of a modality; None if there are none."""
    known = [_known_steps(trace) for trace in traces]
    during = np.concatenate([d[m & k] for d, m, k in zip(distance, missing, known, strict=True)])
    outside = np.concatenate([d[~m & k] for d, m, k in zip(distance, missing, known, strict=True)])
    if not len(during) or not len(outside):
        return None
    limit = RECOVERED * float(np.median(outside))
    before, end, recoveries, lengths, unrecovered = [], [], [], [], 0
    for trace, d, m in zip(traces, distance, missing, strict=True):
        runs, durations = measures.intervals(m), trace.episode.durations
        for number, (a, b) in enumerate(runs):
            lengths.append(float(durations[a:b].sum()))
            end.append(d[b - 1])
            before += [d[a - 1]] if a else []
            after = d[b : runs[number + 1][0] if number + 1 < len(runs) else len(d)]
            if not len(after):
                continue
            reached = np.flatnonzero(after <= limit)
            if len(reached):
                recoveries.append(float(durations[b : b + reached[0]].sum()))
            else:
                unrecovered += 1
    total = float(np.square(np.concatenate([during, outside])).sum())
    return Outages(
        modality=name,
        count=len(lengths),
        steps=len(during) / (len(during) + len(outside)),
        longest=max(lengths),
        before=_root(before),
        during=_root(during),
        end=_root(end),
        share=float(np.square(during).sum()) / max(total, 1e-300),
        recovery=float(np.median(recoveries)) if recoveries else math.nan,
        unrecovered=unrecovered,
    )


def _root(values: Sequence[float] | Array) -> float:
    """Root of the mean square of the known values; NaN without any."""
    known = np.asarray(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    return float(np.sqrt(np.square(known).mean())) if len(known) else math.nan


def _readings(traces: Sequence[Trace], distance: Sequence[Array]) -> dict[str, tuple[float, float]]:
    """See ``Errors.readings``; only of keys that measure nothing but the map components."""
    task, result = traces[0].task, {}
    where = list(task.map_indices)
    for key, channels in task.positions.items():
        if task.observations.get(key) != (2,):
            continue
        rows, modality = [], next((name for name, keys in task.modalities.items() if key in keys), "")
        for trace, d in zip(traces, distance, strict=True):
            if key not in trace.episode.observations:
                continue
            reading = trace.episode.observations[key][:, list(channels)].astype(np.float64)
            off = np.linalg.norm(reading - trace.episode.states[:, where], axis=1)
            at = (
                _known_steps(trace) & np.isfinite(off) & ~missing_steps(trace).get(modality, np.zeros(len(trace), bool))
            )
            rows.append(np.stack([off[at], d[at]]))
        if rows and (both := np.concatenate(rows, axis=1)).size:
            result[key] = (_root(both[0]), _root(both[1]))
    return result


ENTRY = Entry(
    name="errors",
    title="Errors and outages",
    question="In which groups of steps are the errors large, and how fast does the estimate recover from an outage?",
    run=errors_of,
    why_not=why_not,
)
