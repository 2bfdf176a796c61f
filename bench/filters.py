"""Speed of every filter in evaluation and training; memory; tracing overhead; with --reference, the published code.

    python bench/filters.py                  speed and multiple of the arithmetic floor
    python bench/filters.py --count          weights and operations of the crossmodal filters' networks
    python bench/filters.py --reference DIR  the crossmodal filters and the paper's published ones, alternately

Speed is CPU time of one thread, with noise images, random weights and the shapes of the door task: 100 steps of one
trajectory, 25 of 20 at a time (300 particles), and a training step, forward and backward (16 steps of 32 trajectories,
30 particles). Each figure is a median over repetitions, in brackets the least and the greatest value.
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from itertools import accumulate
from pathlib import Path
from statistics import median

import reference
import subject
import torch
from arithmetic import cpu_seconds, measure_rate, spread
from reference import Workload
from subject import NAMES, STEPS, Row
from torch.profiler import ProfilerActivity, profile

from beliefscope.datasets.simulation.door import DOOR
from beliefscope.filters.batch import Batch, Steps
from beliefscope.filters.catalog import NETWORKS, architecture, build, filters_of
from beliefscope.filters.evaluate import run
from beliefscope.filters.filter import Filter
from beliefscope.filters.rollout import first_belief, rollout
from beliefscope.inspect.trace import trace

REPETITIONS = 5

SIZES: dict[str, tuple[tuple[int, int, int], ...]] = {
    "steps": ((16, 32, 30), (32, 32, 30), (64, 32, 30)),
    "trajectories": ((16, 32, 30), (16, 64, 30), (16, 128, 30)),
    "particles": ((16, 32, 60), (16, 32, 120), (16, 32, 240)),
}
"""Axis -> three sizes (T, N, M) that double along the axis."""


def measure() -> list[Row]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    rows = [*speed(), *memory()]
    torch.set_num_threads(threads)
    return [*rows, *tracing()]


def workloads() -> list[Workload]:
    return [
        Workload("N = 1", noise(100, 1), forward, reference.published_forward),
        Workload("N = 20", noise(25, 20), forward, reference.published_forward),
        Workload("training", noise(16, 32), backward, reference.published_backward),
    ]


def speed() -> list[Row]:
    """CPU time and multiple of the floor of every filter, with both sets of networks."""
    rows: list[Row] = []
    for networks in NETWORKS:
        for name in filters_of(DOOR):
            filter_ = build(architecture("door", name, networks))
            for workload in workloads():
                call = partial(workload.ours, filter_, workload.batch)
                flops, seconds, multiples = reference.executed(call), [], []
                for _ in range(REPETITIONS):
                    rate = measure_rate()
                    seconds.append(cpu_seconds(call))
                    multiples.append(seconds[-1] / rate.seconds(flops))
                figures = f"{1e3 * median(seconds) / workload.steps:.3g} ms, {spread(multiples)} x floor"
                rows.append((f"{name}, {networks} networks, {workload.name}, a step", figures, ""))
    return rows


def counts(name: str) -> dict[str, dict[str, int]]:
    """Weights and biases of a filter, and operations of its networks with one input each, by set of networks."""
    result = {}
    for networks in NETWORKS:
        filter_ = build(architecture("door", name, networks))
        flops = reference.networks_flops(filter_, noise(1, 1))
        result[networks] = {"weights": reference.trained_values(filter_), "operations": flops.total}
    return result


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
    rollout(filter_, filter_.encode(batch), first_belief(filter_, batch), generator, particles)


def backward(filter_: Filter, batch: Batch, particles: int = 30) -> None:
    filter_.zero_grad(set_to_none=True)
    generator = torch.Generator().manual_seed(0)
    estimate = rollout(filter_, filter_.encode(batch), first_belief(filter_, batch), generator, particles).estimate
    loss = (estimate.mean - batch.states).square().mean()
    if filter_.has_covariance:
        loss = loss + estimate.covariance.square().mean()
    loss.backward()


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reference", type=Path, metavar="DIR", help="folder with clones of the published code")
    parser.add_argument("--count", action="store_true", help="weights and operations of the networks as JSON, no times")
    options = parser.parse_args()
    folder = options.reference
    if options.count:
        print(json.dumps({name: counts(name) for name in NAMES}, indent=1))
        return
    torch.set_num_threads(1)
    subject.print_machine()
    if folder is None:
        subject.print_table("filters", subject.COLUMNS, measure())
        return
    for name, published in reference.published_filters(folder).items():
        rows = reference.compare(name, published, workloads())
        subject.print_table(name, ("quantity", "published", "authors networks", "default networks"), rows)


if __name__ == "__main__":
    main()
