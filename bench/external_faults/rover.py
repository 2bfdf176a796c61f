"""Skid-steer rover with an unscented Kalman filter in NumPy for one episode at a time.

State: east, north, heading, speed, turn rate, and slip of the wheels, which reverts slowly to 0. Sensors: range and
bearing of a beacon, seen in bursts; magnetometer; speeds of the left and the right wheel. Controls: commanded speed and
turn rate.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import beliefscope as bs
from external_faults.fault import Fault, Values, delay, masked_episode, wrap

DT = 0.2  # s
PLACE = np.array([3.0, -2.0])  # of the beacon, m
TRACK, FAST, QUICK, KEEP = 0.8, 0.8, 1.5, 0.98  # m; 1/s; 1/s; per step
TASK = bs.Task(
    name="rover",
    components=(
        bs.Component("east", "m"),
        bs.Component("north", "m"),
        bs.Component("heading", "rad", wraps=True),
        bs.Component("speed", "m/s"),
        bs.Component("rate", "rad/s"),
        bs.Component("slip", "1"),
    ),
    observations={"beacon": (2,), "magnet": (1,), "encoders": (2,)},
    modalities={"beacon": ("beacon",), "magnet": ("magnet",), "encoders": ("encoders",)},
    control_size=2,
    dt=DT,
    map_components=("east", "north"),
    map_half_width=3.0,
    warmup=10,
    covariates={"seen": bs.Covariate("boolean")},
    masks={"beacon": "seen"},
    channels={
        "beacon": (bs.Component("range", "m"), bs.Component("bearing", "rad", wraps=True)),
        "magnet": (bs.Component("heading", "rad", wraps=True),),
        "encoders": (bs.Component("left", "m/s"), bs.Component("right", "m/s")),
        "control": (bs.Component("speed", "m/s"), bs.Component("rate", "rad/s")),
    },
)
PROCESS = np.array([0.015, 0.015, 0.02, 0.05, 0.08, 0.012])  # standard deviations per step
NOISE = {"beacon": (0.08, 0.06), "magnet": (0.1,), "encoders": (0.04, 0.04)}  # m, rad; rad; m/s
ANGLES = {"state": (2,), "beacon": (1,), "magnet": (0,), "encoders": ()}
START = (0.3, 0.3, 0.2, 0.2, 0.2, 0.06)  # standard deviations of the first belief
N, ALPHA, BETA = 6, 0.8, 2.0
SPREAD = N * ALPHA**2  # n + lambda, kappa = 0
WM = np.array([1 - N / SPREAD, *[0.5 / SPREAD] * (2 * N)])
WC = WM + np.array([1 - ALPHA**2 + BETA, *[0.0] * (2 * N)])
FAULTS = {
    "beacon_delay": Fault("data", "beacon delayed by 8 steps", r"beacon\.delay"),
    "right_gain": Fault("data", "right encoder x 0.85, in the episodes with an even seed", r"encoders\.gain"),
    "magnet_bias": Fault("data", "magnetometer +0.35 rad from step 40", r"magnet\.bias"),
    "arithmetic_mean": Fault(
        "filter",
        "arithmetic mean of the angles of the sigma points, of the state and of the readings",
        r"innovation\.(magnet|beacon)\.turns|dynamics\.broken",
    ),
    "r_missing": Fault("filter", "R of the beacon not added to S", r"measurement_noise\.beacon\.small"),
    "spread": Fault(
        "filter",
        "sigma points of alpha 0.65 with the weights of alpha 0.8",
        r"updates\.(covariance|\w+\.gain)|covariance\.small",
    ),
    "cross_sign": Fault("filter", "cross-covariance of state and magnetometer x -1", r"updates\.(sign|magnet\.gain)"),
    "track": Fault(
        "filter", "track 1.1 m in the expected speeds of the wheels", r"measurement\.encoders\.(function|bias)"
    ),
}


def step(x: Values, u: Values) -> Values:
    """Next states (..., 6), with headings that are not wrapped."""
    east, north, heading, speed, rate, slip = np.moveaxis(x, -1, 0)
    middle = heading + 0.5 * DT * rate
    return np.stack(
        [
            east + DT * speed * np.cos(middle),
            north + DT * speed * np.sin(middle),
            heading + DT * rate,
            speed + DT * FAST * (u[0] - speed),
            rate + DT * QUICK * (u[1] - rate),
            KEEP * slip,
        ],
        -1,
    )


def readings_of(key: str, x: Values, track: float = TRACK) -> Values:
    """Expected readings (..., C) of the states (..., 6)."""
    if key == "beacon":
        d = PLACE - x[..., :2]
        bearing = np.arctan2(d[..., 1], d[..., 0]) - x[..., 2]
        return np.stack([np.hypot(d[..., 0], d[..., 1]), wrap(bearing)], -1)
    if key == "magnet":
        return wrap(x[..., 2:3])
    around = 0.5 * track * x[..., 4]
    return np.stack([x[..., 3] - around, x[..., 3] + around], -1) * (1 + x[..., 5:6])


def simulate(seed: int, fault: str = "", steps: int = 120) -> bs.Episode:
    """An episode, with a fault of the data."""
    rng = np.random.default_rng(seed)
    angle, distance = rng.uniform(-np.pi, np.pi), rng.uniform(4, 8)
    place = PLACE + distance * np.array([np.cos(angle), np.sin(angle)])
    x = np.array([*place, rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 1.0), 0.0, rng.normal(0, 0.06)])
    states, controls, seen = np.zeros((steps, 6)), np.zeros((steps, 2)), np.zeros(steps, bool)
    u, left, on = np.zeros(2), 5, True
    for t in range(steps):
        if t % 14 == 0:
            u = np.array([rng.uniform(0.3, 1.3), rng.uniform(-0.9, 0.9)])
        if left == 0:
            on, left = not on, rng.integers(4, 10)
        left -= 1
        x = step(x, u) + rng.normal(0, PROCESS)
        x[2] = wrap(x[2])
        states[t], controls[t], seen[t] = x, u, on
    readings = {key: readings_of(key, states) + rng.normal(0, NOISE[key], (steps, len(NOISE[key]))) for key in NOISE}
    if fault == "beacon_delay":
        readings["beacon"] = delay(readings["beacon"], 8)
    elif fault == "right_gain" and seed % 2 == 0:
        readings["encoders"][:, 1] *= 0.85
    elif fault == "magnet_bias":
        readings["magnet"][40:] += 0.35
    readings["beacon"][:, 1] = wrap(readings["beacon"][:, 1])
    readings["magnet"] = wrap(readings["magnet"])
    return masked_episode(TASK, states, controls, readings, seen, seed)


class Filter:
    """Unscented Kalman filter with additive noise that updates with one sensor after the other."""

    task = TASK

    def __init__(self, fault: str = "") -> None:
        self.fault = fault

    def initialize_beliefs(self, *, mean: Values, covariance: Values) -> None:
        self.x, self.P = np.array(mean, float), np.array(covariance, float)

    def forward(self, *, observations: dict[str, Values], controls: Values) -> dict[str, Any]:
        moved = step(self._points(self.x, self.P), np.asarray(controls, float))
        moved[:, 2] = wrap(moved[:, 2])
        x = self._mean(moved, ANGLES["state"])
        d = self._differences(moved, x, ANGLES["state"])
        P = d.T @ (WC[:, None] * d) + np.diag(PROCESS**2)
        means, covariances, innovations, spreads = [], [], [], []
        for key in NOISE:
            means.append(x)
            covariances.append(P)
            present = key != "beacon" or float(np.asarray(observations["beacon.present"]).reshape(())) > 0
            if not present:
                innovations.append(None)
                spreads.append(None)
                continue
            angles = ANGLES[key]
            points = self._points(x, P)
            expected = readings_of(key, points, 1.1 if self.fault == "track" else TRACK)
            z = self._mean(expected, angles)
            dz = self._differences(expected, z, angles)
            S = dz.T @ (WC[:, None] * dz)
            if not (self.fault == "r_missing" and key == "beacon"):
                S = S + np.diag(NOISE[key]) ** 2
            cross = self._differences(points, x, ANGLES["state"]).T @ (WC[:, None] * dz)
            if self.fault == "cross_sign" and key == "magnet":
                cross = -cross
            K = np.linalg.solve(S, cross.T).T
            innovation = self._differences(np.asarray(observations[key], float).reshape(1, -1), z, angles)[0]
            x = x + K @ innovation
            x[2] = wrap(x[2])
            P = P - K @ S @ K.T
            P = 0.5 * (P + P.T)
            innovations.append(innovation)
            spreads.append(S)
        self.x, self.P = x, P
        return {
            "estimate_mean": x,
            "estimate_covariance": P,
            "predicted_mean": np.stack(means),
            "predicted_covariance": np.stack(covariances),
            "innovation": innovations,
            "innovation_covariance": spreads,
        }

    def _points(self, x: Values, P: Values) -> Values:
        """Sigma points (13, 6)."""
        scale = N * 0.65**2 if self.fault == "spread" else SPREAD
        root = np.linalg.cholesky(scale * (P + 1e-10 * np.eye(N))).T
        points = x + np.concatenate([np.zeros((1, N)), root, -root])
        points[:, 2] = wrap(points[:, 2])
        return points

    def _mean(self, values: Values, angles: tuple[int, ...]) -> Values:
        """Weighted mean (C,) of the sigma points (13, C)."""
        mean = WM @ values
        if self.fault != "arithmetic_mean":
            for i in angles:
                mean[i] = np.arctan2(WM @ np.sin(values[:, i]), WM @ np.cos(values[:, i]))
        return mean

    @staticmethod
    def _differences(values: Values, mean: Values, angles: tuple[int, ...]) -> Values:
        """(..., C), with wrapped differences of angles."""
        d = values - mean
        for i in angles:
            d[..., i] = wrap(d[..., i])
        return d


def make(fault: str = "") -> bs.Adapter:
    """The filter, with a fault of it."""
    modalities = ("beacon", "magnet", "encoders")
    return bs.Adapter(Filter(fault), batched=False, modalities=modalities, initial_std=START, task=TASK)
