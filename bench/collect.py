"""Simulated episodes a minute and core, with pictures, in one process and in two: the command, its start included."""

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
EPISODES = 20  # for each process


def measure() -> list[Row]:
    rows: list[Row] = []
    for task, steps in LENGTHS.items():
        alone = 0.0
        for workers in (1, 2):
            count, spent = workers * EPISODES, _processor_seconds()
            took = subject.seconds(lambda t=task, c=count, s=steps, w=workers: _collect(t, c, s, w))
            spent = _processor_seconds() - spent
            alone = alone or count / took
            name = f"{task} x {steps}, {workers} process{'es' if workers > 1 else ''}"
            rows += [
                (f"{name}, by processor time", f"{60 * count / spent:.0f} episodes/min/core", BARS[task]),
                (f"{name}, by the clock", f"{60 * count / took:.0f} episodes/min", ""),
            ]
        rows.append((f"{task} x {steps}, two processes / one, by the clock", f"{count / took / alone:.2f} x", ""))
    return rows


def _collect(task: str, episodes: int, steps: int, workers: int) -> None:
    # A process of its own: the workers import its main module again, and that of the benchmark imports all there is.
    with tempfile.TemporaryDirectory() as folder:
        command = f"-m beliefscope collect {task} --episodes {episodes} --steps {steps} --workers {workers} -o".split()
        subprocess.run([sys.executable, *command, Path(folder) / "episodes.h5"], check=True, capture_output=True)


def _processor_seconds() -> float:
    """Of the processes that were started and have ended: what the work costs, however busy the machine is."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
