"""Index of a data file, stored beside it: opening reads the index instead of the attributes of all episodes.

Large files and sample data have an index. It belongs to a file of the same size and time, or of the same size and
content: installing a file changes its time.
"""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from typing import Any

from beliefscope.datasets.dataset import SPLITS, EpisodeSummary
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.io.strict_json import read_json

VERSION = 1

EPISODES = 500
"""Files with fewer episodes open fast enough without an index."""

COLUMNS = tuple(f.name for f in fields(EpisodeSummary) if f.name != "index")


def index_path(path: Path) -> Path:
    """``.push.h5.index`` for ``push.h5``."""
    return path.with_name(f".{path.name}.index")


def read_index(path: Path) -> tuple[tuple[EpisodeSummary, ...], str] | None:
    """The summaries and the hash of a data file; None without an index of the file as it is."""
    try:
        stored = read_json(index_path(path).read_bytes())
        size, time_or_content = stored["file"]
        by_content = isinstance(time_or_content, str)
        if stored["version"] != VERSION or [size, time_or_content] != _identity(path, by_content):
            return None
        columns, digest = [stored["columns"][name] for name in COLUMNS], stored["hash"]
        rows = zip(*columns, strict=True)
        summaries = tuple(_summary(index, dict(zip(COLUMNS, row, strict=True))) for index, row in enumerate(rows))
    except (OSError, KeyError, TypeError, ValueError):
        return None
    return (summaries, digest) if summaries and isinstance(digest, str) else None


def write_index(path: Path, summaries: tuple[EpisodeSummary, ...], digest: str, by_content: bool = False) -> None:
    """Store the index if the folder can be written and the file is large, or ``by_content``, as of sample data."""
    if len(summaries) < EPISODES and not by_content:
        return
    columns = {name: [getattr(s, name) for s in summaries] for name in COLUMNS}
    with suppress(OSError, BadInput):
        document = {"version": VERSION, "file": _identity(path, by_content), "hash": digest, "columns": columns}
        write_atomically(index_path(path), json.dumps(document, separators=(",", ":")).encode())


def _identity(path: Path, by_content: bool) -> list[int | str]:
    status = path.stat()
    if by_content:
        return [status.st_size, _content_hash(path, status.st_size, status.st_mtime_ns)]
    return [status.st_size, status.st_mtime_ns]


@lru_cache(maxsize=16)
def _content_hash(path: Path, size: int, time: int) -> str:
    """SHA-256 of a file with this size and time."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _summary(index: int, values: dict[str, Any]) -> EpisodeSummary:
    """Raises ValueError for values that ``EpisodeFile`` would refuse."""
    summary = EpisodeSummary(index=index, **values)
    whole = all(type(value) is int for value in (summary.steps, summary.seed))
    contact = summary.contact_fraction
    if not (whole and summary.steps > 0 and summary.split in SPLITS and isinstance(summary.policy, str)):
        raise ValueError("invalid summary")
    if not (isinstance(contact, int | float) and 0.0 <= contact <= 1.0):
        raise ValueError("invalid contact fraction")
    return summary
