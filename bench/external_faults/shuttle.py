"""Transport robot in a hall with five walls, with a particle filter in NumPy for one episode at a time.

State: east, north, heading, and slip of the wheels, a relative error of the odometry that reverts slowly to 0.
Sensors: laser with three beams (distances to the walls), which people block in bursts; distance to a radio anchor;
compass. Controls, which are the odometry: speed, also backwards, and yaw rate.
"""

from __future__ import annotations

import numpy as np

import beliefscope as bs
from external_faults.fault import Fault, Values, delay, masked_episode, wrap

DT = 0.5  # s
PARTICLES = 1500
KEEP = 0.97  # of the slip, per step
BEAMS = (0.0, 1.4, -1.4)  # rad from the heading
ANCHOR = (11.5, 0.5)  # m
WALLS = ((-1, 0, 0.0), (0, -1, 0.0), (1, 0, 12.0), (0, 1, 8.0), (0.6, 0.8, 11.6))  # outward normal, distance in m
TASK = bs.Task(
    name="shuttle",
    components=(
        bs.Component("east", "m"),
        bs.Component("north", "m"),
        bs.Component("heading", "rad", wraps=True),
        bs.Component("slip", "1"),
    ),
    observations={"laser": (3,), "radio": (1,), "compass": (1,)},
    modalities={"laser": ("laser",), "radio": ("radio",), "compass": ("compass",)},
    control_size=2,
    dt=DT,
    map_components=("east", "north"),
    map_half_width=3.0,
    warmup=10,
    covariates={"free": bs.Covariate("boolean")},
    masks={"laser": "free"},
    channels={
        "laser": (bs.Component("ahead", "m"), bs.Component("left", "m"), bs.Component("right", "m")),
        "radio": (bs.Component("distance", "m"),),
        "compass": (bs.Component("heading", "rad", wraps=True),),
        "control": (bs.Component("speed", "m/s"), bs.Component("yaw_rate", "rad/s")),
    },
)
PROCESS = (0.05, 0.05, 0.05, 0.03)  # standard deviations per step: m, m, rad, 1
NOISE = {"laser": (0.2, 0.2, 0.2), "radio": (0.25,), "compass": (0.12,)}  # standard deviations: m, m, rad
START = (0.3, 0.3, 0.15, 0.1)  # standard deviations of the first belief
FAULTS = {
    "scan_mirrored": Fault("data", "left and right beam exchanged", r"laser\.axes", "NaokiAkai/als_ros#4"),
    "radio_late": Fault("data", "radio delayed by 3 steps", r"radio\.delay", "labust/labust-ros-pkg#32"),
    "variance_as_std": Fault(
        "filter",
        "variance of the process noise used as its standard deviation",
        r"process_noise\.small",
        "ros-planning/navigation#20",
    ),
    "new_heading": Fault(
        "filter",
        "dynamics move along the heading after the turn",
        r"dynamics\.(broken|bias)",
        "AntoBrandi/Self-Driving-and-ROS-2-Learn-by-Doing-Map-Localization#2",
    ),
    "backwards": Fault(
        "filter", "dynamics move forward only", r"dynamics\.(broken|inverted)", "ros-planning/navigation#746"
    ),
    "map_origin": Fault(
        "filter", "walls shifted by 0.3 m", r"measurement\.laser\.(function|bias)", "turtlebot/turtlebot_simulator#42"
    ),
    "scan_ignored": Fault("filter", "weights without the laser", r"weights\.ignores_likelihood", "midemig/gps_amcl#3"),
    "weights_refilled": Fault(  # weights.lost was added to the causes after the first diagnosis
        "filter",
        "equal weights before each update, also without resampling",
        r"resampling\.biased|weights\.lost",
        "rlabbe/Kalman-and-Bayesian-Filters-in-Python#245",
    ),
    "weights_kept": Fault(
        "filter",
        "weights kept after resampling",
        r"resampling\.off",
        "rlabbe/Kalman-and-Bayesian-Filters-in-Python#146",
    ),
    "not_normalised": Fault(
        "filter",
        "resampling by weights that are not normalised",
        r"resampling\.biased|particles\.deprived",
        "uhobeike/ike_nav#16",
    ),
    "weights_not_stored": Fault(
        "filter", "estimate of the weights before the update", r"estimate\.mean", "ksakmann/Particle-Filter#1"
    ),
    "not_wrapped": Fault(
        "filter",
        "innovation of the compass not wrapped",
        r"innovation\.compass\.turns",
        "bitcraze/crazyflie-firmware#1292",
    ),
}


def ranges(x: Values) -> Values:
    """Distances (..., 3) to the nearest wall in the directions of the beams; x: (..., 4)."""
    distances = []
    for beam in BEAMS:
        c, s = np.cos(x[..., 2] + beam), np.sin(x[..., 2] + beam)
        along = []
        for east, north, distance in WALLS:
            closing = east * c + north * s
            to_wall = (distance - east * x[..., 0] - north * x[..., 1]) / np.maximum(closing, 1e-6)
            along.append(np.where(closing > 1e-6, to_wall, np.inf))
        distances.append(np.min(along, 0))
    return np.stack(distances, -1)


def expected(x: Values) -> dict[str, Values]:
    """Readings (..., C) without noise."""
    distance = np.hypot(x[..., 0] - ANCHOR[0], x[..., 1] - ANCHOR[1])
    return {"laser": ranges(x), "radio": distance[..., None], "compass": wrap(x[..., 2:3])}


def step(x: Values, u: Values, fault: str = "") -> Values:
    """Next states (..., 4), with headings that are not wrapped."""
    speed, turn = abs(u[0]) if fault == "backwards" else u[0], DT * u[1]
    course = x[..., 2] + turn if fault == "new_heading" else x[..., 2]
    d = DT * speed * (1 + x[..., 3])
    moved = [x[..., 0] + d * np.cos(course), x[..., 1] + d * np.sin(course)]
    return np.stack([*moved, x[..., 2] + turn, KEEP * x[..., 3]], -1)


def simulate(seed: int, fault: str = "", steps: int = 120) -> bs.Episode:
    """An episode, with a fault of the data."""
    rng = np.random.default_rng(seed)
    x = np.array([rng.uniform(3, 9), rng.uniform(2, 6), rng.uniform(-np.pi, np.pi), rng.normal(0, 0.1)])
    states, controls, free = np.zeros((steps, 4)), np.zeros((steps, 2)), np.zeros(steps, bool)
    goal, speed, back, left, on = np.array([6.0, 4.0]), 0.0, 0, 3, True
    for t in range(steps):
        if t % 9 == 0:
            goal, speed = np.array([rng.uniform(1.5, 10.0), rng.uniform(1.5, 6.0)]), rng.uniform(0.4, 1.2)
        if t % 23 == 15:
            back = 7
        if left == 0:
            on, left = not on, rng.integers(3, 7) if on else rng.integers(4, 8)
        left -= 1
        east, north = goal - x[:2]
        u = np.array([speed, np.clip(wrap(np.arctan2(north, east) - x[2]), -0.9, 0.9)])
        if back:
            back, u = back - 1, np.array([-0.6, 0.3 * u[1]])
        new = step(x, u) + rng.normal(0, PROCESS)
        if min(distance - east * new[0] - north * new[1] for east, north, distance in WALLS) < 0.4:
            u[0] = 0  # stops before a wall
            new = step(x, u) + rng.normal(0, PROCESS)
            new[:2] = np.clip(new[:2], 0.2, (11.8, 7.8))
        x = new
        x[2] = wrap(x[2])
        states[t], controls[t], free[t] = x, u, on
    readings = {key: h + rng.normal(0, NOISE[key], h.shape) for key, h in expected(states).items()}
    readings["compass"] = wrap(readings["compass"])
    if fault == "scan_mirrored":
        readings["laser"] = readings["laser"][:, [0, 2, 1]]
    elif fault == "radio_late":
        readings["radio"] = delay(readings["radio"], 3)
    return masked_episode(TASK, states, controls, readings, free, seed)


def offsets(x: Values, centre: Values) -> Values:
    """States (M, 4) less the centre (4,), with wrapped differences of heading."""
    d = x - centre
    d[:, 2] = wrap(d[:, 2])
    return d


class Filter:
    """Particle filter that resamples at the end of a step, if the effective sample size is below 15 %."""

    task = TASK

    def __init__(self, fault: str = "") -> None:
        self.fault = fault

    def initialize_beliefs(self, *, mean: Values, covariance: Values) -> None:
        root = np.linalg.cholesky(np.asarray(covariance, float))
        self.x = np.asarray(mean, float) + np.random.normal(size=(PARTICLES, 4)) @ root.T  # noqa: NPY002 - seeded by the trace
        self.w = np.full(PARTICLES, -np.log(PARTICLES))

    def forward(self, *, observations: dict[str, Values], controls: Values) -> dict[str, Values]:
        x = self._predict(np.asarray(controls, float))
        prior = np.full(PARTICLES, -np.log(PARTICLES)) if self.fault == "weights_refilled" else self.w
        logs = self._log_likelihoods(x, observations)
        w = prior + sum(logs[1:] if self.fault == "scan_ignored" else logs)
        w = w - w.max()
        total = np.exp(w).sum()
        w = w - np.log(total)
        p = np.exp(w)
        weights = np.exp(prior) if self.fault == "weights_not_stored" else p
        centre = x[weights.argmax()]
        mean = centre + weights @ offsets(x, centre)
        d = offsets(x, mean)
        mean[2] = wrap(mean[2])
        return {
            "estimate_mean": mean,
            "estimate_covariance": (weights[:, None] * d).T @ d,
            "particles": x,
            "log_weights": w,
            "prior_log_weights": prior,
            "log_likelihood": np.stack(logs),
            "ancestors": self._resample(x, w, p, p * total if self.fault == "not_normalised" else p),
        }

    def _predict(self, u: Values) -> Values:
        """Particles (M, 4) of the controls (2,)."""
        std = np.array(PROCESS) ** (2 if self.fault == "variance_as_std" else 1)
        x = step(self.x, u, self.fault) + np.random.normal(size=(PARTICLES, 4)) * std  # noqa: NPY002 - seeded by the trace
        x[:, 2] = wrap(x[:, 2])
        return x

    def _log_likelihoods(self, x: Values, observations: dict[str, Values]) -> list[Values]:
        """(M,) of each sensor, the laser first."""
        logs, readings = [], expected(x)
        if self.fault == "map_origin":
            readings["laser"] = ranges(x + np.array([0.3, 0, 0, 0]))
        for key, h in readings.items():
            std = np.array(NOISE[key])
            e = np.asarray(observations[key], float).reshape(-1) - h
            if key == "compass" and self.fault != "not_wrapped":
                e = wrap(e)
            log = (-0.5 * (e / std) ** 2 - np.log(std) - 0.919).sum(-1)
            if key == "laser":
                log = log * float(np.asarray(observations["laser.present"]).reshape(()))
            logs.append(log)
        return logs

    def _resample(self, x: Values, w: Values, p: Values, share: Values) -> Values:
        """Systematic, by the share of each particle; indices of the ancestors (M,)."""
        index = np.arange(PARTICLES)
        if 1 / (p**2).sum() < 0.15 * PARTICLES:
            positions = (np.arange(PARTICLES) + np.random.random()) / PARTICLES  # noqa: NPY002 - seeded by the trace
            index = np.searchsorted(np.cumsum(share), positions).clip(max=PARTICLES - 1)
            kept = self.fault == "weights_kept"
            w = w[index] - np.log(p[index].sum()) if kept else np.full(PARTICLES, -np.log(PARTICLES))
        self.x, self.w = x[index], w
        return index


def make(fault: str = "") -> bs.Adapter:
    """The filter, with a fault of it."""
    modalities = ("laser", "radio", "compass")
    return bs.Adapter(Filter(fault), batched=False, modalities=modalities, initial_std=START, task=TASK)
