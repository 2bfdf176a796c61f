"""Numbers out of HDF5 files of others: a file of a few bytes can claim to hold more than any memory does."""

from __future__ import annotations

import math
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput

LARGEST = 1 << 31
"""Bytes of one array, at most: the pictures of two million steps."""

DENSEST = 1100
"""Bytes of numbers for each byte in the file, at most: deflate's own bound is 1032, and other filters stay below."""

SLACK = 1 << 16
"""Bytes that are never too many."""


def check_claim(stored: h5py.Dataset, place: str) -> None:
    """Raises BadInput, naming the place, for what are not numbers in this file, or more than it can hold."""
    kind = stored.dtype.base if stored.dtype.subdtype else stored.dtype
    if kind.kind not in "biuf" or stored.shape is None:
        raise BadInput(f"{place} is {kind}, expected numbers.")
    if stored.is_virtual or stored.external:
        raise BadInput(f"{place} lies in another file, expected its numbers in this one.")
    claimed = math.prod(map(int, stored.shape)) * stored.dtype.itemsize
    held = stored.id.get_storage_size()
    if claimed > min(LARGEST, DENSEST * held + SLACK):
        raise BadInput(f"{place} claims {claimed} bytes of numbers where the file holds {held}.")


def numbers(stored: h5py.Dataset, place: str) -> NDArray[Any]:
    """All of them, after ``check_claim``."""
    check_claim(stored, place)
    return np.asarray(stored[()])
