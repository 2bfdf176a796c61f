"""Columns of a log: arrays of T rows by name, from files and folders of other programs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.recordings.log_readers.arrays import Columns, check_downloaded
from beliefscope.recordings.log_readers.column_map import ELEMENTS, ColumnMap, base_name
from beliefscope.recordings.log_readers.messages import Preview, on_clock, preview
from beliefscope.recordings.log_readers.table_folder import TABLES, numbered, table_files

SUFFIXES = {
    **{".npz": "tables", ".csv": "tables", ".parquet": "tables", ".mcap": "mcap_file", ".db3": "ros_bag"},
    **{".rrd": "rerun_file", ".zip": "zarr_buffer", ".h5": "hdf5_file", ".hdf5": "hdf5_file"},
}
"""Suffix of a file -> its reader, a module of this package."""

FOLDERS = {
    **{"metadata.yaml": "ros_bag", "meta/info.json": "lerobot"},
    **{"zarr.json": "zarr_buffer", ".zgroup": "zarr_buffer"},
}
"""A file in a folder -> the reader of the folder."""

MESSAGES = (".mcap", ".db3")
"""Suffixes of logs of messages."""

PACKAGES = {"mcap": "logs", "rosbags": "logs", "zarr": "logs", "av": "video"}
"""Package -> the extra of this package that installs it."""


def read_columns(path: Path, mapping: ColumnMap | None = None) -> Columns:
    """The columns of a log that the map uses, of the same length; without a map, a preview of all columns.

    Logs of messages are resampled with the map's ``dt`` (see ``messages``). Of other logs, all columns are returned;
    large ones that the map does not use are zeros.

    Raises BadInput for another format, a package that is not installed, a damaged file, rows of different sizes, and
    columns that the map names and the log does not have.
    """
    return _read(path, mapping).columns


def preview_columns(path: Path) -> Preview:
    """Columns for a first map, with few rows of logs of messages. Raises BadInput as ``read_columns``."""
    return _read(path, None)


def _read(path: Path, mapping: ColumnMap | None) -> Preview:
    with _reading(path):
        reader = import_module(f"beliefscope.recordings.log_readers.{_reader(path)}")
        if hasattr(reader, "open_log"):
            if mapping and mapping.time_unit != "s":
                raise BadInput(f"time has the unit {mapping.time_unit!r}, which columns have, and the log has topics")
            with reader.open_log(path, None if mapping is None else mapping.time) as log:
                result = preview(log) if mapping is None else Preview(on_clock(log, mapping))
        elif mapping and mapping.dt is not None and mapping.time:
            raise BadInput("the map needs either dt or time, not both")
        elif mapping and mapping.clock:
            raise BadInput(f"clock is {mapping.clock!r}, but the log has no topics: the map needs dt or time")
        else:
            references = mapping.references if mapping else set()
            used = references | {base_name(reference) for reference in references}
            used |= {mapping.time} if mapping else set()
            result = Preview(reader.read(path, used.__contains__))
    columns = {name: column for name, column in result.columns.items() if column.ndim and len(column)}
    if not columns:
        raise BadInput(f"{path.name} has no column with rows")
    return result._replace(columns=columns)


def message_logs(path: Path) -> list[Path]:
    """The logs of messages in a folder, one per episode: files, or folders of bags. Empty for a path that is a log."""
    if not path.is_dir() or any((path / name).is_file() for name in FOLDERS) or table_files(path):
        return []
    entries = [entry for entry in path.iterdir() if not entry.name.startswith(".")]
    logs = [e for e in entries if (e / "metadata.yaml").is_file() or (e.suffix.lower() in MESSAGES and e.is_file())]
    return sorted(logs, key=numbered)


def _reader(path: Path) -> str:
    if path.is_dir():
        for name, reader in FOLDERS.items():
            if (path / name).is_file():
                return reader
        if table_files(path):
            return "table_folder"
        raise BadInput(
            f"folder {path.name} has none of {', '.join(FOLDERS)}, and no files {', '.join((*TABLES, *MESSAGES))}: "
            "not a ROS 2 bag, LeRobot or Zarr data, or one log per episode"
        )
    if not path.is_file():
        raise BadInput(f"{path} does not exist")
    suffix = path.suffix.lower()
    if suffix == ".bag":
        command = f"rosbags-convert --src {path.name} --dst {path.stem}"
        raise BadInput(f"{path.name} is a bag of ROS 1; convert it: pip install rosbags; {command}")
    if suffix not in SUFFIXES:
        raise BadInput(
            f"{path.name} has the format {suffix or 'unknown'!r}; logs are {', '.join(SUFFIXES)} or a folder"
        )
    check_downloaded(path)
    return SUFFIXES[suffix]


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Errors of the formats' libraries as BadInput with one line: damaged files raise errors of every type."""
    try:
        yield
    except BadInput as error:
        raise error if path.name in str(error) else BadInput(f"{path.name}: {error}") from None
    except ImportError as error:
        package = (error.name or "").partition(".")[0]
        if package not in PACKAGES:
            raise
        extra = f"pip install 'beliefscope[{PACKAGES[package]}]'"
        raise BadInput(f"{path.name} needs the package {package}: {extra}") from None
    except KeyError as error:
        raise BadInput(f"{path.name} has no {error!s:.200}, which its format requires") from None
    except Exception as error:
        reason = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise BadInput(f"{path.name} cannot be read: {reason:.200}") from None


ABSENT = (None, "", "None")
"""Missing values of a column that is no column of numbers."""


def _not_numbers(values: NDArray[Any]) -> str:
    """Why values (T, ...) are no numbers: the first text that is none, or else the first value, and its row."""
    if values.dtype.kind == "c":
        return "has complex values"
    numbers: list[str] = []
    for row, value in enumerate(values.reshape(len(values), -1)[:, 0]) if values.size else ():
        if value in ABSENT:
            continue
        try:
            float(value)
            numbers.append(f"has numbers stored as text, such as {str(value)!r:.50} in row {row}")
        except (TypeError, ValueError):
            return f"has text, such as {str(value)!r:.50} in row {row}"
    if numbers:
        return numbers[0]
    return "has no value" if all(value in ABSENT for value in values.flat) else "has text"


def column(columns: Columns, reference: str, purpose: str) -> NDArray[np.float64]:
    """(T, ...) numbers of a column, ``NAME``, or of elements of its rows: ``NAME[I]`` (T,), ``NAME[I,J]`` (T, 2).

    Raises BadInput for an unknown name, an element that the rows do not have, and text.
    """
    name, elements = reference, ""
    if reference not in columns and (match := ELEMENTS.fullmatch(reference)):
        name, elements = match[1], match[2]
    if name not in columns:
        raise unknown_name(f"column of {purpose}", name, columns)
    values = columns[name]
    if values.dtype.kind == "M":  # dates as s since 1970
        values = np.where(np.isnat(values), np.nan, values.astype("datetime64[ns]").astype(np.int64) / 1e9)
    elif values.dtype.kind == "m":  # durations in s
        values = np.where(np.isnat(values), np.nan, values.astype("timedelta64[ns]").astype(np.int64) / 1e9)
    if values.dtype.kind not in "fiub":
        raise BadInput(f"column {name!r} of {purpose} {_not_numbers(values)}, expected numbers")
    if not elements:
        return values.astype(np.float64)
    index = [int(element) for element in elements.split(",")]
    if values.ndim < 2 or max(index) >= values.shape[1]:
        raise BadInput(f"column {name!r} of {purpose} has rows of shape {values.shape[1:]}, which have no [{elements}]")
    return values[:, index if len(index) > 1 else index[0]].astype(np.float64)


def joined(columns: Columns, references: str | list[str], purpose: str) -> NDArray[np.float64]:
    """(T, d): several columns side by side; a single one may have d elements.

    Raises BadInput for an unknown column, and for columns of different lengths. purpose: their use, for messages.
    """
    names = [references] if isinstance(references, str) else references
    parts = [column(columns, name, purpose) for name in names]
    rows = {len(part) for part in parts}
    if len(rows) > 1:
        raise BadInput(f"columns of {purpose}, {', '.join(names)}, have {', '.join(map(str, sorted(rows)))} rows")
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
