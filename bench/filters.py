"""Speed of every filter in evaluation and training, compared with the paper's published code; memory; tracing overhead.

Speed is per CPU-second of one thread, with noise images, random weights and the shapes of the door task: 100 steps
of one trajectory and of 20 at a time (300 particles), and a training step, forward and backward (16 steps of 32
trajectories, 30 particles). The best of several repetitions counts, because other load only adds time.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from itertools import accumulate

import subject
import torch
from subject import NAMES, STEPS, Row
from torch.profiler import ProfilerActivity, profile

from beliefscope.datasets.simulation.door import DOOR
from beliefscope.filters.batch import Batch, Steps
from beliefscope.filters.catalog import build, filters_of
from beliefscope.filters.evaluate import run
from beliefscope.filters.filter import Filter
from beliefscope.filters.rollout import rollout, start_at_truth
from beliefscope.inspect.trace import trace

Range = tuple[float, float]
PUBLISHED: dict[str, tuple[Range, Range, Range]] = {
    "feature-pf": ((101, 106), (235, 277), (1.8, 2.3)),
    "crossmodal-pf": ((55, 64), (182, 218), (3.4, 4.2)),
    "unimodal-pf": ((95, 117), (252, 276), (2.0, 2.2)),
    "feature-ekf": ((96, 107), (639, 740), (1.7, 2.1)),
    "crossmodal-ekf": ((64, 67), (286, 287), (4.0, 4.1)),
    "unimodal-ekf": ((61, 64), (516, 516), (2.4, 2.4)),
    "lstm": ((563, 563), (362, 362), (2.9, 2.9)),
}
"""The published code on one thread of two shared cores: steps a CPU-second at N = 1 and N = 20, CPU-seconds of a
training step; lowest and highest of several runs. Ratios are to the middle."""

BARS = {2: "6 x, 5 x, 4 x", 1: "3 x, 2 x, 1.5 x"}
"""Required ratios at N = 1, at N = 20 and in training, by stride of the first convolution; published: 1."""

SIZES: dict[str, tuple[tuple[int, int, int], ...]] = {
    "steps": ((16, 32, 30), (32, 32, 30), (64, 32, 30)),
    "trajectories": ((16, 32, 30), (16, 64, 30), (16, 128, 30)),
    "particles": ((16, 32, 60), (16, 32, 120), (16, 32, 240)),
}
"""Axis -> three sizes (T, N, M) that double along the axis."""


def measure() -> list[Row]:
    return [*speed(), *memory(), *tracing()]


def speed() -> list[Row]:
    rows: list[Row] = []
    single, batch, windows = noise(100, 1), noise(100, 20), noise(16, 32)
    for stride, bar in BARS.items():
        for name, architecture in filters_of(DOOR).items():
            filter_ = build(replace(architecture, image_stride=stride))
            single_rate = 100 / cpu_seconds(lambda f=filter_: forward(f, single), 5)
            batch_rate = 2000 / cpu_seconds(lambda f=filter_: forward(f, batch), 2)
            training = cpu_seconds(lambda f=filter_: backward(f, windows), 3)
            published = PUBLISHED.get(name)
            figures = (f"{single_rate:.0f}/s", f"{batch_rate:.0f}/s", f"{training:.2f} s")
            if published is not None:
                single_mean, batch_mean, training_mean = (sum(limits) / 2 for limits in published)
                ratios = (single_rate / single_mean, batch_rate / batch_mean, training_mean / training)
                figures = tuple(f"{f} {r:.1f} x" for f, r in zip(figures, ratios, strict=True))  # type: ignore[assignment]
            rows.append((f"{name}, stride {stride}", ", ".join(figures), bar if published else ""))
    return rows


def noise(steps: int, trajectories: int) -> Batch:
    """Random windows with the shapes of the door task."""
    generator = torch.Generator().manual_seed(0)
    shape = (steps, trajectories)
    images = torch.randint(256, (*shape, 32, 32), generator=generator, dtype=torch.uint8)
    haptics = torch.randn(*shape, 10, generator=generator)
    states = 0.1 * torch.randn(*shape, 3, generator=generator)
    controls = torch.randn(*shape, 7, generator=generator)
    observations = {"image": images, "haptics": haptics}
    return Batch(observations, controls, states, torch.zeros(shape, dtype=torch.bool), states[0])


@torch.no_grad()
def forward(filter_: Filter, batch: Batch, particles: int = 300) -> None:
    generator = torch.Generator().manual_seed(0)
    rollout(filter_, filter_.encode(batch), start_at_truth(filter_, batch), generator, particles)


def backward(filter_: Filter, batch: Batch, particles: int = 30) -> None:
    filter_.zero_grad(set_to_none=True)
    generator = torch.Generator().manual_seed(0)
    estimate = rollout(filter_, filter_.encode(batch), start_at_truth(filter_, batch), generator, particles).estimate
    loss = (estimate.mean - batch.states).square().mean()
    if filter_.has_covariance:
        loss = loss + estimate.covariance.square().mean()
    loss.backward()


def cpu_seconds(function: Callable[[], None], repetitions: int) -> float:
    function()
    best = float("inf")
    for _ in range(repetitions):
        began = time.process_time()
        function()
        best = min(best, time.process_time() - began)
    return best


def memory() -> list[Row]:
    """Peak memory of a training step for sizes doubled along one axis; linear growth gives a ratio of 2."""
    rows: list[Row] = []
    for name in ("crossmodal-ekf", "crossmodal-pf", "lstm"):
        for axis, sizes in SIZES.items():
            if axis == "particles" and name != "crossmodal-pf":
                continue
            peaks = [peak(name, size) for size in sizes]
            growth = (peaks[2] - peaks[1]) / (peaks[1] - peaks[0])
            sizes_mb = " / ".join(f"{size:.0f}" for size in peaks)
            rows.append((f"{name}, training, {axis} doubled twice", f"{sizes_mb} MB, growth {growth:.2f} x", "2 x"))
    return rows


def peak(name: str, size: tuple[int, int, int]) -> float:
    """Peak MB of live tensors during a training step of this size (T, N, M)."""
    steps, trajectories, particles = size
    filter_, batch = build(filters_of(DOOR)[name]), noise(steps, trajectories)
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiled:
        backward(filter_, batch, particles)
    events = [event for event in profiled.profiler.kineto_results.events() if event.name() == "[memory]"]
    return max(accumulate(event.nbytes() for event in sorted(events, key=lambda event: event.start_ns()))) / 1e6


def tracing() -> list[Row]:
    rows: list[Row] = []
    for name in NAMES:
        checkpoint, episode = subject.checkpoint(name), subject.episode()
        batch = Steps.from_episodes(checkpoint.task, [episode]).episode(0)
        plain, traced, ratio = subject.alternate(
            lambda c=checkpoint, b=batch: run(c.filter, b, None, 300, 0),
            lambda c=checkpoint, e=episode: trace(c, e),
            repetitions=5,
        )
        rows += [
            (f"{name}, untraced", f"{STEPS / plain:.0f} steps/s", ""),
            (f"{name}, traced", f"{STEPS / traced:.0f} steps/s", ""),
            (f"{name}, traced / untraced", f"{ratio:.2f} x", "<= 1.3 x"),
        ]
    return rows
