"""Columns of a folder of tables, with one file per episode: NumPy archives, HDF5, CSV or Parquet."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.readers.hdf5_guard import probe
from beliefscope.datasets.text import plural
from beliefscope.recordings.log_readers import hdf5_file, tables
from beliefscope.recordings.log_readers.arrays import Wanted, check_downloaded, check_size

TABLES = (".npz", ".csv", ".parquet", *hdf5_file.SUFFIXES)
"""Suffixes of the files."""

FILE = "<file>"
"""Column of the episodes: the name of the file of each row. No file has a column with this name."""


def numbered(path: Path) -> list[tuple[int, str]]:
    """Key of an order in which numbers in names count as numbers: ``run_2`` before ``run_10``."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def table_files(folder: Path) -> list[Path]:
    """The tables of a folder, in the order of ``numbered``."""
    files = (f for f in folder.iterdir() if f.suffix.lower() in TABLES and not f.name.startswith(".") and f.is_file())
    return sorted(files, key=numbered)


def read(path: Path, wanted: Wanted) -> dict[str, NDArray[Any]]:
    """The columns that all files have, one after the other, and ``FILE``.

    Raises BadInput for files of several formats, a wanted column that a file lacks, and rows of different shapes.
    """
    files = table_files(path)
    if len(suffixes := sorted({file.suffix.lower() for file in files})) > 1:
        raise BadInput(f"folder {path.name} has files {' and '.join(suffixes)}, expected one format")
    probe(file for file in files if file.suffix.lower() in hdf5_file.SUFFIXES)
    parts = []
    for file in files:
        check_downloaded(file)
        parts.append(_table(file, wanted))
    names = [name for name in parts[0] if all(name in part for part in parts)]
    used = [name for name in dict.fromkeys(n for part in parts for n in part) if wanted(name)]
    for file, part in zip(files, parts, strict=True):
        if missing := next((name for name in used if name not in part), ""):
            raise BadInput(f"{file.name} has no column {missing!r}, which other files of {path.name} have")
    columns = {name: _joined(name, files, parts) for name in names}
    columns[FILE] = np.repeat([file.stem for file in files], [_rows(part) for part in parts])
    return columns


def _table(file: Path, wanted: Wanted) -> dict[str, NDArray[Any]]:
    """Columns of a file that have rows. Raises BadInput, with its name, for a damaged file and unequal lengths."""
    try:
        reader = hdf5_file if file.suffix.lower() in hdf5_file.SUFFIXES else tables
        columns = {name: values for name, values in reader.read(file, wanted).items() if values.ndim and len(values)}
    except BadInput:
        raise
    except Exception as error:
        reason = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise BadInput(f"{file.name} cannot be read: {reason:.200}") from None
    if not columns:
        raise BadInput(f"{file.name} has no column with rows")
    count = _rows(columns)
    for name, values in columns.items():
        if len(values) != count:
            first = next(iter(columns))
            raise BadInput(f"{file.name} has {plural(len(values), 'row')} of {name!r}, but {count} of {first!r}")
    return columns


def _rows(columns: dict[str, NDArray[Any]]) -> int:
    return len(next(iter(columns.values())))


def _joined(name: str, files: list[Path], parts: list[dict[str, NDArray[Any]]]) -> NDArray[Any]:
    """The values of all files. Raises BadInput for rows of different shapes, and for numbers beside text."""
    first = parts[0][name]
    for file, part in zip(files, parts, strict=True):
        if part[name].shape[1:] != first.shape[1:]:
            shapes = f"{part[name].shape[1:]} in {file.name} and {first.shape[1:]} in {files[0].name}"
            raise BadInput(f"column {name!r} has rows of shape {shapes}, expected one shape")
        if (part[name].dtype.kind in "US") != (first.dtype.kind in "US"):
            text, numbers = (file, files[0]) if part[name].dtype.kind in "US" else (files[0], file)
            raise BadInput(f"column {name!r} has text in {text.name} and numbers in {numbers.name}")
    rows = sum(len(part[name]) for part in parts)
    check_size(name, (rows, *first.shape[1:]), first.dtype)
    return np.concatenate([part[name] for part in parts])
