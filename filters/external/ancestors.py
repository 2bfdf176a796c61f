"""Ancestors of resampled particles: the first of the particles before that has the numbers of each one after."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

SLOTS = 8
"""Smallest number of entries of the hash table by row."""

HASH = 0x9E3779B1
"""Odd multiplier of the hash: the prime next to 2^32 over the golden ratio (Knuth, TAOCP 3, 6.4)."""

Words = NDArray[np.uint32]


def ancestors(after: Tensor, before: Tensor) -> Tensor:
    """(N, M after) int32: index of the first of the rows ``before`` (N, M, n) that equals each row of ``after``.

    M where there is none.
    """
    pairs = zip(after, before, strict=True)
    return torch.from_numpy(np.stack([_matches(_words(a), _words(b)) for a, b in pairs]))


def _words(rows: Tensor) -> Words:
    """(k, M) bits of rows (M, n), with 0.0 in place of -0.0, so that equal rows have equal bits."""
    rows = rows if rows.dtype in (torch.float32, torch.float64) else rows.float()
    return np.ascontiguousarray((rows.contiguous() + 0.0).numpy().view(np.uint32).T)


def _matches(after: Words, before: Words, salt: int = 1) -> NDArray[np.int32]:
    """As ``ancestors``, of one trajectory: rows are found in a table by a hash of their bits, and then compared.

    Rows that share an entry with another row are left to the next table, with another hash.
    """
    count = before.shape[1]
    bits, index = (SLOTS * count).bit_length(), np.arange(count, dtype=np.int32)
    table, slots = np.zeros(2**bits, np.int32), _hashes(before, bits, salt)
    table[slots[::-1]] = index[::-1]  # of several rows, the first one is assigned last
    candidate = table.take(_hashes(after, bits, salt))
    equal = _equal(before, candidate, after)
    result = np.where(equal, candidate, np.int32(count))
    first, missing = table.take(slots), np.flatnonzero(~equal)
    hidden = np.flatnonzero(first != index)
    hidden = hidden[~_equal(before, first[hidden], before[:, hidden])]
    if len(hidden) and len(missing):
        found = _matches(after[:, missing], before[:, hidden], salt + 1)
        result[missing] = np.append(hidden, count).take(found)
    return result


def _equal(rows: Words, index: NDArray[np.int32], others: Words) -> NDArray[np.bool_]:
    """(M,): whether the rows (k, .) at an index (M,) equal other rows (k, M)."""
    equal = rows[0].take(index) == others[0]
    for row, other in zip(rows[1:], others[1:], strict=True):
        equal &= row.take(index) == other
    return np.asarray(equal)


def _hashes(rows: Words, bits: int, salt: int) -> NDArray[np.intp]:
    """(M,) hashes of that many bits of rows (k, M)."""
    total = rows[0] * np.uint32(pow(HASH, salt, 2**32))
    for i, row in enumerate(rows[1:], 1):
        total += row * np.uint32(pow(HASH, salt + i, 2**32))
    return (total >> np.uint32(32 - bits)).astype(np.intp)
