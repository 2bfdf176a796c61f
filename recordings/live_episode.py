"""A live run over a recorded episode, at the rate of a robot."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import torch

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import Faults
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.traces.run import start_run
from beliefscope.recordings.live import LiveRecorder


@dataclass
class Timing:
    """Durations of a run in s.

    Attributes:
        steps: of each step. late: number of steps that ended after their deadline. stopped: whether by Ctrl-C.
    """

    steps: list[float] = field(default_factory=list)
    total: float = 0.0
    late: int = 0
    stopped: bool = False


def record_steps(
    checkpoint: Checkpoint,
    episode: Episode,
    index: int,
    seed: int,
    particles: int,
    faults: Faults,
    name: str,
    folder: Path,
) -> tuple[LiveRecorder, Iterator[None]]:
    """The recorder, and an iterator that runs and records one step each. The steps equal those of ``trace``."""
    options: dict[str, Any] = {"folder": folder, "like": episode, "expected": len(episode)}
    if isinstance(checkpoint, ExternalFilter):
        options |= {"filter": checkpoint.name, "checkpoint_hash": checkpoint.hash, "data_hash": episode.digest()}
        options |= {"faults": faults, "episode_index": index, "seed": seed}
        options |= {"settings": {"torch": torch.__version__, "source": checkpoint.source}}
        faulty = faults.apply(episode, seed)
        start = checkpoint.start([faulty])  # before the first step, because it may initialise the filter
        outputs = checkpoint.live(faulty, seed)
        first = next(outputs)  # has the names of the measurement models
        options |= {"task": checkpoint.task, "modalities": first[1], "start": start}
        recorder = LiveRecorder(name, **options)

        def external_steps() -> Iterator[None]:
            for (values, _), row in zip(chain([first], outputs), _rows(faulty), strict=True):
                recorder.step(values, **row)
                yield

        return recorder, external_steps()
    run = start_run(checkpoint, episode, index, seed, particles, faults)
    recorder = LiveRecorder(name, checkpoint, start=run.start, **options, **run.provenance)

    @torch.no_grad()
    def steps() -> Iterator[None]:
        generator = run.generator()
        belief = checkpoint.filter.start(run.start, particles, generator)
        for t, row in enumerate(_rows(run.episode)):
            belief, values = checkpoint.filter.step(belief, run.evidence[t], generator)
            recorder.step(values, **row, evidence=run.evidence[t])
            yield

    return recorder, steps()


def run_steps(
    recorder: LiveRecorder, steps: Iterator[None], count: int, rate: float, on_step: Callable[[int, float], None]
) -> Timing:
    """Run all steps until the end or Ctrl-C.

    Args:
        rate: Hz; 0: as fast as possible. on_step: called with the number of completed steps and their rate in Hz.
    """
    timing, start = Timing(), time.perf_counter()
    try:
        with recorder:
            for t in range(count):
                due = start + t / rate if rate else 0.0
                time.sleep(max(0.0, due - time.perf_counter()))
                step_start = time.perf_counter()
                next(steps)
                end = time.perf_counter()
                timing.steps.append(end - step_start)
                timing.late += bool(rate) and end > due + 1 / rate
                on_step(t + 1, (t + 1) / (end - start))
            timing.total = time.perf_counter() - start
    except KeyboardInterrupt:
        timing.stopped, timing.total = True, time.perf_counter() - start
    return timing


def _rows(episode: Episode) -> Iterator[dict[str, Any]]:
    """Arguments of ``LiveRecorder.step`` for each step of an episode."""
    for t in range(len(episode)):
        yield {
            "observations": {key: array[t] for key, array in episode.observations.items()},
            "control": episode.controls[t],
            "truth": episode.states[t],
            "contact": bool(episode.contact[t]),
            "covariates": {name: values[t] for name, values in episode.covariates.items()},
            "qpos": episode.qpos[t],
            "time": None if episode.time is None else episode.time[t],
        }
