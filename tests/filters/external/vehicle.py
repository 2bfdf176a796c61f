"""A vehicle with GPS and wheel speed, and Kalman filters of it in NumPy and torch, for tests of external filters."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from beliefscope.datasets.covariate import Covariate
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Component, Task

DT, ACCELERATION, GPS, SPEED = 0.1, 0.5, 0.3, 0.05  # s; standard deviations in m/s^2, m, m/s

TASK = Task(
    name="vehicle",
    components=(Component("x", "m"), Component("y", "m"), Component("vx", "m/s"), Component("vy", "m/s")),
    observations={"gps": (2,), "speed": (1,)},
    modalities={"gps": ("gps",), "speed": ("speed",)},
    control_size=1,
    dt=DT,
    map_components=("x", "y"),
    map_half_width=2.0,
    warmup=5,
    covariates={"fix": Covariate("boolean")},
)

F = np.eye(4) + DT * np.eye(4, k=2)
Q = ACCELERATION**2 * np.block(
    [[DT**4 / 4 * np.eye(2), DT**3 / 2 * np.eye(2)], [DT**3 / 2 * np.eye(2), DT**2 * np.eye(2)]]
)
Q += 1e-9 * np.eye(4)
H = {"gps": np.eye(2, 4), "speed": np.array([[0.0, 0.0, 1.0, 0.0]])}
R = {"gps": GPS**2 * np.eye(2), "speed": SPEED**2 * np.eye(1)}
P0 = np.diag([0.1, 0.1, 0.1, 0.1])


def drive(seed: int, steps: int = 120, gap: tuple[int, int] | None = None) -> Episode:
    """A linear-Gaussian trajectory; the speed sensor measures vx. In ``gap`` there is no GPS fix: readings are NaN."""
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(Q)
    states = np.zeros((steps, 4))
    for t in range(1, steps):
        states[t] = F @ states[t - 1] + root @ rng.standard_normal(4)
    gps = states[:, :2] + GPS * rng.standard_normal((steps, 2))
    fix = np.ones(steps, np.float32)
    if gap is not None:
        gps[slice(*gap)], fix[slice(*gap)] = np.nan, 0.0
    speed = states[:, 2:3] + SPEED * rng.standard_normal((steps, 1))
    return Episode(
        task=TASK,
        states=states.astype(np.float32),
        controls=np.zeros((steps, 1), np.float32),
        observations={"gps": gps.astype(np.float32), "speed": speed.astype(np.float32)},
        contact=np.zeros(steps, bool),
        qpos=np.zeros((steps, 0), np.float32),
        dt=DT,
        seed=seed,
        split="test",
        covariates={"fix": fix},
    )


class NumpyKalman:
    """One trajectory, without batch axis: sequential updates with GPS and speed; skips NaN; reports innovations.

    gate: largest squared innovation that is used.
    """

    def __init__(self, gate: float = np.inf, scale: float = 1.0) -> None:
        self.gate, self.scale = gate, scale
        self.x, self.P = np.zeros(4), P0

    def initialize_beliefs(self) -> tuple[np.ndarray, np.ndarray]:
        self.x, self.P = np.zeros(4), P0
        return self.x, self.P

    def forward(self, *, observations: dict[str, np.ndarray], controls: np.ndarray) -> dict[str, Any]:
        self.x, self.P = F @ self.x, F @ self.P @ F.T + Q
        innovations, covariances, accepted = [], [], []
        for name in TASK.modalities:
            z = observations[name]
            if np.isnan(z).any():
                innovations, covariances, accepted = [*innovations, None], [*covariances, None], [*accepted, None]
                continue
            nu, s = z - H[name] @ self.x, H[name] @ self.P @ H[name].T + R[name] * self.scale
            used = bool(nu @ np.linalg.solve(s, nu) <= self.gate)
            if used:
                gain = np.linalg.solve(s, H[name] @ self.P).T
                self.x, self.P = self.x + gain @ nu, self.P - gain @ s @ gain.T
            innovations, covariances, accepted = [*innovations, nu], [*covariances, s], [*accepted, used]
        return {
            "estimate_mean": self.x,
            "estimate_covariance": self.P,
            "innovation": innovations,
            "innovation_covariance": covariances,
            "accepted": accepted,
            "extra": {"trace": float(np.trace(self.P))},
        }


class TorchKalman(nn.Module):
    """The same filter for N trajectories, without gate; needs every reading."""

    def __init__(self) -> None:
        super().__init__()
        for name, value in {
            "F": F,
            "Q": Q,
            "H": np.vstack(list(H.values())),
            "R": np.diag([GPS**2] * 2 + [SPEED**2]),
        }.items():
            self.register_buffer(name, torch.from_numpy(value))
        self.devices: set[str] = set()

    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        self.x, self.P = mean, covariance

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> tuple[Tensor, Tensor]:
        self.devices |= {str(value.device.type) for value in (*observations.values(), controls, self.x)}
        x, p = self.x @ self.F.T, self.F @ self.P @ self.F.T + self.Q
        z = torch.cat([observations["gps"], observations["speed"]], dim=1)
        s = self.H @ p @ self.H.T + self.R
        gain = torch.linalg.solve(s, self.H @ p).transpose(1, 2)
        self.x = x + (gain @ (z - x @ self.H.T).unsqueeze(-1)).squeeze(-1)
        self.P = p - gain @ s @ gain.transpose(1, 2)
        return self.x, self.P
