"""On a linear-Gaussian system both filters must find what the Kalman filter finds."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from beliefscope.filters.belief import Gaussian
from beliefscope.filters.ekf import ExtendedKalmanFilter
from beliefscope.filters.filter import Architecture
from beliefscope.filters.rollout import rollout

sys.path.insert(0, str(Path(__file__).parent))
import linear

START = Gaussian(torch.zeros(1, 3, dtype=torch.float64), torch.from_numpy(linear.START)[None])


def single(kind: str) -> Architecture:
    return Architecture(task="door", kind=kind, fusion="none", models=("haptics",))  # type: ignore[arg-type]


def test_ekf_is_the_kalman_filter_on_a_linear_system() -> None:
    controls, observations = linear.simulate(50, seed=1)
    means, covariances = linear.kalman(controls, observations)
    filter_ = ExtendedKalmanFilter(single("ekf"))
    filter_.dynamics = linear.LinearDynamics()  # type: ignore[assignment]
    estimate = rollout(filter_, linear.evidence(controls, observations), START, torch.Generator()).estimate
    np.testing.assert_allclose(estimate.mean[:, 0].numpy(), means, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(estimate.covariance[:, 0].numpy(), covariances, rtol=1e-10, atol=1e-12)


def particle_error(particles: int, runs: int) -> float:
    """Root mean square distance between the particle filter's mean and the Kalman filter's, over runs and steps."""
    controls, observations = linear.simulate(20, seed=2)
    means, _ = linear.kalman(controls, observations)
    filter_ = linear.GaussianLikelihood(single("pf"))
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


def test_pf_approaches_the_kalman_filter_as_one_over_root_m() -> None:
    few, many = particle_error(100, 24), particle_error(10_000, 24)
    # The posterior's deviation is about 0.3; 10^4 particles should do 0.3 / 100, and thrice that allows for resampling.
    assert many < 0.01
    # 100 times the particles: a tenth of the error. 24 runs of 20 steps leave the ratio some 20 % uncertain.
    assert few / many == pytest.approx(10.0, rel=0.35)
