"""Comparison with FilterPy, an independent implementation, step by step."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from beliefscope.datasets.simulation.door import DOOR
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.catalog import KINDS
from beliefscope.filters.filter import Architecture
from beliefscope.filters.models.dynamics import Dynamics
from beliefscope.filters.models.resampling import systematic
from beliefscope.filters.models.ukf import ALPHA, BETA, KAPPA
from beliefscope.filters.rollout import rollout

sys.path.insert(0, str(Path(__file__).parent))
import linear_system as linear

Array = NDArray[np.float64]
STEPS = 30
R = np.diag(linear.R_STD**2)


@pytest.fixture
def dynamics() -> Dynamics:
    """A nonlinear dynamics model; with initial weights the output layer would be almost zero."""
    torch.manual_seed(7)
    model = Dynamics(n=3, control_size=3, units=16).double()
    torch.nn.init.normal_(model.output.weight, std=0.6)
    torch.nn.init.constant_(model.log_noise, -1.5)
    return model.requires_grad_(False)


def extended(dynamics: Dynamics, parts: Tensor, observations: Array) -> Iterator[tuple[Array, Array]]:
    """FilterPy's EKF with a Jacobian from reverse-mode differentiation."""
    oracle = pytest.importorskip("filterpy.kalman").ExtendedKalmanFilter(dim_x=3, dim_z=3)

    def predict_x(u: Tensor) -> None:
        x = torch.from_numpy(oracle.x)
        oracle.F = torch.autograd.functional.jacobian(lambda state: dynamics(state, u), x).numpy()
        oracle.x = dynamics(x, u).numpy()

    oracle.predict_x = predict_x
    oracle.x, oracle.P, oracle.Q, oracle.R = np.zeros(3), linear.START, np.diag(dynamics.noise.numpy() ** 2), R
    for u, z in zip(parts, observations, strict=True):
        oracle.predict(u)
        oracle.update(z, HJacobian=lambda x: np.eye(3), Hx=lambda x: x)
        yield oracle.x, oracle.P


def unscented(dynamics: Dynamics, parts: Tensor, observations: Array) -> Iterator[tuple[Array, Array]]:
    kalman = pytest.importorskip("filterpy.kalman")
    points = kalman.MerweScaledSigmaPoints(3, ALPHA, BETA, KAPPA)
    oracle = kalman.UnscentedKalmanFilter(
        3, 3, 1.0, hx=lambda x: x, fx=lambda x, dt, u: dynamics(torch.from_numpy(x), u).numpy(), points=points
    )
    oracle.x, oracle.P, oracle.Q, oracle.R = np.zeros(3), linear.START, np.diag(dynamics.noise.numpy() ** 2), R
    for u, z in zip(parts, observations, strict=True):
        oracle.predict(u=u)
        oracle.update(z)
        yield oracle.x, oracle.P


@pytest.mark.parametrize(("kind", "oracle"), [("ekf", extended), ("ukf", unscented)])
def test_nonlinear_kalman_filters(kind: str, oracle: object, dynamics: Dynamics) -> None:
    controls, observations = linear.simulate(STEPS, seed=5)
    evidence = linear.evidence(controls, observations)
    parts = dynamics.control_part(evidence.control)
    filter_ = KINDS[kind](Architecture(DOOR, kind, "none", ("haptics",)))  # type: ignore[index, arg-type]
    filter_.dynamics = dynamics
    start = Gaussian(torch.zeros(1, 3, dtype=torch.float64), torch.from_numpy(linear.START)[None])
    from_parts = type(evidence)(parts, evidence.observation, evidence.noise, None)
    estimate = rollout(filter_, from_parts, start, torch.Generator()).estimate
    means, covariances = zip(*oracle(dynamics, parts[:, 0], observations), strict=True)  # type: ignore[operator]
    np.testing.assert_allclose(estimate.mean[:, 0].numpy(), np.array(means), rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(estimate.covariance[:, 0].numpy(), np.array(covariances), rtol=1e-8, atol=1e-11)


def test_systematic_resampling_with_the_same_offset(monkeypatch: pytest.MonkeyPatch) -> None:
    monte_carlo = pytest.importorskip("filterpy.monte_carlo")
    generator = torch.Generator().manual_seed(1)
    log_weights = torch.log_softmax(2.0 * torch.randn(20, 64, generator=generator, dtype=torch.float64), dim=-1)
    ours = systematic(log_weights, torch.Generator().manual_seed(2))
    offsets = iter(torch.rand(20, 1, generator=torch.Generator().manual_seed(2)).flatten().tolist())
    monkeypatch.setattr("filterpy.monte_carlo.resampling.random", lambda: next(offsets))
    theirs = [monte_carlo.systematic_resample(row) for row in log_weights.exp().numpy()]
    np.testing.assert_array_equal(ours.numpy(), theirs)
