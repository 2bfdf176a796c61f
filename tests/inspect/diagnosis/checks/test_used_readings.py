"""Updates that a filter leaves out, without any innovation that it reports."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pytest

import beliefscope as bs
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnosis.catalog import causes_of
from beliefscope.inspect.diagnosis.causes.external_filters import external_causes
from beliefscope.inspect.diagnosis.checks.used_readings import used_readings
from beliefscope.inspect.diagnosis.scoring import applicable, explain, probabilities
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation

TASK = bs.Task(
    name="rail",
    components=(bs.Component("x", "m"),),
    observations={"camera": (4, 4), "far": (1,)},
    modalities={"image": ("camera",), "far": ("far",)},
    masks={"far": "seen"},
    covariates={"seen": bs.Covariate("boolean")},
    control_size=0,
    dt=0.1,
    warmup=0,
)


def drive(seed: int, steps: int = 60) -> bs.Episode:
    rng = np.random.default_rng(seed)
    x = rng.normal(0.0, 0.3, (steps, 1)).cumsum(0).astype(np.float32)
    far = x + rng.normal(0.0, 0.5, x.shape).astype(np.float32)
    seen = (np.arange(steps) % 3 > 0).astype(np.float32)
    camera = np.clip(128.0 + 20.0 * x[:, :, None] + rng.normal(0.0, 4.0, (steps, 4, 4)), 1, 255).astype(np.uint8)
    readings = {"camera": camera, "far": far}
    controls = np.zeros((steps, 0), np.float32)
    return bs.Episode(TASK, x, controls, readings, covariates={"seen": seen}, seed=seed, split="test")


@dataclass
class Updates:
    """A Kalman filter of a random walk that reports its estimate and prediction only.

    image, absent: whether it uses the images, and readings of the other sensor at steps that have none.
    """

    image: bool = True
    absent: bool = False
    task: ClassVar = TASK

    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        self.mean, self.variance = mean, covariance

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        self.variance = self.variance + 0.3**2
        prior = {"predicted_mean": self.mean[None], "predicted_covariance": self.variance[None]}
        readings = [((observations["camera"].mean() - 128.0) / 20.0, 0.1)] if self.image else []
        if self.absent or float(observations["far.present"].reshape(())) > 0.0:
            readings.append((float(observations["far"].reshape(())), 0.5))
        for z, std in readings:
            gain = self.variance / (self.variance + std**2)
            self.mean, self.variance = self.mean + (gain * (z - self.mean)).reshape(1), (1.0 - gain) * self.variance
        return {"estimate_mean": self.mean, "estimate_covariance": self.variance, **prior}


def shares(episode: bs.Episode, **changed: bool) -> dict[str, float]:
    adapter = bs.Adapter(Updates(**changed), batched=False, initial_std=(1.0,), task=TASK)
    checkpoint = bs.load_filter(adapter, name="updates")
    assert isinstance(checkpoint, ExternalFilter)
    return used_readings(bs.trace(checkpoint, [episode]), checkpoint)


@pytest.mark.parametrize(
    ("changed", "image", "absent"),
    [({}, 1.0, 0.0), ({"image": False}, 0.0, 0.0), ({"absent": True}, 1.0, 1.0)],
)
def test_readings_that_change_the_estimate_are_used(changed: dict[str, bool], image: float, absent: float) -> None:
    expected = {"updates/image/all": image, "updates/far/all": 1.0, "absent updates/far/all": absent}
    assert shares(drive(0), **changed) == expected


def test_lost_and_frozen_readings_do_not_count() -> None:
    episode = drive(1)
    lost = {**episode.observations, "camera": episode.observations["camera"].copy()}
    lost["camera"][20:40] = 0
    assert shares(replace(episode, observations=lost))["updates/image/all"] == 1.0
    frozen = {**episode.observations, "camera": np.repeat(episode.observations["camera"][:1], len(episode), axis=0)}
    assert "updates/image/all" not in shares(replace(episode, observations=frozen))


def test_a_share_that_falls_is_a_missing_update() -> None:
    fallen = Deviation("updates/image/all", 0.4, 1.0, 0.99, 1.0, 0.0, True, -30.0)
    causes = applicable((*causes_of(TASK), *external_causes(TASK)), [fallen.statistic])
    result = probabilities({cause.name: explain(cause, [fallen]) for cause in causes})
    assert max(result, key=lambda name: result[name]) == "updates.image.missing"
