"""Kalman filters in NumPy and torch of the vehicle of the gallery, for tests of external filters."""

from __future__ import annotations

import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

GALLERY = Path(__file__).parents[3] / "examples" / "gallery"
data = SimpleNamespace(**runpy.run_path(str(GALLERY / "vehicle.py")))
TASK, drive, F, Q, H, R, P0, GPS, SPEED = (
    getattr(data, name) for name in ("TASK", "drive", "F", "Q", "H", "R", "P0", "GPS", "SPEED")
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
            if np.isnan(z).any() or (name == "gps" and not observations["fix"] > 0.0):
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
