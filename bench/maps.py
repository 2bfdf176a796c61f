"""Speed of likelihood maps: ratio to direct evaluation, sets (image, haptics, fused) per second, a whole episode."""

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
from beliefscope.filters.engine import one_thread
from beliefscope.filters.models.fusion import mixture
from beliefscope.filters.models.pf import MeasurementModel, MixtureParticleFilter
from beliefscope.inspect.maps.map_engine import COARSE, FINE, MapEngine

BARS = {FINE: 20, COARSE: 150}  # sets a second
RATIO, WHOLE = 1.5, 20  # times direct evaluation; s for all coarse maps of an episode
REPETITIONS = 15


class DirectEvaluation:
    """The networks on full inputs: the features of the step repeated for every cell, all cells at once.

    ``split``: with the first joint layer as a sum of two terms, as in ``MeasurementModel.log_likelihood``, but all
    cells at once and without a cache.
    """

    def __init__(self, engine: MapEngine, split: bool = False) -> None:
        assert isinstance(engine.checkpoint.filter, MixtureParticleFilter)
        self.filter, self.engine, self.split = engine.checkpoint.filter, engine, split
        self.batch = Steps.from_episodes(engine.task, [engine.trace.episode]).episode(0)

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
        observations = self.filter.statistics.standardise_observations(at_step)
        models = [self.filter.measurement_model(name) for name in self.filter.names]
        each = torch.stack([self._log_likelihood(model, observations, states) for model in models])
        prior, log_likelihood = (
            torch.from_numpy(a[step])[None] for a in (trace.prior_log_weights, trace.log_likelihood)
        )
        fused = mixture(each - self.filter.scale(prior, log_likelihood)[0], evidence.log_weights[0])
        return torch.cat([each, fused[None]]).unflatten(1, (size, size)).numpy()

    def _log_likelihood(
        self, model: MeasurementModel, observations: dict[str, torch.Tensor], states: torch.Tensor
    ) -> torch.Tensor:
        if self.split:
            return model.log_likelihood(model.observation_part(observations)[0], model.state_part(states))
        weight = torch.cat([model.join_observation.weight, model.join_state.weight], dim=1)
        features = model.encoders(observations)[0].expand(len(states), -1)
        joined = torch.cat([features, model.state_encoder(states)], dim=1)
        return model.head(functional.linear(joined, weight, model.join_observation.bias)).squeeze(-1)


def distinct_places() -> Iterator[tuple[int, float]]:
    """Infinite sequence of distinct steps and angles, so that nothing is cached between maps."""
    return ((step % STEPS, 0.2 + 1e-4 * step) for step in count(100, 7))


def measure() -> list[Row]:
    rows: list[Row] = []
    for name in NAMES:
        engine = MapEngine(subject.checkpoint(name), subject.traced(name))
        for size, bar in BARS.items():
            label = f"{name}, {size} x {size}"
            if isinstance(engine.checkpoint.filter, MixtureParticleFilter):
                rows += compare_with_direct(engine, label, size)
            sample = [next(places) for places in [distinct_places()] for _ in range(100 if size == FINE else 400)]
            engine.map(0, size=size)
            duration = subject.seconds(lambda s=sample, n=size, e=engine: [e.map(step, angle, n) for step, angle in s])
            rows.append((f"{label}, all cross-sections different", f"{len(sample) / duration:.0f} sets/s", f">= {bar}"))
        duration = subject.seconds(lambda e=engine: list(e.maps(range(STEPS), COARSE)))
        rows.append((f"{name}, {COARSE} x {COARSE}, all {STEPS} steps", f"{duration:.1f} s", f"<= {WHOLE} s"))
    return rows


def alternate(first: Callable[[], object], second: Callable[[], object]) -> float:
    """Median ratio of CPU times second / first, run alternately after a warm-up."""

    def seconds(function: Callable[[], object]) -> float:
        start = time.process_time()
        function()
        return time.process_time() - start

    first(), second()
    pairs = [(seconds(first), seconds(second)) for _ in range(REPETITIONS)]
    return median(b / a for a, b in pairs)


def compare_with_direct(engine: MapEngine, label: str, size: int) -> list[Row]:
    """Largest difference, and ratio of CPU times for distinct cross-sections and for a fixed one.

    On one thread, because waiting threads use CPU time too.
    """
    direct, split = DirectEvaluation(engine), DirectEvaluation(engine, split=True)
    difference = max(
        float(np.abs(engine.map(step, angle, size).log_likelihood - direct.map(step, angle, size)).max())
        for step, angle in [(0, 0.1), (STEPS // 2, 0.4), (STEPS - 1, 0.9)]
    )

    def ratio(other: DirectEvaluation, fixed: bool = False) -> str:
        mine, theirs = distinct_places(), distinct_places()
        ours = lambda: engine.map(next(mine)[0], 0.5, size) if fixed else engine.map(*next(mine), size)  # noqa: E731
        with one_thread():
            return f"{alternate(ours, lambda: other.map(*next(theirs), size)):.2f} x"

    return [
        (f"{label}, largest difference from direct evaluation", f"{difference:.0e} nats", "float32"),
        (f"{label}, CPU time direct / ours", ratio(direct), f">= {RATIO} x" if size == FINE else ""),
        (f"{label}, CPU time direct / ours, fixed cross-section", ratio(direct, fixed=True), ""),
        (f"{label}, CPU time direct with split layer / ours", ratio(split), ""),
    ]
