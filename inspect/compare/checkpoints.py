"""Comparison of two filters over the same held-out episodes: improvements and regressions by slice."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.task import with_unit
from beliefscope.datasets.text import percent
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.engine import Engine, Progress
from beliefscope.filters.evaluate import CONSISTENCY
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.finetuning.slices import Slice, standard_slices
from beliefscope.inspect.compare.effects import (
    CHANGE_NOTE,
    EFFECT_NOTE,
    LEVEL,
    Difference,
    Regression,
    differences,
    find_regressions,
)
from beliefscope.inspect.compare.lineage import base_of
from beliefscope.inspect.compare.modules import ModuleChange, module_changes
from beliefscope.inspect.diagnostics.base import Diagnostic
from beliefscope.inspect.diagnostics.views import Line, Plot, Table, Value
from beliefscope.inspect.failures.survey import held_out_or_all
from beliefscope.inspect.statistics.calibration import LEVELS
from beliefscope.inspect.statistics.episode_sums import calibration, measures_of, sample_steps, sum_episodes
from beliefscope.inspect.statistics.intervals import too_few
from beliefscope.inspect.statistics.measures import Array
from beliefscope.inspect.traces.batch import Episodes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_ROWS = 20
"""Maximum number of rows in the tables of improvements and regressions."""

OUTPUT_STEPS = 128
"""Number of steps for comparing module outputs."""

DEPTH = 3
"""Maximum depth of modules in the table of modules; of frozen modules only the outermost are listed."""


@dataclass(frozen=True)
class SliceSize:
    """A slice, and the number of episodes and counted steps that it contains."""

    slice: Slice
    episodes: int
    steps: int


@dataclass(frozen=True)
class CheckpointComparison(Diagnostic):
    """Result of ``compare_checkpoints``; pairs are (before, after).

    Attributes:
        task: task name.
        filters, hashes: names and hashes of the checkpoints.
        finetuned: whether the second checkpoint was fine-tuned from the first.
        episodes: indices in the data set.
        seed, particles: settings of both runs.
        slices: evaluated slices.
        left_out: slices that do not fit the filters, with the reason.
        differences: all measures in all slices.
        calibration: (S, 2, P) share of steps with the true state in the region of each of ``levels`` (P,).
        events: regressed steps, largest increase first.
        modules: changes of the modules that both filters have.
    """

    task: str
    filters: tuple[str, str]
    hashes: tuple[str, str]
    finetuned: bool
    episodes: tuple[int, ...]
    seed: int
    particles: int | None
    slices: tuple[SliceSize, ...]
    left_out: tuple[str, ...]
    differences: tuple[Difference, ...]
    levels: Array
    calibration: Array
    conversion: tuple[str, float]
    events: tuple[Regression, ...]
    modules: tuple[ModuleChange, ...]

    def improvements(self) -> list[Difference]:
        """Improved measures: of clean data, with faults, of single modalities; errors first, then largest effects."""
        return self._ranked((d for d in self.differences if d.improved), -1.0)

    def regressions(self) -> list[Difference]:
        """Regressed measures in the same order."""
        return self._ranked((d for d in self.differences if d.regressed), 1.0)

    def regressed_slices(self) -> list[str]:
        """Slices of all modalities with a regressed measure: clean data, then faults."""
        partial = {size.slice.name for size in self.slices if size.slice.only}
        return list(dict.fromkeys(d.slice for d in self.regressions() if d.slice not in partial))

    def _ranked(self, changes: Iterable[Difference], sign: float) -> list[Difference]:
        slices = {size.slice.name: size.slice for size in self.slices}

        def rank(d: Difference) -> tuple[bool | float, ...]:
            slice_ = slices[d.slice]
            kind = bool(slice_.only), bool(slice_.faults), slice_.contact is not None
            return (*kind, not d.is_error, -sign * d.effect)

        return sorted(changes, key=rank)

    @property
    def frozen(self) -> tuple[str, ...]:
        """Outermost modules whose parameters and buffers have unchanged hashes."""
        names = [m.name for m in self.modules if m.unchanged]
        return tuple(n for n in names if not any(n.startswith(f"{other}.") for other in names))

    @property
    def verdict(self) -> str:
        if self.hashes[0] == self.hashes[1] or not any(d.effect for d in self.differences):
            return f"{self.filters[1]} is identical to {self.filters[0]} in all measures."
        if why := too_few(len(self.episodes)):
            return f"No verdict: {why}."
        errors = [d for d in self.differences if d.is_error]
        improved = _summary("Improved", self.improvements(), errors, -1.0)
        return f"{improved}; {_summary('regressed', self.regressions(), errors, 1.0)}."

    def tables(self) -> list[Table]:
        errors, beliefs = ([d for d in self.differences if d.is_error is kind] for kind in (True, False))
        by_slice = ("slice", "measure", "unit", "before", "after")
        by_change = ("slice", "measure", "before -> after", "change", "95 % interval")
        error_rows = [(*_numbers(d), *map(_percent, (d.effect, d.low, d.high)), d.outcome) for d in errors]
        belief_rows = [(*_numbers(d), *(round(x, 4) for x in (d.effect, d.low, d.high)), d.outcome) for d in beliefs]
        return [
            *(
                Table(title, by_change, rows[:MAX_ROWS], CHANGE_NOTE)
                for title, changes in (("Improvements", self.improvements()), ("Regressions", self.regressions()))
                if (rows := [(d.slice, _title(d), *_change_texts(d)) for d in changes])
            ),
            Table("Errors by slice (RMSE)", (*by_slice, "change %", "low %", "high %", "result"), error_rows),
            Table("Beliefs by slice", (*by_slice, "effect", "low", "high", "result"), belief_rows, EFFECT_NOTE),
            self.event_table(),
            *([self.module_table()] if self.modules else []),
            Table.from_rows("Slices", [*map(_slice_row, self.slices)]),
        ]

    def module_table(self) -> Table:
        """One row per changed or outermost frozen module."""
        names = {m.name for m in self.modules if not m.unchanged and m.name.count(".") < DEPTH} | {*self.frozen}
        return Table.from_rows("Modules", [_module_row(m) for m in self.modules if m.name in names])

    def event_table(self) -> Table:
        """One row per regressed event."""
        timed = any(m.time is not None for m in self.events)
        time = ("time (s)",) if timed else ()
        contact = ("contact",) if any(size.slice.contact is not None for size in self.slices) else ()
        unit, factor = self.conversion
        errors = (with_unit(name, unit) for name in ("before", "after", "increase"))
        rows = [
            (
                *(m.slice, m.episode, m.step, *((m.time,) if timed else ()), m.first, m.last),
                *(("yes" if m.contact else "no",) if contact else ()),
                *(factor * m.before, factor * m.after, factor * (m.after - m.before)),
            )
            for m in self.events
        ]
        return Table("Regressed events", ("slice", "episode", "step", *time, "from", "to", *contact, *errors), rows)

    def plots(self) -> list[Plot]:
        """Main error by slice; calibration of the first slice and of the slice that changed most."""
        main = self.differences[0].measure
        position = [d for d in self.differences if d.measure == main]
        names = tuple(d.slice for d in position)
        x = np.arange(len(position), dtype=np.float64)
        before, after = (np.array(values) for values in zip(*(d.display[:2] for d in position), strict=True))
        bars = (Line("before", x, before), Line("after", x, after, "fused"))
        plots = [
            Plot(f"{main.capitalize()} by slice", "", with_unit("RMSE", self.conversion[0]), bars, "bars", names=names)
        ]
        if np.isnan(self.calibration).all():
            return plots
        changes = np.nan_to_num(np.abs(self.calibration[:, 1] - self.calibration[:, 0]).mean(-1))
        for s in dict.fromkeys((0, int(changes.argmax()))):
            lines = tuple(
                Line(name, self.levels, self.calibration[s, i], layer)
                for i, (name, layer) in enumerate((("before", ""), ("after", "fused")))
            )
            title = f"Calibration: {self.slices[s].slice.name}"
            plots.append(Plot(title, "level of the region", "share of true states inside", lines, diagonal=True))
        return plots


def compare_checkpoints(
    before: Checkpoint,
    after: Checkpoint,
    data: Episodes,
    episodes: Iterable[int] | None = None,
    *,
    slices: Sequence[Slice] = (),
    particles: int = 300,
    seed: int = 0,
    engine: Engine = "local",
    workers: int = 1,
    progress: Progress = None,
) -> CheckpointComparison:
    """Compare two filters of one task: checkpoints or external filters.

    Both run with the same sensor faults and random numbers. Intervals are over episodes, paired between filters.
    An external filter uses only some modalities by ablation (``filters/external/ablation.py``).

    Args:
        episodes: indices in ``data``; by default the held-out episodes of a ``Dataset``, otherwise all.
        slices: slices to evaluate in addition to the standard ones.
        engine, workers: where to run, as for ``filters.engine.run_blocks``. The values do not depend on them.
        progress: called with the completed fraction, 0..1.

    Raises BadInput for checkpoints that cannot be compared, slices that do not fit, and as ``evaluate`` does.
    """
    if before.task.name != after.task.name:
        raise BadInput(f"filters are of tasks {before.task.name!r} and {after.task.name!r}; give two of one task")
    pair, task = (before, after), before.task
    for slice_ in slices:
        for filter_ in pair:
            slice_.check(task, _models(filter_))
    selected, left_out = _standard(pair, {slice_.name for slice_ in slices})
    selected += slices
    indices = tuple(held_out_or_all(data) if episodes is None else episodes)
    members = [data[index] for index in indices]
    sums = sum_episodes(
        pair,
        selected,
        members,
        particles=particles,
        seed=seed,
        engine=engine,
        workers=workers,
        progress=progress,
    )
    counts = sums.sums[:, 0, :, 0]
    finetuned = base_of(after.record).get("hash") == before.hash
    return CheckpointComparison(
        task=task.name,
        filters=(before.name, after.name),
        hashes=(before.hash, after.hash),
        finetuned=finetuned,
        episodes=indices,
        seed=seed,
        particles=particles if "pf" in (before.kind, after.kind) else None,
        slices=tuple(
            SliceSize(slice_, int((counts[:, s] > 0).sum()), int(counts[:, s].sum()))
            for s, slice_ in enumerate(selected)
        ),
        left_out=left_out,
        differences=differences(sums.sums, [slice_.name for slice_ in selected], measures_of(task)),
        levels=LEVELS,
        calibration=calibration(sums.sums.sum(0)).swapaxes(0, 1),
        conversion=task.main_error.conversion,
        events=find_regressions(sums, selected, indices, members, task),
        modules=()
        if any(isinstance(filter_, ExternalFilter) for filter_ in pair)
        else module_changes(
            before.filter,
            after.filter,
            sample_steps(members, task, OUTPUT_STEPS),
            after.record.get("parts") if finetuned else None,
        ),
    )


def _models(checkpoint: Checkpoint) -> tuple[str, ...]:
    """Measurement models that can be used alone."""
    return tuple(checkpoint.task.modalities) if isinstance(checkpoint, ExternalFilter) else checkpoint.filter.names


def _standard(pair: Sequence[Checkpoint], without: set[str]) -> tuple[list[Slice], tuple[str, ...]]:
    """Standard slices that fit the filters except those named, and the reasons why others do not fit."""
    selected, left_out = list[Slice](), list[str]()
    for slice_ in standard_slices(pair[0].task):
        try:
            for filter_ in pair:
                slice_.check(filter_.task, _models(filter_))
        except BadInput as error:
            left_out.append(f"{slice_.name}: {error}")
            continue
        # For a filter of one modality, using only that modality changes nothing.
        if slice_.name not in without and not (slice_.only and len(_models(pair[0])) == 1):
            selected.append(slice_)
    return selected, tuple(left_out)


def _summary(verb: str, changes: Sequence[Difference], errors: Sequence[Difference], sign: float) -> str:
    """The largest significant change and the number of others, or the most likely one if none is significant.

    Args:
        changes: significant changes.
        errors: all differences of errors.
        sign: sign of the effect, 1 for regressions.
    """
    if changes:
        return f"{verb}: {_description(changes[0])}{f' and {len(changes) - 1} more' if len(changes) > 1 else ''}"
    possible = [d for d in errors if max(sign * d.low, sign * d.high) >= math.log1p(LEVEL)]
    if not possible:
        return f"{verb}: nothing by more than {percent(LEVEL)}"
    largest = max(possible, key=lambda d: sign * d.effect)
    change = f"; largest change {_description(largest)}" if sign * largest.effect > 0.0 else ""
    return f"{verb}: nothing significant{change}"


def _description(d: Difference) -> str:
    values, change, interval = _change_texts(d)
    return f"{d.slice}: {_title(d)} {values} ({change}, 95 % interval {interval})"


def _title(d: Difference) -> str:
    return CONSISTENCY.get(d.measure, d.measure.replace("_", " "))


def _change_texts(d: Difference) -> tuple[str, str, str]:
    """Values, change and interval as text: of coverage in points, of the NLL in nats, of others in percent."""
    before, after, unit = d.display
    if d.measure in ("coverage95", "miscalibration"):
        texts, change_unit = [f"{100 * x:+z.1f}" for x in d.change], "points"
    elif d.measure == "nll":
        texts, change_unit = [f"{x:+z.3g}" for x in d.change], unit
    else:
        texts, change_unit = [_factor(x) for x in (d.effect, d.low, d.high)], "%"
    change, low, high = texts
    return f"{before:z.3g} -> {after:z.3g} {unit}".rstrip(), f"{change} {change_unit}", f"{low} to {high}"


def _factor(effect: float) -> str:
    """Logarithm of a factor as change in percent."""
    return f"{100 * math.expm1(min(effect, 30.0)):+z.3g}"


def _numbers(d: Difference) -> tuple[Value, ...]:
    before, after, unit = d.display
    return d.slice, _title(d), unit, before, after


def _percent(effect: float) -> float:
    return round(100.0 * math.expm1(min(effect, 30.0)), 2)


def _slice_row(size: SliceSize) -> dict[str, Value]:
    slice_ = size.slice
    return {
        "slice": slice_.name,
        "faults": str(slice_.faults),
        "phase": "all" if slice_.contact is None else "contact" if slice_.contact else "free motion",
        "only": " + ".join(slice_.only),
        "episodes": size.episodes,
        "steps": size.steps,
    }


def _module_row(m: ModuleChange) -> dict[str, Value]:
    return {
        "module": m.name,
        "class": m.kind,
        "parameters": m.parameters,
        "gradient": m.gradient,
        "weights changed %": 100.0 * m.weights,
        "output drift %": 100.0 * m.drift,
        "frozen": "yes" if m.unchanged else "",
        "SHA-256": m.hashes[0][:12] if m.unchanged else " -> ".join(digest[:12] for digest in m.hashes),
    }


def write_comparison(folder: Path, document: Mapping[str, Any], text: str, figure: Figure) -> None:
    """Write a comparison into a new folder as JSON, figure (SVG and PDF) and Markdown."""
    from beliefscope.inspect.diagnostics.plotting import write_figure  # matplotlib is slow to import

    folder.mkdir()
    for suffix in ("svg", "pdf"):
        write_figure(figure, folder / f"change.{suffix}")
    write_atomically(folder / "change.md", f"```\n{text}\n```\n".encode())
    write_atomically(folder / "change.json", (json.dumps(document, indent=2) + "\n").encode())
