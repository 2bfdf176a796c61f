"""A study: filters x tasks x seeds, each trained once and measured with black pictures, and the table of all of it."""

from __future__ import annotations

import csv
import fcntl
import hashlib
import io
import json
import logging
import math
import os
import statistics
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from scipy.special import chdtri

from beliefscope.datasets.catalog import find_task, load_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.catalog import architecture
from beliefscope.filters.checkpoint import save_checkpoint
from beliefscope.filters.evaluate import LEFT_OUT, metrics
from beliefscope.filters.training.stages import BLACKOUTS, Report
from beliefscope.filters.training.train import PLANS, train, versions

TRIVIAL = "training mean"
"""Stands in place of a filter for the predictor that always says the mean of the training states."""

Document = dict[str, Any]
"""The JSON document of a cell."""


@dataclass(frozen=True)
class Cell:
    """One filter to be trained once, and what its numbers depend on.

    Attributes:
        task: its name. source: what ``load_task`` knows it by: the name, or ``path/to/file.py:NAME``.
        filter, seed, preset: names the architecture and the plan.
        data: file or folder of the episodes. data_hash: of them. skip_bad: leave out those that cannot be used.
    """

    task: str
    filter: str
    seed: int
    preset: str
    source: str
    data: Path
    data_hash: str
    skip_bad: bool = False

    def __str__(self) -> str:
        return f"{self.task}/{self.filter}/seed{self.seed}"

    def path(self, folder: Path, suffix: str = ".json") -> Path:
        return folder / "cells" / f"{self}{suffix}"

    def depends_on(self) -> Document:
        """What a document must hold to be this cell's, as JSON gives it back."""
        load_task(self.source)
        return {
            "task": self.task,
            "filter": self.filter,
            "architecture": architecture(self.task, self.filter).to_json(),
            "seed": self.seed,
            "plan": json.loads(json.dumps(asdict(PLANS[self.preset]))),
            "blackouts": list(BLACKOUTS),
            "data_hash": self.data_hash,
            "versions": versions(),
        }

    def document(self, folder: Path) -> Document | None:
        """The document of the finished or failed cell; None where there is none that is this cell's, and whole."""
        try:
            found = read_json(self.path(folder).read_bytes())
            if not isinstance(found, dict) or any(found.get(k) != v for k, v in self.depends_on().items()):
                return None
            if "error" not in found:
                checkpoint = self.path(folder, ".safetensors").read_bytes()
                if hashlib.sha256(checkpoint).hexdigest() != found["checkpoint_hash"]:
                    return None
                to_markdown(rows_of({self: found}))  # whole is what the table can be made of
        except (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError):
            return None
        return found

    def finished(self, folder: Path) -> Document | None:
        found = self.document(folder)
        return None if found is None or "error" in found else found


def run_cell(cell: Cell, folder: Path, report: Report | None = None, wait: bool = True) -> Document | None:
    """Trains and measures a cell, unless that is done; goes on where it was killed. Writes checkpoint, then document.

    A cell that another process is at is waited for; with ``wait=False`` it is left to that one, and the answer is None.
    What goes wrong is the document's ``error``, and is tried again by the next study.
    """
    path = cell.path(folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    # A lock of the system's goes with the process that held it, killed or not; its file is empty and stays.
    with open(path.with_name(f".{path.stem}.lock"), "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            return None
        if (found := cell.finished(folder)) is not None:
            return found
        try:
            document = _trained(cell, folder, report)
        except Exception as error:
            document = _failed(cell, error)
        write_atomically(path, json.dumps(_finite(document), indent=1).encode())
        return document


def _failed(cell: Cell, error: Exception) -> Document:
    what = f"{type(error).__name__}: {' '.join(str(error).split())}"
    return cell.depends_on() | {"error": what, "traceback": "".join(traceback.format_exception(error))}


def _trained(cell: Cell, folder: Path, report: Report | None) -> Document:
    episodes = _episodes(cell.source, cell.data, cell.skip_bad, cell.data_hash)
    checkpoint = cell.path(folder, ".safetensors")
    trained = train(
        architecture(cell.task, cell.filter),
        episodes,
        data_hash=cell.data_hash,
        plan=PLANS[cell.preset],
        seed=cell.seed,
        command=f"beliefscope train {cell.task} --filter {cell.filter} --data {cell.data.name} "
        f"--preset {cell.preset} --seed {cell.seed}",
        report=report,
        partial=checkpoint.with_name(f"{checkpoint.name}.partial"),
        parts=folder / "parts",
    )
    saved = save_checkpoint(trained.filter, cell.filter, trained.record, checkpoint)
    measured = {"checkpoint_hash": saved, "trivial": trivial(cell.task, episodes)}
    return trained.record | cell.depends_on() | measured


@lru_cache(maxsize=1)
def _episodes(source: str, data: Path, skip_bad: bool, data_hash: str) -> tuple[Episode, ...]:
    with open_dataset(data, load_task(source), skip_bad) as dataset:
        if dataset.hash != data_hash:
            raise BadInput(f"{data} was changed while the study ran: its hash is now {dataset.hash[:12]}.")
        return tuple(dataset)


def trivial(task: str, episodes: Sequence[Episode]) -> dict[str, float]:
    """RMSE on the held-out episodes, their first steps left out, of always predicting the training states' mean."""
    by_split = {s: [torch.from_numpy(e.states).double() for e in episodes if e.split == s] for s in ("val", "test")}
    mean = torch.cat([torch.from_numpy(e.states).double() for e in episodes if e.split == "train"]).mean(0)
    counted = [states[min(LEFT_OUT, len(states) - 1) :] for states in by_split["test"] or by_split["val"]]
    error = mean - torch.cat(counted)
    return metrics(find_task(task), error, torch.full((*error.shape, error.shape[-1]), math.nan)).rmse


def _finite(value: Any) -> Any:
    """JSON knows no infinity and no NaN: a number that is not finite is null."""
    if isinstance(value, Mapping):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def run_local(
    cells: Sequence[Cell], folder: Path, report: Callable[[Cell], Report] | None = None
) -> Iterator[tuple[Cell, Document]]:
    """Runs the cells here, one after the other, those last that another process is at; yields each as it is done."""
    left = []
    for cell in cells:
        document = run_cell(cell, folder, report and report(cell), wait=False)
        if document is None:
            left.append(cell)
        else:
            yield cell, document
    for cell in left:
        document = run_cell(cell, folder, report and report(cell))
        assert document is not None
        yield cell, document


def run_ray(cells: Sequence[Cell], folder: Path) -> Iterator[tuple[Cell, Document]]:
    """Runs the cells on a Ray cluster, each with one CPU, and one GPU where the cluster has any.

    The cluster is that of ``RAY_ADDRESS``, else one that runs on this machine, else one is started for the while. All
    its machines need this package, and ``folder`` and the data at the same place: a file system that they share.

    Raises:
        BadInput: where Ray is not installed or its cluster cannot be reached.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # or Ray tells its makers about every cluster
    try:
        import ray
    except ImportError:
        raise BadInput("engine 'ray' needs Ray: pip install 'beliefscope[ray]'") from None
    ours = not ray.is_initialized()
    if ours:
        quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
        try:
            ray.init("auto", **quiet)
        except (ConnectionError, RuntimeError, ValueError) as error:
            if address := os.environ.get("RAY_ADDRESS"):
                raise BadInput(f"engine 'ray' reaches no cluster at RAY_ADDRESS {address!r}: {error}") from None
            ray.init("local", include_dashboard=False, **quiet)
    try:
        run = ray.remote(num_cpus=1, num_gpus=min(1, ray.cluster_resources().get("GPU", 0)), max_retries=2)(run_cell)
        running = {run.remote(cell, folder): cell for cell in cells}
        while running:
            (done, *_), _ = ray.wait(list(running))
            cell = running.pop(done)
            try:
                yield cell, ray.get(done)
            except ray.exceptions.RayError as error:  # a machine or a process that was lost, again and again
                document = _failed(cell, error)
                cell.path(folder).parent.mkdir(parents=True, exist_ok=True)
                write_atomically(cell.path(folder), json.dumps(document, indent=1).encode())
                yield cell, document
    finally:
        if ours:
            ray.shutdown()


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        task, filter: names; ``TRIVIAL`` for the trivial predictor. blackout: chance of a black picture; None with it.
        seeds: that are finished, asked: for, failed: of these.
        mean, spread: over the seeds, by quantity: RMSE (``hinge_x_cm``, ..., ``position_cm``), ``nll``, ``nees``,
            ``coverage95``, ``seconds`` of training. Spread is the standard deviation (n - 1). None where a seed has no
            such number, and a spread of one seed.
        bounds: of ``nees``: see ``nees_bounds``. None with no covariance.
        alone: modality -> mean RMSE over the seeds of the same filter where that modality alone decides; of crossmodal
            filters.
    """

    task: str
    filter: str
    blackout: float | None
    seeds: int
    asked: int
    failed: int
    mean: Mapping[str, float | None]
    spread: Mapping[str, float | None]
    bounds: tuple[float, float] | None = None
    alone: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)
    each: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)


def nees_bounds(n: int, trajectories: int) -> tuple[float, float]:
    """Where NEES / n of a consistent filter lies in 95 % of cases, averaged over independent trajectories at one step.

    Their sum is chi-square with n * trajectories degrees of freedom. Bar-Shalom, Li and Kirubarajan, Estimation with
    Applications to Tracking and Navigation, 5.4.2.
    """
    freedom = n * trajectories
    low, high = chdtri(freedom, [0.975, 0.025]) / freedom  # chdtri takes the share above
    return float(low), float(high)


def rows_of(documents: Mapping[Cell, Document | None]) -> list[Row]:
    """The table of the cells asked for, from those that are finished; the others are counted and not guessed."""
    rows = []
    for task in dict.fromkeys(cell.task for cell in documents):
        finished: list[Document] = []
        for name in dict.fromkeys(cell.filter for cell in documents if cell.task == task):
            asked = [documents[cell] for cell in documents if (cell.task, cell.filter) == (task, name)]
            found = [d for d in asked if d is not None and "error" not in d]
            failed = sum(d is not None and "error" in d for d in asked)
            finished += found
            for blackout in BLACKOUTS:
                each = {str(d["seed"]): _numbers(d, blackout) for d in found}
                mean, spread = _over_seeds(list(each.values()))
                bounds = None
                if mean.get("nees") is not None:
                    trajectories = found[0]["episodes"]["test"] or found[0]["episodes"]["val"]
                    bounds = nees_bounds(len(find_task(task).components), trajectories)
                alone = _alone([d["metrics"][f"{blackout:g}"] for d in found])
                rows.append(
                    Row(task, name, blackout, len(found), len(asked), failed, mean, spread, bounds, alone, each)
                )
        if finished:
            rows.append(Row(task, TRIVIAL, None, 0, 0, 0, finished[0]["trivial"], {}))
    return rows


def _numbers(document: Document, blackout: float) -> dict[str, float | None]:
    fused = document["metrics"][f"{blackout:g}"]["fused"]
    rest = {key: fused[key] for key in ("nll", "nees", "coverage95")}
    rmse = {key: fused["rmse"][key] for key in document["trivial"]}
    return rmse | rest | {"seconds": document["seconds"]}


def _alone(measured: Sequence[Document]) -> dict[str, dict[str, float | None]]:
    names = [name for name in (measured[0] if measured else ()) if name != "fused"]
    return {name: _over_seeds([one[name]["rmse"] for one in measured])[0] for name in names}


def _over_seeds(numbers: Sequence[Mapping[str, float | None]]) -> tuple[dict[str, Any], dict[str, Any]]:
    mean: dict[str, float | None] = {}
    spread: dict[str, float | None] = {}
    for key in numbers[0] if numbers else ():
        values = [one[key] for one in numbers]
        known = [value for value in values if value is not None]
        whole = len(known) == len(values)
        mean[key] = statistics.fmean(known) if whole else None
        spread[key] = statistics.stdev(known) if whole and len(known) > 1 else None
    return mean, spread


CONSISTENCY = ("nll", "nees", "coverage95", "seconds")


def quantities(rows: Sequence[Row]) -> list[str]:
    """Keys of the rows' RMSE, in order, then those of ``CONSISTENCY``."""
    rmse = dict.fromkeys(key for row in rows for key in row.mean if key not in CONSISTENCY)
    return [*rmse, *CONSISTENCY]


def to_csv(rows: Sequence[Row]) -> str:
    """Unrounded; empty where there is no number."""
    keys = quantities(rows)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    numbers = [f"{key}_{part}" for key in keys for part in ("mean", "spread")]
    writer.writerow(
        ["task", "filter", "blackout", "seeds", "seeds_asked", "seeds_failed", *numbers, "nees_low", "nees_high"]
    )
    for row in rows:
        values = [part.get(key) for key in keys for part in (row.mean, row.spread)]
        bounds = row.bounds or (None, None)
        seeds = (row.seeds, row.asked, row.failed) if row.filter != TRIVIAL else (None, None, None)
        writer.writerow([row.task, row.filter, row.blackout, *seeds, *values, *bounds])
    return text.getvalue()


def to_markdown(rows: Sequence[Row]) -> str:
    """A table for each task: mean ± spread over the seeds."""
    return "\n".join(_task_table(task, [r for r in rows if r.task == task]) for task in {r.task: 0 for r in rows})


def _task_table(task: str, rows: Sequence[Row]) -> str:
    keys = quantities(rows)
    heads = {"nll": "NLL", "nees": "NEES/n", "coverage95": "coverage", "seconds": "training (s)"}
    names = [heads.get(key) or "{} ({})".format(*key.rsplit("_", 1)) for key in keys]
    names.insert(keys.index("nees") + 1, "consistent NEES/n")
    lines = [
        f"## {task}\n",
        f"| filter | black pictures | seeds | {' | '.join(names)} |",
        "| --- |" + " ---: |" * (len(names) + 2),
    ]
    for row in rows:
        black = "any" if row.blackout is None else f"{row.blackout:.0%}"
        seeds = f"{row.seeds} of {row.asked}" + (f", {row.failed} failed" if row.failed else "")
        values = [_cell(row, key) for key in keys]
        bounds = "" if row.bounds is None else "{:.2f} to {:.2f}".format(*row.bounds)
        values.insert(keys.index("nees") + 1, bounds)
        if row.filter == TRIVIAL:
            seeds = ""
        elif not row.seeds:
            values = ["failed" if row.failed == row.asked else "missing"] + [""] * (len(values) - 1)
        lines.append(f"| {row.filter} | {black} | {seeds} | {' | '.join(values)} |")
    return "\n".join(lines) + "\n"


def _cell(row: Row, key: str) -> str:
    value, spread = row.mean.get(key), row.spread.get(key)
    if value is None:
        return ""
    digits = 0 if key == "seconds" else 2
    return f"{value:.{digits}f}" + ("" if spread is None else f" ± {spread:.{digits}f}")
