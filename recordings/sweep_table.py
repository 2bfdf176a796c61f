"""Sweeps on disk: the rows of each finished cell, and the tables joined from them.

A sweep's folder has ``cells/CHECKPOINT/CELL.parquet``, one file for each finished cell, from which an interrupted sweep
resumes; ``results.parquet``, a row for each checkpoint, data set, faults, seed, episode and phase; and
``checkpoints.parquet`` and ``datasets.parquet``, which describe them. The results depend on the inputs only, to the
bit.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.filters.engine import Engine, run_all
from beliefscope.inspect.sweep import Cell, Row, describe_checkpoint, describe_data

TABLES = RESULTS, CHECKPOINTS, DATASETS = "results", "checkpoints", "datasets"
"""Tables of a sweep."""

TEXTS = frozenset(
    {"checkpoint", "data", "faults", "task", "episode_hash", "split", "policy", "provenance", "phase", "unit"}
)
INTEGERS = frozenset({"seed", "episode", "particles", "steps", "worst_step"})
"""Columns of the results; all others are numbers."""

METADATA = b"beliefscope"

Progress = Callable[[int, int], None]


def run_sweep(
    cells: Sequence[Cell],
    folder: Path,
    *,
    engine: Engine = "local",
    workers: int = 1,
    progress: Progress | None = None,
) -> pa.Table:
    """Run the missing cells of a sweep and write its tables; the results.

    An interrupted sweep resumes with the missing cells. The tables have the same bits with any engine, number of
    workers and interruption.

    Args:
        progress: called with the numbers of finished episodes and of all, at the start and after each cell.

    Raises BadInput for unusable files, and as ``run_all``.
    """
    missing = [cell for cell in cells if not is_finished(cell, folder)]
    total = sum(len(cell.episodes) for cell in cells)
    done = total - sum(len(cell.episodes) for cell in missing)
    report = progress or (lambda done, total: None)
    report(done, total)
    with closing(run_all(partial(_run_cell, folder), missing, engine, workers)) as results:
        for cell, _ in results:
            done += len(cell.episodes)
            report(done, total)
    write_tables(cells, folder)
    return pq.read_table(folder / f"{RESULTS}.parquet")


def replaced_results(cells: Iterable[Cell], folder: Path) -> int:
    """Number of results (checkpoint, data set, faults, seed) in the tables of a folder that a sweep replaces."""
    columns = ("checkpoint", "data", "faults", "seed")
    try:
        table = pq.read_table(folder / f"{RESULTS}.parquet", columns=[*columns])
    except (OSError, pa.ArrowInvalid):
        return 0
    rows = table.group_by([*columns]).aggregate([]).to_pylist()
    kept = {(cell.checkpoint_hash, cell.data_hash, cell.faults, cell.seed) for cell in cells}
    return sum(tuple(row[name] for name in columns) not in kept for row in rows)


def is_finished(cell: Cell, folder: Path) -> bool:
    """Whether the rows of a cell are stored completely."""
    try:
        metadata = pq.read_metadata(_file(cell, folder)).metadata
    except (OSError, pa.ArrowInvalid):
        return False
    return bool(metadata) and metadata.get(METADATA) == cell.key.encode()


def _file(cell: Cell, folder: Path) -> Path:
    return folder / "cells" / cell.checkpoint_hash[:16] / f"{cell.key}.parquet"


def _run_cell(folder: Path, cell: Cell) -> None:
    path = _file(cell, folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = cell.rows()
    names = list(dict.fromkeys(name for row in rows for name in row))  # rows may lack columns
    table = pa.table([pa.array([row.get(name) for row in rows], _type(name)) for name in names], names=names)
    write_table(table.replace_schema_metadata({METADATA: cell.key.encode()}), path)


def write_table(rows: pa.Table | list[Row], path: Path) -> None:
    data = io.BytesIO()
    table = pa.Table.from_pylist(rows) if isinstance(rows, list) else rows
    pq.write_table(table, data, compression="zstd")
    write_atomically(path, data.getvalue())


def _type(name: str) -> pa.DataType:
    return pa.string() if name in TEXTS else pa.int32() if name in INTEGERS else pa.float64()


def write_tables(cells: Sequence[Cell], folder: Path) -> None:
    """Join the rows of finished cells in the order of the cells, in constant memory, and describe the checkpoints.

    Raises BadInput for a deleted file of a cell.
    """
    files = [_file(cell, folder) for cell in cells]
    if deleted := [str(file) for file in files if not file.is_file()]:
        raise BadInput(f"{deleted[0]} was deleted while the sweep ran; run the same command again to restore it")
    names = dict.fromkeys(name for file in files for name in pq.read_schema(file).names)
    schema = pa.schema([(name, _type(name)) for name in names])
    temporary = folder / f".{RESULTS}.parquet.partial"
    with pq.ParquetWriter(temporary, schema, compression="zstd") as writer:
        for group in _groups(files):
            writer.write_table(pa.concat_tables([_aligned(pq.read_table(file), schema) for file in group]))
    os.replace(temporary, folder / f"{RESULTS}.parquet")
    data = {cell.checkpoint: cell.data for cell in cells}
    checkpoints = [describe_checkpoint(*pair) for pair in data.items()]
    datasets = [describe_data(*pair) for pair in dict.fromkeys((cell.data, cell.checkpoint) for cell in cells)]
    write_table(checkpoints, folder / f"{CHECKPOINTS}.parquet")
    write_table(list({row["data"]: row for row in datasets}.values()), folder / f"{DATASETS}.parquet")


def _groups(files: Sequence[Path], rows: int = 100_000) -> Iterator[list[Path]]:
    """Consecutive files with about so many rows: row groups large enough to compress and to skip."""
    group: list[Path] = []
    count = 0
    for file in files:
        group.append(file)
        count += pq.read_metadata(file).num_rows
        if count >= rows:
            yield group
            group, count = [], 0
    if group:
        yield group


def _aligned(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """The table with the columns of the schema; missing ones are null."""
    columns = [
        table.column(field.name) if field.name in table.column_names else pa.nulls(len(table), field.type)
        for field in schema
    ]
    return pa.table(columns, schema=schema)
