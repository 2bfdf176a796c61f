"""Time to the end of a task, from its progress."""

from __future__ import annotations

MIN_PROGRESS = 0.05
"""Smallest progress since the first one from which the rate is known well enough."""


class RemainingTime:
    """Estimates the time to the end from the rate since the first progress.

    The time before is start-up, such as imports and the reading of data, and a resumed task starts with the progress of
    its earlier runs.
    """

    def __init__(self) -> None:
        self._first: tuple[float, float] | None = None

    def update(self, progress: float, now: float) -> float | None:
        """s to the end; None below ``MIN_PROGRESS``.

        Args:
            progress: completed fraction, 0 to 1. now: s, of any clock that does not go back.
        """
        if progress <= 0.0:
            return None
        self._first = self._first or (progress, now)
        first, since = self._first
        done = progress - first
        return (now - since) * (1.0 - progress) / done if done >= MIN_PROGRESS else None
