"""The table of a study: means and spreads over the seeds, as rows, CSV and Markdown."""

from __future__ import annotations

import csv
import io
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from beliefscope.datasets.task import Task
from beliefscope.datasets.text import capitalised
from beliefscope.filters.evaluate import BASELINES, nees_bounds
from beliefscope.filters.start_offset import STUDY_OFFSET
from beliefscope.filters.training.plan import evaluated_blackouts

TRIVIAL = "training mean"
"""In place of a filter's name: the predictor that always returns the mean of the training states."""

OFFSET, TRUTH = "offset_metrics", "metrics"
"""Keys of a cell's metrics from starts with ``STUDY_OFFSET``, and at the truth. Offset starts come first in tables: at
the truth, an estimator that keeps the start has no error where the state does not move."""

CONSISTENCY = ("nll", "nees", "coverage95", "seconds")

Document = dict[str, Any]
"""The JSON document of a cell."""

Numbers = Mapping[str, float | None]


class Condition(Protocol):
    """A cell of a study, by task and filter."""

    @property
    def task(self) -> str: ...

    @property
    def definition(self) -> Task: ...

    @property
    def filter(self) -> str: ...


@dataclass(frozen=True)
class Row:
    """One row of the table.

    Attributes:
        task, filter: names; ``TRIVIAL`` for the trivial predictor. blackout: probability of an image blackout; None
            for the trivial predictor.
        start: offset of the first belief, such as ``3cm,20deg``; empty at the truth.
        seeds: number of finished seeds. requested, failed: number of requested and failed ones.
        mean, spread: over the seeds, by quantity: RMSE (``hinge_x_cm``, ..., ``position_cm``), ``nll``, ``nees``,
            ``coverage95``, ``seconds`` of training. The spread is the standard deviation (n - 1). None if a seed lacks
            the quantity, and for the spread of one seed.
        bounds: of ``nees``, see ``nees_bounds``. None without a covariance.
        updates: modality -> mean RMSE over the seeds of its single-modality updates, which start from the fused prior;
            empty for studies of earlier versions. standalone: the same for the filter with only that modality. Both for
            filters of several models only. by_seed: seed -> quantity -> value.
        from_step_0: mean RMSE over the seeds without omitting the first steps. baselines: name in ``BASELINES`` -> mean
            RMSE over the seeds from the same starts. Both empty for studies of earlier versions.
        main: key of the task's main error.
    """

    task: str
    filter: str
    blackout: float | None
    seeds: int
    requested: int
    failed: int
    mean: Numbers
    spread: Numbers
    bounds: tuple[float, float] | None = None
    standalone: Mapping[str, Numbers] = field(default_factory=dict)
    updates: Mapping[str, Numbers] = field(default_factory=dict)
    by_seed: Mapping[str, Numbers] = field(default_factory=dict)
    start: str = ""
    from_step_0: Numbers = field(default_factory=dict)
    baselines: Mapping[str, Numbers] = field(default_factory=dict)
    main: str = "position_cm"


def rows_of(documents: Mapping[Any, Document | None]) -> list[Row]:
    """The rows of the requested cells (each a ``Condition``), computed from the finished ones.

    Conditions without metrics of any finished cell of the task are omitted, such as offset starts of earlier versions.
    """
    rows = []
    cells: Sequence[Condition] = list(documents)
    for task, definition in {cell.task: cell.definition for cell in cells}.items():
        requested: dict[str, list[Document | None]] = {}
        for cell in cells:
            if cell.task == task:
                requested.setdefault(cell.filter, []).append(documents[cell])
        finished = [d for members in requested.values() for d in members if d is not None and "error" not in d]
        for key in (OFFSET, TRUTH):
            blackouts = [
                b
                for b in evaluated_blackouts(definition)
                if not finished or any(f"{b:g}" in d.get(key, {}) for d in finished)
            ]
            for name, members in requested.items():
                rows += [_row(definition, name, key, blackout, members) for blackout in blackouts]
        if finished:
            rows.append(Row(task, TRIVIAL, None, 0, 0, 0, finished[0]["trivial"], {}, main=definition.main_error.key))
    return rows


def _row(task: Task, name: str, key: str, blackout: float, requested: Sequence[Document | None]) -> Row:
    """The row of one condition: the seeds with metrics ``key`` at this probability of an image blackout."""
    failed = sum(d is not None and "error" in d for d in requested)
    finished = [d for d in requested if d is not None and f"{blackout:g}" in d.get(key, {})]
    metrics = [d[key][f"{blackout:g}"] for d in finished]
    fused = [by_name["fused"] for by_name in metrics]
    by_seed = {str(d["seed"]): _numbers(m, d["seconds"]) for d, m in zip(finished, fused, strict=True)}
    mean, spread = _over_seeds(list(by_seed.values()))
    bounds = None
    if mean.get("nees") is not None:
        trajectories = finished[0]["episodes"]["test"] or finished[0]["episodes"]["val"]
        bounds = nees_bounds(len(task.components), trajectories)
    return Row(
        task.name,
        name,
        blackout,
        *(len(finished), len(requested), failed),
        mean,
        spread,
        bounds,
        standalone=_rmse_by_name([{k: m for k, m in by_name.items() if k != "fused"} for by_name in metrics]),
        updates=_rmse_by_name([m.get("updates", {}) for m in fused]),
        by_seed=by_seed,
        start=str(STUDY_OFFSET.for_task(task)) if key == OFFSET else "",
        from_step_0=_over_seeds([m.get("rmse_from_step_0", {}) for m in fused])[0],
        baselines=_rmse_by_name([{k: m for k, m in f.get("baselines", {}).items() if m} for f in fused]),
        main=task.main_error.key,
    )


def _numbers(metrics: Document, seconds: float | None) -> dict[str, float | None]:
    consistency = {key: metrics[key] for key in ("nll", "nees", "coverage95")}
    return {**metrics["rmse"], **consistency, "seconds": seconds}


def _rmse_by_name(metrics: Sequence[Document]) -> dict[str, dict[str, float | None]]:
    """Mean RMSE over the seeds by modality or baseline; one that a seed lacks is omitted."""
    names = [name for name in (metrics[0] if metrics else ()) if all(name in by_name for by_name in metrics)]
    return {name: _over_seeds([by_name[name]["rmse"] for by_name in metrics])[0] for name in names}


def _over_seeds(numbers: Sequence[Numbers]) -> tuple[dict[str, Any], dict[str, Any]]:
    mean: dict[str, float | None] = {}
    spread: dict[str, float | None] = {}
    for key in numbers[0] if numbers else ():
        values = [value for by_key in numbers if (value := by_key.get(key)) is not None]
        complete = len(values) == len(numbers)
        mean[key] = statistics.fmean(values) if complete else None
        spread[key] = statistics.stdev(values) if complete and len(values) > 1 else None
    return mean, spread


def quantities(rows: Sequence[Row]) -> list[str]:
    """Keys of the rows' RMSE, in order, then those of ``CONSISTENCY``."""
    rmse = dict.fromkeys(key for row in rows for key in row.mean if key not in CONSISTENCY)
    return [*rmse, *CONSISTENCY]


def _errors(keys: Sequence[str]) -> list[str]:
    return [key for key in keys if key not in CONSISTENCY]


def to_csv(rows: Sequence[Row]) -> str:
    """The table with unrounded values; missing ones are empty."""
    keys = quantities(rows)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = [f"{key}_{part}" for key in keys for part in ("mean", "spread")]
    others = [f"{key}_{part}" for key in _errors(keys) for part in ("from_step_0", *BASELINES)]
    counts = ("seeds", "seeds_requested", "seeds_failed")
    names = ["task", "filter", "start_offset", "blackout", *counts, *columns, *others, "nees_low", "nees_high"]
    writer.writerow(names)
    for row in rows:
        values = [part.get(key) for key in keys for part in (row.mean, row.spread)]
        parts = (row.from_step_0, *(row.baselines.get(name, {}) for name in BASELINES))
        values += [part.get(key) for key in _errors(keys) for part in parts]
        bounds = row.bounds or (None, None)
        seeds = (row.seeds, row.requested, row.failed) if row.filter != TRIVIAL else (None, None, None)
        writer.writerow([row.task, row.filter, row.start, row.blackout, *seeds, *values, *bounds])
    return text.getvalue()


def to_markdown(rows: Sequence[Row]) -> str:
    """A table for each task and start: mean ± spread over the seeds."""
    conditions = dict.fromkeys((row.task, row.start) for row in rows)
    return "\n".join(_table(*pair, [r for r in rows if (r.task, r.start) == pair]) for pair in conditions)


def _table(task: str, start: str, rows: Sequence[Row]) -> str:
    keys = quantities(rows)
    titles = {"nll": "NLL", "nees": "NEES/n", "coverage95": "coverage", "seconds": "training (s)"}
    names = [titles.get(key) or label(key) for key in keys]
    names.insert(keys.index("nees") + 1, "consistent NEES/n")
    lines = [
        f"## {task}, {start_label(start)}\n",
        f"| filter | image blackout | seeds | {' | '.join(names)} |",
        "| --- |" + " ---: |" * (len(names) + 2),
    ]
    for row in rows:
        blackout = "any" if row.blackout is None else f"{row.blackout:.0%}"
        seeds = f"{row.seeds} of {row.requested}" + (f", {row.failed} failed" if row.failed else "")
        values = [_value(row, key) for key in keys]
        bounds = "" if row.bounds is None else "{:.2f} to {:.2f}".format(*row.bounds)
        values.insert(keys.index("nees") + 1, bounds)
        if row.filter == TRIVIAL:
            seeds = ""
        elif not row.seeds:
            values = ["failed" if row.failed == row.requested else "missing"] + [""] * (len(values) - 1)
        lines.append(f"| {row.filter} | {blackout} | {seeds} | {' | '.join(values)} |")
    return "\n".join(lines) + "\n" + _baseline_table(rows) + _modality_table(rows)


def label(key: str) -> str:
    """``angle (deg)`` for ``angle_deg``."""
    return "{} ({})".format(*key.rsplit("_", 1))


def start_label(start: str) -> str:
    """Of ``Row.start``: ``start offset 3cm,20deg``."""
    return f"start offset {start}" if start else "start at the truth"


def headline_keys(rmse: Iterable[str], main: str = "position_cm") -> list[str]:
    """Keys of the RMSE of the main error and of each angle, of all keys."""
    return [main, *(key for key in rmse if key.endswith("_deg") and key != main)]


def _baseline_table(rows: Sequence[Row]) -> str:
    """RMSE from step 0 and of the baselines, for position and angles; empty without any."""
    lines, names = [], [name for name in BASELINES if any(row.baselines.get(name) for row in rows)]
    for row in rows:
        parts = [row.mean, row.from_step_0, *(row.baselines.get(name, {}) for name in names)]
        for key in headline_keys(row.mean, row.main) if row.baselines else ():
            values = ["" if (value := part.get(key)) is None else f"{value:.2f}" for part in parts]
            lines.append(f"| {row.filter} | {row.blackout:.0%} | {label(key)} | {' | '.join(values)} |")
    if not lines:
        return ""
    head = ["\nThe RMSE, the RMSE from step 0 and the baselines, all from the same starts.\n"]
    head.append(f"| filter | image blackout | quantity | RMSE | from step 0 | {' | '.join(names)} |")
    head.append("| --- | ---: | --- |" + " ---: |" * (2 + len(names)))
    return "\n".join(head + lines) + "\n"


def _modality_table(rows: Sequence[Row]) -> str:
    """Main RMSE of the updates and of the standalone filter of every modality; empty without any."""
    names = dict.fromkeys(name for row in rows for name in row.standalone)
    if not names:
        return ""
    heads = [head for name in names for head in (f"{name}-only update", f"{name} standalone")]
    title = label(rows[0].main)
    lines = [
        f"\n{capitalised(title)} by modality: an update starts at every step from the fused prior, a "
        "standalone filter never uses the other modalities.\n",
        f"| filter | image blackout | fused | {' | '.join(heads)} |",
        "| --- |" + " ---: |" * (len(heads) + 2),
    ]
    for row in rows:
        if row.standalone:
            by_modality = (part.get(name, {}).get(row.main) for name in names for part in (row.updates, row.standalone))
            values = ["" if v is None else f"{v:.2f}" for v in (row.mean.get(row.main), *by_modality)]
            lines.append(f"| {row.filter} | {row.blackout:.0%} | {' | '.join(values)} |")
    return "\n".join(lines) + "\n"


def _value(row: Row, key: str) -> str:
    value, spread = row.mean.get(key), row.spread.get(key)
    if value is None:
        return ""
    digits = 0 if key == "seconds" else 2
    return f"{value:.{digits}f}" + ("" if spread is None else f" ± {spread:.{digits}f}")
