"""Lid of a box that a compliant hand lifts, with a particle filter in NumPy for one episode at a time.

State: angle, rate, and load, the unknown torque of what lies on the lid (random walk). Sensors: accelerometer on the
lid (gravity, 2 channels); force of the grip (spring between hand and lid); camera (image row of the edge, in
perspective), which the hand often occludes. Controls: angle of the hand and force of the gas strut.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import beliefscope as bs
from external_faults.fault import Fault, Values, delay, masked_episode

DT = 0.05  # s
PARTICLES = 800
SPRING, DAMP, WEIGHT, STRUT = 30.0, 5.0, 7.0, 2.0  # torques over the inertia: 1/s2, 1/s, rad/s2, rad/s2
GRIP, FOCAL = 20.0, 300.0  # N/rad; px
LENGTH, EYE, DEPTH = 0.4, 0.25, 1.1  # of the lid; height and distance of the camera: m
TASK = bs.Task(
    name="lid",
    components=(bs.Component("angle", "rad"), bs.Component("rate", "rad/s"), bs.Component("load", "rad/s2")),
    observations={"gravity": (2,), "grip": (1,), "edge": (1,)},
    modalities={"gravity": ("gravity",), "grip": ("grip",), "edge": ("edge",)},
    control_size=2,
    dt=DT,
    map_components=("angle",),
    map_half_width=0.2,
    warmup=10,
    covariates={"visible": bs.Covariate("boolean")},
    masks={"edge": "visible"},
    channels={
        "gravity": (bs.Component("along", "m/s2"), bs.Component("across", "m/s2")),
        "grip": (bs.Component("force", "N"),),
        "edge": (bs.Component("row", "px"),),
        "control": (bs.Component("hand", "rad"), bs.Component("strut", "1")),
    },
)
PROCESS = (0.003, 0.1, 0.1)  # standard deviations per step: rad, rad/s, rad/s2
NOISE = {"gravity": (0.4, 0.4), "grip": (0.6,), "edge": (2.5,)}  # standard deviations: m/s2, N, px
START = (0.03, 0.15, 0.6)  # standard deviations of the first belief
FAULTS = {
    "grip_offset": Fault("data", "grip biased by +1.6 N", r"grip\.bias"),
    "edge_outliers": Fault("data", "outliers of the edge, 12 % of +-30 px", r"edge\.noise"),
    "gravity_stuck": Fault("data", "gravity stuck at steps 40 to 74", r"gravity\.stuck"),
    "strut_scale": Fault("data", "strut x 2.4", r"control\.scale"),
    "controls_delay": Fault("data", "controls delayed by 4 steps", r"control\.delay"),
    "strut_scaled": Fault("filter", "strut in the dynamics x 2.5", r"dynamics\.(large|broken)"),
    "dt_short": Fault("filter", "time step of the dynamics x 0.6", r"dynamics\.frozen"),
    "q_large": Fault("filter", "process noise x 2.8", r"process_noise\.large"),
    "edge_eye": Fault("filter", "camera at a height of 0.22 m", r"measurement\.edge\.(function|bias)"),
    "rg_small": Fault("filter", "noise of the gravity x 0.2", r"measurement_noise\.gravity\.small"),
    "unmasked": Fault("filter", "edge used where it has no reading", r"updates\.edge\.absent"),
    "truncated": Fault(
        "filter", "resampling from the best twelfth of the particles", r"particles\.deprived|resampling\.biased"
    ),
}


def step(x: Values, u: Values, dt: float = DT, strut: float = STRUT) -> Values:
    """Next states (..., 3)."""
    a, w, load = x[..., 0], x[..., 1], x[..., 2]
    w1 = w + dt * (SPRING * (u[0] - a) - DAMP * w - WEIGHT * np.cos(a) + strut * u[1] - load)
    return np.stack([a + dt * w1, w1, load], -1)


def expected(angle: Values, hand: Any, eye: float = EYE) -> dict[str, Values]:
    """Readings (..., C) without noise."""
    row = FOCAL * (LENGTH * np.sin(angle) - eye) / (DEPTH - LENGTH * np.cos(angle))
    return {
        "gravity": np.stack([9.81 * np.sin(angle), 9.81 * np.cos(angle)], -1),
        "grip": GRIP * (hand - angle)[..., None],
        "edge": row[..., None],
    }


def simulate(seed: int, fault: str = "", steps: int = 120) -> bs.Episode:
    """An episode, with a fault of the data."""
    rng = np.random.default_rng(seed)
    x = np.array([rng.uniform(0.3, 1.0), 0.0, rng.normal(0, 1.0)])
    states, controls, visible = np.zeros((steps, 3)), np.zeros((steps, 2)), np.zeros(steps, bool)
    hand, goal, strut, left, seen = x[0] + 0.2, 0.8, 1.0, 0, False
    for t in range(steps):
        if t % 20 == 0:
            goal = rng.uniform(0.4, 1.7)
        if t % 15 == 0:
            strut = rng.uniform(0, 2)
        if left == 0:
            seen, left = not seen, rng.integers(3, 8)
        left -= 1
        hand += np.clip(goal - hand, -0.09, 0.09)
        u = np.array([hand, strut])
        x = step(x, u) + rng.normal(0, PROCESS)
        states[t], controls[t], visible[t] = x, u, seen
    clean = expected(states[:, 0], controls[:, 0])
    readings = {key: h + rng.normal(0, NOISE[key], h.shape) for key, h in clean.items()}
    if fault == "grip_offset":
        readings["grip"] += 1.6
    elif fault == "edge_outliers":
        outliers = rng.random((steps, 1)) < 0.12
        readings["edge"] += np.where(outliers, rng.choice([-1, 1], (steps, 1)) * 30, 0)
    elif fault == "gravity_stuck":
        readings["gravity"][40:75] = readings["gravity"][40]
    elif fault == "strut_scale":
        controls[:, 1] *= 2.4
    elif fault == "controls_delay":
        controls = delay(controls, 4)
    return masked_episode(TASK, states, controls, readings, visible, seed)


class Filter:
    """Particle filter that resamples at the end of a step, if the effective sample size is below 60 %."""

    task = TASK

    def __init__(self, fault: str = "") -> None:
        self.fault = fault

    def initialize_beliefs(self, *, mean: Values, covariance: Values) -> None:
        root = np.linalg.cholesky(np.asarray(covariance, float))
        self.x = np.asarray(mean, float) + np.random.normal(size=(PARTICLES, 3)) @ root.T  # noqa: NPY002 - seeded by the trace
        self.w = np.full(PARTICLES, -np.log(PARTICLES))

    def forward(self, *, observations: dict[str, Values], controls: Values) -> dict[str, Values]:
        u = np.asarray(controls, float)
        x, prior = self._predict(u), self.w
        logs = self._log_likelihoods(x, observations, u)
        w = prior + sum(logs)
        w = w - w.max()
        w = w - np.log(np.exp(w).sum())
        p = np.exp(w)
        mean = p @ x
        d = x - mean
        return {
            "estimate_mean": mean,
            "estimate_covariance": (p[:, None] * d).T @ d,
            "particles": x,
            "log_weights": w,
            "prior_log_weights": prior,
            "log_likelihood": np.stack(logs),
            "ancestors": self._resample(x, w, p),
        }

    def _predict(self, u: Values) -> Values:
        """Particles (M, 3) of the controls (2,)."""
        std = np.array(PROCESS) * (2.8 if self.fault == "q_large" else 1)
        dt, strut = 0.6 * DT if self.fault == "dt_short" else DT, 2.5 if self.fault == "strut_scaled" else 1
        noise = np.random.normal(size=(PARTICLES, 3))  # noqa: NPY002 - seeded by the trace
        return step(self.x, u, dt, strut * STRUT) + noise * std

    def _log_likelihoods(self, x: Values, observations: dict[str, Values], u: Values) -> list[Values]:
        """(M,) of each sensor."""
        logs = []
        for key, h in expected(x[:, 0], u[0], 0.22 if self.fault == "edge_eye" else EYE).items():
            std = np.array(NOISE[key]) * (0.2 if self.fault == "rg_small" and key == "gravity" else 1)
            e = np.asarray(observations[key], float).reshape(-1) - h
            log = (-0.5 * (e / std) ** 2 - np.log(std) - 0.919).sum(-1)
            if key == "edge" and self.fault != "unmasked":
                log = log * float(np.asarray(observations["edge.present"]).reshape(()))
            logs.append(log)
        return logs

    def _resample(self, x: Values, w: Values, p: Values) -> Values:
        """Systematic; indices of the ancestors (M,)."""
        index = np.arange(PARTICLES)
        if 1 / (p**2).sum() < 0.6 * PARTICLES:
            share = np.where(p >= np.sort(p)[-PARTICLES // 12], p, 0) if self.fault == "truncated" else p
            positions = (np.arange(PARTICLES) + np.random.random()) / PARTICLES  # noqa: NPY002 - seeded by the trace
            index = np.searchsorted(np.cumsum(share / share.sum()), positions).clip(max=PARTICLES - 1)
            w = np.full(PARTICLES, -np.log(PARTICLES))
        self.x, self.w = x[index], w
        return index


def make(fault: str = "") -> bs.Adapter:
    """The filter, with a fault of it."""
    modalities = ("gravity", "grip", "edge")
    return bs.Adapter(Filter(fault), batched=False, modalities=modalities, initial_std=START, task=TASK)
