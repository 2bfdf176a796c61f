"""Dynamics, process noise and fusion weights of an external filter, from what it reports."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import beliefscope as bs
from beliefscope.datasets.faults.injection import Faults
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnosis.diagnose import diagnose
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.healthy import profile_of

SENSORS = {"front": 0.02, "rear": 0.05}
"""Sensor of a position, m -> its standard deviation, m."""

TASK = bs.Task(
    name="cart",
    components=(bs.Component("x", "m"), bs.Component("y", "m")),
    observations=dict.fromkeys(SENSORS, (2,)),
    modalities={key: (key,) for key in SENSORS},
    control_size=2,
    dt=0.1,
)


def drive(seed: int) -> bs.Episode:
    """The controls are displacements, m."""
    rng = np.random.default_rng(seed)
    controls = np.repeat(rng.normal(0.0, 0.05, (15, 2)), 4, axis=0)
    states = np.cumsum(controls + rng.normal(0.0, 0.005, (60, 2)), axis=0)
    readings = {key: states + rng.normal(0.0, std, (60, 2)) for key, std in SENSORS.items()}
    return bs.Episode(TASK, states, controls, readings, seed=seed, split="test")


class Cart:
    """Two updates of one prediction, averaged with weights."""

    def __init__(
        self, gain: float = 1.0, noise: float = 0.005, weight: float | None = None, ignores_start: bool = False
    ) -> None:
        self.gain, self.noise, self.weight, self.ignores_start = gain, noise, weight, ignores_start

    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        self.mean, self.covariance = (np.zeros(2) if self.ignores_start else mean), covariance

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        mean, covariance = self.mean + self.gain * controls, self.covariance + self.noise**2 * np.eye(2)
        posterior = []
        for key, std in SENSORS.items():
            k = covariance @ np.linalg.inv(covariance + std**2 * np.eye(2))
            posterior.append((mean + k @ (observations[key] - mean), (np.eye(2) - k) @ covariance))
        share = 0.8 + 0.1 * np.tanh(20.0 * observations["rear"][0]) if self.weight is None else self.weight
        weights = np.array([share, 1.0 - share])
        self.mean, self.covariance = (sum(w * p[i] for w, p in zip(weights, posterior, strict=True)) for i in (0, 1))
        return {
            "estimate_mean": self.mean,
            "estimate_covariance": self.covariance,
            "predicted_mean": np.stack([mean] * 2),
            "predicted_covariance": np.stack([covariance] * 2),
            "weights": weights[:, None],
        }


def loaded(filter_: Cart) -> Checkpoint:
    adapter = bs.Adapter(filter_, batched=False, modalities=tuple(SENSORS), initial_std=(0.02, 0.02))
    return bs.load_filter(adapter, TASK, name="cart")


@cache
def profile() -> HealthyProfile:
    return profile_of(loaded(Cart()), [drive(seed) for seed in range(12)], "cart")


@pytest.mark.first(2)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("filter_", "cause"),
    [
        (Cart(gain=-1.0), "dynamics.inverted"),
        pytest.param(Cart(gain=0.1), "dynamics.frozen", marks=pytest.mark.long),
        (Cart(noise=0.0005), "process_noise.small"),
        pytest.param(Cart(noise=0.0), "process_noise.small", marks=pytest.mark.long),
        pytest.param(Cart(noise=0.05), "process_noise.large", marks=pytest.mark.long),
        (Cart(weight=0.98), "weights.constant"),
        (Cart(ignores_start=True), "start.ignored"),
    ],
)
def test_defects_of_an_external_filter_are_named(filter_: Cart, cause: str) -> None:
    result = diagnose(loaded(filter_), {seed: drive(seed) for seed in range(20, 30)}, profile=profile())
    assert result.causes, result.headline
    assert (result.causes[0].cause.name, result.causes[0].probability > 0.5) == (cause, True)


@pytest.mark.long
@pytest.mark.slow
def test_a_healthy_external_filter_is_healthy() -> None:
    assert diagnose(loaded(Cart()), {seed: drive(seed) for seed in range(20, 30)}, profile=profile()).state == "healthy"


@pytest.mark.slow
def test_a_faulty_sensor_is_not_broken_dynamics() -> None:
    faulty = {seed: Faults.parse("sensor_gain=rear:factor=-1").apply(drive(seed), seed) for seed in range(50, 56)}
    result = diagnose(loaded(Cart(weight=0.5)), faulty, profile=profile())
    probability = {c.cause.name: c.probability for c in result.causes}
    assert probability["rear.sign"] > 0.9 > 0.2 > probability.get("dynamics.broken", 0.0)


@pytest.mark.slow
@pytest.mark.long
def test_units_of_groups_may_have_a_slash() -> None:
    task = replace(TASK, name="fast_cart", covariates={"speed": bs.Covariate("continuous", cuts=(0.4,), unit="m/s")})
    episodes = [drive(seed) for seed in range(16)]
    fast = [replace(e, task=task, covariates={"speed": np.linalg.norm(e.controls, axis=1) / task.dt}) for e in episodes]
    adapter = bs.Adapter(Cart(), batched=False, modalities=tuple(SENSORS), initial_std=(0.02, 0.02))
    filter_ = bs.load_filter(adapter, task, name="cart")
    record = HealthyProfile.from_json(profile_of(filter_, fast[:12], "cart").to_json())
    result = diagnose(filter_, dict(enumerate(fast[12:])), profile=record)
    assert result.state == "healthy"
    assert any(name.startswith("nees/fused/speed below 0.4 m") for name in record.statistics)
