"""Flume of four reaches with a tracer that decays, with a batched ensemble Kalman filter in NumPy.

State: concentrations of the reaches, flow, and logarithm of the relative decay, which reverts slowly to 0. Sensors:
probes in the reaches 1 and 3; level gauge; absorption in reach 4, which saturates, every 4th step. Controls: dose of
the tracer and opening of the valve.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import beliefscope as bs
from external_faults.fault import Fault, Values, masked_episode

DT = 0.5  # s
POLL, MEMBERS, INFLATION = 4, 120, 1.02  # steps; 1; 1
VOLUME, DECAY, LAG, KEEP = 3.0, 0.06, 3.0, 0.985  # l; 1/s; s; per step
LEVEL, DARK, HALF = 10.0, 2.0, 5.0  # cm; 1; mg/l
TASK = bs.Task(
    name="river",
    components=(
        *(bs.Component(f"c{i}", "mg/l") for i in (1, 2, 3, 4)),
        bs.Component("flow", "l/s"),
        bs.Component("decay", "1"),
    ),
    observations={"probe": (2,), "gauge": (1,), "absorption": (1,)},
    modalities={"probe": ("probe",), "gauge": ("gauge",), "absorption": ("absorption",)},
    control_size=2,
    dt=DT,
    map_components=("c2", "c4"),
    map_half_width=1.0,
    warmup=10,
    covariates={"polled": bs.Covariate("boolean")},
    masks={"absorption": "polled"},
    channels={
        "probe": (bs.Component("first", "mg/l"), bs.Component("third", "mg/l")),
        "gauge": (bs.Component("level", "cm"),),
        "absorption": (bs.Component("absorption", "1"),),
        "control": (bs.Component("dose", "mg/s"), bs.Component("valve", "l/s")),
    },
)
PROCESS = np.array([0.06, 0.06, 0.06, 0.06, 0.02, 0.06])  # standard deviations per step
NOISE = {"probe": (0.15, 0.15), "gauge": (0.25,), "absorption": (0.02,)}  # mg/l; cm; 1
START = (0.3, 0.3, 0.3, 0.3, 0.1, 0.3)  # standard deviations of the first belief
FAULTS = {
    "probe_swapped": Fault("data", "probes exchanged", r"probe\.axes"),
    "gauge_frozen": Fault("data", "gauge frozen in the steps 45 to 85, in 6 of 10 episodes", r"gauge\.stuck"),
    "absorption_noise": Fault("data", "noise of the absorption x 5", r"absorption\.noise"),
    "unperturbed": Fault("filter", "observations not perturbed", r"updates\.covariance|covariance\.small"),
    "shared_noise": Fault("filter", "one draw of the process noise for all members", r"process_noise\.small"),
    "undivided": Fault(
        "filter",
        "products of anomalies not divided by M - 1 in S and in the cross-covariance",
        r"updates\.(covariance|\w+\.gain)|measurement_noise\.\w+\.small",
    ),
    "inflation": Fault("filter", "inflation of the forecast 1.1", r"process_noise\.large|covariance\.large"),
    "volume": Fault("filter", "volume of a reach 2 l in the dynamics", r"dynamics\.(large|broken)"),
}


def step(x: Values, u: Values, volume: float = VOLUME) -> Values:
    """Next states (..., 6) of the controls (..., 2)."""
    c, q, k = x[..., :4], x[..., 4:5], DECAY * np.exp(x[..., 5:6])
    arriving = np.concatenate([u[..., :1] + 0 * q, q * c[..., :3]], -1)
    c = c + DT * ((arriving - q * c) / volume - k * c)
    return np.concatenate([c, q + DT * (u[..., 1:] - q) / LAG, KEEP * x[..., 5:6]], -1)


def readings_of(x: Values) -> dict[str, Values]:
    """Expected readings (..., C) of the states (..., 6)."""
    return {
        "probe": x[..., [0, 2]],
        "gauge": LEVEL * np.maximum(x[..., 4:5], 0.05) ** 0.6,
        "absorption": DARK * (1 - np.exp(-x[..., 3:4] / HALF)),
    }


def simulate(seed: int, fault: str = "", steps: int = 120) -> bs.Episode:
    """An episode, with a fault of the data."""
    rng = np.random.default_rng(seed)
    x = np.array([*rng.uniform(2, 5, 4), rng.uniform(0.7, 1.4), rng.normal(0, 0.3)])
    states, controls = np.zeros((steps, 6)), np.zeros((steps, 2))
    u = np.zeros(2)
    for t in range(steps):
        if t % 15 == 0:
            u[0] = rng.uniform(2, 9)
        if t % 22 == 0:
            u[1] = rng.uniform(0.6, 1.5)
        x = step(x, u) + rng.normal(0, PROCESS)
        states[t], controls[t] = x, u
    readings = {key: h + rng.normal(0, NOISE[key], (steps, len(NOISE[key]))) for key, h in readings_of(states).items()}
    if fault == "probe_swapped":
        readings["probe"] = readings["probe"][:, ::-1].copy()
    elif fault == "gauge_frozen" and seed % 10 < 6:
        readings["gauge"][45:86] = readings["gauge"][45]
    elif fault == "absorption_noise":
        readings["absorption"] += rng.normal(0, 0.098, (steps, 1))
    polled = np.arange(steps) % POLL == 0
    return masked_episode(TASK, states, controls, readings, polled, seed)


class Filter:
    """Stochastic ensemble Kalman filter that updates with all present sensors at once."""

    task = TASK

    def __init__(self, fault: str = "") -> None:
        self.fault = fault

    def initialize_beliefs(self, *, mean: Values, covariance: Values) -> None:
        root = np.linalg.cholesky(np.asarray(covariance, float))
        z = np.random.standard_normal((len(mean), MEMBERS, 6))  # noqa: NPY002 - seeded by the trace
        self.X = np.asarray(mean, float)[:, None] + z @ root.swapaxes(1, 2)

    def forward(self, *, observations: dict[str, Values], controls: Values) -> dict[str, Any]:
        X = self._forecast(np.asarray(controls, float))
        n = len(X)
        mean, covariance = self._moments(X)
        expected = readings_of(X)
        present = {key: np.ones(n) for key in NOISE}
        present["absorption"] = np.asarray(observations["absorption.present"], float).reshape(n)
        Z = np.concatenate(list(expected.values()), -1)
        y = np.concatenate([np.asarray(observations[key], float).reshape(n, -1) for key in NOISE], -1)
        std = np.concatenate([NOISE[key] for key in NOISE])
        used = np.concatenate([np.repeat(present[k][:, None], len(NOISE[k]), 1) for k in NOISE], -1) > 0
        A, B = X - X.mean(1, keepdims=True), Z - Z.mean(1, keepdims=True)
        B = np.where(used[:, None], B, 0)
        divisor = 1 if self.fault == "undivided" else MEMBERS - 1
        S = B.swapaxes(1, 2) @ B / divisor + np.diag(std**2)
        cross = A.swapaxes(1, 2) @ B / divisor
        K = np.linalg.solve(S, cross.swapaxes(1, 2)).swapaxes(1, 2)
        perturbed = y[:, None] + std * np.random.standard_normal(Z.shape)  # noqa: NPY002 - seeded by the trace
        if self.fault == "unperturbed":
            perturbed = y[:, None] + 0 * Z
        X = X + np.where(used[:, None], perturbed - Z, 0) @ K.swapaxes(1, 2)
        self.X = X
        estimate, posterior = self._moments(X)
        innovations, spreads = self._innovations(y - Z.mean(1), S, present)
        return {
            "estimate_mean": estimate,
            "estimate_covariance": posterior,
            "particles": X,
            "log_weights": np.full((n, MEMBERS), -np.log(MEMBERS)),
            "predicted_mean": np.repeat(mean[:, None], 3, 1),
            "predicted_covariance": np.repeat(covariance[:, None], 3, 1),
            "innovation": innovations,
            "innovation_covariance": spreads,
        }

    def _forecast(self, controls: Values) -> Values:
        """Members (N, M, 6), inflated, of the controls (N, 2)."""
        X = step(self.X, controls[:, None], 2.0 if self.fault == "volume" else VOLUME)
        noise = np.random.standard_normal((len(X), 1 if self.fault == "shared_noise" else MEMBERS, 6))  # noqa: NPY002 - seeded by the trace
        X = X + PROCESS * noise
        mean = X.mean(1, keepdims=True)
        return mean + (1.1 if self.fault == "inflation" else INFLATION) * (X - mean)

    @staticmethod
    def _moments(X: Values) -> tuple[Values, Values]:
        """Means (N, 6) and covariances (N, 6, 6) of members (N, M, 6)."""
        A = X - X.mean(1, keepdims=True)
        return X.mean(1), A.swapaxes(1, 2) @ A / (MEMBERS - 1)

    @staticmethod
    def _innovations(e: Values, S: Values, present: dict[str, Values]) -> tuple[list[Values], list[Values]]:
        """By sensor, with NaN where it has no reading."""
        innovations, spreads, i = [], [], 0
        for key, std in NOISE.items():
            unseen = np.where(present[key] > 0, 1.0, np.nan)
            part = slice(i, i + len(std))
            innovations.append(e[:, part] * unseen[:, None])
            spreads.append(S[:, part, part] * unseen[:, None, None])
            i += len(std)
        return innovations, spreads


def make(fault: str = "") -> bs.Adapter:
    """The filter, with a fault of it."""
    return bs.Adapter(Filter(fault), modalities=("probe", "gauge", "absorption"), initial_std=START, task=TASK)
