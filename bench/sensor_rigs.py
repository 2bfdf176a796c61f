"""Tasks of 1, 4 and 9 state components with 1, 3 and 6 sensors, and their Kalman filter, as a user writes them.

beliefscope serve $(python bench/sensor_rigs.py FOLDER)
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import write_dataset
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.external.adapter import Adapter

DT, STEPS, EPISODES = 0.1, 80, 3
START = 0.3  # standard deviation of the first belief, in the units of each component


@dataclass(frozen=True)
class Rig:
    """A state that moves at random, and sensors that measure some of its components.

    Attributes:
        drift: (n,) standard deviation of the change of each component in a step.
        sensors: name -> indices of the measured components, and the standard deviation of the noise.
        rates: component -> component that is its rate of change.
    """

    task: Task
    drift: tuple[float, ...]
    sensors: Mapping[str, tuple[tuple[int, ...], float]]
    rates: Mapping[int, int]

    @property
    def transition(self) -> Any:
        """(n, n) matrix of a step."""
        result = np.eye(len(self.drift))
        for component, rate in self.rates.items():
            result[component, rate] = DT
        return result

    def episode(self, seed: int) -> Episode:
        """A trajectory from zero, with readings."""
        rng = np.random.default_rng(seed)
        states = np.zeros((STEPS, len(self.drift)))
        for t in range(1, STEPS):
            states[t] = self.transition @ states[t - 1] + np.array(self.drift) * rng.standard_normal(len(self.drift))
        readings = {
            name: states[:, list(measured)] + noise * rng.standard_normal((STEPS, len(measured)))
            for name, (measured, noise) in self.sensors.items()
        }
        return Episode(
            task=self.task,
            states=states.astype(np.float32),
            controls=np.zeros((STEPS, 1), np.float32),
            observations={name: values.astype(np.float32) for name, values in readings.items()},
            contact=np.zeros(STEPS, bool),
            qpos=np.zeros((STEPS, 0), np.float32),
            dt=DT,
            seed=seed,
            split="test",
            provenance={},
        )


class Kalman(nn.Module):
    """A Kalman filter in information form, which reports the update of each sensor."""

    def __init__(self, rig: Rig) -> None:
        super().__init__()
        n = len(rig.drift)
        self.names = tuple(rig.sensors)
        self.transition = torch.tensor(rig.transition, dtype=torch.float32)
        self.noise = torch.tensor(rig.drift).square().diag()
        self.models = [torch.eye(n)[list(measured)] for measured, _ in rig.sensors.values()]
        self.precisions = [1.0 / noise**2 for _, noise in rig.sensors.values()]

    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        self.mean, self.covariance = mean, covariance

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> dict[str, Tensor]:
        mean = self.mean @ self.transition.T
        covariance = self.transition @ self.covariance @ self.transition.T + self.noise
        prior = torch.linalg.inv(covariance)
        parts = [p * h.T @ h for h, p in zip(self.models, self.precisions, strict=True)]
        pulls = [
            p * (observations[name] - mean @ h.T) @ h
            for name, h, p in zip(self.names, self.models, self.precisions, strict=True)
        ]
        covariances = torch.stack([torch.linalg.inv(prior + part) for part in parts], dim=1)
        self.covariance = torch.linalg.inv(prior + sum(parts))
        self.mean = mean + (self.covariance @ sum(pulls)[..., None])[..., 0]
        shares = torch.stack([part.diagonal() for part in parts])
        total = shares.sum(0)
        weights = torch.where(total > 0.0, shares / total.clamp(min=1e-9), 1.0 / len(parts))
        return {
            "estimate_mean": self.mean,
            "estimate_covariance": self.covariance,
            "modality_mean": mean[:, None] + (covariances @ torch.stack(pulls, dim=1)[..., None])[..., 0],
            "modality_covariance": covariances,
            "effective_weights": weights.expand(len(mean), -1, -1),
        }


def build(rig: Rig) -> Adapter:
    filter_ = Kalman(rig)

    def log_likelihood(states: Tensor, inputs: dict[str, Tensor]) -> Tensor:
        return torch.stack(
            [
                -0.5 * p * (inputs[name] - states @ h.T).square().sum(-1)
                for name, h, p in zip(filter_.names, filter_.models, filter_.precisions, strict=True)
            ]
        )

    return Adapter(
        filter_,
        modalities=filter_.names,
        initial_std=(START,) * len(rig.drift),
        log_likelihood=log_likelihood,
        task=rig.task,
    )


def _rig(
    name: str,
    components: Mapping[str, tuple[str, float]],
    sensors: Mapping[str, tuple[tuple[int, ...], float]],
    rates: Mapping[int, int],
) -> Rig:
    """components: name -> unit and drift."""
    task = Task(
        name=name,
        components=tuple(Component(component, unit) for component, (unit, _) in components.items()),
        observations={sensor: (len(measured),) for sensor, (measured, _) in sensors.items()},
        modalities={sensor: (sensor,) for sensor in sensors},
        control_size=1,
        dt=DT,
        map_components=tuple(components)[:2],
        map_half_width=2.0,
        warmup=0,
    )
    return Rig(task, tuple(drift for _, drift in components.values()), sensors, rates)


WELL = _rig("well", {"depth": ("m", 0.05)}, {"sonar": ((0,), 0.2)}, {})
CART = _rig(
    "cart",
    {"x": ("m", 0.01), "y": ("m", 0.01), "vx": ("m/s", 0.05), "vy": ("m/s", 0.05)},
    {"gps": ((0, 1), 0.5), "wheel_speed": ((2,), 0.1), "beacon": ((0,), 0.2)},
    {0: 2, 1: 3},
)
SUBMARINE = _rig(
    "submarine",
    {
        **{f"position_{axis}": ("m", 0.01) for axis in "xyz"},
        **{f"velocity_{axis}": ("m/s", 0.05) for axis in "xyz"},
        **dict.fromkeys(("roll", "pitch", "yaw"), ("rad", 0.02)),
    },
    {
        "acoustic_positioning": ((0, 1, 2), 1.0),
        "pressure": ((2,), 0.05),
        "doppler_velocity_log": ((3, 4, 5), 0.1),
        "inclinometer": ((6, 7), 0.03),
        "magnetic_compass": ((8,), 0.15),
        "visual_odometry": ((3, 4, 5, 8), 0.2),
    },
    {0: 3, 1: 4, 2: 5},
)
WELL_TASK, CART_TASK, SUBMARINE_TASK = WELL.task, CART.task, SUBMARINE.task
well, cart, submarine = partial(build, WELL), partial(build, CART), partial(build, SUBMARINE)


def options(folder: Path) -> list[str]:
    """Write the episodes of all rigs; options of ``beliefscope serve`` that show them."""
    result = []
    for rig in (WELL, CART, SUBMARINE):
        name = rig.task.name
        path = folder / f"{name}.h5"
        write_dataset(path, rig.task, [rig.episode(seed) for seed in range(EPISODES)])
        result += ["--task", f"{__file__}:{name.upper()}_TASK", "--data", str(path), "--filter", f"{__file__}:{name}"]
    return result


if __name__ == "__main__":
    print(*options(Path(sys.argv[1])))
