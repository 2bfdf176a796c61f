"""Simulated episodes with images per minute and core, by the command with one and two processes, with start-up."""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import subject
from subject import Row

LENGTHS = {"door": 200, "push": 250}
BARS = {"door": ">= 50", "push": ""}
EPISODES = 20  # per process


def measure() -> list[Row]:
    rows: list[Row] = []
    for task, steps in LENGTHS.items():
        single = 0.0
        for workers in (1, 2):
            count, before = workers * EPISODES, _cpu_seconds()
            duration = subject.seconds(lambda t=task, c=count, s=steps, w=workers: _collect(t, c, s, w))
            spent = _cpu_seconds() - before
            single = single or count / duration
            name = f"{task} x {steps}, {workers} process{'es' if workers > 1 else ''}"
            rows += [
                (f"{name}, CPU time", f"{60 * count / spent:.0f} episodes/min/core", BARS[task]),
                (f"{name}, wall time", f"{60 * count / duration:.0f} episodes/min", ""),
            ]
        rows.append((f"{task} x {steps}, two processes / one, wall time", f"{count / duration / single:.2f} x", ""))
    return rows


def _collect(task: str, episodes: int, steps: int, workers: int) -> None:
    # A subprocess: workers import its main module again, which is small, unlike the benchmark's.
    with tempfile.TemporaryDirectory() as folder:
        command = f"-m beliefscope collect {task} --episodes {episodes} --steps {steps} --workers {workers} -o".split()
        subprocess.run([sys.executable, *command, Path(folder) / "episodes.h5"], check=True, capture_output=True)


def _cpu_seconds() -> float:
    """CPU time of finished subprocesses, which does not depend on other load."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
