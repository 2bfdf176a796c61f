"""A study: filters x tasks x seeds, each trained once, and given filters; all evaluated with image blackouts."""

from __future__ import annotations

import fcntl
import hashlib
import json
import math
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import torch

from beliefscope.datasets.catalog import TASKS, load_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.datasets.store import has_sample, open_dataset, sample_path
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import difference
from beliefscope.filters import legacy_names
from beliefscope.filters.catalog import architecture, filters_of
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, partial_path, save_checkpoint
from beliefscope.filters.engine import Engine, run_all
from beliefscope.filters.evaluate import metrics
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.filter import Architecture, Filter
from beliefscope.filters.names import is_code, is_source
from beliefscope.filters.open_filter import open_filter
from beliefscope.filters.start_offset import STUDY_OFFSET
from beliefscope.filters.training.plan import BLACKOUTS, PLANS, Report, evaluated_blackouts
from beliefscope.filters.training.study_table import OFFSET, TRUTH, Document, Row, rows_of, to_csv, to_markdown
from beliefscope.filters.training.train import measure, train, versions


@dataclass(frozen=True)
class Cell:
    """One filter to be trained once, or a given one, and everything its results depend on.

    Attributes:
        task: its name. source: the argument of ``load_task``: the name, or ``FILE.py:NAME``.
        filter, seed, preset: names of the architecture and of the training schedule.
        data: file or folder of the episodes. data_hash: of the episodes. skip_bad: whether to skip unusable ones.
        given: checkpoint file or build function of a filter that is evaluated only; empty for one to be trained.
    """

    task: str
    filter: str
    seed: int
    preset: str
    source: str
    data: Path
    data_hash: str
    skip_bad: bool = False
    given: str = ""

    def __str__(self) -> str:
        return f"{self.task}/{self.filter}/seed{self.seed}"

    @property
    def definition(self) -> Task:
        """The task."""
        return load_task(self.source)

    def path(self, folder: Path, suffix: str = ".json") -> Path:
        return folder / "cells" / f"{self}{suffix}"

    def inputs(self) -> Document:
        """The part of the cell's document that identifies it, as read from JSON."""
        common = {
            "task": self.task,
            "filter": self.filter,
            "seed": self.seed,
            "blackouts": list(BLACKOUTS),
            "data_hash": self.data_hash,
            "versions": versions(),
        }
        if self.given:
            return common | {"checkpoint_hash": given_filter(self.source, self.given).hash}
        plan = json.loads(json.dumps(asdict(PLANS[self.preset])))
        return common | {"architecture": architecture(self.definition, self.filter).to_json(), "plan": plan}

    def document(self, folder: Path) -> Document | None:
        """The document of the finished or failed cell; None if it is missing, incomplete or of other inputs."""
        try:
            document = read_json(self.path(folder).read_bytes())
            if not self.given:
                document["architecture"] = Architecture.from_json(document["architecture"], self.definition).to_json()
                document["plan"] = legacy_names.rename_keys(document["plan"], legacy_names.PLAN)
            if any(document.get(key) != value for key, value in self.inputs().items()):
                return None
            if "error" not in document:
                if not is_code(self.given):
                    checkpoint = self.path(folder, ".safetensors").read_bytes()
                    if hashlib.sha256(checkpoint).hexdigest() != document["checkpoint_hash"]:
                        return None
                evaluated = {*BLACKOUTS} & {*evaluated_blackouts(self.definition)}
                if not {f"{blackout:g}" for blackout in evaluated} <= document[TRUTH].keys():
                    return None
                to_markdown(rows_of({self: document}))  # fails for an incomplete document
        except (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError):
            return None
        return document

    def trained(self, folder: Path) -> Document | None:
        """The document of the trained cell, else None. Earlier versions did not evaluate offset starts."""
        document = self.document(folder)
        return None if document is None or "error" in document else document

    def finished(self, folder: Path) -> Document | None:
        """The document of the trained and completely evaluated cell, else None."""
        document = self.trained(folder)
        return None if document is None or OFFSET not in document else document


def study_cells(
    preset: str,
    tasks: Sequence[str],
    filters: Sequence[str],
    seeds: int,
    files: Mapping[str, Path],
    skip_bad: bool = False,
    note: Callable[[str], None] = lambda text: None,
) -> list[Cell]:
    """All cells by task, then seed, then filter, so that a table of all filters is available early.

    Args:
        tasks: names or ``FILE.py:NAME``; empty for all with training data. filters: names to train; empty for
            all of each task. Checkpoint files and build functions are evaluated only, with the tasks that they fit.
        files: data of tasks without a sample dataset, or in its place. note: receives each skipped episode.

    Raises BadInput for unknown names and unusable data.
    """
    if preset not in PLANS:
        raise unknown_name("preset", preset, PLANS)
    sources = list(dict.fromkeys(tasks or [*(name for name in TASKS if name in files or _trains(name)), *files]))
    available = {name for source in sources for name in filters_of(load_task(source))}
    given = [text for text in filters if is_source(text)]
    for name in filters:
        if name not in available and name not in given:
            raise unknown_name("filter", name, sorted(available))
    fitting = _fitting(sources, given)
    cells = []
    for source in sources:
        task = load_task(source)
        path = (files[source] if source in files else sample_path(task)).resolve()
        with open_dataset(path, task, skip_bad) as episodes:
            if other := difference(task, episodes.task):
                raise BadInput(f"{str(path)!r} contains episodes of {other}, not of {task.name!r}")
            data_hash, splits = episodes.hash, {summary.split for summary in episodes.summaries}
            for line in episodes.skipped:
                note(f"skipped: {line}")
        if "train" not in splits or splits == {"train"}:
            raise BadInput(f"{path} has episodes of {', '.join(sorted(splits))}; a study needs train and test or val")
        cells += [
            Cell(task.name, name, seed, preset, source, path, data_hash, skip_bad)
            for seed in range(seeds)
            for name in filters_of(task)
            if not filters or name in filters
        ]
        cells += [
            Cell(task.name, name, 0, preset, source, path, data_hash, skip_bad, text)
            for name, text in fitting[source].items()
        ]
    return cells


@lru_cache
def given_filter(source: str, text: str) -> Checkpoint:
    """A given filter of the task ``source``. Raises BadInput as ``open_filter``."""
    return open_filter(source, text)


def _fitting(sources: Sequence[str], given: Sequence[str]) -> dict[str, dict[str, str]]:
    """Task -> display name and text of each given filter that fits it. Raises BadInput for one that fits none."""
    fitting: dict[str, dict[str, str]] = {source: {} for source in sources}
    for text in given:
        place = text if is_code(text) else str(Path(text).resolve())
        errors = []
        for source, names in fitting.items():
            try:
                checkpoint = given_filter(source, place)
            except BadInput as error:
                errors.append(error)
                continue
            name = checkpoint.name if is_code(text) else Path(text).stem
            if name in names or name in filters_of(load_task(source)):
                raise BadInput(
                    f"filter {text!r} is displayed as {name!r}, which another filter of the study is; rename it"
                )
            names[name] = place
        if len(errors) == len(fitting):
            raise errors[0]
    return fitting


def _trains(task: str) -> bool:
    """Whether the task has a sample dataset with training episodes; those of the field tasks are for testing only."""
    if not has_sample(task):
        return False
    with open_dataset(sample_path(task)) as episodes:
        return any(summary.split == "train" for summary in episodes.summaries)


def run_cell(cell: Cell, folder: Path, report: Report | None = None, wait: bool = True) -> Document | None:
    """Trains and evaluates a cell unless it is finished; resumes an interrupted one. Writes checkpoint and document.

    A cell trained by an earlier version is evaluated only. If another process runs the cell, waits for it, or with
    ``wait=False`` returns None. An error is stored in the document; the next study tries the cell again.
    """
    path = cell.path(folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    # The operating system releases the lock when its process ends, killed or not; the empty file stays.
    with open(path.with_name(f".{path.stem}.lock"), "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            return None
        if (document := cell.finished(folder)) is not None:
            return document
        try:
            document = cell.trained(folder)
            if cell.given:
                document = _given_cell(cell, folder)
            elif document is None:
                document = _train_cell(cell, folder, report)
            else:
                document = _evaluate_cell(cell, folder, document)
        except Exception as error:
            document = _failure(cell, error)
        write_atomically(path, json.dumps(_finite(document), indent=1).encode())
        return document


def _failure(cell: Cell, error: Exception) -> Document:
    is_input, text = isinstance(error, BadInput), " ".join(str(error).split())
    message = text if is_input else f"{type(error).__name__}: {text}"
    trace = "".join(traceback.format_exception(error))
    return cell.inputs() | {"error": message, "invalid_input": is_input, "traceback": trace}


def _train_cell(cell: Cell, folder: Path, report: Report | None) -> Document:
    episodes = _episodes(cell.source, cell.data, cell.skip_bad, cell.data_hash)
    checkpoint = cell.path(folder, ".safetensors")
    trained = train(
        architecture(cell.definition, cell.filter),
        episodes,
        data_hash=cell.data_hash,
        plan=PLANS[cell.preset],
        seed=cell.seed,
        command=f"beliefscope train {cell.task} --filter {cell.filter} --data {cell.data.name} "
        f"--preset {cell.preset} --seed {cell.seed}",
        report=report,
        partial=partial_path(checkpoint),
        shared=folder / "shared",
    )
    checkpoint_hash = save_checkpoint(trained.filter, cell.filter, trained.record, checkpoint)
    results = {"checkpoint_hash": checkpoint_hash, "trivial": trivial(cell.definition, episodes)}
    return trained.record | cell.inputs() | results | {OFFSET: offset_metrics(trained.filter, episodes)}


def _given_cell(cell: Cell, folder: Path) -> Document:
    """The document of a given filter: its metrics; a checkpoint file is copied."""
    episodes = _episodes(cell.source, cell.data, cell.skip_bad, cell.data_hash)
    checkpoint = given_filter(cell.source, cell.given)
    if not is_code(cell.given):
        write_atomically(cell.path(folder, ".safetensors"), Path(cell.given).read_bytes())
    filter_ = checkpoint if isinstance(checkpoint, ExternalFilter) else checkpoint.filter
    splits = {split: sum(e.split == split for e in episodes) for split in ("train", "val", "test")}
    results = {"episodes": splits, "seconds": None, "trivial": trivial(cell.definition, episodes)}
    metrics = {TRUTH: measure(filter_, held_out(episodes)), OFFSET: offset_metrics(filter_, episodes)}
    return cell.inputs() | results | metrics


def _evaluate_cell(cell: Cell, folder: Path, document: Document) -> Document:
    """The document of a trained cell with its metrics from both starts."""
    episodes = _episodes(cell.source, cell.data, cell.skip_bad, cell.data_hash)
    filter_ = load_checkpoint(cell.path(folder, ".safetensors")).filter
    return document | {TRUTH: measure(filter_, held_out(episodes)), OFFSET: offset_metrics(filter_, episodes)}


def held_out(episodes: Sequence[Episode]) -> list[Episode]:
    """The test episodes, or the validation episodes if there are none."""
    by_split = {split: [e for e in episodes if e.split == split] for split in ("test", "val")}
    return by_split["test"] or by_split["val"]


def offset_metrics(filter_: Filter | ExternalFilter, episodes: Sequence[Episode]) -> Document:
    """As ``measure``, on held-out episodes, from starts with ``STUDY_OFFSET``."""
    return measure(filter_, held_out(episodes), STUDY_OFFSET.for_task(filter_.task))


@lru_cache(maxsize=1)
def _episodes(source: str, data: Path, skip_bad: bool, data_hash: str) -> tuple[Episode, ...]:
    with open_dataset(data, load_task(source), skip_bad) as dataset:
        if dataset.hash != data_hash:
            raise BadInput(f"{data} was changed while the study ran: its hash is now {dataset.hash[:12]}.")
        return tuple(dataset)


def trivial(task: Task, episodes: Sequence[Episode]) -> dict[str, float]:
    """RMSE of always predicting the mean training state, on held-out episodes without their first steps."""
    mean = torch.cat([torch.from_numpy(e.states).double() for e in episodes if e.split == "train"]).mean(0)
    states = [torch.from_numpy(e.states).double() for e in held_out(episodes)]
    evaluated = [truth[task.first_counted(len(truth)) :] for truth in states]
    error = mean - torch.cat(evaluated)
    return metrics(task, error, torch.full((*error.shape, error.shape[-1]), math.nan)).rmse


def _finite(value: Any) -> Any:
    """The value with infinity and NaN, which JSON lacks, replaced by None."""
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def run_local(
    cells: Sequence[Cell], folder: Path, report: Callable[[Cell], Report] | None = None
) -> Iterator[tuple[Cell, Document]]:
    """Runs the cells one after the other, cells locked by another process last; yields each when it is done."""
    busy = []
    for cell in cells:
        document = run_cell(cell, folder, report and report(cell), wait=False)
        if document is None:
            busy.append(cell)
        else:
            yield cell, document
    for cell in busy:
        document = run_cell(cell, folder, report and report(cell))
        assert document is not None
        yield cell, document


def run_cells(cells: Sequence[Cell], folder: Path, engine: Engine, workers: int) -> Iterator[tuple[Cell, Document]]:
    """Runs the cells with an engine (``engine.run_all``); yields each when it is done."""

    def failed(cell: Cell, error: Exception) -> Document:
        document = _failure(cell, error)
        cell.path(folder).parent.mkdir(parents=True, exist_ok=True)
        write_atomically(cell.path(folder), json.dumps(document, indent=1).encode())
        return document

    return run_all(partial(_run_cell, folder), cells, engine, workers, failed)


def _run_cell(folder: Path, cell: Cell) -> Document:
    document = run_cell(cell, folder)
    assert document is not None
    return document


def write_tables(folder: Path, cells: Sequence[Cell], preset: str) -> tuple[list[Row], Document]:
    """Writes ``table.md``, ``table.csv`` and ``study.json`` of the finished cells; returns the rows and the overview.

    The overview holds the requested cells and their states, the checkpoints' hashes, and the unrounded rows.
    """
    documents = {cell: cell.document(folder) for cell in cells}
    rows = rows_of(documents)
    overview = {
        "preset": preset,
        "tasks": {cell.task: {"data": cell.data.name, "data_hash": cell.data_hash} for cell in cells},
        "filters": list(dict.fromkeys(cell.filter for cell in cells)),
        "given": {cell.filter: cell.given for cell in cells if cell.given},
        "seeds": 1 + max(cell.seed for cell in cells),
        "versions": versions(),
        "cells": {str(c): "missing" if d is None else d.get("error", "finished") for c, d in documents.items()},
        "checkpoints": {str(c): d["checkpoint_hash"] for c, d in documents.items() if d and "error" not in d},
        "rows": [asdict(row) for row in rows],
    }
    write_atomically(folder / "table.md", to_markdown(rows).encode())
    write_atomically(folder / "table.csv", to_csv(rows).encode())
    write_atomically(folder / "study.json", json.dumps(overview, indent=1).encode())
    return rows, overview
