"""Synthetic traces of smooth random arrays, with every field of both kinds of filter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.inspect.maps.map_engine import LikelihoodMap
from beliefscope.inspect.trace import Trace

MODALITIES = ("image", "haptics")


def _smooth(rng: np.random.Generator, steps: int, *shape: int) -> NDArray[np.float32]:
    """(steps, *shape) random walks of unit spread."""
    walk = rng.normal(size=(steps, *shape)).cumsum(axis=0)
    return (walk / (walk.std() + 1e-9)).astype(np.float32)


def _covariances(rng: np.random.Generator, scale: NDArray[np.float32], *shape: int) -> NDArray[np.float32]:
    """(*shape, n, n) symmetric positive definite matrices with standard deviations near ``scale`` (n,)."""
    factor = np.eye(len(scale)) + 0.5 * np.tril(rng.normal(size=(*shape, len(scale), len(scale))), -1)
    factor *= scale[:, None]
    return (factor @ np.swapaxes(factor, -1, -2)).astype(np.float32)


def _episode(rng: np.random.Generator, steps: int) -> Episode:
    angle = 0.4 + 0.3 * np.sin(np.linspace(0, 9, steps))
    states = np.stack([np.full(steps, 0.81), np.full(steps, -0.28), angle], axis=1).astype(np.float32)
    contact = np.sin(np.linspace(0, 20, steps)) > 0
    effector = np.array([0.5, -0.1, 0.62]) + [0.1, 0.1, 0.02] * _smooth(rng, steps, 3)
    observations = {
        "image": np.clip(128 + 50 * _smooth(rng, steps, 32, 32), 0, 255).astype(np.uint8),
        "effector_position": effector.astype(np.float32),
        "force": 9 * _smooth(rng, steps, 3),
        "torque": _smooth(rng, steps, 3),
        "contact": contact[:, None].astype(np.float32),
    }
    return Episode(
        task=DOOR,
        states=states,
        controls=_smooth(rng, steps, 7),
        observations=observations,
        contact=contact,
        qpos=_smooth(rng, steps, 10),
        dt=0.1,
        seed=7,
        split="test",
        provenance={"policy": "pull", "hinge": [0.81, -0.28]},
    )


def make_trace(kind: str, steps: int = 40, particles: int = 30, seed: int = 0) -> Trace:
    """A trace with realistic values; K = 2 modalities, n = 3 components."""
    rng = np.random.default_rng(seed)
    episode = _episode(rng, steps)
    scale = np.array([0.02, 0.02, 0.03], np.float32)
    noise = scale * _smooth(rng, steps, 2, 3)
    beta = 1 / (1 + np.exp(-_smooth(rng, steps, 3)))
    weights = np.stack([beta, 1 - beta], axis=1).astype(np.float32)
    common: dict[str, Any] = {
        "episode": episode,
        "modalities": MODALITIES,
        "kind": kind,
        "filter": f"crossmodal-{kind}",
        "estimate_mean": episode.states + noise.mean(axis=1) / 2,
        "estimate_covariance": _covariances(rng, scale / 2, steps),
        "modality_mean": episode.states[:, None] + noise,
        "modality_covariance": _covariances(rng, scale, steps, 2),
        "start_mean": episode.states[0],
        "start_covariance": np.diag(scale**2),
        "checkpoint_hash": "c" * 64,
        "data_hash": episode.digest(),
        "episode_index": 3,
        "seed": 11,
        "faults": Faults.parse("blackout=0.4,force_bias:x=5:from=3"),
        "settings": {"particles": particles, "versions": {"torch": "2"}},
    }
    if kind == "ekf":
        return Trace(
            weights=weights,
            effective_weights=weights,
            predicted_mean=episode.states[:, None] + 1.1 * noise,
            predicted_covariance=_covariances(rng, scale, steps, 2),
            observation_mean=episode.states[:, None] + 2 * noise,
            observation_covariance=_covariances(rng, 2 * scale, steps, 2),
            **common,
        )
    cloud = common["estimate_mean"][:, None] + scale * rng.normal(size=(steps, particles, 3))
    likelihood = -0.5 * ((cloud[:, None] - common["modality_mean"][:, :, None]) / scale) ** 2
    likelihood = likelihood.sum(axis=-1).astype(np.float32)
    total = likelihood.mean(axis=1)
    normalised = total - np.log(np.exp(total).sum(axis=1, keepdims=True))
    return Trace(
        weights=weights[:, :, :1],
        effective_weights=weights[:, :, :1],
        particles=cloud.astype(np.float32),
        prior_log_weights=np.full_like(total, -np.log(particles)),
        log_weights=normalised.astype(np.float32),
        log_likelihood=likelihood,
        ancestors=rng.integers(particles, size=(steps, particles), dtype=np.int32),
        **common,
    )


def make_map(trace: Trace, step: int, size: int = 41) -> LikelihoodMap:
    """Gaussian maps: isotropic for the image, elongated for haptics, and their sum."""
    axis = np.linspace(-0.135, 0.135, size, dtype=np.float32)
    x, y = np.meshgrid(axis, axis)
    angle = 0.02 * step
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    image = -0.5 * (x**2 + y**2) / 0.03**2
    haptics = -0.5 * (along**2 / 0.08**2 + across**2 / 0.01**2)
    layers = np.stack([image, haptics, image + haptics]).astype(np.float32)
    truth = trace.episode.states[step]
    return LikelihoodMap(step, float(truth[2]), (*trace.modalities, "fused"), axis, axis, truth[:2], layers)


def _assert_same(first: Trace, second: Trace) -> None:
    for field in fields(Trace):
        left, right = getattr(first, field.name), getattr(second, field.name)
        if isinstance(left, np.ndarray):
            assert left.dtype == right.dtype, field.name
            np.testing.assert_array_equal(left, right, field.name)
        elif field.name != "episode":
            assert left == right, field.name
    assert first.episode.digest() == second.episode.digest()
    assert first.episode.provenance == second.episode.provenance


@pytest.fixture(params=["ekf", "pf"])
def trace(request: pytest.FixtureRequest) -> Trace:
    return make_trace(request.param)


@pytest.fixture
def new_trace() -> Callable[..., Trace]:
    return make_trace


@pytest.fixture
def new_map() -> Callable[..., LikelihoodMap]:
    return make_map


@pytest.fixture
def assert_same() -> Callable[[Trace, Trace], None]:
    return _assert_same
