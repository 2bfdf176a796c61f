"""Ball on a tray that a robot tilts, with a trained extended Kalman filter that has two learned virtual sensors.

State: position and velocity of the ball in the plane of the tray. Sensors: an RGB camera above, with a CNN that
gives the position and its variance; the wrench at the wrist (force along the normal, two torques), with an MLP that
does the same. The wrench is that of the ball while the hand holds the tray alone (contact), and noise otherwise. In
parts of some episodes the image is dark or a bar covers it. The mass of the ball differs between episodes. Controls:
two tilts. The virtual measurements are fused by a product of experts. ``train.py`` has trained the weights.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

import beliefscope as bs
from external_faults.fault import Fault, Values, delay, stored

DT = 0.05  # s
SIZE, VIEW = 24, 0.17  # pixels; m, half of the image
RIM, STIFF, DRAG, QUADRATIC = 0.12, 60.0, 0.3, 1.5  # m; 1/s2; 1/s; 1/m
ROLL = 5 / 7 * 9.81  # m/s2, of a solid ball
PROCESS = (0.0006, 0.0006, 0.018, 0.018)  # standard deviations per step: m, m, m/s, m/s
WRENCH = (0.06, 0.004, 0.004)  # standard deviations: N, N m, N m
START = (0.01, 0.01, 0.05, 0.05)  # standard deviations of the first belief
WEIGHTS = Path(__file__).with_name("tray.safetensors")
TASK = bs.Task(
    name="tray",
    components=(
        bs.Component("x", "m"),
        bs.Component("y", "m"),
        bs.Component("vx", "m/s"),
        bs.Component("vy", "m/s"),
    ),
    observations={"camera": (SIZE, SIZE, 3), "wrench": (3,)},
    modalities={"vision": ("camera",), "haptics": ("wrench",)},
    control_size=2,
    dt=DT,
    map_components=("x", "y"),
    map_half_width=0.05,
    warmup=10,
    covariates={"contact": bs.Covariate("boolean")},
    channels={
        "wrench": (bs.Component("normal force", "N"), bs.Component("torque x", "N m"), bs.Component("torque y", "N m")),
        "control": (bs.Component("tilt x", "rad"), bs.Component("tilt y", "rad")),
    },
)
FAULTS = {
    "camera_moved": Fault("data", "camera moved by 1 pixel", r"camera\.shift"),
    "underexposed": Fault("data", "exposure x 0.45", r"camera\.exposure"),
    "torques_swapped": Fault("data", "torques about x and y exchanged", r"wrench\.axes"),
    "torque_bias": Fault("data", "torque about x biased by 0.03 N m", r"wrench\.bias"),
    "tilt_late": Fault("data", "tilts delayed by 4 steps", r"control\.delay"),
    "channels_reversed": Fault(
        "filter",
        "image in BGR instead of RGB",
        r"model\.vision\.broken|measurement\.vision\.(function|bias)|measurement_noise\.vision\.large",
    ),
    "dropout_on": Fault(  # undone, with a warning: external filters run in evaluation mode
        "filter",
        "dropout of the vision head left on",
        r"model\.vision\.(overconfident|broken)|measurement_noise\.vision\.small",
    ),
    "logvar_as_logstd": Fault(
        "filter",
        "log variance of the haptics head used as log standard deviation",
        r"model\.haptics\.overconfident|measurement_noise\.haptics\.small",
    ),
    "covariances_added": Fault(
        "filter",
        "product of experts with the sum of the covariances",
        r"fusion\.miscalibrated|updates\.(vision|haptics)\.gain",
    ),
    "other_dt": Fault("filter", "dynamics with dt 0.04 instead of 0.05 s", r"dynamics\.(frozen|broken)"),
}


def acceleration(x: Any, u: Any, lib: Any) -> Any:
    """Acceleration (..., 2) of the ball without the quadratic drag. lib: numpy or torch."""
    p, v = x[..., :2], x[..., 2:]
    beyond = p - lib.clip(p, -RIM, RIM)
    return ROLL * lib.sin(u) - DRAG * v - STIFF * beyond


def advance(x: Any, a: Any, lib: Any, dt: float = DT) -> Any:
    """Next states (..., 4) of the accelerations (..., 2). lib: numpy or torch."""
    v = x[..., 2:] + dt * a
    return lib.concatenate([x[..., :2] + dt * v, v], -1)


def step(x: Values, u: Values) -> Values:
    """True next state, without noise."""
    v = x[..., 2:]
    a = acceleration(x, u, np) - QUADRATIC * np.linalg.norm(v, axis=-1, keepdims=True) * v
    return advance(x, a, np)


def windows(rng: np.random.Generator, steps: int, off: tuple[int, int], on: tuple[int, int]) -> Values:
    """Alternating stretches (steps,), boolean; off, on: range of their lengths."""
    result, value, t = np.zeros(steps, bool), rng.random() < 0.5, 0
    while t < steps:
        n = int(rng.integers(*(on if value else off)))
        result[t : t + n], value, t = value, not value, t + n
    return result


def render(rng: np.random.Generator, states: Values, held: Values, dark: Values, covered: Values) -> Values:
    """Images (T, SIZE, SIZE, 3); held, dark, covered: (T,) boolean. A bar crosses the covered images."""
    steps = len(states)
    axis = (np.arange(SIZE) + 0.5) / SIZE * 2 * VIEW - VIEW
    column, row = np.meshgrid(axis, -axis)
    image = np.empty((steps, SIZE, SIZE, 3))
    on_tray = np.maximum(np.abs(column), np.abs(row)) < 0.15
    image[:] = np.where(on_tray[..., None], (70.0, 85.0, 125.0), (45.0, 40.0, 38.0))
    hand = (column > 0.12) & (np.abs(row) < 0.035)
    image[held] = np.where(hand[..., None], (150.0, 150.0, 155.0), image[held])
    scale = 1 + 0.6 * states[:, 1] / 0.15 * 0.15  # perspective
    x, y = states[:, 0] * scale, states[:, 1] * (1 + 0.05 * states[:, 1] / 0.15)
    distance = np.hypot(column - x[:, None, None], row - y[:, None, None])
    ball = np.clip((0.022 - distance) / 0.010 + 0.5, 0, 1)[..., None]
    image = image * (1 - ball) + np.array((220.0, 125.0, 45.0)) * ball
    angle, offset, speed = rng.uniform(0, np.pi), rng.uniform(-0.1, 0.1), rng.normal(0, 0.002)
    across = column * np.cos(angle) + row * np.sin(angle) - (offset + speed * np.arange(steps))[:, None, None]
    arm = (np.abs(across) < 0.04) & covered[:, None, None]
    image = np.where(arm[..., None], (95.0, 70.0, 60.0), image)
    light = rng.uniform(0.85, 1.15) * np.where(dark, 0.05, 1.0)
    image = image * light[:, None, None, None] + rng.normal(0, 14, image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def simulate(seed: int, fault: str = "", steps: int = 100) -> bs.Episode:
    """An episode, with a fault of the data."""
    rng = np.random.default_rng(seed)
    x = np.concatenate([rng.uniform(-0.1, 0.1, 2), rng.normal(0, 0.05, 2)])
    states, controls, goal, tilt = np.zeros((steps, 4)), np.zeros((steps, 2)), np.zeros(2), np.zeros(2)
    for t in range(steps):
        if t % 20 == 0:
            goal = rng.uniform(-0.11, 0.11, 2)
        wanted = np.clip(0.9 * (goal - x[:2]) - 0.25 * x[2:] + rng.normal(0, 0.02, 2), -0.15, 0.15)
        tilt = tilt + np.clip(wanted - tilt, -0.05, 0.05)
        x = step(x, tilt) + rng.normal(0, PROCESS)
        states[t], controls[t] = x, tilt
    held = windows(rng, steps, (12, 28), (20, 40))
    dark = windows(rng, steps, (25, 60), (10, 25)) & (rng.random() < 0.75)
    covered = windows(rng, steps, (25, 60), (8, 20)) & (rng.random() < 0.6)
    camera = render(rng, states, held, dark, covered)
    weight = rng.uniform(0.2, 0.35) * 9.81 * held
    wrench = np.stack([-weight, -weight * states[:, 1], weight * states[:, 0]], 1) + rng.normal(0, WRENCH, (steps, 3))
    if fault == "camera_moved":
        camera = np.roll(camera, 1, 2)
        camera[:, :, 0] = camera[:, :, 1]
    elif fault == "underexposed":
        camera = (camera * 0.45).astype(np.uint8)
    elif fault == "torques_swapped":
        wrench = wrench[:, [0, 2, 1]]
    elif fault == "torque_bias":
        wrench[:, 1] += 0.03
    elif fault == "tilt_late":
        controls = delay(controls, 4)
    return bs.Episode(
        TASK,
        states,
        controls=controls,
        observations={"camera": camera, "wrench": wrench},
        covariates={"contact": held.astype(np.float32)},
        seed=seed,
        split="test",
    )


def convolutions(channels: int) -> list[nn.Module]:
    """Layers from images (N, channels, H, W) to features (N, 24 H W / 16)."""
    return [
        nn.Conv2d(channels, 12, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(12, 24, 3, 2, 1),
        nn.ReLU(),
        nn.Conv2d(24, 24, 3, 2, 1),
        nn.ReLU(),
        nn.Flatten(),
    ]


class Vision(nn.Module):
    """Image (N, SIZE, SIZE, 3) in 0 to 1 -> position (N, 2) in m and its log variance (N, 2)."""

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(*convolutions(3))
        self.head = nn.Sequential(nn.Dropout(0.15), nn.Linear(864, 96), nn.ReLU(), nn.Dropout(0.15), nn.Linear(96, 4))

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        out = self.head(self.features((image.permute(0, 3, 1, 2) - 0.3) / 0.2))
        return 0.1 * out[:, :2], 2 * out[:, 2:] - 7


class Haptics(nn.Module):
    """Wrench (N, 3) -> position (N, 2) in m and its log variance (N, 2)."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.Linear(3, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, 4)
        )
        self.register_buffer("scale", torch.tensor([1.5, 0.12, 0.12]))

    def forward(self, wrench: Tensor) -> tuple[Tensor, Tensor]:
        out = self.net(wrench / self.scale)
        return 0.1 * out[:, :2], 2 * out[:, 2:] - 7


class Dynamics(nn.Module):
    """Analytic rolling with a learned correction of the acceleration, and learned process noise."""

    def __init__(self) -> None:
        super().__init__()
        self.correction = nn.Sequential(nn.Linear(4, 24), nn.Tanh(), nn.Linear(24, 2))
        self.log_std = nn.Parameter(torch.tensor([-6.0, -6.0, -3.5, -3.5]))
        self.dt = DT

    def forward(self, x: Tensor, u: Tensor) -> Tensor:
        more = 0.5 * self.correction(torch.cat([4 * x[..., 2:], 10 * u], -1))
        return advance(x, acceleration(x, u, torch) + more, torch, self.dt)


class Filter(nn.Module):
    """Differentiable extended Kalman filter, with one update by the fused position."""

    task = TASK

    def __init__(self, fault: str = "") -> None:
        super().__init__()
        self.fault = fault
        self.vision, self.haptics, self.dynamics = Vision(), Haptics(), Dynamics()

    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        self.x, self.P = mean, covariance

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> dict[str, Tensor]:
        x, P = self._predict(controls)
        image = observations["camera"].float() / 255
        if self.fault == "channels_reversed":
            image = image.flip(-1)
        heads = {"vision": self.vision(image), "haptics": self.haptics(observations["wrench"])}
        z = torch.stack([head[0] for head in heads.values()], 1)  # (N, 2, 2)
        R = torch.stack([head[1].exp() for head in heads.values()], 1)
        if self.fault == "logvar_as_logstd":
            R[:, 1] = R[:, 1] ** 2
        means, spreads = zip(*(self._update(x, P, z[:, k], R[:, k]) for k in range(2)), strict=True)
        information = 1 / R
        fused = (information * z).sum(1) / information.sum(1)
        noise = R.sum(1) if self.fault == "covariances_added" else 1 / information.sum(1)
        self.x, self.P = self._update(x, P, fused, noise)
        S = P[:, None, :2, :2] + torch.diag_embed(R)
        return {
            "estimate_mean": self.x,
            "estimate_covariance": self.P,
            "predicted_mean": torch.stack([x, x], 1),
            "predicted_covariance": torch.stack([P, P], 1),
            "modality_mean": torch.stack(means, 1),
            "modality_covariance": torch.stack(spreads, 1),
            "innovation": z - x[:, None, :2],
            "innovation_covariance": S,
        }

    def _predict(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (N, 4) and covariance (N, 4, 4)."""
        F = torch.func.vmap(torch.func.jacrev(self.dynamics))(self.x, u)
        return self.dynamics(self.x, u), F @ self.P @ F.mT + torch.diag((2 * self.dynamics.log_std).exp())

    @staticmethod
    def _update(x: Tensor, P: Tensor, z: Tensor, R: Tensor) -> tuple[Tensor, Tensor]:
        """Kalman update by a measured position z with variances R, both (N, 2)."""
        S = P[:, :2, :2] + torch.diag_embed(R)
        K = torch.linalg.solve(S, P[:, :2]).mT
        A = torch.eye(4) - torch.cat([K, torch.zeros_like(K)], -1)
        P = A @ P @ A.mT + K @ torch.diag_embed(R) @ K.mT
        return x + (K @ (z - x[:, :2])[..., None])[..., 0], (P + P.mT) / 2


def build(fault: str = "") -> Filter:
    """The trained filter, with a fault of it."""
    model = Filter(fault)
    model.load_state_dict(stored(WEIGHTS))
    model.eval()
    if fault == "dropout_on":
        model.vision.train()
    elif fault == "other_dt":
        model.dynamics.dt = 0.04
    return model


def make(fault: str = "") -> bs.Adapter:
    """The trained filter for Beliefscope, with a fault of it."""
    return bs.Adapter(build(fault), modalities=("vision", "haptics"), initial_std=START, task=TASK)
