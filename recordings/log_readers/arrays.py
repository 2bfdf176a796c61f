"""Arrays of logs: their sizes, which a file may declare without containing them, and columns that are not read."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.readers.hdf5_limits import MAX_BYTES

Columns = Mapping[str, NDArray[Any]]
"""Name -> (T, ...) values of a column of a log."""

POINTER = b"version https://git-lfs"
"""First bytes of the file that Git LFS leaves in place of one that is not downloaded."""

Wanted = Callable[[str], bool]
"""Whether the values of a column are used."""


def check_size(name: str, shape: Sequence[int], dtype: DTypeLike) -> None:
    """Raise BadInput for a column that needs more than ``MAX_BYTES``."""
    size = math.prod(map(int, shape)) * np.dtype(dtype).itemsize
    if size > MAX_BYTES:
        raise BadInput(f"column {name!r} needs {size / 1e9:.3g} GB, more than the limit of {MAX_BYTES / 1e9:.3g} GB")


def unread(shape: Sequence[int], dtype: DTypeLike) -> NDArray[Any]:
    """Zeros without memory, for the shape and the type of a column that the map does not use."""
    return np.broadcast_to(np.zeros((), dtype), tuple(shape))


def check_downloaded(path: Path) -> None:
    """Raise BadInput for a file that Git LFS has not downloaded."""
    with path.open("rb") as file:
        if file.read(len(POINTER)) == POINTER:
            raise BadInput(f"{path.name} is a pointer of Git LFS, expected the file: `git lfs pull` downloads it")
