"""Likelihood maps: against the naive way in one run, sets (image, haptics, fused) a second, and a whole episode's."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import count
from statistics import median

import numpy as np
import subject
import torch
from subject import NAMES, STEPS, Row
from torch.nn import functional

from beliefscope.filters.batch import Steps
from beliefscope.filters.models.fusion import mixture
from beliefscope.filters.models.pf import MeasurementModel, ParticleFilter
from beliefscope.inspect.likelihood import COARSE, FINE, MapEngine
from beliefscope.inspect.maps.grid import one_thread

BARS = {FINE: 20, COARSE: 150}  # sets a second
RATIO, WHOLE = 1.5, 20  # times the naive way; s for all coarse maps of an episode
TURNS = 15


class Naive:
    """The networks on whole inputs: the step's features repeated for every cell, joined with its own, all at once.

    ``split``: the first layer after the join in two summands, as ``MeasurementModel.log_likelihood`` has it, still with
    all cells at once and nothing kept.
    """

    def __init__(self, engine: MapEngine, split: bool = False) -> None:
        assert isinstance(engine.checkpoint.filter, ParticleFilter)
        self.filter, self.engine, self.split = engine.checkpoint.filter, engine, split
        self.batch = Steps.of(engine.task, [engine.trace.episode]).episode(0)

    @torch.no_grad()
    def map(self, step: int, angle: float, size: int) -> np.ndarray:
        """(3, S, S) log-likelihoods."""
        task, trace, evidence = self.engine.task, self.engine.trace, self.engine.evidence[step]
        offsets = ((torch.arange(size) + 0.5) / size * 2.0 - 1.0) * task.map_half_width
        cells = self.batch.states[step, 0].repeat(size, size, 1)
        cells[..., self.engine.fixed] = angle
        cells[..., task.map_indices[0]] += offsets
        cells[..., task.map_indices[1]] += offsets[:, None]
        states = self.filter.statistics.standardise("state", cells.flatten(0, 1))
        at_step = {m: values[step : step + 1] for m, values in self.batch.observations.items()}
        seen = self.filter.statistics.standardise_observations(at_step)
        models = [self.filter.measurement_model(name) for name in self.filter.names]
        each = torch.stack([self._log_likelihood(model, seen, states) for model in models])
        prior, known = (torch.from_numpy(a[step])[None] for a in (trace.prior_log_weights, trace.log_likelihood))
        fused = mixture(each - self.filter.scale(prior, known)[0], evidence.log_weights[0])
        return torch.cat([each, fused[None]]).unflatten(1, (size, size)).numpy()

    def _log_likelihood(
        self, model: MeasurementModel, seen: dict[str, torch.Tensor], states: torch.Tensor
    ) -> torch.Tensor:
        if self.split:
            return model.log_likelihood(model.observation_part(seen)[0], model.state_part(states))
        weight = torch.cat([model.join_observation.weight, model.join_state.weight], dim=1)
        features = model.encoders(seen)[0].expand(len(states), -1)
        joined = torch.cat([features, model.state_encoder(states)], dim=1)
        return model.head(functional.linear(joined, weight, model.join_observation.bias)).squeeze(-1)


def fresh() -> Iterator[tuple[int, float]]:
    """Steps and angles without end, no two of a kind, so that nothing is remembered from the map before."""
    return ((step % STEPS, 0.2 + 1e-4 * step) for step in count(100, 7))


def measure() -> list[Row]:
    rows: list[Row] = []
    for name in NAMES:
        engine = MapEngine(subject.checkpoint(name), subject.traced(name))
        for size, bar in BARS.items():
            what = f"{name}, {size} x {size}"
            if isinstance(engine.checkpoint.filter, ParticleFilter):
                rows += against_naive(engine, what, size)
            some = [next(places) for places in [fresh()] for _ in range(100 if size == FINE else 400)]
            engine.map(0, size=size)
            took = subject.seconds(lambda s=some, n=size, e=engine: [e.map(step, angle, n) for step, angle in s])
            rows.append((f"{what}, no two slices alike", f"{len(some) / took:.0f} sets/s", f">= {bar}"))
        took = subject.seconds(lambda e=engine: list(e.maps(range(STEPS), COARSE)))
        rows.append((f"{name}, {COARSE} x {COARSE}, all {STEPS} steps", f"{took:.1f} s", f"<= {WHOLE} s"))
    return rows


def in_turn(first: Callable[[], object], second: Callable[[], object]) -> float:
    """Median of the CPU times second / first, pair by pair, run in turn after a warm-up each."""

    def seconds(function: Callable[[], object]) -> float:
        began = time.process_time()
        function()
        return time.process_time() - began

    first(), second()
    pairs = [(seconds(first), seconds(second)) for _ in range(TURNS)]
    return median(b / a for a, b in pairs)


def against_naive(engine: MapEngine, what: str, size: int) -> list[Row]:
    """How far they differ, and the ratio of their CPU times: of slices all different, and of one that is held.

    All on one thread, as ours are: a thread that waits for another takes CPU time too.
    """
    naive, split = Naive(engine), Naive(engine, split=True)
    apart = max(
        float(np.abs(engine.map(step, angle, size).log_likelihood - naive.map(step, angle, size)).max())
        for step, angle in [(0, 0.1), (STEPS // 2, 0.4), (STEPS - 1, 0.9)]
    )

    def ratio(other: Naive, held: bool = False) -> str:
        mine, its = fresh(), fresh()
        ours = lambda: engine.map(next(mine)[0], 0.5, size) if held else engine.map(*next(mine), size)  # noqa: E731
        with one_thread():
            return f"{in_turn(ours, lambda: other.map(*next(its), size)):.2f} x"

    return [
        (f"{what}, largest difference to the naive way", f"{apart:.0e} nats", "float32"),
        (f"{what}, CPU time of the naive way / ours", ratio(naive), f">= {RATIO} x" if size == FINE else ""),
        (f"{what}, CPU time of the naive way / ours, the slice held", ratio(naive, held=True), ""),
        (f"{what}, CPU time of the join split but all at once / ours", ratio(split), ""),
    ]
