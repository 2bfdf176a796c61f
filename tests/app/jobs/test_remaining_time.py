"""Estimates of the time to the end of a task with constant speed after its start-up."""

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
