"""A task of one component, which two sensors read, and its Kalman filter, as a user writes them."""

import numpy as np
import torch
from torch import Tensor, nn

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.external.adapter import Adapter

TASK = Task(
    name="tank",
    components=(Component("temperature", "K"),),
    observations={"reading": (1,), "colour": (1,)},
    modalities={"thermometer": ("reading",), "pyrometer": ("colour",)},
    control_size=1,
    dt=0.1,
    map_components=("temperature",),
    map_half_width=2.0,
    warmup=0,
)
DRIFT, NOISE = 0.3, (0.5, 1.0)  # K, standard deviations


class Kalman(nn.Module):
    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        self.mean, self.covariance = mean, covariance

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> dict[str, Tensor]:
        z = torch.stack([observations["reading"], observations["colour"]], dim=1)  # (N, 2, 1)
        predicted = self.covariance + DRIFT**2
        noise = torch.tensor(NOISE).square().reshape(1, 2, 1, 1).expand(len(z), 2, 1, 1)
        gain = predicted[:, None] / (predicted[:, None] + noise)
        single = self.mean[:, None] + gain[..., 0] * (z - self.mean[:, None])
        information = 1.0 / noise
        self.covariance = 1.0 / (1.0 / predicted + information.sum(1))
        self.mean = (self.covariance @ (self.mean / predicted[..., 0] + (information[..., 0] * z).sum(1))[..., None])[
            ..., 0
        ]
        weights = (information / information.sum(1, keepdim=True))[..., 0]
        return {
            "estimate_mean": self.mean,
            "estimate_covariance": self.covariance,
            "modality_mean": single,
            "modality_covariance": predicted[:, None] * (1.0 - gain),
            "observation_mean": z,
            "observation_covariance": noise,
            "weights": weights,
            "effective_weights": weights,
        }


def build() -> Adapter:
    return Adapter(Kalman(), modalities=tuple(TASK.modalities), initial_std=(0.3,), task=TASK)


def episode(seed: int, steps: int = 60) -> Episode:
    rng = np.random.default_rng(seed)
    states = 290.0 + np.cumsum(DRIFT * rng.standard_normal((steps, 1)), axis=0)
    readings = [(states + sigma * rng.standard_normal((steps, 1))).astype(np.float32) for sigma in NOISE]
    return Episode(
        task=TASK,
        states=states.astype(np.float32),
        controls=np.zeros((steps, 1), np.float32),
        observations=dict(zip(TASK.observations, readings, strict=True)),
        contact=np.zeros(steps, bool),
        qpos=np.zeros((steps, 0), np.float32),
        dt=0.1,
        seed=seed,
        split="test",
        provenance={},
    )
