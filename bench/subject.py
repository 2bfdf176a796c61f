"""Benchmark subject: the pretrained filters on one simulated door episode of 800 steps."""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from statistics import median

import torch
from rich.console import Console
from rich.table import Table

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.inspect.trace import Trace, trace

STEPS = 800
NAMES = ("crossmodal-ekf", "crossmodal-pf")

Row = tuple[str, str, str]
"""Quantity, measured value, requirement."""

COLUMNS = ("quantity", "measured", "required")


def print_machine() -> None:
    print(
        f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, "
        f"Python {platform.python_version()}, torch {torch.__version__} on {torch.get_num_threads()} threads"
    )


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    table = Table(*columns, title=title, title_justify="left", min_width=90)
    for row in rows:
        table.add_row(*row)
    Console(width=120).print(table)
    sys.stdout.flush()


@cache
def episode() -> Episode:
    """The episode of seed 1, index 1: a push with contact and free motion."""
    simulate = find_task("door").simulate
    assert simulate is not None
    return simulate(1, 1, STEPS)


@cache
def checkpoint(name: str) -> Checkpoint:
    return load_checkpoint(pretrained_path("door", name))


@cache
def traced(name: str) -> Trace:
    return trace(checkpoint(name), episode())


def seconds(function: Callable[[], object]) -> float:
    began = time.perf_counter()
    function()
    return time.perf_counter() - began


def alternate(
    first: Callable[[], object], second: Callable[[], object], repetitions: int
) -> tuple[float, float, float]:
    """Median seconds of both, run alternately after a warm-up, and the median ratio second / first of the pairs."""
    first(), second()
    pairs = [(seconds(first), seconds(second)) for _ in range(repetitions)]
    return median(a for a, _ in pairs), median(b for _, b in pairs), median(b / a for a, b in pairs)
