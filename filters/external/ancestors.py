"""Ancestors of resampled particles: the first of the particles before that has the numbers of each one after."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

SLOTS = 8
"""Smallest number of entries of the hash table by row."""

HASH = 0x9E3779B1
"""Odd multiplier of the hash: the prime next to 2^32 over the golden ratio (Knuth, TAOCP 3, 6.4)."""

Words = NDArray[np.uint32]
Indices = NDArray[np.intp]


def words_of(rows: Tensor, memory: Words | None = None) -> Words:
    """(N, k, M) copy of the bits of rows (N, M, n), such that equal rows have equal bits.

    Args:
        memory: array that receives the copy if it has its shape. Fresh memory costs more time than the copy.
    """
    rows = rows if rows.dtype in (torch.float32, torch.float64) else rows.float()
    positive = rows.contiguous() + 0.0  # 0.0 in place of -0.0
    words = positive.numpy().view(np.uint32).swapaxes(1, 2)
    if memory is None or memory.shape != words.shape:
        return np.ascontiguousarray(words)
    np.copyto(memory, words)
    return memory


def ancestors(after: Words, before: Words, table: NDArray[np.int32] | None = None) -> Tensor:
    """(N, M after) int32: index of the first of the rows ``before`` that equals each row of ``after``.

    M where there is none.

    Args:
        after, before: (N, k, M) as ``words_of`` returns them.
        table: memory of ``new_table`` for this M, which may have entries of an earlier search.
    """
    table = new_table(before.shape[2]) if table is None else table
    return torch.from_numpy(np.stack([_matches(a, b, table) for a, b in zip(after, before, strict=True)]))


def new_table(count: int) -> NDArray[np.int32]:
    """Memory of a hash table for a number of rows."""
    return np.zeros(2 ** (SLOTS * count).bit_length(), np.int32)


def _matches(after: Words, before: Words, table: NDArray[np.int32]) -> NDArray[np.int32]:
    """As ``ancestors``, of one trajectory: rows are found in a table by a hash of their bits, and then compared.

    Of the rows before that share an entry of the table, it has the first one; the others are searched in order.
    """
    count = before.shape[1]
    index, shift = np.arange(count, dtype=np.int32), np.uint32(33 - len(table).bit_length())
    hashes, wanted = _hashes(before), _hashes(after)
    slots = (hashes >> shift).astype(np.intp)
    table[np.ascontiguousarray(slots[::-1])] = index[::-1]  # of several rows, the first one is assigned last
    result = _take(table, (wanted >> shift).astype(np.intp))  # earlier entries are refused by the comparison
    missing = np.flatnonzero(~_equal(before, result, after))
    hidden = np.flatnonzero(_take(table, slots) != index) if len(missing) else missing
    result[missing] = count
    if len(hidden):
        parents = _search(after[:, missing], wanted[missing], before[:, hidden], hashes[hidden])
        result[missing] = _take(np.append(hidden, count), parents)
    return result


def _search(after: Words, wanted: Words, before: Words, hashes: Words) -> Indices:
    """As ``_matches``, in sorted hashes: every row with an equal hash is compared. For few rows this is faster."""
    count = len(hashes)
    order = np.argsort(hashes, kind="stable")
    ordered = hashes[order]
    position = np.searchsorted(ordered, wanted)
    result = _take(order, position)
    rows = np.flatnonzero(~_equal(before, result, after))
    while len(rows):  # other rows with the same hash may follow
        result[rows] = count
        position[rows] += 1
        rows = rows[position[rows] < count]
        rows = rows[ordered[position[rows]] == wanted[rows]]
        candidate = order[position[rows]]
        equal = _equal(before, candidate, after[:, rows])
        result[rows[equal]] = candidate[equal]
        rows = rows[~equal]
    return result


def _take(values: NDArray[Any], index: NDArray[Any]) -> NDArray[Any]:
    """``values[index]`` for indices in range, without the check of the range, which takes most of the time."""
    return values.take(index, mode="clip")


def _equal(rows: Words, index: NDArray[Any], others: Words) -> NDArray[np.bool_]:
    """(M,): whether the rows (k, .) at an index (M,) equal other rows (k, M)."""
    index = index.astype(np.intp)
    equal = _take(rows[0], index) == others[0]
    for row, other in zip(rows[1:], others[1:], strict=True):
        equal &= _take(row, index) == other
    return np.asarray(equal)


def _hashes(rows: Words) -> Words:
    """(M,) hashes of rows (k, M)."""
    total = rows[0] * np.uint32(HASH)
    for i, row in enumerate(rows[1:], 2):
        total += row * np.uint32(pow(HASH, i, 2**32))
    return total
