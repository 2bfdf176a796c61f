"""Product particle filter: equal to the Kalman filter with many particles, with and without biases of the sensors."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from beliefscope.datasets.catalog import find_task
from beliefscope.filters.batch import Batch, Steps
from beliefscope.filters.belief import Evidence, Gaussian, Particles
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.models.information import InformationFilter
from beliefscope.filters.models.information_pf import InformationParticleFilter, with_particles
from beliefscope.filters.rollout import first_belief, rollout
from beliefscope.filters.subsets import standalone_evidence
from beliefscope.inspect.maps.map_engine import MapEngine
from beliefscope.inspect.standalone import standalone
from beliefscope.inspect.trace import load_trace, save_trace, trace

sys.path.insert(0, str(Path(__file__).parent))
import linear_system as linear

STEPS = 12
START = Gaussian(torch.zeros(1, 3, dtype=torch.float64), torch.from_numpy(linear.START)[None])


def pair(bias: float) -> tuple[InformationFilter, InformationParticleFilter]:
    """The two filters with the same weights, linear dynamics, and biases of this standard deviation."""
    kalman = build(architecture("door-field", "information-ekf"), seed=0)
    assert isinstance(kalman, InformationFilter)
    particles = with_particles(kalman)
    for filter_ in (kalman, particles):
        filter_.double().eval().requires_grad_(False)
        filter_.dynamics = linear.LinearDynamics()  # type: ignore[assignment]
        filter_.log_motion.fill_(-20.0)
        filter_.log_bias.fill_(float(torch.tensor(bias).log()))
        filter_.log_scale.zero_()
    return kalman, particles


def evidence(weights: tuple[float, float] = (0.5, 0.5)) -> Evidence:
    """Two sensors of different noise, which differ by a constant in the first component; N = 1."""
    controls, observations = linear.simulate(STEPS, seed=3)
    noise = torch.tensor([[0.5, 0.4, 0.6], [0.8, 0.3, 0.9]], dtype=torch.float64)
    z = torch.from_numpy(observations)[:, None, None].repeat(1, 1, 2, 1)
    z[:, :, 1] += noise[1] * torch.randn(STEPS, 1, 3, generator=torch.Generator().manual_seed(0))
    z[:, :, 0, 0] += 0.5
    log_weights = torch.tensor(weights, dtype=torch.float64).log()[:, None].expand(2, 3)
    return Evidence(
        control=torch.from_numpy(controls)[:, None],
        observation=z,
        noise=noise.expand(STEPS, 1, 2, 3),
        log_weights=log_weights.expand(STEPS, 1, 2, 3),
    )


def estimate(filter_: InformationFilter, sequence: Evidence, particles: int) -> Gaussian:
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        return rollout(filter_, sequence, START, torch.Generator().manual_seed(0), particles).estimate
    finally:
        torch.set_default_dtype(default)


@pytest.mark.first(2)
@pytest.mark.slow
@pytest.mark.parametrize("weights", [(0.5, 0.5), (0.8, 0.2)])
@pytest.mark.parametrize("bias", [1e-4, 0.5])
def test_equals_the_kalman_filter(bias: float, weights: tuple[float, float]) -> None:
    kalman, particles = pair(bias)
    exact = estimate(kalman, evidence(weights), 1)
    result = estimate(particles, evidence(weights), 40_000)
    # Posterior standard deviations are 0.2 to 0.4: with 4e4 particles the means have a Monte-Carlo error of 0.002.
    torch.testing.assert_close(result.mean, exact.mean, rtol=0.0, atol=0.02)
    torch.testing.assert_close(result.covariance, exact.covariance, rtol=0.1, atol=0.005)
    other = estimate(pair(2.0)[0], evidence(weights), 1).mean
    assert (other - exact.mean).abs().max() > 0.1  # the bias matters, far beyond the tolerance


def test_unused_sensors_leave_the_prediction() -> None:
    _, particles = pair(0.5)
    nothing = evidence().select_models(torch.zeros(STEPS, 1, 2, dtype=torch.bool))
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    belief = particles.start(START, 50, torch.Generator().manual_seed(0))
    torch.set_default_dtype(default)
    _, step = particles.step(belief, nothing[0], torch.Generator().manual_seed(0))
    assert isinstance(step.posterior, Particles)
    torch.testing.assert_close(step.posterior.log_weights, belief.log_weights)
    assert step.log_likelihood is not None
    assert (step.log_likelihood == 0.0).all()


def test_fused_weights_are_the_product_of_the_likelihoods() -> None:
    _, particles = pair(0.5)
    belief = particles.start(Gaussian(*(x.float() for x in (START.mean, START.covariance))), 50, torch.Generator())
    _, step = particles.step(belief, evidence()[0], torch.Generator())
    assert isinstance(step.posterior, Particles)
    assert step.log_likelihood is not None
    product = torch.log_softmax(belief.log_weights + step.log_likelihood.sum(1), dim=-1)
    torch.testing.assert_close(step.posterior.log_weights, product)


@pytest.fixture(scope="module")
def checkpoint() -> Checkpoint:
    filter_ = build(architecture("door-field", "information-pf"), seed=0).eval().requires_grad_(False)
    task = find_task("door-field")
    assert task.simulate is not None
    filter_.statistics.fit(Steps.from_episodes(task, [task.simulate(2, 0, 20)]))
    return Checkpoint(filter_, "information-pf", "0" * 64, {})


def test_trace_standalone_run_and_maps(checkpoint: Checkpoint, tmp_path: Path) -> None:
    task = find_task("door-field")
    assert task.simulate is not None
    run = trace(checkpoint, task.simulate(2, 0, 20), particles=200)
    assert run.particles is not None
    assert run.particles.shape == (20, 200, 3)
    assert run.effective_weights is not None
    assert run.effective_weights.shape == (20, 2, 3)
    save_trace(run, tmp_path / "run.trace")
    assert load_trace(tmp_path / "run.trace").modalities == ("image", "haptics")
    alone = standalone(checkpoint, run, "haptics")
    assert alone.modalities == ("haptics",)
    assert (alone.estimate_mean != run.estimate_mean).any()
    engine = MapEngine(checkpoint, run)
    product = engine.map(10, size=16)
    assert product.rule == "beta-weighted product of virtual sensors (one prior)"
    image, haptics, fused = (product.log_likelihood[k].astype(float) for k in range(3))
    difference = fused - image - haptics  # equal weights to 1e-2: the product, up to a constant
    assert (difference - difference.mean()).std() < 0.05 * fused.std()
    posterior = engine.map(10, size=16, quantity="posterior")
    assert posterior.rule.startswith("prior times beta-weighted product")
    assert np.isfinite(posterior.log_likelihood).all()


def test_standalone_filter_uses_one_sensor(checkpoint: Checkpoint) -> None:
    filter_ = checkpoint.filter
    assert filter_.task.simulate is not None
    steps = Steps.from_episodes(filter_.task, [filter_.task.simulate(2, 0, 20)])
    batch: Batch = steps.windows(steps.first, 20)
    only = standalone_evidence(filter_, batch, filter_.encode(batch), "haptics")
    changed = replace(only, observation=only.observation + torch.tensor([1.0, 0.0])[:, None])
    results: list[Tensor] = [
        rollout(filter_, each, first_belief(filter_, batch), torch.Generator().manual_seed(0), 50).estimate.mean
        for each in (only, changed)
    ]
    assert torch.equal(*results)
