"""Traces with known results: traces of built-in filters with simulated arrays."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.trace import Trace, trace

Array = NDArray[np.float64]

START = 30
"""Number of warm-up steps, which metrics exclude."""

SCALE = np.array([0.01, 0.02, 0.05])
"""m, m, rad: standard deviations of the image noise, large relative to the covariance floor."""


@cache
def real(filter_: str, steps: int = 60) -> Trace:
    """A short trace of a pretrained filter on a door episode, with 100 particles."""
    with open_dataset(sample_path("door")) as dataset:
        index = next(s.index for s in dataset.summaries if s.split == "test")
        episode = dataset[index]
    checkpoint = load_checkpoint(pretrained_path("door", filter_))
    return trace(checkpoint, of_length(episode, steps), index, seed=7, particles=100)


def of_length(episode: Episode, steps: int) -> Episode:
    """An episode truncated or repeated to a number of steps."""
    at = np.arange(steps) % len(episode)
    arrays: dict[str, Any] = {name: getattr(episode, name)[at] for name in ("states", "controls", "contact", "qpos")}
    return replace(episode, observations={key: a[at] for key, a in episode.observations.items()}, **arrays)


def planted(base: Trace, states: Any, contact: Any = None, **arrays: Any) -> Trace:
    """A copy of a trace with other true states (T, n), contact (T,) and arrays (converted to float32)."""
    steps = len(states)
    contact = np.arange(steps) % 2 == 0 if contact is None else np.asarray(contact, dtype=bool)
    episode = replace(of_length(base.episode, steps), states=np.float32(states), contact=contact)
    converted = {
        name: value if name == "ancestors" or value is None else np.float32(value) for name, value in arrays.items()
    }
    return replace(base, episode=episode, **converted)


def kalman(z: Array, noise: Array, process: Array, start: Array) -> tuple[Array, Array, Array, Array]:
    """Kalman filter of a fully observed random walk, from mean 0 and covariance ``start``.

    Args:
        z: (N, T, n) observations.
        noise, process, start: (n, n) covariances.

    Returns:
        Predicted mean (N, T, n) and covariance (T, n, n), then the posterior's.
    """
    mean, covariance = np.zeros_like(z[:, 0]), start
    history: list[tuple[Array, Array, Array, Array]] = []
    for step in range(z.shape[1]):
        predicted, spread = mean, covariance + process
        gain = spread @ np.linalg.inv(spread + noise)
        mean, covariance = predicted + (z[:, step] - predicted) @ gain.T, spread - gain @ spread
        history.append((predicted, spread, mean, covariance))
    a, b, c, d = zip(*history, strict=True)
    return np.stack(a, 1), np.stack(b), np.stack(c, 1), np.stack(d)


def simulated(
    trajectories: int = 20, steps: int = 130, scale: float = 1.0, memory: float = 0.0, seed: int = 0
) -> list[Trace]:
    """Traces of exact Kalman filters on a simulated random walk with two noisy sensors; the angle walks about pi.

    Args:
        scale: factor of the reported covariances; 1 is exact.
        memory: AR(1) coefficient of the sensor noise; 0 is white.
    """
    rng = np.random.default_rng(seed)
    n = len(SCALE)
    process, start = np.diag(np.square(0.5 * SCALE)), np.diag(np.square(SCALE))
    mix = np.array([[1.0, 0.4, 0.0], [0.0, 1.0, 0.3], [0.0, 0.0, 1.0]]) * SCALE[:, None]
    noises = [np.diag(np.square(SCALE)), mix @ mix.T]
    walk = rng.multivariate_normal(np.zeros(n), process, (trajectories, steps)).cumsum(1)
    truth = walk + rng.multivariate_normal(np.zeros(n), start, trajectories)[:, None]
    observed = []
    for noise in noises:
        v = rng.multivariate_normal(np.zeros(n), noise, (trajectories, steps))
        for step in range(1, steps):  # stationary AR(1)
            v[:, step] = memory * v[:, step - 1] + np.sqrt(1.0 - memory**2) * v[:, step]
        observed.append(truth + v)
    precise = [np.linalg.inv(noise) for noise in noises]
    joint = np.linalg.inv(sum(precise))
    both = sum(z @ p for z, p in zip(observed, precise, strict=True)) @ joint
    unimodal = [kalman(z, noise, process, start) for z, noise in zip(observed, noises, strict=True)]
    _, _, mean, covariance = kalman(both, joint, process, start)
    centre = np.array([0.5, -0.2, np.pi])

    def state(value: Array) -> Array:
        value = value + centre
        value[..., 2] = (value[..., 2] + np.pi) % (2.0 * np.pi) - np.pi
        return value

    return [
        planted(
            real("crossmodal-ekf"),
            state(truth[i]),
            estimate_mean=state(mean[i]),
            estimate_covariance=scale * covariance,
            modality_mean=np.stack([state(result[2][i]) for result in unimodal], 1),
            modality_covariance=scale * np.stack([result[3] for result in unimodal], 1),
            predicted_mean=np.stack([state(result[0][i]) for result in unimodal], 1),
            predicted_covariance=scale * np.stack([result[1] for result in unimodal], 1),
            observation_mean=np.stack([state(z[i]) for z in observed], 1),
            observation_covariance=scale * np.broadcast_to(np.stack(noises), (steps, 2, n, n)),
        )
        for i in range(trajectories)
    ]


K_ARRAYS = (
    "modality_mean",
    "modality_covariance",
    "weights",
    "effective_weights",
    "predicted_mean",
    "predicted_covariance",
    "observation_mean",
    "observation_covariance",
    "log_likelihood",
)


def swapped(trace: Trace) -> Trace:
    """A copy of a trace with its modalities in reverse order."""
    arrays: dict[str, Any] = {name: value[:, ::-1] for name in K_ARRAYS if (value := getattr(trace, name)) is not None}
    return replace(trace, modalities=trace.modalities[::-1], **arrays)
