"""Size limits for arrays read from HDF5: a file of a few bytes can declare an array larger than memory."""

from __future__ import annotations

import math
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput

MAX_BYTES = 1 << 31
"""Limit for one array: the images of two million steps."""

MAX_COMPRESSION = 1100
"""Limit for array bytes per stored byte. Deflate reaches at most 1032, other filters less."""

SLACK = 1 << 16
"""Array bytes that are always allowed."""


def check_array(stored: h5py.Dataset, place: str) -> None:
    """Raise BadInput if the array is not numeric, not stored in this file, or larger than the file can hold."""
    element, shape = stored.dtype, stored.shape  # h5py reads them from the file each time
    kind = element.base if element.subdtype else element
    if kind.kind not in "biuf" or shape is None:
        raise BadInput(f"{place} is {kind}, expected numbers.")
    if stored.is_virtual or stored.external:
        raise BadInput(f"{place} is stored in another file, expected numbers in this one.")
    declared = math.prod(map(int, shape)) * element.itemsize
    size = stored.id.get_storage_size()
    if declared > min(MAX_BYTES, MAX_COMPRESSION * size + SLACK):
        raise BadInput(f"{place} declares {declared} bytes of numbers, but the file stores {size}.")


def numeric_arrays(file: h5py.File) -> dict[str, h5py.Dataset]:
    """All arrays of numbers by their path in the file."""
    arrays: dict[str, h5py.Dataset] = {}

    def visit(name: str, item: h5py.HLObject) -> None:
        if isinstance(item, h5py.Dataset) and item.shape and item.dtype.kind in "biuf":
            arrays[name] = item

    file.visititems(visit)
    return arrays


def read_array(stored: h5py.Dataset, place: str) -> NDArray[Any]:
    """Read an array after ``check_array``."""
    check_array(stored, place)
    return np.asarray(stored[()])
