"""Traces of known answers: real ones of shipped filters with arrays planted into them, by simulation."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.trace import Trace, trace

Array = NDArray[np.float64]

START = 30
"""Steps that no metric counts."""

SCALE = np.array([0.01, 0.02, 0.05])
"""m, m, rad: standard deviations of the image's noise; far above the floor on covariances, 1e-4."""


@cache
def real(filter_: str, steps: int = 60) -> Trace:
    """A short trace of a shipped filter on a door, with 100 particles."""
    with open_dataset(sample_path("door")) as dataset:
        index = next(s.index for s in dataset.summaries if s.split == "test")
        episode = dataset[index]
    return trace(load_checkpoint(shipped("door", filter_)), of_length(episode, steps), index, seed=7, particles=100)


def of_length(episode: Episode, steps: int) -> Episode:
    """An episode cut, or repeated, to some steps."""
    at = np.arange(steps) % len(episode)
    arrays: dict[str, Any] = {name: getattr(episode, name)[at] for name in ("states", "controls", "contact", "qpos")}
    return replace(episode, observations={key: a[at] for key, a in episode.observations.items()}, **arrays)


def planted(base: Trace, states: Any, contact: Any = None, **arrays: Any) -> Trace:
    """The trace with other true states (T, n), contact (T,), and arrays (float32, as in a trace)."""
    steps = len(states)
    contact = np.arange(steps) % 2 == 0 if contact is None else np.asarray(contact, dtype=bool)
    episode = replace(of_length(base.episode, steps), states=np.float32(states), contact=contact)
    ready = {
        name: value if name == "ancestors" or value is None else np.float32(value) for name, value in arrays.items()
    }
    return replace(base, episode=episode, **ready)


def kalman(z: Array, noise: Array, process: Array, start: Array) -> tuple[Array, Array, Array, Array]:
    """Kalman filter of a random walk seen whole, from mean 0 and covariance ``start``.

    Args:
        z: (N, T, n). noise, process, start: (n, n).

    Returns:
        Predicted mean (N, T, n) and covariance (T, n, n), then the posterior's.
    """
    mean, covariance = np.zeros_like(z[:, 0]), start
    kept: list[tuple[Array, Array, Array, Array]] = []
    for step in range(z.shape[1]):
        before, wide = mean, covariance + process
        gain = wide @ np.linalg.inv(wide + noise)
        mean, covariance = before + (z[:, step] - before) @ gain.T, wide - gain @ wide
        kept.append((before, wide, mean, covariance))
    a, b, c, d = zip(*kept, strict=True)
    return np.stack(a, 1), np.stack(b), np.stack(c, 1), np.stack(d)


def simulated(
    trajectories: int = 20, steps: int = 130, stated: float = 1.0, memory: float = 0.0, seed: int = 0
) -> list[Trace]:
    """Traces of exact Kalman filters on a simulated random walk with two noisy sensors; the angle walks about pi.

    Args:
        stated: covariances are multiplied by it, so 1 is true. memory: of the sensors' noise, AR(1); 0 is white.
    """
    rng = np.random.default_rng(seed)
    n = len(SCALE)
    process, start = np.diag(np.square(0.5 * SCALE)), np.diag(np.square(SCALE))
    mix = np.array([[1.0, 0.4, 0.0], [0.0, 1.0, 0.3], [0.0, 0.0, 1.0]]) * SCALE[:, None]
    noises = [np.diag(np.square(SCALE)), mix @ mix.T]
    walk = rng.multivariate_normal(np.zeros(n), process, (trajectories, steps)).cumsum(1)
    truth = walk + rng.multivariate_normal(np.zeros(n), start, trajectories)[:, None]
    seen = []
    for noise in noises:
        v = rng.multivariate_normal(np.zeros(n), noise, (trajectories, steps))
        for step in range(1, steps):  # stationary, whatever the memory
            v[:, step] = memory * v[:, step - 1] + np.sqrt(1.0 - memory**2) * v[:, step]
        seen.append(truth + v)
    precise = [np.linalg.inv(noise) for noise in noises]
    joint = np.linalg.inv(sum(precise))
    both = sum(z @ p for z, p in zip(seen, precise, strict=True)) @ joint
    alone = [kalman(z, noise, process, start) for z, noise in zip(seen, noises, strict=True)]
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
            estimate_covariance=stated * covariance,
            modality_mean=np.stack([state(one[2][i]) for one in alone], 1),
            modality_covariance=stated * np.stack([one[3] for one in alone], 1),
            predicted_mean=np.stack([state(one[0][i]) for one in alone], 1),
            predicted_covariance=stated * np.stack([one[1] for one in alone], 1),
            observation_mean=np.stack([state(z[i]) for z in seen], 1),
            observation_covariance=stated * np.broadcast_to(np.stack(noises), (steps, 2, n, n)),
        )
        for i in range(trajectories)
    ]


K_ARRAYS = (
    "modality_mean",
    "modality_covariance",
    "weights",
    "acting",
    "predicted_mean",
    "predicted_covariance",
    "observation_mean",
    "observation_covariance",
    "log_likelihood",
)


def swapped(given: Trace) -> Trace:
    """The same with its modalities in the opposite order."""
    arrays: dict[str, Any] = {name: value[:, ::-1] for name in K_ARRAYS if (value := getattr(given, name)) is not None}
    return replace(given, modalities=given.modalities[::-1], **arrays)
