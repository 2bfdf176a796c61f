"""JSON files of the workspace as the values they stand for. Whoever may write there may have written anything."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter

from beliefscope.datasets.document import read_json

T = TypeVar("T")


def is_text(name: str) -> bool:
    """Whether the name of a file can be told in JSON; on Linux it may be any bytes, of another encoding for example."""
    return not any("\ud800" <= letter <= "\udfff" for letter in name)


def read_record(kind: TypeAdapter[T], path: Path) -> T:
    """What a file holds, with fields of the right types. Raises OSError, and ValueError for anything else."""
    data = path.read_bytes()
    read_json(data)  # refuses what pydantic takes: NaN, wherever it stands
    return kind.validate_json(data, strict=True)
