"""Checkpoints of sweeps as filters. Their names identify them in any server with the sweep, also after a restart."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from beliefscope.app.runs.catalog import result_folders
from beliefscope.app.runs.settings import Settings
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint

if TYPE_CHECKING:
    from beliefscope.recordings.sweep_table import Experiments

HASH_DIGITS = 8
"""Digits of the checkpoint's hash at the end of a name."""

NAME = re.compile(rf"(.+)-([0-9a-f]{{{HASH_DIGITS}}})", re.DOTALL)

Candidate = tuple[str, Callable[[], Checkpoint]]
"""Where a checkpoint is stored, such as ``sweep 'lr'``, and the function that loads it, which may raise BadInput."""


def sweep_folders(settings: Settings) -> dict[str, Path]:
    """Folders of sweeps by name: those given to the server, and those in the workspace."""
    return result_folders(settings.sweeps, settings.workspace, "results.parquet")


def load_sweep_filter(sweep: Experiments, checkpoint: str, settings: Settings) -> tuple[str, Checkpoint]:
    """Name and filter of the checkpoint with this hash.

    Raises BadInput for an unknown hash, and for a file that is missing or was changed.
    """
    path = sweep.path("checkpoints", "checkpoint", checkpoint)
    loaded = load_checkpoint(path, settings.definitions)
    if loaded.hash != checkpoint:
        raise BadInput(f"checkpoint {str(path)!r} was changed after the sweep, from {checkpoint[:12]}")
    return f"{path.stem}-{checkpoint[:HASH_DIGITS]}", loaded


def sweep_candidates(task: str, name: str, settings: Settings) -> Iterator[Candidate]:
    """The checkpoints of the server's sweeps with a name from ``load_sweep_filter``."""
    match = NAME.fullmatch(name)
    folders = sweep_folders(settings) if match else {}
    if match is None or not folders:
        return
    from beliefscope.recordings.sweep_table import Experiments  # pyarrow and DuckDB are slow to import

    for sweep, folder in folders.items():
        with suppress(BadInput):  # damaged tables; the list of sweeps reports them
            tables = Experiments([folder])
            query = "SELECT checkpoint FROM checkpoints WHERE task = ? AND name = ? AND starts_with(checkpoint, ?)"
            for row in tables.query(query, [task, *match.groups()]).to_pylist():
                yield f"sweep {sweep!r}", partial(_load, tables, row["checkpoint"], settings)


def _load(sweep: Experiments, checkpoint: str, settings: Settings) -> Checkpoint:
    return load_sweep_filter(sweep, checkpoint, settings)[1]
