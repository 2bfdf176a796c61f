"""Errors of any estimator: by group of steps, in outages of a sensor and after them, and next to raw readings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beliefscope.datasets.covariate import in_phase
from beliefscope.datasets.task import Task, display_name, with_unit
from beliefscope.datasets.text import percent, plural
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics.base import Diagnostic, Entry
from beliefscope.inspect.diagnostics.views import Array, Curve, Table
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.measures import Mask
from beliefscope.inspect.statistics.outages import (
    Outages,
    missing_steps,
    outages_of,
    root_mean_square,
    without_reading,
)
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.restarts import RESTARTS, restarted_runs_text


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
class Errors(Diagnostic):
    """Result of ``errors_of``.

    Attributes:
        task, filter, trajectories: names and number of traces.
        groups: all counted steps, then each group of the covariates.
        outages: of each modality that has some.
        readings: observation key that measures the map components (``Task.positions``) -> root mean square distances of
            its readings and of the estimate from the truth, in the steps with a reading, m.
        restarts: number of traces in which the filter was restarted at the true state.
        stay: root mean square of the main error with the start as the estimate of all counted steps; NaN if unknown.
        starts_at_truth: whether all traces start at the true state.
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
    restarts: int = 0
    stay: float = math.nan
    starts_at_truth: bool = False

    @property
    def worse(self) -> tuple[str, ...]:
        """Observation keys whose raw readings are closer to the truth than the estimate."""
        return tuple(key for key, (reading, estimate) in self.readings.items() if reading < estimate)

    @property
    def alarms(self) -> tuple[str, ...]:
        texts = [f"the estimate is worse than the readings of {display_name(key)}" for key in self.worse]
        slow = [o for o in self.outages if o.unrecovered > o.count / 2]
        return (*texts, *(f"no recovery from most outages of {display_name(o.modality)}" for o in slow))

    @property
    def verdict(self) -> str:
        total = self.groups[0]
        text = f"{self.task.main_error.title} RMSE {self._text(total.position)}"
        others = [group for group in self.groups[1:] if measures.MIN_STEPS <= group.steps < total.steps]
        if others:
            worst = max(others, key=lambda group: group.position)
            steps = worst.steps / total.steps
            text += f"; largest {in_phase(worst.name, self.task.covariates)}: {self._text(worst.position)}"
            text += f" ({percent(worst.share)} of the squared error in {percent(steps)} of the steps)"
        parts = [f"{text}."]
        if total.position >= self.stay:
            start = "The start, which is the true state," if self.starts_at_truth else "The start"
            error = self._text(self.stay)
            parts.append(f"{start} as the estimate of all steps would have {error}: the filter is no better.")
        if self.restarts:
            parts.insert(0, restarted_runs_text(self.restarts, self.trajectories))
        for outage in sorted(self.outages, key=lambda o: -o.share)[:2]:
            outages, verb = plural(outage.count, "outage"), "has" if outage.count == 1 else "have"
            text = f"{outages} of {display_name(outage.modality)}, up to {outage.longest:.3g} s, {verb} "
            text += f"{percent(outage.share)} of the squared error in {percent(outage.steps)} of the steps"
            if (long := outage.dominant) is not None and long.steps < outage.steps:
                text += f"; those over {long.low:g} s have {percent(long.share)} in {percent(long.steps)}"
                text += f", with an error of {self._text(math.sqrt(long.square))}"
            if not math.isnan(outage.recovery):
                text += f"; recovery takes {outage.recovery:.3g} s" if outage.recovery else "; recovery is immediate"
            if outage.unrecovered:
                text += f", and is missing after {outage.unrecovered}"
            parts.append(f"{text}.")
        for key in self.worse:
            reading, estimate = map(self._text, self.readings[key])
            text = f"The readings of {display_name(key)} are closer to the truth ({reading}) than the estimate"
            parts.append(f"{text} in the same steps ({estimate}).")
        return " ".join(parts)

    @property
    def _unit(self) -> tuple[str, float]:
        """Display unit of distances, and its factor."""
        main = self.task.main_error
        return main.unit, main.factor

    def _text(self, value: float) -> str:
        """A distance with three significant digits, or all digits before the decimal point."""
        unit, scale = self._unit
        return f"{scale * value:{'.3g' if scale * value < 1000.0 else '.0f'}} {unit}".rstrip()

    def tables(self) -> list[Table]:
        unit, scale = self._unit
        rows = [
            {
                "group": g.name,
                "steps": g.steps,
                with_unit(f"{self.task.main_error.name} RMSE", unit): scale * g.position,
                "squared error (%)": 100.0 * g.share,
                **measures.by_component(self.task, {"RMSE": g.rmse, "bias": g.bias}),
            }
            for g in self.groups
        ]
        tables = [Table.from_rows("Errors by group", rows)]
        if self.outages:
            outages = [
                {
                    "sensor": o.modality,
                    "outages": o.count,
                    "steps (%)": 100.0 * o.steps,
                    "longest (s)": o.longest,
                    with_unit("before", unit): scale * o.before,
                    with_unit("during", unit): scale * o.during,
                    with_unit("at the end", unit): scale * o.end,
                    "squared error (%)": 100.0 * o.share,
                    "recovery (s)": o.recovery,
                    "not recovered": o.unrecovered,
                }
                for o in self.outages
            ]
            tables.append(Table.from_rows("Outages", outages))
            columns = ("sensor", "duration (s)", "outages", "steps (%)", with_unit("RMSE", unit), "squared error (%)")
            durations = [
                (o.modality, c.text, c.count, 100.0 * c.steps, scale * math.sqrt(c.square), 100.0 * c.share)
                for o in self.outages
                for c in o.classes
            ]
            tables.append(Table("Outages by duration", columns, durations))
        if self.readings:
            names = (with_unit(f"RMSE of {what}", unit) for what in ("its readings", "the estimate there"))
            numbers = [(key, scale * a, scale * b) for key, (a, b) in self.readings.items()]
            tables.append(Table("Estimate and raw readings", ("observation", *names), numbers))
        return tables

    def curves(self) -> list[Curve]:
        unit, scale = self._unit
        chart = f"{self.task.main_error.title} error"
        return [Curve("fused", scale * self.distance, chart, unit, "fused")] if len(self.distance) else []

    def bands(self) -> dict[str, Mask]:
        return {"outage": np.any(list(self.missing.values()), axis=0)} if self.missing else {}


def why_not(trace: Trace, checkpoint: Checkpoint | None = None) -> str | None:
    """One-line reason why the diagnostic does not apply, or None."""
    return None if _known_steps(trace).any() else measures.UNKNOWN_TRUTH


def _known_steps(trace: Trace) -> Mask:
    """(T,): counted steps with a known main error."""
    return measures.counted(trace) & np.isfinite(trace.episode.states[:, list(trace.task.main_error.indices)]).all(1)


def errors_of(traces: Sequence[Trace]) -> Errors:
    """Evaluate the errors of one estimator over one or more episodes."""
    first, single = traces[0], len(traces) == 1
    error = [measures.errors(trace)[:, -1] for trace in traces]
    distance = [first.task.main_error.norm(e) for e in error]
    missing = [missing_steps(trace) for trace in traces]
    counted = [_known_steps(trace) for trace in traces]
    outages = (outages_of(k, traces, distance, [m[k] for m in missing], counted) for k in first.task.modalities)
    return Errors(
        task=first.task,
        filter=first.filter,
        trajectories=len(traces),
        groups=tuple(_groups(traces, error, distance)),
        outages=tuple(outage for outage in outages if outage is not None),
        readings=_readings(traces, distance, missing),
        distance=distance[0] if single else np.zeros(0),
        missing=missing[0] if single else {},
        restarts=sum(RESTARTS in trace.settings for trace in traces),
        stay=root_mean_square(np.concatenate([_stay(t)[at] for t, at in zip(traces, counted, strict=True)])),
        starts_at_truth=all(map(measures.starts_at_truth, traces)),
    )


def _stay(trace: Trace) -> Array:
    """(T,): main error of the start as the estimate of all steps."""
    states = trace.episode.states
    return np.asarray(
        trace.task.main_error.norm(trace.task.difference(np.broadcast_to(trace.start_mean, states.shape), states))
    )


def _groups(traces: Sequence[Trace], error: Sequence[Array], distance: Sequence[Array]) -> list[GroupErrors]:
    counted = np.concatenate([_known_steps(trace) for trace in traces])
    every, norm = np.concatenate(error), np.concatenate(distance)
    total = float(np.square(norm[counted]).sum())
    groups = []
    for name, mask in measures.pooled_phases(traces).items():
        at = mask & counted
        if at.any():
            squares = np.square(norm[at])
            rmse, bias = np.sqrt(np.square(every[at]).mean(0)), every[at].mean(0)
            share = float(squares.sum()) / max(total, 1e-300)
            groups.append(GroupErrors(name, int(at.sum()), float(np.sqrt(squares.mean())), rmse, bias, share))
    return groups


def _readings(
    traces: Sequence[Trace], distance: Sequence[Array], missing: Sequence[dict[str, Mask]]
) -> dict[str, tuple[float, float]]:
    """See ``Errors.readings``; only of keys that measure nothing but the map components."""
    task, result = traces[0].task, {}
    for key, channels in task.positions.items():
        if task.observations.get(key) != (2,):
            continue
        rows, modality = [], next((name for name, keys in task.modalities.items() if key in keys), "")
        for trace, d, outages in zip(traces, distance, missing, strict=True):
            if key not in trace.episode.observations:
                continue
            reading = trace.episode.observations[key][:, list(channels)].astype(np.float64)
            off = np.linalg.norm(reading - trace.episode.states[:, list(task.map_indices)], axis=1)
            at = _known_steps(trace) & np.isfinite(off) & ~without_reading(trace.episode, key)
            if modality in outages:
                at &= ~outages[modality]
            rows.append(np.stack([off[at], d[at]]))
        if rows and (both := np.concatenate(rows, axis=1)).size:
            result[key] = (root_mean_square(both[0]), root_mean_square(both[1]))
    return result


ENTRY = Entry(
    name="errors",
    title="Errors and outages",
    question="In which groups of steps are the errors large, and how fast does the estimate recover from an outage?",
    run=errors_of,
    why_not=why_not,
)
