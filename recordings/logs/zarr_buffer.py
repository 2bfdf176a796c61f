"""Zarr replay buffers: arrays over the steps of all episodes in ``data``, and the episodes' ends in ``meta``."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.logs.arrays import Wanted, check_size, unread

ENDS = "meta/episode_ends"

EPISODE = "episode"
"""Column with the number of the episode, from its ends."""

REFUSED = ("pickle", "json2", "msgpack2")
"""Codecs of objects. Reading the first can run code."""


def read(path: Path, wanted: Wanted) -> dict[str, NDArray[Any]]:
    """The arrays of a folder or zip archive in format 2 or 3. Raises BadInput for another layout and other types."""
    import zarr

    storage = zarr.storage
    store = storage.ZipStore(path, mode="r") if path.is_file() else storage.LocalStore(path, read_only=True)
    with closing(store):
        group = zarr.open_group(store, mode="r", use_consolidated=False)
        data = group.get("data")
        if not isinstance(data, zarr.Group) or not isinstance(group.get(ENDS), zarr.Array):
            raise BadInput(f"the store has no group 'data' and array {ENDS!r}: not a replay buffer")
        ends = _array(group[ENDS], ENDS, True)
        if ends.ndim != 1 or ends.dtype.kind not in "iu" or not len(ends) or np.any(np.diff(ends, prepend=0) <= 0):
            raise BadInput(f"{ENDS} is {ends!r:.100}, expected ascending whole numbers, the first above 0")
        columns = {}
        for name, array in data.members(max_depth=None):
            if isinstance(array, zarr.Array):
                if array.shape[:1] != (ends[-1],):
                    raise BadInput(f"array {name!r} has shape {array.shape}, and the last episode ends at {ends[-1]}")
                columns[name] = _array(array, name, wanted(name))
    check_size(EPISODE, (ends[-1],), np.int64)
    return {EPISODE: np.repeat(np.arange(len(ends)), np.diff(ends, prepend=0))} | columns


def _array(array: Any, name: str, wanted: bool) -> NDArray[Any]:
    codecs = {str(getattr(codec, "codec_id", "")) for codec in (*array.filters, *array.compressors)}
    if array.dtype.kind not in "fiub" or codecs & {*REFUSED}:
        raise BadInput(f"array {name!r} has the type {array.dtype}, expected numbers")
    if not wanted:
        return unread(array.shape, array.dtype)
    check_size(name, array.shape, array.dtype)
    check_size(f"chunk of {name}", array.chunks, array.dtype)
    return np.asarray(array[...])
