"""Columns of NumPy archives, CSV and Parquet."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.log_readers.arrays import Wanted

MAX_HEADER = 1 << 20
"""Bytes of the first line of a CSV file that are checked, and of the rows after it."""

SEPARATORS = (";", "\t")
"""Separators of CSV files in place of commas; decimal commas are then read as well."""

UTF_16 = (b"\xff\xfe", b"\xfe\xff")
"""First bytes of files in UTF-16."""


def read(path: Path, wanted: Wanted) -> dict[str, NDArray[Any]]:
    """All columns (T, ...) of a ``.npz``, ``.csv`` or ``.parquet`` file; nested lists in Parquet become arrays.

    Raises BadInput for a file that is no archive of NumPy, as ``csv_format``, and for names that occur twice.
    """
    if path.suffix.lower() == ".npz":
        if not is_zipfile(path):  # NumPy would suggest to load the file as a pickle
            raise BadInput(f"{path.name} is not a complete NumPy archive, as written by np.savez")
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    from pyarrow import csv, parquet

    if path.suffix.lower() == ".csv":
        separator, point = csv_format(path)
        convert = csv.ConvertOptions(decimal_point=point)
        numbered = csv.ReadOptions(use_threads=False)  # errors then state the row
        table = csv.read_csv(path, numbered, csv.ParseOptions(delimiter=separator), convert)
        table = table.rename_columns([name.strip() for name in table.column_names])
    else:
        table = parquet.read_table(path)
    for name in table.column_names:
        if table.column_names.count(name) > 1:
            raise BadInput(f"{path.name} has {table.column_names.count(name)} columns {name!r}, expected unique names")
    return {name: from_arrow(table.column(name)) for name in table.column_names}


def csv_format(path: Path) -> tuple[str, str]:
    """Separator of the columns and decimal point. Raises BadInput for another encoding than UTF-8."""
    with path.open("rb") as file:
        first, rows = file.readline(MAX_HEADER), file.read(MAX_HEADER)
    try:
        header = first.decode("utf-8-sig", "strict" if len(first) < MAX_HEADER else "ignore")
    except UnicodeDecodeError as error:
        code = "UTF-16" if first[:2] in UTF_16 else f"not UTF-8, with the byte 0x{first[error.start]:02x} in line 1"
        raise BadInput(f"{path.name} is {code}: expected a CSV file in UTF-8") from None
    separator = max(SEPARATORS, key=header.count)
    if "," in header or separator not in header:
        return ",", "."
    commas, points = (len(re.findall(pattern, rows)) for pattern in (rb"\d,\d", rb"\d\.\d"))
    return separator, "," if commas > points else "."


def from_arrow(column: Any) -> NDArray[Any]:
    """(T, ...): rows of lists of equal lengths become further axes; missing numbers NaN. Raises ValueError else."""
    import pyarrow as pa
    from pyarrow import compute

    if isinstance(column, pa.ChunkedArray):
        column = column.combine_chunks()
    kind = column.type
    if pa.types.is_decimal(kind):
        column = column.cast(pa.float64())
    if not (pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)):
        values = column.to_numpy(zero_copy_only=False)
        return values if values.dtype != object else values.astype(str)
    if not len(column):
        return np.zeros(0)
    lengths = compute.unique(compute.list_value_length(column)).to_pylist()
    if len(lengths) != 1 or lengths == [None]:
        raise ValueError(f"rows of lists of {lengths[:5]} elements, expected one length")
    values = from_arrow(column.flatten())
    return values.reshape(len(column), lengths[0], *values.shape[1:])
