"""Time to the end of a task, from its progress."""

from __future__ import annotations

from collections import deque

MIN_PROGRESS = 0.05
"""Smallest progress since the first one from which the rate is known well enough."""

MIN_SECONDS = 5.0
"""Shortest time over which the rate is measured: progress may come in bursts."""


class RemainingTime:
    """Estimates the time to the end from the rate in the second half of the time since the first progress.

    The time before is start-up, such as imports and the reading of data, and a resumed task starts with the progress of
    its earlier runs. Parts of a task may be slower than earlier ones.
    """

    def __init__(self) -> None:
        self._first: tuple[float, float] | None = None
        self._recent: deque[tuple[float, float]] = deque()
        """Updates from the last one in the first half of the time, or ``MIN_SECONDS`` ago, on."""

    def update(self, progress: float, now: float) -> float | None:
        """s to the end; None below ``MIN_PROGRESS``.

        Args:
            progress: completed fraction, 0 to 1. now: s, of any clock that does not go back.
        """
        if progress <= 0.0:
            return None
        self._first = self._first or (progress, now)
        self._recent.append((progress, now))
        first, since = self._first
        while len(self._recent) > 1 and self._recent[1][1] <= min((since + now) / 2.0, now - MIN_SECONDS):
            self._recent.popleft()
        if progress - first < MIN_PROGRESS:
            return None
        begin, start = self._recent[0]
        if begin >= progress:  # nothing was completed since
            begin, start = first, since
        return (now - start) * (1.0 - progress) / (progress - begin)
