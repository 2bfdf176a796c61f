"""Engines: every item once, with progress, whatever happens to the processes of a cluster."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import pytest

from beliefscope.filters.engine import Progress, run_all, run_blocks


def squares(block: Sequence[int], progress: Progress) -> list[int]:
    if progress is not None:
        progress(0.5)
    return [number**2 for number in block]


def square_once_killed(folder: Path, number: int) -> int:
    """The square; the process of every fourth number kills itself the first time, as the kernel does without memory."""
    marker = folder / str(number)
    if number % 4 == 0 and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2


def test_progress_counts_items_of_blocks() -> None:
    shares: list[float] = []
    results = list(run_blocks(squares, [[1, 2, 3], [4]], progress=shares.append))
    assert results == [([1, 2, 3], [1, 4, 9]), ([4], [16])]
    assert shares == [1.5 / 4, 3 / 4, 3.5 / 4, 1.0]


@pytest.mark.slow
@pytest.mark.long
def test_processes_report_whole_blocks() -> None:
    shares: list[float] = []
    results = sorted(run_blocks(squares, [[1, 2, 3], [4]], workers=2, progress=shares.append))
    assert results == [([1, 2, 3], [1, 4, 9]), ([4], [16])]
    assert shares in ([3 / 4, 1.0], [1 / 4, 1.0])


@pytest.mark.long
def test_items_of_killed_ray_workers_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="pip install 'beliefscope[ray]'")
    monkeypatch.setenv("RAY_raylet_start_wait_time_s", "200")  # 30 s by default, which a busy machine exceeds
    assert os.environ.get("RAY_ADDRESS") is None
    results = sorted(run_all(partial(square_once_killed, tmp_path), range(9), "ray"))
    assert results == [(i, i**2) for i in range(9)]
    assert len(list(tmp_path.iterdir())) == 3
