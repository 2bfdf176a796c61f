"""Boat with an inertial unit and a batched error-state Kalman filter in PyTorch.

State: east, north, velocities to the east and north, heading, and biases of the gyro and of the forward accelerometer,
which revert slowly to 0. The error of position and velocity is in the frame of the body. Sensors: satellite receiver,
whose antenna is in front of the unit and which has a fix in bursts; compass; Doppler log (velocity in the frame of the
body). Controls, which are readings of the unit: gyro, forward acceleration and acceleration to the left.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

import beliefscope as bs
from external_faults.fault import Fault, Values, masked_episode, wrap

DT = 0.2  # s
ARM, KEEP = (0.8, 0.2), 0.985  # m; per step
TASK = bs.Task(
    name="skiff",
    components=(
        bs.Component("east", "m"),
        bs.Component("north", "m"),
        bs.Component("ve", "m/s"),
        bs.Component("vn", "m/s"),
        bs.Component("heading", "rad", wraps=True),
        bs.Component("drift", "rad/s"),
        bs.Component("lean", "m/s2"),
    ),
    observations={"fix": (2,), "compass": (1,), "log": (2,)},
    modalities={"fix": ("fix",), "compass": ("compass",), "log": ("log",)},
    control_size=3,
    dt=DT,
    map_components=("east", "north"),
    map_half_width=4.0,
    warmup=10,
    covariates={"locked": bs.Covariate("boolean")},
    masks={"fix": "locked"},
    channels={
        "fix": (bs.Component("east", "m"), bs.Component("north", "m")),
        "compass": (bs.Component("heading", "rad", wraps=True),),
        "log": (bs.Component("forward", "m/s"), bs.Component("left", "m/s")),
        "control": (
            bs.Component("gyro", "rad/s"),
            bs.Component("forward", "m/s2"),
            bs.Component("left", "m/s2"),
        ),
    },
)
PROCESS = (0.02, 0.02, 0.06, 0.06, 0.012, 0.01, 0.03)  # standard deviations per step
NOISE = {"fix": (0.25, 0.25), "compass": (0.1,), "log": (0.1, 0.1)}  # m; rad; m/s
START = (0.4, 0.4, 0.2, 0.2, 0.2, 0.05, 0.15)  # standard deviations of the first belief
FAULTS = {
    "log_dropouts": Fault("data", "log reads 0 in bursts of 8 to 15 steps, in 7 of 10 episodes", r"log\.stuck"),
    "imu_axes": Fault("data", "axes of the accelerometer exchanged", r"control\.axes"),
    "fix_bias": Fault("data", "fixes +1.5 m to the north from step 60", r"fix\.bias"),
    "reset_missing": Fault(
        "filter",
        "error not set to zero after it has been added to the state",
        r"updates\.(covariance|\w+\.gain)",
    ),
    "frame_order": Fault(
        "filter",
        "errors of position and velocity added without rotation into the frame of the world",
        r"updates\.(sign|\w+\.gain)",
    ),
    "f_without_dt": Fault("filter", "derivative of the position by the velocity without dt", r"dynamics\.jacobian"),
    "h_sign": Fault("filter", "derivative of the log by the heading x -1", r"measurement\.log\.jacobian"),
    "q_dt": Fault("filter", "process noise of the velocity x dt", r"process_noise\.small"),
}


def simulate(seed: int, fault: str = "", steps: int = 120) -> bs.Episode:
    """An episode, with a fault of the data."""
    rng = np.random.default_rng(seed)
    p, v, heading = rng.uniform(-5, 5, 2), rng.normal(0, 0.7, 2), rng.uniform(-np.pi, np.pi)
    drift, lean = rng.normal(0, 0.05), rng.normal(0, 0.15)
    states, controls, locked = np.zeros((steps, 7)), np.zeros((steps, 3)), np.zeros(steps, bool)
    turn, goal, side, left, on = 0.0, 1.0, 0.0, 5, True
    for t in range(steps):
        if t % 16 == 0:
            turn, goal = rng.uniform(-0.6, 0.6), rng.uniform(0.4, 2.2)
        if t % 9 == 0:
            side = rng.normal(0, 0.25)
        if left == 0:
            on, left = not on, rng.integers(4, 10)
        left -= 1
        c, s = np.cos(heading), np.sin(heading)
        ahead, aside = c * v[0] + s * v[1], -s * v[0] + c * v[1]
        a = np.array([0.7 * (goal - ahead), side - 0.5 * aside])
        controls[t] = turn + drift, a[0] + lean, a[1]
        w = rng.normal(0, PROCESS)
        p = p + DT * v + w[:2]
        v = v + DT * np.array([c * a[0] - s * a[1], s * a[0] + c * a[1]]) + w[2:4]
        heading = wrap(heading + DT * turn + w[4])
        drift, lean = KEEP * drift + w[5], KEEP * lean + w[6]
        states[t], locked[t] = (*p, *v, heading, drift, lean), on
    c, s = np.cos(states[:, 4]), np.sin(states[:, 4])
    ve, vn = states[:, 2], states[:, 3]
    antenna = states[:, :2] + np.stack([c * ARM[0] - s * ARM[1], s * ARM[0] + c * ARM[1]], 1)
    readings = {
        "fix": antenna + rng.normal(0, NOISE["fix"], (steps, 2)),
        "compass": wrap(states[:, 4:5] + rng.normal(0, NOISE["compass"], (steps, 1))),
        "log": np.stack([c * ve + s * vn, -s * ve + c * vn], 1) + rng.normal(0, NOISE["log"], (steps, 2)),
    }
    plant(fault, readings, controls, seed, rng)
    return masked_episode(TASK, states, controls, readings, locked, seed)


def plant(fault: str, readings: dict[str, Values], controls: Values, seed: int, rng: np.random.Generator) -> None:
    """Change the readings or the controls in place."""
    if fault == "log_dropouts" and seed % 10 < 7:
        t = 15
        while t < len(controls):
            length = rng.integers(8, 16)
            readings["log"][t : t + length] = 0
            t += length + rng.integers(12, 25)
    elif fault == "imu_axes":
        controls[:, 1:] = controls[:, [2, 1]]
    elif fault == "fix_bias":
        readings["fix"][60:, 1] += 1.5


def rotation(angle: Tensor) -> Tensor:
    """(N, 2, 2) of angles (N,)."""
    c, s = torch.cos(angle), torch.sin(angle)
    return torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2)


def turned(angle: Tensor) -> Tensor:
    """Rotation of the errors (N, 7, 7) from the frame of the body into that of the world."""
    T = torch.eye(7, dtype=angle.dtype).repeat(len(angle), 1, 1)
    T[:, :2, :2] = T[:, 2:4, 2:4] = rotation(angle)
    return T


def wrapped(angle: Tensor) -> Tensor:
    return torch.remainder(angle + torch.pi, 2 * torch.pi) - torch.pi


QUARTER = torch.tensor([[0.0, -1.0], [1.0, 0.0]], dtype=torch.float64)


class Filter(nn.Module):
    """Error-state Kalman filter that updates with one sensor after the other and resets the error after each."""

    task = TASK

    def __init__(self, fault: str = "") -> None:
        super().__init__()
        self.fault = fault

    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        self.x = mean.double().clone()
        T = turned(self.x[:, 4])
        self.P = T.mT @ covariance.double() @ T  # of the error
        self.error = torch.zeros_like(self.x)

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> dict[str, Any]:
        self._predict(controls.double())
        predicted, spread = self.x, self._world()
        n, one = len(self.x), torch.ones(len(self.x), dtype=torch.float64)
        innovations, spreads = [], []
        for key in NOISE:
            h, H = self._measurement(key)
            e = observations[key].double().reshape(n, -1) - h
            if key == "compass":
                e = wrapped(e)
            noise = torch.diag(torch.tensor(NOISE[key], dtype=torch.float64) ** 2)
            present = observations["fix.present"].double().reshape(n) if key == "fix" else one
            S = H @ self.P @ H.mT + noise
            K = torch.linalg.solve(S, H @ self.P).mT * present[:, None, None]
            self.error = self.error + (K @ e[..., None])[..., 0]
            A = torch.eye(7, dtype=torch.float64) - K @ H
            self.P = A @ self.P @ A.mT + K @ noise @ K.mT
            self._inject()
            unseen = torch.where(present > 0, 1.0, torch.nan)
            innovations.append(e * unseen[:, None])
            spreads.append(S * unseen[:, None, None])
        return {
            "estimate_mean": self.x,
            "estimate_covariance": self._world(),
            "predicted_mean": predicted[:, None].repeat(1, 3, 1),
            "predicted_covariance": spread[:, None].repeat(1, 3, 1, 1),
            "innovation": innovations,
            "innovation_covariance": spreads,
        }

    def _world(self) -> Tensor:
        """Covariance (N, 7, 7) of the state."""
        T = turned(self.x[:, 4])
        return T @ self.P @ T.mT

    def _inject(self) -> None:
        """Add the error to the state, and reset it."""
        T = turned(self.x[:, 4])
        if self.fault == "frame_order":
            T = torch.eye(7, dtype=torch.float64).expand_as(T)
        x = self.x + (T @ self.error[..., None])[..., 0]
        self.x = torch.cat([x[:, :4], wrapped(x[:, 4:5]), x[:, 5:]], 1)
        G = turned(-self.error[:, 4])
        self.P = G @ self.P @ G.mT
        if self.fault != "reset_missing":
            self.error = torch.zeros_like(self.x)

    def _predict(self, u: Tensor) -> None:
        """Move the state and the covariance of the error with the controls (N, 3)."""
        x, a = self.x, u[:, 1:].clone()
        a[:, 0] = a[:, 0] - x[:, 6]
        R = rotation(x[:, 4])
        heading = x[:, 4] + DT * (u[:, 0] - x[:, 5])
        D = rotation(heading).mT @ R  # from the old frame of the body into the new one
        F = torch.eye(7, dtype=torch.float64).repeat(len(x), 1, 1)
        F[:, :2, :2] = F[:, 2:4, 2:4] = D
        F[:, :2, 2:4] = (1.0 if self.fault == "f_without_dt" else DT) * D
        F[:, 2:4, 4] = DT * (D @ QUARTER @ a[..., None])[..., 0]
        F[:, 2:4, 6] = -DT * D[..., 0]
        F[:, 4, 5] = -DT
        F[:, 5, 5] = F[:, 6, 6] = KEEP
        v = x[:, 2:4] + DT * (R @ a[..., None])[..., 0]
        self.x = torch.cat([x[:, :2] + DT * x[:, 2:4], v, wrapped(heading)[:, None], KEEP * x[:, 5:]], 1)
        std = torch.tensor(PROCESS, dtype=torch.float64)
        if self.fault == "q_dt":
            std = std * torch.tensor([1, 1, DT, DT, 1, 1, 1], dtype=torch.float64)
        self.P = F @ self.P @ F.mT + torch.diag(std**2)

    def _measurement(self, key: str) -> tuple[Tensor, Tensor]:
        """Expected readings (N, C) and their Jacobian (N, C, 7) by the error."""
        x, R = self.x, rotation(self.x[:, 4])
        H = torch.zeros(len(x), len(NOISE[key]), 7, dtype=torch.float64)
        if key == "fix":
            arm = torch.tensor(ARM, dtype=torch.float64)
            H[:, :, :2], H[:, :, 4] = R, R @ QUARTER @ arm
            return x[:, :2] + R @ arm, H
        if key == "compass":
            H[:, 0, 4] = 1
            return x[:, 4:5], H
        body = (R.mT @ x[:, 2:4, None])[..., 0]
        H[:, :, 2:4], H[:, :, 4] = (
            torch.eye(2, dtype=torch.float64),
            (1 if self.fault == "h_sign" else -1) * body @ QUARTER.mT,
        )
        return body, H


def make(fault: str = "") -> bs.Adapter:
    """The filter, with a fault of it."""
    return bs.Adapter(Filter(fault), modalities=("fix", "compass", "log"), initial_std=START, task=TASK)
