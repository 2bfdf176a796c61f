"""Slot in a plate on a motorised stage, with a trained particle filter that has a learned likelihood per modality.

State: position and yaw of the slot. Sensors: a gray camera above, with a CNN; force at the finger and position of its
tip, with an MLP. The finger feels the slot where it presses on the plate (contact), and is lifted otherwise; in parts
of some episodes the image is dark. Controls: commanded velocity and yaw rate of the stage. ``train.py`` has trained
the weights.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

import beliefscope as bs
from external_faults.fault import Fault, Values, stored
from external_faults.tray import convolutions, windows

DT = 0.1  # s
PARTICLES = 300
SIZE, VIEW = 28, 0.07  # pixels; m, half of the image
LENGTH, WIDTH, EDGE = 0.018, 0.008, 0.0012  # m: half length and half width of the slot; width of its edge
START = (0.004, 0.004, 0.08)  # standard deviations of the first belief
WEIGHTS = Path(__file__).with_name("slot.safetensors")
OLD = Path(__file__).with_name("slot_old.safetensors")  # of the haptics network, after one epoch
TASK = bs.Task(
    name="slot",
    components=(bs.Component("x", "m"), bs.Component("y", "m"), bs.Component("yaw", "rad")),
    observations={"camera": (SIZE, SIZE), "force": (3,), "tip": (2,)},
    modalities={"vision": ("camera",), "haptics": ("force", "tip")},
    control_size=3,
    dt=DT,
    map_components=("x", "y"),
    map_half_width=0.02,
    warmup=10,
    covariates={"contact": bs.Covariate("boolean")},
    channels={
        "control": (bs.Component("vx", "m/s"), bs.Component("vy", "m/s"), bs.Component("yaw rate", "rad/s")),
    },
)
FAULTS = {
    "camera_noise": Fault("data", "pixel noise of 45 gray levels added", r"camera\.noise"),
    "camera_frozen": Fault("data", "image frozen from step 40", r"camera\.frozen"),
    "force_gain": Fault("data", "force x 1.8", r"force\.gain"),
    "stage_scale": Fault("data", "commands of the stage x 0.5", r"control\.scale"),
    "labels_offset": Fault("data", "labels of y shifted by 4 mm", r"labels\.offset"),
    "scaled_twice": Fault(
        "filter",
        "image divided by 255 twice",
        r"model\.vision\.broken|measurement\.vision\.(function|bias)|measurement_noise\.vision\.large",
    ),
    "old_haptics": Fault(
        "filter",
        "haptics network of an early checkpoint",
        r"model\.haptics\.(broken|bias|underconfident)|measurement\.haptics\.(function|bias)"
        r"|measurement_noise\.haptics\.large",
    ),
    "weights_kept": Fault("filter", "weights not reset after resampling", r"resampling\.off"),
    "haptics_masked": Fault(
        "filter",
        "mask of contact inverted: haptics used only in free motion",
        r"updates\.haptics\.(missing|absent)|weights\.ignores_likelihood|model\.haptics\.(broken|underconfident)"
        r"|measurement_noise\.haptics\.large",
    ),
    "noise_small": Fault("filter", "standard deviation of the process noise x 0.1", r"process_noise\.small"),
}


def advance(x: Values, u: Values) -> Values:
    """State after the motion of the stage, without noise."""
    x0, y0, w = x[..., 0], x[..., 1], u[..., 2]
    moved = [x0 + DT * (u[..., 0] - w * y0), y0 + DT * (u[..., 1] + w * x0), x[..., 2] + DT * w]
    return np.stack(moved, -1)


def noise(u: Values) -> Values:
    """Standard deviations (3,) of a step: the stage slips more, the faster it moves."""
    speed = np.hypot(u[0], u[1])
    return np.array([0.0003 + 0.06 * speed * DT, 0.0003 + 0.06 * speed * DT, 0.003 + 0.08 * abs(u[2]) * DT])


def local(point: Values, states: Values) -> Values:
    """Points (..., 2) in the frame of the slot; states: (..., 3)."""
    d, c, s = point - states[..., :2], np.cos(states[..., 2]), np.sin(states[..., 2])
    return np.stack([c * d[..., 0] + s * d[..., 1], -s * d[..., 0] + c * d[..., 1]], -1)


def press(rng: np.random.Generator, states: Values, tip: Values, contact: Values) -> Values:
    """Forces (T, 3) at the tip in world axes."""
    r = local(tip, states)
    size = np.array([LENGTH, WIDTH])
    sides = 1 / (1 + np.exp(-(size - np.abs(r)) / EDGE))
    inside = sides.prod(-1)
    normal = -4.0 + 2.5 * inside
    lateral = -2.2 * inside[:, None] * np.tanh(1.3 * r / size)
    c, s = np.cos(states[:, 2]), np.sin(states[:, 2])
    velocity = np.diff(tip, axis=0, prepend=tip[:1]) / DT
    rub = -0.25 * np.abs(normal)[:, None] * np.tanh(velocity / 0.02)
    world = np.stack([c * lateral[:, 0] - s * lateral[:, 1], s * lateral[:, 0] + c * lateral[:, 1]], -1) + rub
    return np.where(contact[:, None], np.concatenate([world, normal[:, None]], 1), 0) + rng.normal(0, 0.12, (len(r), 3))


def render(rng: np.random.Generator, states: Values, tip: Values, dark: Values) -> Values:
    """Images (T, SIZE, SIZE) of the plate, the finger and its arm; dark: (T,) boolean."""
    steps = len(states)
    axis = (np.arange(2 * SIZE) + 0.5) / (2 * SIZE) * 2 * VIEW - VIEW
    grid = np.stack(np.meshgrid(axis, -axis), -1)
    image = 150 + 120 * grid[..., 0] + 200 * rng.normal(0, 1) * grid[..., 1] * np.ones((steps, 1, 1))
    r = local(grid[None], states[:, None, None])
    image = np.where((np.abs(r[..., 0]) < LENGTH) & (np.abs(r[..., 1]) < WIDTH), 45.0, image)
    image = np.where(np.hypot(r[..., 0] - LENGTH - 0.008, r[..., 1]) < 0.005, 235.0, image)
    finger = np.hypot(grid[..., 0] - tip[:, 0, None, None], grid[..., 1] - tip[:, 1, None, None]) < 0.006
    arm = (np.abs(grid[..., 0] - tip[:, 0, None, None]) < 0.004) & (grid[..., 1] > tip[:, 1, None, None])
    image = np.where(finger | arm, 90.0, image)
    image = image.reshape(steps, SIZE, 2, SIZE, 2).mean((2, 4))
    image = image * (rng.uniform(0.85, 1.15) * np.where(dark, 0.06, 1.0))[:, None, None]
    return np.clip(np.round(image + rng.normal(0, 10, image.shape)), 0, 255).astype(np.uint8)


def simulate(seed: int, fault: str = "", steps: int = 100) -> bs.Episode:
    """An episode, with a fault of the data."""
    rng = np.random.default_rng(seed)
    x = np.array([*rng.uniform(-0.03, 0.03, 2), rng.uniform(-0.5, 0.5)])
    states, controls, goal, u = np.zeros((steps, 3)), np.zeros((steps, 3)), x, np.zeros(3)
    for t in range(steps):
        if t % 15 == 0:
            goal = np.array([*rng.uniform(-0.035, 0.035, 2), rng.uniform(-0.6, 0.6)])
        wanted = np.clip(0.8 * (goal - x), [-0.025, -0.025, -0.4], [0.025, 0.025, 0.4])
        u = 0.6 * u + 0.4 * wanted
        x = advance(x, u) + rng.normal(0, noise(u))
        states[t], controls[t] = x, u
    contact = windows(rng, steps, (10, 25), (15, 35))
    phase = rng.uniform(0, 2 * np.pi, 2) + np.arange(steps)[:, None] * DT * np.array([1.1, 1.9])
    over = states[:, :2] + rng.normal(0, 0.003, 2) + np.sin(phase) * (0.02, 0.012)
    tip, at = np.zeros((steps, 2)), over[0]
    for t in range(steps):
        target = over[t] if contact[max(t - 3, 0) : t + 4].any() else np.array([0.055, 0.055])
        at = at + 0.7 * (target - at)
        tip[t] = at
    dark = windows(rng, steps, (25, 60), (12, 28)) & (rng.random() < 0.75)
    camera = render(rng, states, tip, dark)
    force = press(rng, states, tip, contact)
    if fault == "camera_noise":
        camera = np.clip(camera + rng.normal(0, 45, camera.shape), 0, 255).astype(np.uint8)
    elif fault == "camera_frozen":
        camera[40:] = camera[40]
    elif fault == "force_gain":
        force = 1.8 * force
    elif fault == "stage_scale":
        controls = 0.5 * controls
    elif fault == "labels_offset":
        states = states + np.array([0, 0.004, 0])
    return bs.Episode(
        TASK,
        states,
        controls=controls,
        observations={"camera": camera, "force": force, "tip": tip + rng.normal(0, 0.0002, tip.shape)},
        covariates={"contact": contact.astype(np.float32)},
        seed=seed,
        split="test",
    )


def mlp(*sizes: int) -> nn.Sequential:
    """Linear layers with ReLU between them."""
    layers = [m for a, b in pairwise(sizes) for m in (nn.Linear(a, b), nn.ReLU())]
    return nn.Sequential(*layers[:-1])


class Vision(nn.Module):
    """Images (N, SIZE, SIZE) in 0 to 1 and particles (N, M, 3) -> log likelihoods (N, M)."""

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(*convolutions(1), nn.Linear(1176, 96), nn.ReLU(), nn.Linear(96, 32))
        self.score = mlp(35, 96, 96, 1)

    def forward(self, image: Tensor, particles: Tensor) -> Tensor:
        f = self.features((image[:, None] - 0.5) / 0.25)
        s = particles / torch.tensor([0.025, 0.025, 0.35])
        return self.score(torch.cat([f[:, None].expand(-1, s.shape[1], -1), s], -1))[..., 0]


class Haptics(nn.Module):
    """Force (N, 3), tip (N, 2) and particles (N, M, 3) -> log likelihoods (N, M)."""

    def __init__(self) -> None:
        super().__init__()
        self.score = mlp(5, 64, 64, 64, 1)

    def forward(self, force: Tensor, tip: Tensor, particles: Tensor) -> Tensor:
        c, s = particles[..., 2].cos(), particles[..., 2].sin()
        d, f = tip[:, None] - particles[..., :2], force[:, None].expand(-1, particles.shape[1], -1)
        turned = [torch.stack([c * v[..., 0] + s * v[..., 1], c * v[..., 1] - s * v[..., 0]], -1) for v in (d, f)]
        return self.score(torch.cat([turned[0] / 0.012, turned[1] / 1.5, f[..., 2:] / 3], -1))[..., 0]


class Dynamics(nn.Module):
    """Motion of the stage with learned process noise: standard deviations (N, 3) of the controls (N, 3)."""

    def __init__(self) -> None:
        super().__init__()
        self.log_std = mlp(3, 24, 3)
        self.factor = 1.0

    def std(self, u: Tensor) -> Tensor:
        return (self.log_std(u / torch.tensor([0.02, 0.02, 0.3])) - 5).exp() * self.factor

    def move(self, x: Tensor, u: Tensor) -> Tensor:
        """Particles (N, M, 3) after the motion, without noise."""
        x0, y0, w = x[..., 0], x[..., 1], u[..., None, 2]
        vx, vy = u[..., None, 0], u[..., None, 1]
        return torch.stack([x0 + DT * (vx - w * y0), y0 + DT * (vy + w * x0), x[..., 2] + DT * w], -1)

    def forward(self, x: Tensor, u: Tensor) -> Tensor:
        return self.move(x, u) + torch.randn_like(x) * self.std(u)[:, None]


class Filter(nn.Module):
    """Differentiable particle filter that resamples if the effective sample size is below half."""

    task = TASK

    def __init__(self, fault: str = "") -> None:
        super().__init__()
        self.fault = fault
        self.vision, self.haptics, self.dynamics = Vision(), Haptics(), Dynamics()
        self.register_buffer("temper", torch.ones(2))  # exponents of the likelihoods, tuned after the training

    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        root = torch.linalg.cholesky(covariance)
        self.x = mean[:, None] + torch.randn(len(mean), PARTICLES, 3) @ root.mT
        self.w = torch.full((len(mean), PARTICLES), -float(np.log(PARTICLES)))

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> dict[str, Tensor]:
        x, prior = self.dynamics(self.x, controls), self.w
        image, force = observations["camera"].float() / 255, observations["force"]
        if self.fault == "scaled_twice":
            image = image / 255
        seen, felt = self.vision(image, x), self.haptics(force, observations["tip"], x)
        touching = force[:, 2:].abs() > 0.6
        felt = felt * (~touching if self.fault == "haptics_masked" else touching)
        seen, felt = self.temper[0] * seen, self.temper[1] * felt
        w = torch.log_softmax(prior + seen + felt, 1)
        mean = (w.exp()[..., None] * x).sum(1)
        d = x - mean[:, None]
        covariance = (w.exp()[..., None] * d).mT @ d
        return {
            "estimate_mean": mean,
            "estimate_covariance": covariance,
            "particles": x,
            "log_weights": w,
            "prior_log_weights": prior,
            "log_likelihood": torch.stack([seen, felt], 1),
            "ancestors": self._resample(x, w),
        }

    def _resample(self, x: Tensor, w: Tensor) -> Tensor:
        """Systematic; indices of the ancestors (N, M)."""
        p = w.exp()
        low = 1 / (p**2).sum(1) < PARTICLES / 2
        positions = (torch.arange(PARTICLES) + torch.rand(len(x), 1)) / PARTICLES
        index = torch.searchsorted(p.cumsum(1), positions).clamp(max=PARTICLES - 1)
        index = torch.where(low[:, None], index, torch.arange(PARTICLES))
        self.x = x.gather(1, index[..., None].expand(-1, -1, 3))
        uniform = torch.full_like(w, -float(np.log(PARTICLES)))
        kept = torch.log_softmax(w.gather(1, index), 1)
        self.w = kept if self.fault == "weights_kept" else torch.where(low[:, None], uniform, w)
        return index


def build(fault: str = "") -> Filter:
    """The trained filter, with a fault of it."""
    model = Filter(fault)
    weights = stored(WEIGHTS)
    if fault == "old_haptics":
        weights |= stored(OLD)
    model.load_state_dict(weights)
    model.eval()
    if fault == "noise_small":
        model.dynamics.factor = 0.1
    return model


def make(fault: str = "") -> bs.Adapter:
    """The trained filter for Beliefscope, with a fault of it."""
    return bs.Adapter(build(fault), modalities=("vision", "haptics"), initial_std=START, task=TASK)
