"""Electric kiln, with an extended Kalman filter in NumPy for one episode at a time.

State: temperatures of the heating element, chamber and load, and leak, an unknown heat flow (random walk). Sensors:
thermocouples in chamber and load; ammeter, which depends on the power and on the resistance of the element; pyrometer
(4th power of the load's temperature) where the viewport is open, a third of the steps at random. Controls: power and
damper.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import beliefscope as bs
from external_faults.fault import Fault, Values, masked_episode

DT = 0.5  # min
HEAT, WIRE, AIR_LOAD, AIR_WIRE = 160.0, 0.25, 0.1, 0.12  # K/min at full power; 1/min
LOSS, DAMPER, ROOM = 0.03, 0.06, 25.0  # 1/min; 1/min with the damper open; degrees Celsius
GLOW, ALPHA, AMPERE, SIGMA = 1.5, 0.0016, 30.0, 20.0  # K/min and W per (1000 K)^4: first, last; 1/K; A
TASK = bs.Task(
    name="kiln",
    components=(
        bs.Component("element", "K"),
        bs.Component("chamber", "K"),
        bs.Component("load", "K"),
        bs.Component("leak", "K/min"),
    ),
    observations={"probes": (2,), "ammeter": (1,), "pyrometer": (1,)},
    modalities={"probes": ("probes",), "ammeter": ("ammeter",), "pyrometer": ("pyrometer",)},
    control_size=2,
    dt=DT,
    map_components=("chamber", "load"),
    map_half_width=20.0,
    warmup=10,
    covariates={"open": bs.Covariate("boolean")},
    masks={"pyrometer": "open"},
    channels={
        "probes": (bs.Component("chamber", "K"), bs.Component("load", "K")),
        "ammeter": (bs.Component("current", "A"),),
        "pyrometer": (bs.Component("radiance", "W"),),
        "control": (bs.Component("power", "1"), bs.Component("damper", "1")),
    },
)
PROCESS = (3.0, 1.5, 1.0, 0.35)  # standard deviations per step: K, K, K, K/min
NOISE = {"probes": (3.0, 4.0), "ammeter": (0.25,), "pyrometer": (0.03,)}  # standard deviations: K, A, W
START = (12.0, 4.0, 4.0, 1.5)  # standard deviations of the first belief
FAULTS = {
    "chamber_offset": Fault("data", "chamber probe biased by +9 K", r"probes\.bias"),
    "probes_swapped": Fault("data", "probes exchanged", r"probes\.axes"),
    "pyrometer_noise": Fault("data", "noise of the pyrometer x 4.1", r"pyrometer\.noise"),
    "ammeter_scale": Fault("data", "gain of the ammeter x 0.9", r"ammeter\.gain"),
    "controls_swapped": Fault("data", "power and damper exchanged", r"control\.axes"),
    "damper_sign": Fault("filter", "damper in the dynamics x -1", r"dynamics\.(inverted|broken)"),
    "dt_short": Fault("filter", "time step of the dynamics x 0.72", r"dynamics\.frozen"),
    "q_small": Fault("filter", "process noise x 0.15", r"process_noise\.small"),
    "alpha": Fault("filter", "temperature coefficient 0.0021 1/K", r"measurement\.ammeter\.(function|bias)"),
    "rp_small": Fault("filter", "noise of the pyrometer x 0.2", r"measurement_noise\.pyrometer\.small"),
    "pyrometer_jacobian": Fault("filter", "Jacobian of the pyrometer x 4", r"measurement\.pyrometer\.jacobian"),
    "probes_gain": Fault("filter", "gain of updates with the probes x 0.25", r"updates\.probes\.gain"),
}


def glow(celsius: Any) -> Any:
    """Radiation: 4th power of the temperature in 1000 K."""
    return ((celsius + 273.15) / 1000) ** 4


def step(x: Values, power: float, damper: float, dt: float = DT) -> Values:
    """Next state (4,)."""
    wire, air, load, leak = x
    warming = HEAT * power - WIRE * (wire - air) - 40 * GLOW * (glow(wire) - glow(load))
    flow = AIR_WIRE * (wire - air) - AIR_LOAD * (air - load) - (LOSS + DAMPER * damper) * (air - ROOM) + leak
    heating = AIR_LOAD * (air - load) + 12 * GLOW * (glow(wire) - glow(load))
    return np.array([wire + dt * warming, air + dt * flow, load + dt * heating, 0.98 * leak])


def jacobian(x: Values, damper: float, dt: float = DT) -> Values:
    """Derivative of ``step`` (4, 4)."""
    wire, load = (4 * ((x[k] + 273.15) / 1000) ** 3 / 1000 for k in (0, 2))
    return np.array(
        [
            [1 - dt * (WIRE + 40 * GLOW * wire), dt * WIRE, dt * 40 * GLOW * load, 0],
            [dt * AIR_WIRE, 1 - dt * (AIR_WIRE + AIR_LOAD + LOSS + DAMPER * damper), dt * AIR_LOAD, dt],
            [dt * 12 * GLOW * wire, dt * AIR_LOAD, 1 - dt * (AIR_LOAD + 12 * GLOW * load), 0],
            [0, 0, 0, 0.98],
        ]
    )


def current(wire: Any, power: Any, alpha: float = ALPHA) -> Any:
    """Current of the element, A."""
    return AMPERE * power / (1 + alpha * (wire - 20))


def simulate(seed: int, fault: str = "", steps: int = 140) -> bs.Episode:
    """An episode, with a fault of the data."""
    rng = np.random.default_rng(seed)
    load = rng.uniform(260, 420)
    x = np.array([load + rng.uniform(40, 140), load + rng.normal(0, 15), load, rng.normal(0, 1.5)])
    states, controls = np.zeros((steps, 4)), np.zeros((steps, 2))
    goal, power, damper = 0.0, 0.5, 0.3
    for t in range(steps):
        if t % 11 == 0:
            goal = rng.uniform(0.1, 1.0) + (380 - x[2]) / 400
        if t % 17 == 0:
            damper = rng.uniform(0, 1)
        power += 0.4 * (np.clip(goal, 0.1, 1) - power)
        u = np.array([np.clip(power + 0.05 * np.sin(0.8 * t), 0.05, 1), damper])
        x = step(x, *u) + rng.normal(0, PROCESS)
        states[t], controls[t] = x, u
    readings = {
        "probes": states[:, 1:3] + rng.normal(0, NOISE["probes"], (steps, 2)),
        "ammeter": current(states[:, :1], controls[:, :1]) + rng.normal(0, NOISE["ammeter"], (steps, 1)),
        "pyrometer": SIGMA * glow(states[:, 2:3]) / 2 + rng.normal(0, NOISE["pyrometer"], (steps, 1)),
    }
    seen = rng.random(steps) < 1 / 3
    seen[0] = True
    if fault == "chamber_offset":
        readings["probes"][:, 0] += 9.0
    elif fault == "probes_swapped":
        readings["probes"] = readings["probes"][:, ::-1].copy()
    elif fault == "pyrometer_noise":
        readings["pyrometer"] += rng.normal(0, 0.12, (steps, 1))
    elif fault == "ammeter_scale":
        readings["ammeter"] *= 0.9
    elif fault == "controls_swapped":
        controls = controls[:, ::-1].copy()
    return masked_episode(TASK, states, controls, readings, seen, seed)


class Filter:
    """Extended Kalman filter that updates with one sensor after the other."""

    task = TASK

    def __init__(self, fault: str = "") -> None:
        self.fault = fault

    def initialize_beliefs(self, *, mean: Values, covariance: Values) -> None:
        self.x, self.P = np.array(mean, float), np.array(covariance, float)

    def forward(self, *, observations: dict[str, Values], controls: Values) -> dict[str, Any]:
        power, damper = np.asarray(controls, float)
        dt = 0.72 * DT if self.fault == "dt_short" else DT
        if self.fault == "damper_sign":
            damper = -damper
        F = jacobian(self.x, damper, dt)
        x = step(self.x, power, damper, dt)
        P = F @ self.P @ F.T + np.diag(PROCESS) ** 2 * (0.15**2 if self.fault == "q_small" else 1)
        means, covariances, innovations, spreads = [], [], [], []
        for key in NOISE:
            h, H, std = self._measurement(key, x, power)
            N = np.diag(std**2)
            S, innovation = H @ P @ H.T + N, np.asarray(observations[key], float).reshape(-1) - h
            seen = key != "pyrometer" or float(np.asarray(observations["pyrometer.present"]).reshape(())) > 0
            means.append(x)
            covariances.append(P)
            innovations.append(innovation if seen else None)
            spreads.append(S if seen else None)
            if seen:
                K = P @ H.T @ np.linalg.inv(S)
                x = x + (0.25 if self.fault == "probes_gain" and key == "probes" else 1) * K @ innovation
                A = np.eye(4) - K @ H
                P = A @ P @ A.T + K @ N @ K.T
        self.x, self.P = x, P
        return {
            "estimate_mean": x,
            "estimate_covariance": P,
            "predicted_mean": np.stack(means),
            "predicted_covariance": np.stack(covariances),
            "innovation": innovations,
            "innovation_covariance": spreads,
        }

    def _measurement(self, key: str, x: Values, power: float) -> tuple[Values, Values, Values]:
        """Expected readings (C,), their Jacobian (C, 4) and standard deviations (C,)."""
        std = np.array(NOISE[key])
        if key == "probes":
            return x[1:3], np.eye(4)[1:3], std
        if key == "ammeter":
            alpha = 0.0021 if self.fault == "alpha" else ALPHA
            h = np.array([current(x[0], power, alpha)])
            return h, np.array([[-h[0] * alpha / (1 + alpha * (x[0] - 20)), 0, 0, 0]]), std
        H = np.array([[0, 0, 2 * SIGMA * ((x[2] + 273.15) / 1000) ** 3 / 1000, 0]])
        if self.fault == "pyrometer_jacobian":
            H = 4 * H
        if self.fault == "rp_small":
            std = 0.2 * std
        return np.array([SIGMA * glow(x[2]) / 2]), H, std


def make(fault: str = "") -> bs.Adapter:
    """The filter, with a fault of it."""
    modalities = ("probes", "ammeter", "pyrometer")
    return bs.Adapter(Filter(fault), batched=False, modalities=modalities, initial_std=START, task=TASK)
