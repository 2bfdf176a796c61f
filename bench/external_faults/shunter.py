"""Shunting locomotive on a siding, with a batched particle filter.

State: position, speed and pull, the acceleration of an unknown gradient and load (random walk). Sensors: tachometer of
a wheel, which creeps with the traction; current, which grows with traction times speed; signal strength of two
transmitters beside the track, which falls with the logarithm of the distance, every 5th step. Controls: traction and
eddy-current brake.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

import beliefscope as bs
from external_faults.fault import Fault, Values, delay, masked_episode

DT = 0.5  # s
PARTICLES = 1000
POLL = 5  # steps
BRAKE, AIR = 0.35, 0.012  # 1/s per unit of the brake; 1/m
CREEP, IDLE, AMPERE = 0.08, 12.0, 9.0  # per m/s2 of traction; A; A s3/m2
SIDE, LEVEL, SLOPE = 25.0, 40.0, 8.7  # m; dB; dB per unit of the natural logarithm
PLACES = (-20.0, 260.0)  # m
TASK = bs.Task(
    name="shunter",
    components=(bs.Component("position", "m"), bs.Component("speed", "m/s"), bs.Component("pull", "m/s2")),
    observations={"wheel": (1,), "current": (1,), "radio": (2,)},
    modalities={"wheel": ("wheel",), "current": ("current",), "radio": ("radio",)},
    control_size=2,
    dt=DT,
    map_components=("position",),
    map_half_width=8.0,
    warmup=10,
    covariates={"polled": bs.Covariate("boolean")},
    masks={"radio": "polled"},
    channels={
        "wheel": (bs.Component("speed", "m/s"),),
        "current": (bs.Component("current", "A"),),
        "radio": (bs.Component("west", "dB"), bs.Component("east", "dB")),
        "control": (bs.Component("traction", "m/s2"), bs.Component("brake", "1")),
    },
)
PROCESS = (0.08, 0.05, 0.012)  # standard deviations per step: m, m/s, m/s2
NOISE = {"wheel": (0.2,), "current": (2.5,), "radio": (0.6, 0.6)}  # standard deviations: m/s, A, dB
START = (2.0, 0.2, 0.06)  # standard deviations of the first belief
FAULTS = {
    "wheel_scale": Fault("data", "gain of the wheel x 1.24", r"wheel\.gain"),
    "radio_delay": Fault("data", "radio delayed by 10 steps, 2 readings", r"radio\.delay"),
    "current_outliers": Fault("data", "outliers of the current, 12 % of +-22 A", r"current\.noise"),
    "wheel_stuck": Fault("data", "wheel stuck at steps 64 to 95", r"wheel\.stuck"),
    "traction_offset": Fault("data", "traction biased by -0.3 m/s2", r"control\.bias"),
    "brake_omitted": Fault("filter", "dynamics without the brake", r"dynamics\.(frozen|broken|bias)"),
    "traction_scale": Fault("filter", "traction in the dynamics x 1.65", r"dynamics\.(large|broken)"),
    "q_pull": Fault("filter", "process noise of the pull x 5.5", r"process_noise\.large"),
    "transmitter_place": Fault("filter", "east transmitter at 225 m", r"measurement\.radio\.(function|bias)"),
    "rw_large": Fault("filter", "noise of the wheel x 3.3", r"measurement_noise\.wheel\.large"),
    "radio_unmasked": Fault("filter", "radio used where it has no reading", r"updates\.radio\.absent"),
    "sharp_resampling": Fault(
        "filter", "resampling by the 4th power of the weights", r"particles\.deprived|resampling\.biased"
    ),
}


def step(x: Any, traction: Any, brake: Any, lib: Any, scale: float = 1.0) -> Any:
    """Next states (..., 3). lib: numpy or torch. scale: of the traction."""
    s, v, g = x[..., 0], x[..., 1], x[..., 2]
    a = scale * traction - BRAKE * brake * v - AIR * v * abs(v) + g
    return lib.stack([s + v * DT + 0.5 * a * DT**2, v + a * DT, 0.97 * g], -1)


def strength(position: Any, place: float, lib: Any) -> Any:
    """Signal of a transmitter, dB."""
    return LEVEL - SLOPE * lib.log(((position - place) ** 2 + SIDE**2) ** 0.5)


def simulate(seed: int, fault: str = "", steps: int = 120) -> bs.Episode:
    """An episode, with a fault of the data."""
    rng = np.random.default_rng(seed)
    x = np.array([rng.uniform(30, 210), rng.normal(0, 0.8), rng.normal(0, 0.05)])
    states, controls = np.zeros((steps, 3)), np.zeros((steps, 2))
    goal, brake, wobble = 120.0, 0.0, 0.0
    for t in range(steps):
        if t % 24 == 0:
            goal = rng.uniform(15, 225)
        if t % 9 == 0:
            brake, wobble = float(rng.random() < 0.4) * rng.uniform(0.3, 1.0), rng.normal(0, 0.35)
        u = np.array([np.clip(0.02 * (goal - x[0]) - 0.25 * x[1] + wobble, -1.0, 1.0), brake])
        x = step(x, u[0], u[1], np) + rng.normal(0, PROCESS)
        states[t], controls[t] = x, u
    v, traction = states[:, 1], controls[:, 0]
    radio = np.stack([strength(states[:, 0], place, np) for place in PLACES], 1)
    readings = {
        "wheel": (v * (1 + CREEP * traction))[:, None] + rng.normal(0, NOISE["wheel"], (steps, 1)),
        "current": (IDLE + AMPERE * traction * v)[:, None] + rng.normal(0, NOISE["current"], (steps, 1)),
        "radio": radio + rng.normal(0, NOISE["radio"], (steps, 2)),
    }
    plant(fault, readings, controls, rng)
    polled = np.arange(steps) % POLL == 0
    return masked_episode(TASK, states, controls, readings, polled, seed)


def plant(fault: str, readings: dict[str, Values], controls: Values, rng: np.random.Generator) -> None:
    """Change the readings or the controls in place."""
    if fault == "wheel_scale":
        readings["wheel"] *= 1.24
    elif fault == "radio_delay":
        readings["radio"] = delay(readings["radio"], 10)
    elif fault == "current_outliers":
        shape = readings["current"].shape
        readings["current"] += np.where(rng.random(shape) < 0.12, rng.choice([-1, 1], shape) * 22.0, 0)
    elif fault == "wheel_stuck":
        readings["wheel"][64:96] = readings["wheel"][64]
    elif fault == "traction_offset":
        controls[:, 0] -= 0.3


class Filter(nn.Module):
    """Particle filter that resamples at the end of a step, if the effective sample size is below half."""

    task = TASK

    def __init__(self, fault: str = "") -> None:
        super().__init__()
        self.fault = fault

    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        root = torch.linalg.cholesky(covariance.double())
        noise = torch.randn(len(mean), PARTICLES, 3, dtype=torch.float64)
        self.x = mean.double()[:, None] + noise @ root.mT
        self.w = torch.full((len(mean), PARTICLES), -np.log(PARTICLES), dtype=torch.float64)

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> dict[str, Tensor]:
        x = self._predict(controls.double())
        prior, logs = self.w, self._log_likelihoods(x, observations, controls.double()[:, :1])
        w = torch.log_softmax(prior + logs.sum(1), -1)
        p = w.exp()
        mean = (p[..., None] * x).sum(1)
        d = x - mean[:, None]
        return {
            "estimate_mean": mean,
            "estimate_covariance": (p[..., None] * d).mT @ d,
            "particles": x,
            "log_weights": w,
            "prior_log_weights": prior,
            "log_likelihood": logs,
            "ancestors": self._resample(x, w, p),
        }

    def _predict(self, controls: Tensor) -> Tensor:
        """Particles (N, M, 3) of the controls (N, 2)."""
        traction, brake = controls[:, :1], controls[:, 1:]
        std = torch.tensor(PROCESS, dtype=torch.float64)
        if self.fault == "q_pull":
            std = std * torch.tensor([1.0, 1.0, 5.5], dtype=torch.float64)
        if self.fault == "brake_omitted":
            brake = 0 * brake
        moved = step(self.x, traction, brake, torch, 1.65 if self.fault == "traction_scale" else 1.0)
        return moved + torch.randn(len(controls), PARTICLES, 3, dtype=torch.float64) * std

    def _log_likelihoods(self, x: Tensor, observations: dict[str, Tensor], traction: Tensor) -> Tensor:
        """(N, sensors, M)."""
        v, n, logs = x[..., 1], len(x), []
        places = (PLACES[0], 225.0 if self.fault == "transmitter_place" else PLACES[1])
        expected = {
            "wheel": (v * (1 + CREEP * traction))[..., None],
            "current": (IDLE + AMPERE * traction * v)[..., None],
            "radio": torch.stack([strength(x[..., 0], place, torch) for place in places], -1),
        }
        for key, h in expected.items():
            std = torch.tensor(NOISE[key], dtype=torch.float64)
            if self.fault == "rw_large" and key == "wheel":
                std = std * 3.3
            e = observations[key].double().reshape(n, 1, -1) - h
            log = (-0.5 * (e / std) ** 2 - torch.log(std) - 0.919).sum(-1)
            if key == "radio" and self.fault != "radio_unmasked":
                log = log * observations["radio.present"].double().reshape(n, 1)
            logs.append(log)
        return torch.stack(logs, 1)

    def _resample(self, x: Tensor, w: Tensor, p: Tensor) -> Tensor:
        """Systematic; indices of the ancestors (N, M)."""
        n = len(x)
        chances = p**4 / (p**4).sum(-1, keepdim=True) if self.fault == "sharp_resampling" else p
        positions = (torch.arange(PARTICLES) + torch.rand(n, 1, dtype=torch.float64)) / PARTICLES
        index = torch.searchsorted(chances.cumsum(-1).contiguous(), positions.contiguous()).clamp(max=PARTICLES - 1)
        need = (1 / (p**2).sum(-1) < 0.5 * PARTICLES)[:, None]
        index = torch.where(need, index, torch.arange(PARTICLES).expand(n, PARTICLES))
        self.x = x.gather(1, index[..., None].expand(n, PARTICLES, 3))
        self.w = torch.where(need, torch.full_like(w, -np.log(PARTICLES)), w)
        return index


def make(fault: str = "") -> bs.Adapter:
    """The filter, with a fault of it."""
    return bs.Adapter(Filter(fault), modalities=("wheel", "current", "radio"), initial_std=START, task=TASK)
