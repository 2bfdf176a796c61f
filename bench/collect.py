"""Simulated episodes a minute and core, with pictures, in one process and in two."""

from __future__ import annotations

import resource
import tempfile
from pathlib import Path

import subject
from subject import Row

from beliefscope.datasets.collect import collect

LENGTHS = {"door": 200, "push": 250}
BARS = {"door": ">= 50", "push": ""}
EPISODES = 10  # for each process


def measure() -> list[Row]:
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for task, steps in LENGTHS.items():
            collect(task, 1, 2, 0, 1, Path(folder) / "warm-up.h5")
            alone = 0.0
            for workers in (1, 2):
                spent = _processor_seconds()
                count = workers * EPISODES
                took = subject.seconds(
                    lambda t=task, c=count, s=steps, w=workers: collect(t, c, s, 0, w, Path(folder) / f"{t}{w}.h5")
                )
                spent = _processor_seconds() - spent
                alone = alone or count / took
                name = f"{task} x {steps}, {workers} process{'es' if workers > 1 else ''}"
                rows += [
                    (f"{name}, by processor time", f"{60 * count / spent:.0f} episodes/min/core", BARS[task]),
                    (f"{name}, by the clock", f"{60 * count / took:.0f} episodes/min", ""),
                ]
            rows.append((f"{task} x {steps}, two processes / one", f"{count / took / alone:.2f} x", ""))
    return rows


def _processor_seconds() -> float:
    """Of this process and of the children that have ended: what the work costs, however busy the machine is."""
    return sum(
        usage.ru_utime + usage.ru_stime
        for usage in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )
