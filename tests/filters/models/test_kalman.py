"""On a linear-Gaussian system all model-based filters must agree with the Kalman filter."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from beliefscope.datasets.simulation.door import DOOR
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.catalog import KINDS
from beliefscope.filters.filter import Architecture
from beliefscope.filters.models.resampling import Resampling
from beliefscope.filters.rollout import rollout

sys.path.insert(0, str(Path(__file__).parent))
import linear_system as linear

START = Gaussian(torch.zeros(1, 3, dtype=torch.float64), torch.from_numpy(linear.START)[None])


def single(kind: str, **options: object) -> Architecture:
    return Architecture(task=DOOR, kind=kind, fusion="none", models=("haptics",), **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["ekf", "ukf"])
def test_equals_the_kalman_filter_on_a_linear_system(kind: str) -> None:
    controls, observations = linear.simulate(50, seed=1)
    means, covariances = linear.kalman(controls, observations)
    filter_ = KINDS[kind](single(kind))  # type: ignore[index]
    filter_.dynamics = linear.LinearDynamics()  # type: ignore[assignment]
    estimate = rollout(filter_, linear.evidence(controls, observations), START, torch.Generator()).estimate
    np.testing.assert_allclose(estimate.mean[:, 0].numpy(), means, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(estimate.covariance[:, 0].numpy(), covariances, rtol=1e-10, atol=1e-12)


def particle_error(particles: int, runs: int, resampling: Resampling = "systematic") -> float:
    """Root mean square distance between the particle filter's mean and the Kalman filter's, over runs and steps."""
    controls, observations = linear.simulate(20, seed=2)
    means, _ = linear.kalman(controls, observations)
    filter_ = linear.GaussianLikelihood(single("pf", resampling=resampling))
    filter_.dynamics = linear.LinearDynamics()  # type: ignore[assignment]
    squares = []
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        for seed in range(runs):
            generator = torch.Generator().manual_seed(seed)
            run = rollout(filter_, linear.evidence(controls, observations), START, generator, particles)
            squares.append(np.square(run.estimate.mean[:, 0].numpy() - means).mean())
    finally:
        torch.set_default_dtype(default)
    return float(np.sqrt(np.mean(squares)))


@pytest.mark.slow
def test_pf_error_decreases_with_the_square_root_of_the_particles() -> None:
    few, many = particle_error(100, 48), particle_error(10_000, 8)
    # The posterior standard deviation is about 0.3: with 10^4 particles 0.3 / 100, times three for resampling.
    assert many < 0.01
    # 100 times the particles: a tenth of the error. The ratio over 8 runs of 20 steps has some 10 % uncertainty.
    assert few / many == pytest.approx(10.0, rel=0.35)


@pytest.mark.parametrize("resampling", ["hard", "soft"])
def test_other_resampling_rules_agree_with_the_kalman_filter(resampling: Resampling) -> None:
    # Soft resampling with wrong weights would have an error of the order of the posterior's 0.3.
    assert particle_error(10_000, 4, resampling) < 0.015
