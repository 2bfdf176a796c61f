"""What much data costs: 600 doors of 800 steps read into memory, and windows cut from them while a filter trains."""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from subject import STEPS, Row

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.batch import Statistics, Steps
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.training.stages import Trainer
from beliefscope.filters.training.train import PLANS

EPISODES, WRITTEN = 600, 20
TURNS = 10


def measure() -> list[Row]:
    # In a process of its own, whose peak of memory nothing else has raised.
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(_measure).result()


def _measure() -> list[Row]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "doors.h5"
        with open_dataset(sample_path("door")) as sample:
            short = list(sample)
            write_dataset(path, sample.task, (_long(short, i) for i in range(WRITTEN)))
        began, before = time.perf_counter(), _peak()
        episodes: list[Episode] = []
        for _ in range(EPISODES // WRITTEN):
            with open_dataset(path) as data:
                episodes += list(data)
                task = data.task
        read = time.perf_counter() - began
        began = time.perf_counter()
        steps = Steps.of(task, episodes)
        joining = time.perf_counter() - began
        few = Steps.of(task, episodes[:10])  # enough for pictures that are looked up
    pictures = steps.observations["image"]
    fitting = time.perf_counter()
    Statistics(task).fit(steps)
    fitting = time.perf_counter() - fitting
    rows: list[Row] = [
        (f"{EPISODES} x {STEPS} steps read from HDF5, checked", f"{read:.1f} s", ""),
        ("joined to tensors", f"{joining:.1f} s", ""),
        ("mean and deviation of all", f"{fitting:.1f} s", ""),
        (f"pictures in memory, {pictures.dtype}", f"{pictures.nbytes / 1e6:.0f} MB", "not as floats"),
        ("peak of memory above the start", f"{(_peak() - before) / 1e3:.0f} MB", ""),
    ]
    for name in ("crossmodal-ekf", "crossmodal-pf"):
        for remembered in (False, True):
            share, step = _loader(few if remembered else steps, name, remembered)
            what = "pictures remembered" if remembered else "through the encoders"
            rows.append(
                (f"{name}, training step, {what}: of {step * 1e3:.0f} ms, windows cut", f"{share:.1%}", "<= 10 %")
            )
    return rows


def _long(short: list[Episode], number: int) -> Episode:
    """An episode of 800 steps out of the sample set's of 100."""
    parts = [short[(number + i) % len(short)] for i in range(STEPS // len(short[0]))]

    def joined(of: Callable[[Episode], Any]) -> Any:
        return np.concatenate([of(part) for part in parts])

    return replace(
        parts[0],
        states=joined(lambda e: e.states),
        controls=joined(lambda e: e.controls),
        contact=joined(lambda e: e.contact),
        qpos=joined(lambda e: e.qpos),
        observations={key: joined(lambda e, key=key: e.observations[key]) for key in parts[0].observations},
    )


def _loader(steps: Steps, name: str, remembered: bool) -> tuple[float, float]:
    """The share of cutting windows in a training step end to end over 16 steps, and the seconds of such a step."""
    filter_ = build(architecture("door", name))
    filter_.statistics.fit(steps)
    trainer = Trainer(filter_, steps, PLANS["cpu"], seed=0)
    cut, spent = trainer.sample, [0.0]

    def timed(*arguments: Any) -> Any:
        began = time.perf_counter()
        batch = cut(*arguments)
        spent[0] += time.perf_counter() - began
        return batch

    trainer.sample = timed  # type: ignore[method-assign]
    marks: list[tuple[float, float]] = []
    trainer.report = lambda *_: marks.append((time.perf_counter(), spent[0]))
    trainer.end_to_end("bench", filter_.parameters(), TURNS + 1, 16, 1e-4, remembered=remembered)
    took = marks[-1][0] - marks[0][0]
    return (marks[-1][1] - marks[0][1]) / took, took / TURNS


def _peak() -> float:
    """KB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
