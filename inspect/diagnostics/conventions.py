"""Conventions of the inputs: whether other signs, scales, axes or delays of the readings lower the error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.control_faults import has_position
from beliefscope.datasets.faults.injection import Faults, apply_to
from beliefscope.datasets.task import Task, display_name
from beliefscope.datasets.text import percent
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.engine import Progress
from beliefscope.filters.subsets import modalities_of
from beliefscope.inspect.diagnostics.base import Diagnostic, Entry
from beliefscope.inspect.diagnostics.shapley import run_subsets
from beliefscope.inspect.diagnostics.standalone_modalities import of_standalone_run
from beliefscope.inspect.diagnostics.views import Array, Line, Plot, Table
from beliefscope.inspect.statistics.intervals import LEVEL, MIN_TRAJECTORIES, jackknife, too_few
from beliefscope.inspect.statistics.measures import (
    Mask,
    error_names,
    means,
    removed_share,
    squared_errors,
    starts_at_truth,
)
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all

SCALES = (0.1, 10.0)
"""Factors of a sensor in other units."""

MAX_AXES = 3
"""Number of first channels of a sensor that are exchanged in pairs."""

DELAY = 2
"""Steps by which a modality, or the controls, are delayed."""

MAX_BARS = 5
"""Number of changes in the plot; the table has all."""

RELEVANT = 0.2
"""Smallest share of an error whose removal the verdict mentions."""


@dataclass(frozen=True)
class Change:
    """A change of the inputs.

    Attributes:
        text: in words.
        faults: fault injection that makes the change.
        modality: of the sensor; empty for the controls.
    """

    text: str
    faults: str
    modality: str = ""


@dataclass(frozen=True)
class Conventions(Diagnostic):
    """Result of ``conventions``, with C changes and Q errors.

    Attributes:
        task, filter, trajectories: of the traces.
        at_truth: whether the runs start at the true state.
        changes: of the inputs.
        errors: Q names; the main error first.
        share, low, high: (C, Q) share of the RMS error over the counted steps that a change removes, negative if it
            adds some, with intervals over episodes which hold the level of 95 % for all changes and errors
            together; NaN below ``MIN_TRAJECTORIES`` episodes.
        omitted: (C, Q) as ``share``, for the runs without the modality of the change; for the controls, for the first
            estimate at all steps.
    """

    task: Task
    filter: str
    trajectories: int
    at_truth: bool
    changes: tuple[Change, ...]
    errors: tuple[str, ...]
    share: Array
    low: Array
    high: Array
    omitted: Array

    @property
    def relevant_removals(self) -> list[tuple[int, int]]:
        """Change and error, by their indices, of relevant removals, largest first.

        More than the omission of the input removes: a change that only makes a filter ignore a bad input is none.
        """
        significant = self.low > 0.0 if self.trajectories >= MIN_TRAJECTORIES else np.ones_like(self.share, dtype=bool)
        rows, columns = np.nonzero(self._large & significant)
        order = np.argsort(-self.share[rows, columns])
        return [(int(rows[k]), int(columns[k])) for k in order]

    @property
    def _large(self) -> Mask:
        """(C, Q): removals of at least ``RELEVANT``, also of the error that remains without the input."""
        gain = 1.0 - (1.0 - self.share) / (1.0 - np.maximum(self.omitted, 0.0))
        return (self.share >= RELEVANT) & (gain >= RELEVANT)

    @property
    def alarms(self) -> tuple[str, ...]:
        if self.trajectories < MIN_TRAJECTORIES:
            return ()
        return tuple(f"{self.changes[i].text}: {self._effect(i, j)}" for i, j in self.relevant_removals)

    @property
    def verdict(self) -> str:
        count = len(self.changes)
        if not self.relevant_removals:
            adverb, end = "significantly " if self._large.any() else "", ""
            if not adverb and (self.share >= RELEVANT).any():
                end = " below that without the input"
            limit = f"{percent(RELEVANT)} or more{end}"
            text = f"None of {count} changes of signs, scales, axes and delays {adverb}lowers an error by {limit}."
        else:
            i, j = self.relevant_removals[0]
            text = f"With {self.changes[i].text}, {self._effect(i, j)}: filter and data may disagree about it."
        if self.at_truth:
            text += " Runs start at the true state, where few readings can lower the error."
        if why := too_few(self.trajectories):
            text += f" No intervals: {why}."
        return text

    def _effect(self, i: int, j: int) -> str:
        low, high = self.low[i, j], min(self.high[i, j], 1.0)
        interval = "" if np.isnan(low) else f" ({100 * low:z.0f} to {100 * high:z.0f})"
        return f"the {self.errors[j]} error falls by {percent(self.share[i, j])}{interval}"

    def tables(self) -> list[Table]:
        has_intervals = self.trajectories >= MIN_TRAJECTORIES
        heads = [
            head
            for name in self.errors
            for head in (f"{name} error removed, %", *(("from", "to") if has_intervals else ()), "without the input")
        ]
        rows = []
        for i in np.argsort(-self.share.max(1)):
            numbers = np.stack([self.share[i], self.low[i], self.high[i], self.omitted[i]], axis=1)
            displayed = (numbers if has_intervals else numbers[:, [0, 3]]).ravel()
            rows.append((self.changes[i].text, *(100.0 * displayed), self.changes[i].faults))
        note = "Intervals of 95 % for all of them together. Inject the fault to see the run with the change."
        return [Table("Errors with other conventions", ("with", *heads, "fault injection"), rows, note)]

    def plots(self) -> list[Plot]:
        """The changes that remove most; bars below -100 %, of errors that more than double, are cut off."""
        first = np.argsort(-self.share.max(1), kind="stable")[:MAX_BARS]
        texts = tuple(self.changes[i].text for i in first)
        x, share = np.arange(len(texts), dtype=np.float64), np.maximum(self.share[first], -1.0)
        lines = tuple(
            Line(name, x, 100.0 * share[:, j], layer="" if j else "fused") for j, name in enumerate(self.errors)
        )
        more = f", first {len(first)} of {len(self.changes)} changes" if len(first) < len(self.changes) else ""
        return [Plot(f"Removed error{more}", "", "% of the RMS error", lines, "bars", names=texts)]


def changes_of(task: Task, modalities: Sequence[str], episode: Episode) -> tuple[Change, ...]:
    """Changes of the inputs that a filter with these modalities uses."""
    result = []
    for modality in modalities:
        for key in task.modalities[modality]:
            readings = episode.observations.get(key)
            if readings is not None and key not in task.images and not np.isin(readings, (0, 1)).all():  # no flags
                result += _of_sensor(task, key, modality, readings.shape[1] if readings.ndim == 2 else 1)
        text = f"{display_name(modality)} delayed by {DELAY} steps"
        result.append(Change(text, f"delay={modality}:steps={DELAY}", modality))
    channels = episode.controls.shape[-1]
    if channels > 1 and not has_position(channels):
        for i in range(min(channels, MAX_AXES)):
            (name,) = _channel_names(task, "control", (i,))
            text = f"the opposite sign of {name} of the controls"
            result.append(Change(text, f"control_scale=-1:channel={i}"))
    if channels:
        result.append(Change(f"controls delayed by {DELAY} steps", f"control_delay={DELAY}"))
        result += [Change(f"controls times {f:g}", f"control_scale={f:g}") for f in (-1.0, *SCALES)]
    return tuple(change for change in result if apply_to(change.faults, task))


def _channel_names(task: Task, key: str, indices: Sequence[int]) -> list[str]:
    """Names of channels within a sentence; without own ones, ``channel 0``, or ``channels 0`` and ``1``."""
    if key in task.channels:
        return [display_name(task.channels[key][i].name) for i in indices]
    return [f"channel{'s' * (len(indices) > 1)} {indices[0]}", *map(str, indices[1:])]


def _of_sensor(task: Task, key: str, modality: str, channels: int) -> list[Change]:
    """Changes of a sensor with a number of channels; that of an array is 1."""
    name = display_name(key)
    result = [Change(f"the opposite sign of {name}", f"sensor_gain={key}:factor=-1", modality)]
    result += [Change(f"{name} times {f:g}", f"sensor_gain={key}:factor={f:g}", modality) for f in SCALES]
    for i, j in combinations(range(min(channels, MAX_AXES)), 2):
        text = f"{' and '.join(_channel_names(task, key, (i, j)))} of {name} exchanged"
        result.append(Change(text, f"sensor_swapped={key}:first={i}:second={j}", modality))
    return result


def conventions(traces: Sequence[Trace], checkpoint: Checkpoint, progress: Progress = None) -> Conventions:
    """Run a filter over the episodes of traces with each change of its inputs, with the same random numbers."""
    first, report, modalities = traces[0], progress or (lambda share: None), modalities_of(checkpoint)
    changes, errors = changes_of(first.task, modalities, first.episode), error_names(first.task)
    sums = np.empty((len(traces), len(changes), len(errors), 2))
    before = sums[..., 0] = np.array([squared_errors(trace) for trace in traces])[:, None]
    for i, change in enumerate(changes):
        sums[:, i, :, 1] = _with_change(checkpoint, traces, Faults.parse(change.faults))
        report((i + 1) / (len(changes) + len(modalities)))
    share, low, high = jackknife(sums, removed_share, 1.0 - (1.0 - LEVEL) / (len(changes) * len(errors)))
    others = ~np.eye(len(modalities), dtype=bool)
    without = np.sum([squared_errors(t, run_subsets(checkpoint, t, subsets=others)) for t in traces], axis=0)
    still = np.sum([squared_errors(t, np.repeat(means(t)[:1, -1], len(t), axis=0)) for t in traces], axis=0)
    by_input = removed_share(np.stack(np.broadcast_arrays(before.sum(0), np.vstack([without, still])), axis=-1))
    omitted = by_input[[modalities.index(change.modality) if change.modality else -1 for change in changes]]
    at_truth = all(map(starts_at_truth, traces))
    count = len(traces)
    return Conventions(first.task, first.filter, count, at_truth, changes, tuple(errors), share, low, high, omitted)


def _with_change(checkpoint: Checkpoint, traces: Sequence[Trace], change: Faults) -> Array:
    """(R, Q) squared errors of traces whose episodes have a further fault; different episodes run together."""
    values: dict[int, Array] = {}
    groups: dict[tuple[int, int], dict[int, int]] = {}
    for number, trace in enumerate(traces):
        repetition = sum(other.episode_index == trace.episode_index for other in traces[:number])
        groups.setdefault((trace.seed, repetition), {})[trace.episode_index] = number
    particles = int(traces[0].settings.get("particles", 300))
    for (seed, _), numbers in groups.items():
        episodes = {index: change.apply(traces[number].episode) for index, number in numbers.items()}
        for trace in trace_all(checkpoint, episodes, episodes, seed, particles):
            values[numbers[trace.episode_index]] = squared_errors(trace)
    return np.array([values[number] for number in range(len(traces))])


def why_not(trace: Trace, checkpoint: Checkpoint | None) -> str | None:
    """One-line reason why the diagnostic does not apply, or None."""
    if why := of_standalone_run(trace):
        return why
    if not np.isfinite(trace.episode.states).all():
        return "the episode has no ground truth at some steps"
    if checkpoint is not None and not changes_of(trace.task, modalities_of(checkpoint), trace.episode):
        return f"filter {trace.filter} has no input with a sign, a scale, axes or a delay"
    return None


ENTRY = Entry(
    name="conventions",
    title="Conventions of the inputs",
    question="Does the error fall with another sign, scale, delay or order of axes of a sensor or of the controls?",
    run=conventions,
    why_not=why_not,
    needs="filter",
    slow=True,
)
