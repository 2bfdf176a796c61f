"""Columns of HDF5 files: arrays by their path, such as ``obs/wrist``; or one group per episode, such as ``demo_0``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.readers.hdf5_guard import open_hdf5
from beliefscope.datasets.readers.hdf5_limits import check_array, numeric_arrays, read_array
from beliefscope.recordings.log_readers.arrays import Wanted, check_size, unread

SUFFIXES = (".h5", ".hdf5")

EPISODE = "episode"
"""Column with the name of the episode's group, unless an array has this name."""

DEPTH = 2
"""Maximum number of levels to the groups of the episodes: ``demo_0``, or ``data/demo_0``."""


def read(path: Path, wanted: Wanted) -> dict[str, NDArray[Any]]:
    """The arrays of numbers. Raises BadInput for a data set of Beliefscope, and for episodes with other arrays."""
    with open_hdf5(path) as file:
        if "format" in file.attrs and str(file.attrs["format"]).startswith("beliefscope"):
            raise BadInput(f"{path.name} is a data set already: pass it as --data")
        arrays = numeric_arrays(file)
        groups = _episodes(list(arrays))
        if not groups:
            return {name: _values(name, stored, wanted(name)) for name, stored in arrays.items()}
        names = {name.removeprefix(f"{group}/"): None for name in arrays for group in groups if name.startswith(group)}
        columns = {name: [_of_group(path, arrays, group, name, wanted(name)) for group in groups] for name in names}
        for name, parts in columns.items():
            check_size(name, (sum(map(len, parts)), *parts[0].shape[1:]), parts[0].dtype)
        counts = [len(part) for part in next(iter(columns.values()))]
        return {EPISODE: np.repeat([group.rpartition("/")[2] for group in groups], counts)} | {
            name: np.concatenate(parts) for name, parts in columns.items()
        }


def _episodes(names: list[str]) -> list[str]:
    """The groups that contain all arrays and have a number at the end of their names, in its order; or none."""
    for depth in range(1, DEPTH + 1):
        groups = dict.fromkeys("/".join(name.split("/")[:depth]) for name in names)
        inside = all(name.count("/") >= depth for name in names)
        if names and inside and all(group[-1:].isdecimal() for group in groups):
            return sorted(groups, key=lambda group: (len(group), group))
    return []


def _of_group(path: Path, arrays: dict[str, Any], group: str, name: str, wanted: bool) -> NDArray[Any]:
    if (stored := arrays.get(f"{group}/{name}")) is None:
        raise BadInput(f"{path.name} has no array {group}/{name}, which other episodes have")
    return _values(name, stored, wanted)


def _values(name: str, stored: Any, wanted: bool) -> NDArray[Any]:
    if wanted:
        return read_array(stored, f"array {name!r}")
    check_array(stored, f"array {name!r}")
    return unread(stored.shape, stored.dtype)
