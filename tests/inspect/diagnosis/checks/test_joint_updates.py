"""Measurement noise of filters that update with all measurements at once."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pytest

import beliefscope as bs
from beliefscope.inspect.diagnosis.checks.innovations import innovation_statistics

STD = {"near": 0.5, "far": 2.0}
"""Standard deviations of two sensors of the same position, m."""
TASK = bs.Task(
    name="rail",
    components=(bs.Component("x", "m"),),
    observations=dict.fromkeys(STD, (1,)),
    modalities={key: (key,) for key in STD},
    masks={"far": "seen"},
    covariates={"seen": bs.Covariate("boolean")},
    control_size=0,
    dt=0.1,
)


def drive(seed: int, steps: int = 60) -> bs.Episode:
    rng = np.random.default_rng(seed)
    x = rng.normal(0.0, 0.3, (steps, 1)).cumsum(0)
    readings = {key: (x + rng.normal(0.0, std, x.shape)).astype(np.float32) for key, std in STD.items()}
    seen = (np.arange(steps) % 3 > 0).astype(np.float32)
    states, controls = x.astype(np.float32), np.zeros((steps, 0), np.float32)
    return bs.Episode(TASK, states, controls, readings, covariates={"seen": seen}, seed=seed, split="test")


class Joint:
    """A Kalman filter of a random walk, with the update by each sensor alone beside that by both."""

    task: ClassVar = TASK

    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        self.mean, self.variance = mean, covariance

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        prior, mean = self.variance + 0.3**2, self.mean
        present = {"near": True, "far": float(observations["far.present"].reshape(())) > 0.0}
        nu = [observations[key] - mean if present[key] else None for key in STD]
        sizes = [prior + std**2 if present[key] else None for key, std in STD.items()]
        gains = [0.0 if size is None else prior / size for size in sizes]
        information = 1.0 / prior + sum(present[key] / std**2 for key, std in STD.items())
        self.variance = 1.0 / information
        steps = (self.variance * n / std**2 for n, std in zip(nu, STD.values(), strict=True) if n is not None)
        self.mean = mean + sum(x.reshape(1) for x in steps)
        own = [mean if n is None else mean + (g * n).reshape(1) for g, n in zip(gains, nu, strict=True)]
        return {
            "estimate_mean": self.mean,
            "estimate_covariance": self.variance,
            "predicted_mean": np.stack([mean, mean]),
            "predicted_covariance": np.stack([prior, prior]),
            "modality_mean": np.stack(own),
            "modality_covariance": np.stack([(1.0 - g) * prior for g in gains]),
            "innovation": nu,
            "innovation_covariance": sizes,
        }


def test_the_noise_of_each_sensor_is_that_of_its_own_update() -> None:
    """``det S_k / det R_k = det P / det P_k``: the covariance between the measurements of both has no part in it."""
    adapter = bs.Adapter(Joint(), batched=False, modalities=tuple(STD), initial_std=(1.0,), task=TASK)
    statistics = innovation_statistics(bs.trace(bs.load_filter(adapter, name="joint"), [drive(0)]))
    noise = {key: statistics[f"measurement noise/{key}/all"] for key in STD}
    assert noise == pytest.approx(STD, rel=1e-4)
