"""Robotic lawn mower on a slope, with an extended Kalman filter in NumPy for one episode at a time.

State: east, north, heading, speed, and bias of the gyro, which reverts slowly to 0. Sensors: RTK receiver, whose
antenna is in front of the axle and which has a fix in bursts; compass; speeds of the left and the right wheel.
Controls, which are readings of the IMU: gyro, forward acceleration including gravity, and pitch.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import beliefscope as bs
from external_faults.fault import Fault, Values, masked_episode, wrap

DT = 0.25  # s
GRAVITY, ARM, TRACK, KEEP = 9.81, 0.45, 0.7, 0.98  # m/s2; m in front of the axle; m between the wheels; per step
TASK = bs.Task(
    name="mower",
    components=(
        bs.Component("east", "m"),
        bs.Component("north", "m"),
        bs.Component("heading", "rad", wraps=True),
        bs.Component("speed", "m/s"),
        bs.Component("bias", "rad/s"),
    ),
    observations={"rtk": (2,), "compass": (1,), "wheels": (2,)},
    modalities={"rtk": ("rtk",), "compass": ("compass",), "wheels": ("wheels",)},
    control_size=3,
    dt=DT,
    map_components=("east", "north"),
    map_half_width=3.0,
    warmup=10,
    covariates={"fix": bs.Covariate("boolean")},
    masks={"rtk": "fix"},
    channels={
        "rtk": (bs.Component("east", "m"), bs.Component("north", "m")),
        "compass": (bs.Component("heading", "rad", wraps=True),),
        "wheels": (bs.Component("left", "m/s"), bs.Component("right", "m/s")),
        "control": (
            bs.Component("gyro", "rad/s"),
            bs.Component("acceleration", "m/s2"),
            bs.Component("pitch", "rad"),
        ),
    },
)
SLIP, SKID, PUSH, WALK = 0.015, 0.12, 0.4, 0.02  # standard deviations: m per step; rad/s; m/s2; rad/s per step
PROCESS = (SLIP, SLIP, DT * SKID, DT * PUSH, WALK)  # standard deviations per step: m, m, rad, m/s, rad/s
NOISE = {"rtk": (0.06, 0.06), "compass": (0.12,), "wheels": (0.06, 0.06)}  # standard deviations: m, rad, m/s
START = (0.3, 0.3, 0.2, 0.2, 0.08)  # standard deviations of the first belief
FAULTS = {
    "gyro_reversed": Fault("data", "gyro x -1", r"control\.sign", "manankharwar/fusioncore#88"),
    "gyro_degrees": Fault(
        "data", "gyro in degrees per second", r"control\.scale", "septentrio-gnss/septentrio_gnss_driver#104"
    ),
    "gravity_sign": Fault(
        "filter", "gravity in the dynamics x -1", r"dynamics\.(inverted|broken)", "byu-magicc/roscopter#8"
    ),
    "jacobian_sign": Fault(
        "filter",
        "derivative of east by heading in the Jacobian of the dynamics x -1",
        r"dynamics\.jacobian",
        "cra-ros-pkg/robot_localization#591",
    ),
    "noise_without_dt": Fault(
        "filter",
        "process noise of heading and speed x 4, not multiplied by the time step",
        r"process_noise\.large",
        "motokimura/kalman_filter_with_kitti#7",
    ),
    "noise_discarded": Fault("filter", "process noise 0", r"process_noise\.small", "Pedro-Pathing/PedroPathing#162"),
    "lever_arm": Fault(
        "filter",
        "antenna on the axle, 0.45 m behind its place",
        r"measurement\.rtk\.(function|bias)",
        "Agroecology-Lab/feldfreund_devkit_ros#49",
    ),
    "accuracy_not_squared": Fault(
        "filter", "variance of the RTK receiver 0.06 m2", r"measurement_noise\.rtk\.large", "paparazzi/paparazzi#3661"
    ),
    "not_wrapped": Fault(
        "filter", "innovation of the compass not wrapped", r"innovation\.compass\.turns", "PX4/PX4-Autopilot#21287"
    ),
    "fused_again": Fault(
        "filter", "last fix used again where there is no new one", r"updates\.rtk\.absent", "PX4/PX4-ECL#767"
    ),
    "measured_only": Fault(  # also in a question to a forum
        "filter", "wheels correct the speed only", r"updates\.wheels\.gain", "openhumanoids/pronto#89"
    ),
    "covariance_kept": Fault(
        "filter",
        "updates do not change the covariance",
        r"updates\.covariance",
        "alirezaahmadi/KalmanFilter-Vehicle-GNSS-INS#2",
    ),
}


def step(x: Values, u: Values, gravity: float = GRAVITY) -> Values:
    """Next state (5,), with a heading that is not wrapped."""
    east, north, heading, speed, bias = x
    gyro, acceleration, pitch = u
    return np.array(
        [
            east + DT * speed * np.cos(heading),
            north + DT * speed * np.sin(heading),
            heading + DT * (gyro - bias),
            speed + DT * (acceleration - gravity * np.sin(pitch)),
            KEEP * bias,
        ]
    )


def simulate(seed: int, fault: str = "", steps: int = 130) -> bs.Episode:
    """An episode, with a fault of the data."""
    rng = np.random.default_rng(seed)
    place = [rng.uniform(-4, 4), rng.uniform(-4, 4), rng.uniform(-np.pi, np.pi)]
    x = np.array([*place, rng.uniform(0.3, 1.0), rng.normal(0, 0.1)])
    states, controls, fix = np.zeros((steps, 5)), np.zeros((steps, 3)), np.zeros(steps, bool)
    turn, goal, phase, left, on = 0.0, 0.8, rng.uniform(0, 6), 3, True
    for t in range(steps):
        if t % 11 == 0:
            turn = rng.uniform(-0.8, 0.8)
        if t % 17 == 0:
            goal = rng.uniform(0.2, 1.3)
        if left == 0:
            on, left = not on, rng.integers(3, 8 if on else 7)
        left -= 1
        pitch = 0.14 * np.sin(0.13 * t + phase)
        u = np.array([turn + x[4], 0.8 * (goal - x[3]) + GRAVITY * np.sin(pitch), pitch])
        x = step(x, u) + rng.normal(0, PROCESS)
        x[2] = wrap(x[2])
        states[t], controls[t], fix[t] = x, u, on
    east, north, heading, speed, bias = states.T
    antenna = np.stack([east + ARM * np.cos(heading), north + ARM * np.sin(heading)], 1)
    around = TRACK / 2 * (controls[:, 0] - bias)
    readings = {
        "rtk": antenna + rng.normal(0, NOISE["rtk"], (steps, 2)),
        "compass": wrap(states[:, 2:3] + rng.normal(0, NOISE["compass"], (steps, 1))),
        "wheels": np.stack([speed - around, speed + around], 1) + rng.normal(0, NOISE["wheels"], (steps, 2)),
    }
    if fault == "gyro_reversed":
        controls[:, 0] *= -1
    elif fault == "gyro_degrees":
        controls[:, 0] = np.degrees(controls[:, 0])
    return masked_episode(TASK, states, controls, readings, fix, seed)


class Filter:
    """Extended Kalman filter that updates with one sensor after the other."""

    task = TASK

    def __init__(self, fault: str = "") -> None:
        self.fault = fault

    def initialize_beliefs(self, *, mean: Values, covariance: Values) -> None:
        self.x, self.P = np.array(mean, float), np.array(covariance, float)

    def forward(self, *, observations: dict[str, Values], controls: Values) -> dict[str, Any]:
        u = np.asarray(controls, float)
        x, P = self._predict(u)
        means, covariances, innovations, spreads = [], [], [], []
        for key in NOISE:
            h, H, N = self._measurement(key, x, u[0])
            S, innovation = H @ P @ H.T + N, np.asarray(observations[key], float).reshape(-1) - h
            if key == "compass" and self.fault != "not_wrapped":
                innovation = wrap(innovation)
            seen = key != "rtk" or float(np.asarray(observations["rtk.present"]).reshape(())) > 0
            seen = seen or self.fault == "fused_again"
            means.append(x)
            covariances.append(P)
            innovations.append(innovation if seen else None)
            spreads.append(S if seen else None)
            if seen:
                K = P @ H.T @ np.linalg.inv(S)
                correction = K @ innovation
                if self.fault == "measured_only" and key == "wheels":
                    correction = correction * (0, 0, 0, 1, 0)
                x = x + correction
                x[2] = wrap(x[2])
                if self.fault != "covariance_kept":
                    A = np.eye(5) - K @ H
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

    def _predict(self, u: Values) -> tuple[Values, Values]:
        """Mean (5,) and covariance (5, 5) of the controls (3,)."""
        heading, speed = self.x[2:4]
        x = step(self.x, u, -GRAVITY if self.fault == "gravity_sign" else GRAVITY)
        x[2] = wrap(x[2])
        F = np.eye(5)
        F[0, 2], F[0, 3] = -DT * speed * np.sin(heading), DT * np.cos(heading)
        F[1, 2], F[1, 3] = DT * speed * np.cos(heading), DT * np.sin(heading)
        F[2, 4], F[4, 4] = -DT, KEEP
        if self.fault == "jacobian_sign":
            F[0, 2] *= -1
        std = (SLIP, SLIP, SKID, PUSH, WALK) if self.fault == "noise_without_dt" else PROCESS
        P = F @ self.P @ F.T
        return x, P if self.fault == "noise_discarded" else P + np.diag(std) ** 2

    def _measurement(self, key: str, x: Values, gyro: float) -> tuple[Values, Values, Values]:
        """Expected readings (C,), their Jacobian (C, 5) and covariance (C, C) of their noise."""
        H, N = np.zeros((len(NOISE[key]), 5)), np.diag(NOISE[key]) ** 2
        if key == "rtk":
            arm = 0.0 if self.fault == "lever_arm" else ARM
            c, s = np.cos(x[2]), np.sin(x[2])
            H[0, 0] = H[1, 1] = 1
            H[:, 2] = arm * np.array([-s, c])
            return x[:2] + arm * np.array([c, s]), H, np.diag(NOISE[key]) if self.fault == "accuracy_not_squared" else N
        if key == "compass":
            H[0, 2] = 1
            return x[2:3], H, N
        around = TRACK / 2 * (gyro - x[4])
        H[:, 3], H[:, 4] = 1, (TRACK / 2, -TRACK / 2)
        return np.array([x[3] - around, x[3] + around]), H, N


def make(fault: str = "") -> bs.Adapter:
    """The filter, with a fault of it."""
    modalities = ("rtk", "compass", "wheels")
    return bs.Adapter(Filter(fault), batched=False, modalities=modalities, initial_std=START, task=TASK)
