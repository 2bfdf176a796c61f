"""A long episode in a file, read in parts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode, digest_of
from beliefscope.datasets.errors import BadInput

STEPS_PER_PART = 4096
"""Steps of an episode that are stored, read and encoded at once; limits memory."""


class EpisodeParts:
    """An episode in a file; it has the methods of ``Episode`` that need no whole arrays.

    Attributes:
        task: of the episode.
    """

    def __init__(
        self,
        steps: int,
        read: Callable[[slice], Episode],
        read_array: Callable[[str, slice], NDArray[Any]],
        digest: str,
        place: str,
    ) -> None:
        """Read the first step.

        Args:
            steps: of the whole episode.
            read: reads and validates steps. read_array: reads steps of an array in ``Episode.arrays``.
            digest: of the whole episode, as stored. place: file and name of the episode, for messages.
        """
        self._steps, self._read, self._read_array = steps, read, read_array
        self._digest, self._place = digest, place
        self._first, self._last_read = 0, read(slice(0, 1))
        self.task = self._last_read.task

    def __len__(self) -> int:
        return self._steps

    def part(self, first: int, last: int) -> Episode:
        """Steps ``first`` to ``last - 1``; those of the latest part are not read again. Raises BadInput if invalid."""
        if not self._first <= first <= last <= self._first + len(self._last_read):
            self._first, self._last_read = first, self._read(slice(first, last))
        return self._last_read.part(first - self._first, last - self._first)

    def digest(self) -> str:
        """``Episode.digest`` of the arrays in the file. Raises BadInput if it is not the stored one."""
        parts = [slice(first, first + STEPS_PER_PART) for first in range(0, self._steps, STEPS_PER_PART)]
        like = self.part(0, 1)
        if digest_of(like, self._steps, lambda name: (self._read_array(name, p) for p in parts)) != self._digest:
            raise BadInput(f"the arrays of {self._place} do not match its digest: they were modified.")
        return self._digest
