"""A linear-Gaussian system with the filters' interfaces, and a reference Kalman filter in NumPy."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from beliefscope.filters.belief import Evidence
from beliefscope.filters.models.pf import MixtureParticleFilter

A = np.array([[0.9, 0.1, 0.0], [0.0, 0.8, 0.2], [0.1, 0.0, 0.7]])
Q_STD = np.array([0.3, 0.2, 0.25])
R_STD = np.array([0.5, 0.4, 0.6])
START = 0.1 * np.eye(3)


class LinearDynamics(nn.Module):
    """``x' = A x + u`` with the interface of ``Dynamics``; the control part is u."""

    def __init__(self) -> None:
        super().__init__()
        self.matrix = torch.from_numpy(A)
        self.noise = torch.from_numpy(Q_STD)

    def forward(self, states: Tensor, control_part: Tensor) -> Tensor:
        return states @ self.matrix.T + control_part

    def with_jacobian(self, states: Tensor, control_part: Tensor) -> tuple[Tensor, Tensor]:
        return self(states, control_part), self.matrix.expand(*states.shape, 3)


class GaussianLikelihood(MixtureParticleFilter):
    """A particle filter whose only measurement model is the system's Gaussian likelihood."""

    def log_likelihood(self, evidence: Evidence, states: Tensor) -> Tensor:
        white = (evidence.observation[:, 0, None] - states) / torch.from_numpy(R_STD)
        return -0.5 * white.square().sum(-1).unsqueeze(1)


def simulate(steps: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Controls u (T, 3) and observations z (T, 3) of one run from the origin."""
    rng = np.random.default_rng(seed)
    controls = rng.normal(size=(steps, 3))
    state, observations = np.zeros(3), []
    for u in controls:
        state = A @ state + u + Q_STD * rng.normal(size=3)
        observations.append(state + R_STD * rng.normal(size=3))
    return controls, np.array(observations)


def kalman(controls: np.ndarray, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Textbook Kalman filter: means (T, 3) and covariances (T, 3, 3)."""
    mean, covariance = np.zeros(3), START
    means, covariances = [], []
    for u, z in zip(controls, observations, strict=True):
        mean, covariance = A @ mean + u, A @ covariance @ A.T + np.diag(Q_STD**2)
        gain = covariance @ np.linalg.inv(covariance + np.diag(R_STD**2))
        mean, covariance = mean + gain @ (z - mean), (np.eye(3) - gain) @ covariance
        means.append(mean)
        covariances.append(covariance)
    return np.array(means), np.array(covariances)


def evidence(controls: np.ndarray, observations: np.ndarray) -> Evidence:
    """The run as evidence of one measurement model, N = 1."""
    return Evidence(
        control=torch.from_numpy(controls)[:, None],
        observation=torch.from_numpy(observations)[:, None, None],
        noise=torch.from_numpy(np.tile(R_STD, (len(controls), 1)))[:, None, None],
        log_weights=None,
    )
