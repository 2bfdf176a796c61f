"""Wind turbine with an elastic shaft, with a batched extended Kalman filter.

State: speed of the rotor, twist of the shaft, speed of the generator, and wind, which reverts slowly to its mean.
Sensors: strain gauges of the flap (square of the relative wind, reduced by the pitch) and of the shaft's torque;
tachometer of the generator; power meter (torque times speed minus losses), every 5th step. Controls: torque of the
generator and pitch of the blades.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

import beliefscope as bs
from external_faults.fault import Fault, delay, masked_episode

DT = 0.05  # s
POLL = 5  # steps
AERO, LEAD, PITCH, STIFF, DAMP = (
    0.03,
    1.2,
    0.5,
    9.0,
    0.6,
)  # 1/m2; m/rad; 1; kN m/rad; kN m s/rad, inertia of the rotor 1
INERTIA, FRICTION = 0.4, 0.18  # of the generator: t m2; 1/s
MEAN, CALM = 8.0, 0.005  # m/s; per step
THRUST, SHIELD, FEATHER, LOSS = 0.012, 0.4, 0.35, 0.04  # kN s2/m2; m/rad; 1; kW s2/rad2
TASK = bs.Task(
    name="turbine",
    components=(
        bs.Component("rotor", "rad/s"),
        bs.Component("twist", "rad"),
        bs.Component("generator", "rad/s"),
        bs.Component("wind", "m/s"),
    ),
    observations={"strain": (2,), "tacho": (1,), "power": (1,)},
    modalities={"strain": ("strain",), "tacho": ("tacho",), "power": ("power",)},
    control_size=2,
    dt=DT,
    map_components=("rotor", "wind"),
    map_half_width=0.5,
    warmup=10,
    covariates={"polled": bs.Covariate("boolean")},
    masks={"power": "polled"},
    channels={
        "strain": (bs.Component("flap", "kN"), bs.Component("shaft", "kN m")),
        "tacho": (bs.Component("speed", "rad/s"),),
        "power": (bs.Component("power", "kW"),),
        "control": (bs.Component("torque", "kN m"), bs.Component("pitch", "1")),
    },
)
PROCESS = (0.02, 0.0008, 0.03, 0.12)  # standard deviations per step: rad/s, rad, rad/s, m/s
NOISE = {"strain": (0.03, 0.05), "tacho": (0.04,), "power": (0.015,)}  # standard deviations: kN, kN m; rad/s; kW
START = (0.1, 0.01, 0.1, 0.4)  # standard deviations of the first belief
FAULTS = {
    "tacho_scale": Fault("data", "gain of the tachometer x 0.93", r"tacho\.gain"),
    "strain_swapped": Fault("data", "strain gauges exchanged", r"strain\.axes"),
    "power_delay": Fault("data", "power delayed by 15 steps, 3 readings", r"power\.delay"),
    "torque_offset": Fault("data", "torque biased by +0.22 kN m", r"control\.bias"),
    "shaft_noise": Fault("data", "noise of the shaft's gauge x 3.5", r"strain\.noise"),
    "pitch_sign": Fault("filter", "pitch in the dynamics x -1", r"dynamics\.(inverted|broken)"),
    "friction_omitted": Fault("filter", "dynamics without friction", r"dynamics\.(bias|broken)"),
    "q_wind": Fault("filter", "process noise of the wind x 0.15", r"process_noise\.small"),
    "flap_h": Fault("filter", "thrust 0.0148 kN s2/m2", r"measurement\.strain\.(function|bias)"),
    "rt_large": Fault("filter", "noise of the tachometer x 4.5", r"measurement_noise\.tacho\.large"),
    "power_jacobian": Fault(
        "filter", "Jacobian of the power by the generator speed x -0.7", r"measurement\.power\.jacobian"
    ),
    "gain_small": Fault("filter", "gain of updates with the strain x 0.2", r"updates\.strain\.gain"),
}


def step(x: Any, u: Any, lib: Any, friction: float = FRICTION, pitch: float = PITCH) -> Any:
    """Next states (..., 4). lib: numpy or torch."""
    r, s, g, v = x[..., 0], x[..., 1], x[..., 2], x[..., 3]
    shaft = STIFF * s + DAMP * (r - g)
    r1 = r + DT * (AERO * v * (v - LEAD * r) * (1 - pitch * u[..., 1]) - shaft)
    g1 = g + DT * ((shaft - u[..., 0]) / INERTIA - friction * g)
    return lib.stack([r1, s + DT * (r1 - g1), g1, v + CALM * (MEAN - v)], -1)


def simulate(seed: int, fault: str = "", steps: int = 120) -> bs.Episode:
    """An episode, with a fault of the data."""
    rng = np.random.default_rng(seed)
    x = np.array([rng.uniform(2.5, 4), 0.08, 0.0, MEAN + rng.normal(0, 1)])
    x[2] = x[0]
    states, controls = np.zeros((steps, 4)), np.zeros((steps, 2))
    goal, pitch, blade = 3.0, 0.3, 0.3
    for t in range(steps):
        if t % 24 == 0:
            goal, blade = rng.uniform(2.0, 4.5), rng.uniform(0, 1)
        pitch += np.clip(blade - pitch, -0.08, 0.08)
        u = np.array([np.clip(0.75 + 0.6 * (x[2] - goal), 0.05, 1.8), pitch])
        x = step(x, u, np) + rng.normal(0, PROCESS)
        states[t], controls[t] = x, u
    r, s, g, v = states.T
    strain = np.stack([THRUST * (v - SHIELD * r) ** 2 * (1 - FEATHER * controls[:, 1]), STIFF * s], 1)
    readings = {
        "strain": strain + rng.normal(0, NOISE["strain"], (steps, 2)),
        "tacho": states[:, 2:3] + rng.normal(0, NOISE["tacho"], (steps, 1)),
        "power": (controls[:, 0] * g - LOSS * g**2)[:, None] + rng.normal(0, NOISE["power"], (steps, 1)),
    }
    if fault == "tacho_scale":
        readings["tacho"] *= 0.93
    elif fault == "strain_swapped":
        readings["strain"] = readings["strain"][:, ::-1].copy()
    elif fault == "power_delay":
        readings["power"] = delay(readings["power"], 15)
    elif fault == "torque_offset":
        controls[:, 0] += 0.22
    elif fault == "shaft_noise":
        readings["strain"][:, 1] += rng.normal(0, 0.17, steps)
    polled = np.arange(steps) % POLL == 0
    return masked_episode(TASK, states, controls, readings, polled, seed)


class Filter(nn.Module):
    """Extended Kalman filter that updates with one sensor after the other."""

    task = TASK

    def __init__(self, fault: str = "") -> None:
        super().__init__()
        self.fault = fault

    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        self.x, self.P = mean.double(), covariance.double()

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> dict[str, Any]:
        u = controls.double()
        x, P = self._predict(u)
        n, one = len(x), torch.ones(len(x), dtype=torch.float64)
        means, covariances, innovations, spreads = [], [], [], []
        for key in NOISE:
            means.append(x)
            covariances.append(P)
            h, H = self._measurement(key, x, u)
            std = torch.tensor(NOISE[key], dtype=torch.float64)
            if self.fault == "rt_large" and key == "tacho":
                std = std * 4.5
            noise = torch.diag(std**2)
            present = observations["power.present"].double().reshape(n) if key == "power" else one
            e = observations[key].double().reshape(n, -1) - h
            S = H @ P @ H.mT + noise
            K = torch.linalg.solve(S, H @ P).mT * present[:, None, None]
            x = x + ((0.2 if self.fault == "gain_small" and key == "strain" else 1) * K @ e[..., None])[..., 0]
            A = torch.eye(4, dtype=torch.float64) - K @ H
            P = A @ P @ A.mT + K @ noise @ K.mT
            unseen = torch.where(present > 0, 1.0, torch.nan)
            innovations.append(e * unseen[:, None])
            spreads.append(S * unseen[:, None, None])
        self.x, self.P = x, P
        return {
            "estimate_mean": x,
            "estimate_covariance": P,
            "predicted_mean": torch.stack(means, 1),
            "predicted_covariance": torch.stack(covariances, 1),
            "innovation": innovations,
            "innovation_covariance": spreads,
        }

    def _predict(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (N, 4) and covariance (N, 4, 4) of the controls (N, 2)."""
        x = self.x
        friction = 0.0 if self.fault == "friction_omitted" else FRICTION
        pitch = -PITCH if self.fault == "pitch_sign" else PITCH
        free = AERO * (1 - pitch * u[:, 1])
        F = torch.zeros(len(x), 4, 4, dtype=torch.float64)
        F[:, 0, 0] = 1 - DT * (free * LEAD * x[:, 3] + DAMP)
        F[:, 0, 1], F[:, 0, 2] = -DT * STIFF, DT * DAMP
        F[:, 0, 3] = DT * free * (2 * x[:, 3] - LEAD * x[:, 0])
        F[:, 2, 0], F[:, 2, 1] = DT * DAMP / INERTIA, DT * STIFF / INERTIA
        F[:, 2, 2] = 1 - DT * (DAMP / INERTIA + friction)
        F[:, 1] = torch.eye(4, dtype=torch.float64)[1] + DT * (F[:, 0] - F[:, 2])  # the new speeds move the twist
        F[:, 3, 3] = 1 - CALM
        std = torch.tensor(PROCESS, dtype=torch.float64)
        if self.fault == "q_wind":
            std = std * torch.tensor([1, 1, 1, 0.15], dtype=torch.float64)
        return step(x, u, torch, friction, pitch), F @ self.P @ F.mT + torch.diag(std**2)

    def _measurement(self, key: str, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Expected readings (N, C) and their Jacobian (N, C, 4)."""
        r, s, g, v = x.unbind(1)
        H = torch.zeros(len(x), len(NOISE[key]), 4, dtype=torch.float64)
        if key == "strain":
            thrust = (0.0148 if self.fault == "flap_h" else THRUST) * (1 - FEATHER * u[:, 1])
            w = v - SHIELD * r
            H[:, 0, 0], H[:, 0, 3], H[:, 1, 1] = -2 * SHIELD * thrust * w, 2 * thrust * w, STIFF
            return torch.stack([thrust * w**2, STIFF * s], 1), H
        if key == "tacho":
            H[:, 0, 2] = 1
            return g[:, None], H
        H[:, 0, 2] = u[:, 0] - 2 * LOSS * g
        if self.fault == "power_jacobian":
            H[:, 0, 2] *= -0.7
        return (u[:, 0] * g - LOSS * g**2)[:, None], H


def make(fault: str = "") -> bs.Adapter:
    """The filter, with a fault of it."""
    return bs.Adapter(Filter(fault), modalities=("strain", "tacho", "power"), initial_std=START, task=TASK)
