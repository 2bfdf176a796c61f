"""Columns of a log: arrays of T rows by name, from NumPy archives, CSV and Parquet."""

from __future__ import annotations

import re
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput, unknown_name

Columns = Mapping[str, NDArray[Any]]

DAMAGED = (
    *(OSError, ValueError, KeyError, EOFError, RuntimeError, MemoryError, OverflowError, SyntaxError),
    *(struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)
"""Errors of the readers for damaged files, and for encrypted archives."""

ELEMENT = re.compile(r"(.*)\[(\d+)\]")
"""``NAME[I]``: element I of the rows of an array."""


def read_columns(path: Path) -> dict[str, NDArray[Any]]:
    """The columns of a ``.npz``, ``.csv`` or ``.parquet`` file; nested lists in Parquet become arrays.

    Raises BadInput for another format, a damaged file, and rows of different sizes.
    """
    try:
        match path.suffix.lower():
            case ".npz":
                with np.load(path, allow_pickle=False) as archive:
                    columns = {name: archive[name] for name in archive.files}
            case ".csv" | ".parquet":
                columns = _read_table(path)
            case suffix:
                raise BadInput(f"{path.name} has the format {suffix or 'unknown'!r}; logs are .npz, .csv or .parquet")
    except BadInput:
        raise
    except DAMAGED as error:
        raise BadInput(f"{path.name} cannot be read: {(str(error).splitlines() or ['no message'])[0]:.200}") from None
    columns = {name: column for name, column in columns.items() if column.ndim and len(column)}
    if not columns:
        raise BadInput(f"{path.name} has no column with rows")
    return columns


def _read_table(path: Path) -> dict[str, NDArray[Any]]:
    import pyarrow as pa
    from pyarrow import csv, parquet

    try:
        table = csv.read_csv(path) if path.suffix.lower() == ".csv" else parquet.read_table(path)
        return {name: _array(table.column(name)) for name in table.column_names}
    except pa.ArrowException as error:
        raise ValueError(error) from None


def _array(column: Any) -> NDArray[Any]:
    """Rows of lists of equal lengths become further axes; missing numbers NaN."""
    import pyarrow as pa

    values = column.to_numpy(zero_copy_only=False)
    if pa.types.is_nested(column.type):
        return np.array(column.to_pylist(), dtype=np.float64)
    return values if values.dtype != object else values.astype(str)


def column(columns: Columns, reference: str, purpose: str) -> NDArray[np.float64]:
    """(T, ...) numbers of a column, ``NAME``, or of one element of its rows, ``NAME[I]``.

    Raises BadInput for an unknown name, an element that the rows do not have, and text.
    """
    name, element = reference, None
    if reference not in columns and (match := ELEMENT.fullmatch(reference)):
        name, element = match[1], int(match[2])
    if name not in columns:
        raise unknown_name(f"column of {purpose}", name, columns)
    values = columns[name]
    if values.dtype.kind not in "fiub":
        raise BadInput(f"column {name!r} of {purpose} has text, such as {str(values.flat[0])!r:.50}, expected numbers")
    if element is None:
        return values.astype(np.float64)
    if values.ndim < 2 or element >= values.shape[1]:
        raise BadInput(f"column {name!r} of {purpose} has rows of shape {values.shape[1:]}, which have no [{element}]")
    return values[:, element].astype(np.float64)


def joined(columns: Columns, references: str | list[str], purpose: str) -> NDArray[np.float64]:
    """(T, d): several columns side by side; a single one may have d elements."""
    names = [references] if isinstance(references, str) else references
    parts = [column(columns, name, purpose) for name in names]
    rows = {len(part) for part in parts}
    if len(rows) > 1:
        raise BadInput(f"columns of {purpose}, {', '.join(names)}, have {', '.join(map(str, sorted(rows)))} rows")
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
