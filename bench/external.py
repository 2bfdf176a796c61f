"""Cost of tracing an external filter and of recording a live step, in CPU time.

A traced run is compared with a bare loop over the same module in the same process; both are repeated in turn, and the
ratio is that of the medians. The Kalman filter has N = 1; the particle filter has the interface of torchfilter, whose
ancestors are matched. ``LiveRecorder.step`` is measured in the thread that calls it, with two images.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from subject import Row
from torch import Tensor, nn

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.trace import trace
from beliefscope.recordings.live import LiveRecorder

REPEATS = 9
PARTICLES = 10_000
STEPS = 50
SIDE = 64


class Sensor(nn.Module):
    """Likelihood of a small network on the image and the state, as in a learned particle filter."""

    def __init__(self) -> None:
        super().__init__()
        self.image = nn.Sequential(nn.Conv2d(1, 8, 5, 2), nn.ReLU(), nn.Flatten(), nn.Linear(8 * 14 * 14, 32))
        self.state = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 32))
        self.score = nn.Sequential(nn.ReLU(), nn.Linear(32, 32), nn.ReLU(), nn.Linear(32, 1))

    def forward(self, *, states: Tensor, observations: dict[str, Tensor]) -> Tensor:
        image = self.image(observations["image"][:, None].float() / 255.0)
        return self.score(image[:, None] + self.state(states))[..., 0]


class Particles(nn.Module):
    """Particle filter with the attributes of torchfilter's: resamples at the end of its step."""

    def __init__(self) -> None:
        super().__init__()
        self.measurement_model = Sensor()
        self.move = nn.Sequential(nn.Linear(10, 32), nn.ReLU(), nn.Linear(32, 3))

    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        noise = torch.randn(len(mean), PARTICLES, 3) @ torch.linalg.cholesky(covariance).mT
        self.particle_states = mean[:, None] + noise
        self.particle_log_weights = torch.full((len(mean), PARTICLES), -np.log(PARTICLES))

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> Tensor:
        inputs = torch.cat([self.particle_states, controls[:, None].expand(-1, PARTICLES, -1)], dim=-1)
        self.particle_states = self.particle_states + 1e-3 * self.move(inputs)
        self.particle_states = self.particle_states + 1e-3 * torch.randn_like(self.particle_states)
        scores = self.measurement_model(states=self.particle_states, observations=observations)
        self.particle_log_weights = torch.log_softmax(self.particle_log_weights + scores, dim=-1)
        weights = self.particle_log_weights.exp()
        mean = (weights.unsqueeze(-1) * self.particle_states).sum(1)
        index = torch.multinomial(weights, PARTICLES, replacement=True)
        self.particle_states = self.particle_states.gather(1, index.unsqueeze(-1).expand(-1, -1, 3))
        self.particle_log_weights = torch.full_like(weights, -np.log(PARTICLES))
        return mean


class Learned(nn.Module):
    """Kalman filter with a learned virtual sensor."""

    def __init__(self) -> None:
        super().__init__()
        self.image = Sensor().image
        self.output = nn.Linear(32 + 10, 3)

    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        self.mean, self.covariance = mean, covariance

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> tuple[Tensor, Tensor]:
        keys = ("effector_position", "force", "torque", "contact")
        features = self.image(observations["image"][:, None].float() / 255.0)
        z = self.output(torch.cat([features, *(observations[key] for key in keys)], dim=1))
        noise = 0.01 * torch.eye(3).expand(len(z), 3, 3)
        predicted = self.covariance + 1e-4 * torch.eye(3)
        gain = torch.linalg.solve(predicted + noise, predicted).mT
        self.mean = self.mean + (gain @ (z - self.mean).unsqueeze(-1)).squeeze(-1)
        self.covariance = predicted - gain @ predicted
        return self.mean, self.covariance


def bare(module: Any, external: ExternalFilter, episode: Episode) -> None:
    """The module's own loop over the episode."""
    start = external.start([episode])
    with torch.no_grad():
        torch.manual_seed(0)
        module.initialize_beliefs(mean=start.mean, covariance=start.covariance)
        inputs = {key: torch.from_numpy(value)[:, None] for key, value in episode.observations.items()}
        controls = torch.from_numpy(episode.controls)[:, None]
        for t in range(len(controls)):
            module(observations={key: value[t] for key, value in inputs.items()}, controls=controls[t])


def cpu_seconds(call: Callable[[], object]) -> float:
    start = time.process_time()
    call()
    return time.process_time() - start


def tracing(name: str, module: Any, episode: Episode) -> Row:
    """Ratio of a traced run to a bare one."""
    torch.manual_seed(0)
    external = ExternalFilter(Adapter(module.eval()), episode.task, "bench")
    pairs = []
    for _ in range(REPEATS):
        pairs.append(
            (cpu_seconds(lambda: bare(module, external, episode)), cpu_seconds(lambda: trace(external, episode)))
        )
    alone, traced = (statistics.median(times) for times in zip(*pairs, strict=True))
    ms = 1e3 / len(episode)
    return f"tracing {name}, {ms * alone:.2f} ms a step bare", f"{traced / alone:.2f} x", "1.3 x"


def live_step(episode: Episode) -> Row:
    """CPU time of the calling thread in a step with two images of 64 x 64 pixels."""
    shapes = {"left": (SIDE, SIDE), "right": (SIDE, SIDE), **dict(episode.task.observations)}
    task = replace(episode.task, observations=shapes, modalities={"image": ("left",), "other": ("right",)})
    rng = np.random.default_rng(0)
    images = {key: rng.integers(0, 255, (SIDE, SIDE), np.uint8) for key in ("left", "right")}
    covariance, times = np.diag([1e-4, 1e-4, 1e-3]), []
    with tempfile.TemporaryDirectory() as folder, LiveRecorder("run", task=task, folder=folder, views=False) as live:
        for t in range(len(episode)):
            observations = {key: value[t] for key, value in episode.observations.items()} | images
            start = time.thread_time()
            live.step((episode.states[t], covariance), observations, episode.controls[t], truth=episode.states[t])
            times.append(time.thread_time() - start)
            time.sleep(0.005)
    values = 1e3 * np.array(times[1:])
    return (
        "LiveRecorder.step, two 64 x 64 images",
        f"{np.median(values):.3f} ms, 95 % of the steps below {np.quantile(values, 0.95):.3f} ms",
        "0.3 ms of the caller's thread",
    )


def measure() -> list[Row]:
    """Return one row per measurement."""
    with open_dataset(sample_path("door")) as data:
        episode = data[9]
    short = replace(
        episode,
        **{name: getattr(episode, name)[:STEPS] for name in ("states", "controls", "contact", "qpos")},
        observations={key: value[:STEPS] for key, value in episode.observations.items()},
    )
    return [
        tracing("a Kalman filter, N = 1", Learned(), episode),
        tracing(f"a particle filter, {PARTICLES:,} particles", Particles(), short),
        live_step(episode),
    ]


if __name__ == "__main__":
    torch.set_num_threads(1)
    for row in measure():
        print(": ".join(row[:2]), f"(required: {row[2]})")
