"""The table of a study: means and spreads over the seeds, as rows, CSV and Markdown."""

from __future__ import annotations

import csv
import io
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from beliefscope.datasets.catalog import find_task
from beliefscope.filters.evaluate import nees_bounds
from beliefscope.filters.training.plan import BLACKOUTS

TRIVIAL = "training mean"
"""In place of a filter's name: the predictor that always returns the mean of the training states."""

CONSISTENCY = ("nll", "nees", "coverage95", "seconds")

Document = dict[str, Any]
"""The JSON document of a cell."""

Numbers = Mapping[str, float | None]


class Condition(Protocol):
    """A cell of a study, by task and filter."""

    @property
    def task(self) -> str: ...

    @property
    def filter(self) -> str: ...


@dataclass(frozen=True)
class Row:
    """One row of the table.

    Attributes:
        task, filter: names; ``TRIVIAL`` for the trivial predictor. blackout: probability of an image blackout; None
            for the trivial predictor.
        seeds: number of finished seeds. requested, failed: number of requested and failed ones.
        mean, spread: over the seeds, by quantity: RMSE (``hinge_x_cm``, ..., ``position_cm``), ``nll``, ``nees``,
            ``coverage95``, ``seconds`` of training. The spread is the standard deviation (n - 1). None if a seed lacks
            the quantity, and for the spread of one seed.
        bounds: of ``nees``, see ``nees_bounds``. None without a covariance.
        updates: modality -> mean RMSE over the seeds of its single-modality updates, which start from the fused prior;
            empty for studies of earlier versions. standalone: the same for the filter with only that modality. Both for
            filters of several models only. by_seed: seed -> quantity -> value.
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


def rows_of(documents: Mapping[Any, Document | None]) -> list[Row]:
    """The rows of the requested cells (each a ``Condition``), computed from the finished ones."""
    rows = []
    cells: Sequence[Condition] = list(documents)
    for task in dict.fromkeys(cell.task for cell in cells):
        finished: list[Document] = []
        for name in dict.fromkeys(cell.filter for cell in cells if cell.task == task):
            requested = [documents[cell] for cell in cells if (cell.task, cell.filter) == (task, name)]
            finished += [d for d in requested if d is not None and "error" not in d]
            rows += _filter_rows(task, name, requested)
        if finished:
            rows.append(Row(task, TRIVIAL, None, 0, 0, 0, finished[0]["trivial"], {}))
    return rows


def _filter_rows(task: str, name: str, documents: Sequence[Document | None]) -> list[Row]:
    """One row for each probability of an image blackout."""
    finished = [d for d in documents if d is not None and "error" not in d]
    failed = sum(d is not None and "error" in d for d in documents)
    rows = []
    for blackout in BLACKOUTS:
        by_seed = {str(d["seed"]): _numbers(d, blackout) for d in finished}
        mean, spread = _over_seeds(list(by_seed.values()))
        bounds = None
        if mean.get("nees") is not None:
            trajectories = finished[0]["episodes"]["test"] or finished[0]["episodes"]["val"]
            bounds = nees_bounds(len(find_task(task).components), trajectories)
        metrics = [d["metrics"][f"{blackout:g}"] for d in finished]
        standalone = _over_modalities([{k: m for k, m in by_name.items() if k != "fused"} for by_name in metrics])
        updates = _over_modalities([by_name["fused"].get("updates", {}) for by_name in metrics])
        counts = len(finished), len(documents), failed
        rows.append(Row(task, name, blackout, *counts, mean, spread, bounds, standalone, updates, by_seed))
    return rows


def _numbers(document: Document, blackout: float) -> dict[str, float | None]:
    fused = document["metrics"][f"{blackout:g}"]["fused"]
    consistency = {key: fused[key] for key in ("nll", "nees", "coverage95")}
    rmse = {key: fused["rmse"][key] for key in document["trivial"]}
    return rmse | consistency | {"seconds": document["seconds"]}


def _over_modalities(metrics: Sequence[Document]) -> dict[str, dict[str, float | None]]:
    """Mean RMSE over the seeds by modality; a modality that a seed lacks is omitted."""
    names = [name for name in (metrics[0] if metrics else ()) if all(name in by_name for by_name in metrics)]
    return {name: _over_seeds([by_name[name]["rmse"] for by_name in metrics])[0] for name in names}


def _over_seeds(numbers: Sequence[Numbers]) -> tuple[dict[str, Any], dict[str, Any]]:
    mean: dict[str, float | None] = {}
    spread: dict[str, float | None] = {}
    for key in numbers[0] if numbers else ():
        values = [value for by_key in numbers if (value := by_key[key]) is not None]
        complete = len(values) == len(numbers)
        mean[key] = statistics.fmean(values) if complete else None
        spread[key] = statistics.stdev(values) if complete and len(values) > 1 else None
    return mean, spread


def quantities(rows: Sequence[Row]) -> list[str]:
    """Keys of the rows' RMSE, in order, then those of ``CONSISTENCY``."""
    rmse = dict.fromkeys(key for row in rows for key in row.mean if key not in CONSISTENCY)
    return [*rmse, *CONSISTENCY]


def to_csv(rows: Sequence[Row]) -> str:
    """The table with unrounded values; missing ones are empty."""
    keys = quantities(rows)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = [f"{key}_{part}" for key in keys for part in ("mean", "spread")]
    counts = ("seeds", "seeds_requested", "seeds_failed")
    writer.writerow(["task", "filter", "blackout", *counts, *columns, "nees_low", "nees_high"])
    for row in rows:
        values = [part.get(key) for key in keys for part in (row.mean, row.spread)]
        bounds = row.bounds or (None, None)
        seeds = (row.seeds, row.requested, row.failed) if row.filter != TRIVIAL else (None, None, None)
        writer.writerow([row.task, row.filter, row.blackout, *seeds, *values, *bounds])
    return text.getvalue()


def to_markdown(rows: Sequence[Row]) -> str:
    """A table for each task: mean ± spread over the seeds."""
    return "\n".join(_task_table(task, [r for r in rows if r.task == task]) for task in {r.task: 0 for r in rows})


def _task_table(task: str, rows: Sequence[Row]) -> str:
    keys = quantities(rows)
    titles = {"nll": "NLL", "nees": "NEES/n", "coverage95": "coverage", "seconds": "training (s)"}
    names = [titles.get(key) or "{} ({})".format(*key.rsplit("_", 1)) for key in keys]
    names.insert(keys.index("nees") + 1, "consistent NEES/n")
    lines = [
        f"## {task}\n",
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
    return "\n".join(lines) + "\n" + _modality_table(rows)


def _modality_table(rows: Sequence[Row]) -> str:
    """Position RMSE of the updates and of the standalone filter of every modality; empty without any."""
    names = dict.fromkeys(name for row in rows for name in row.standalone)
    if not names:
        return ""
    heads = [head for name in names for head in (f"{name}-only update", f"{name} standalone")]
    lines = [
        "\nPosition (cm) by modality: an update starts at every step from the fused prior, a standalone filter never "
        "uses the other modalities.\n",
        f"| filter | image blackout | fused | {' | '.join(heads)} |",
        "| --- |" + " ---: |" * (len(heads) + 2),
    ]
    for row in rows:
        if row.standalone:
            by_modality = (
                part.get(name, {}).get("position_cm") for name in names for part in (row.updates, row.standalone)
            )
            values = ["" if v is None else f"{v:.2f}" for v in (row.mean.get("position_cm"), *by_modality)]
            lines.append(f"| {row.filter} | {row.blackout:.0%} | {' | '.join(values)} |")
    return "\n".join(lines) + "\n"


def _value(row: Row, key: str) -> str:
    value, spread = row.mean.get(key), row.spread.get(key)
    if value is None:
        return ""
    digits = 0 if key == "seconds" else 2
    return f"{value:.{digits}f}" + ("" if spread is None else f" ± {spread:.{digits}f}")
