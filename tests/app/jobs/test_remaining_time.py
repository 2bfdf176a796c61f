"""Estimates of the time to the end of a task after its start-up."""

from __future__ import annotations

import pytest

from beliefscope.app.jobs.remaining_time import RemainingTime


@pytest.mark.parametrize(("startup", "done"), [(0.0, 0.01), (60.0, 0.01), (5.0, 0.6)])
def test_startup_and_earlier_progress_do_not_count(startup: float, done: float) -> None:
    """100 s for all of the work; ``done`` is the first progress, after the start-up."""
    time_left = RemainingTime()
    assert time_left.update(0.0, 0.0) is None
    assert time_left.update(done, startup) is None
    assert time_left.update(done + 0.04, startup + 4.0) is None
    assert time_left.update(done + 0.1, startup + 10.0) == pytest.approx(100.0 * (0.9 - done))
    assert time_left.update(1.0, startup + 100.0 * (1.0 - done)) == 0.0


def test_a_slow_part_has_its_own_rate() -> None:
    """A part of 100 s begins after 0.8 of the progress, which took 10 s."""
    time_left = RemainingTime()
    for second in range(11):
        time_left.update(0.08 * second, float(second))
    assert time_left.update(0.83, 25.0) == pytest.approx(85.0)
    assert time_left.update(0.83, 60.0) == pytest.approx(0.17 * 59.0 / 0.75)
    assert time_left.update(0.9, 60.0) == pytest.approx(50.0)


def test_a_pause_of_seconds_does_not_count() -> None:
    time_left = RemainingTime()
    for progress, now in ((0.1, 0.0), (0.4, 1.0), (0.41, 2.0)):
        remaining = time_left.update(progress, now)
    assert remaining == pytest.approx(0.59 * 2.0 / 0.31)
