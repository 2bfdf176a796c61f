"""Columns of NumPy archives, CSV and Parquet."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.logs.arrays import Wanted


def read(path: Path, wanted: Wanted) -> dict[str, NDArray[Any]]:
    """All columns of a ``.npz``, ``.csv`` or ``.parquet`` file; nested lists in Parquet become arrays."""
    if path.suffix.lower() == ".npz":
        if not is_zipfile(path):  # NumPy would suggest to load the file as a pickle
            raise BadInput(f"{path.name} is no complete NumPy archive, as written by np.savez")
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    from pyarrow import csv, parquet

    table = csv.read_csv(path) if path.suffix.lower() == ".csv" else parquet.read_table(path)
    return {name: from_arrow(table.column(name)) for name in table.column_names}


def from_arrow(column: Any) -> NDArray[Any]:
    """(T, ...): rows of lists of equal lengths become further axes; missing numbers NaN. Raises ValueError else."""
    import pyarrow as pa
    from pyarrow import compute

    if isinstance(column, pa.ChunkedArray):
        column = column.combine_chunks()
    kind = column.type
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
