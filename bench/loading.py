"""Loading of large data sets: 600 doors of 800 steps read into memory, and windows sampled from them in training."""

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
from beliefscope.filters.training.plan import PLANS
from beliefscope.filters.training.stages import Trainer

EPISODES, WRITTEN = 600, 20
REPETITIONS = 10


def measure() -> list[Row]:
    # In a subprocess, for its own peak memory.
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(_measure).result()


def _measure() -> list[Row]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "doors.h5"
        with open_dataset(sample_path("door")) as sample:
            short = list(sample)
            write_dataset(path, sample.task, (_long(short, i) for i in range(WRITTEN)))
        start, before = time.perf_counter(), _peak()
        episodes: list[Episode] = []
        for _ in range(EPISODES // WRITTEN):
            with open_dataset(path) as data:
                episodes += list(data)
                task = data.task
        reading = time.perf_counter() - start
        start = time.perf_counter()
        steps = Steps.from_episodes(task, episodes)
        joining = time.perf_counter() - start
        few = Steps.from_episodes(task, episodes[:10])  # enough for cached images
    images = steps.observations["image"]
    start = time.perf_counter()
    Statistics(task).fit(steps)
    fitting = time.perf_counter() - start
    rows: list[Row] = [
        (f"{EPISODES} x {STEPS} steps read from HDF5 and validated", f"{reading:.1f} s", ""),
        ("converted to tensors", f"{joining:.1f} s", ""),
        ("mean and standard deviation", f"{fitting:.1f} s", ""),
        (f"images in memory, {images.dtype}", f"{images.nbytes / 1e6:.0f} MB", "not as floats"),
        ("peak memory increase", f"{(_peak() - before) / 1e3:.0f} MB", ""),
    ]
    for name in ("crossmodal-ekf", "crossmodal-pf"):
        for cached in (False, True):
            share, step = _loader(few if cached else steps, name, cached)
            encoding = "images cached" if cached else "images encoded"
            rows.append(
                (f"{name}, training step of {step * 1e3:.0f} ms, {encoding}: sampling", f"{share:.1%}", "<= 10 %")
            )
    return rows


def _long(short: list[Episode], number: int) -> Episode:
    """An episode of 800 steps, concatenated from episodes of 100."""
    parts = [short[(number + i) % len(short)] for i in range(STEPS // len(short[0]))]

    def joined(get: Callable[[Episode], Any]) -> Any:
        return np.concatenate([get(part) for part in parts])

    return replace(
        parts[0],
        states=joined(lambda e: e.states),
        controls=joined(lambda e: e.controls),
        contact=joined(lambda e: e.contact),
        qpos=joined(lambda e: e.qpos),
        observations={key: joined(lambda e, key=key: e.observations[key]) for key in parts[0].observations},
    )


def _loader(steps: Steps, name: str, cached: bool) -> tuple[float, float]:
    """Fraction of sampling in an end-to-end training step of 16 steps, and seconds of such a step."""
    filter_ = build(architecture("door", name))
    filter_.statistics.fit(steps)
    trainer = Trainer(filter_, steps, PLANS["cpu"], seed=0)
    sample, spent = trainer.sample, [0.0]

    def timed(*arguments: Any) -> Any:
        start = time.perf_counter()
        batch = sample(*arguments)
        spent[0] += time.perf_counter() - start
        return batch

    trainer.sample = timed  # type: ignore[method-assign]
    marks: list[tuple[float, float]] = []
    trainer.report = lambda *_: marks.append((time.perf_counter(), spent[0]))
    trainer.end_to_end("bench", filter_.parameters(), REPETITIONS + 1, 16, 1e-4, cached=cached)
    duration = marks[-1][0] - marks[0][0]
    return (marks[-1][1] - marks[0][1]) / duration, duration / REPETITIONS


def _peak() -> float:
    """Peak memory, KB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
