"""Few faulty episodes among healthy ones, which a test of their mean cannot find."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import beliefscope as bs
from beliefscope.inspect.diagnosis.case import _far_outside

TASK = bs.Task("ferry", (bs.Component("x", "m"),), {"gps": (1,)}, {"gps": ("gps",)}, 0, 0.1, warmup=0)


def drive(seed: int, std: float = 0.1, steps: int = 60) -> bs.Episode:
    rng = np.random.default_rng(seed)
    x = rng.normal(0.0, 0.3, (steps, 1)).cumsum(0)
    readings = {"gps": (x + rng.normal(0.0, std, x.shape)).astype(np.float32)}
    controls = np.zeros((steps, 0), np.float32)
    return bs.Episode(TASK, x.astype(np.float32), controls, readings, seed=seed, split="test")


def reading(*, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
    covariance = np.full((*controls.shape[:-1], 1, 1), 0.01)
    return {"estimate_mean": observations["gps"], "estimate_covariance": covariance}


@cache
def record() -> Any:
    return bs.healthy_record(filter_(), [drive(seed) for seed in range(20)])


def filter_() -> bs.Checkpoint:
    return bs.load_filter(bs.Adapter(reading, task=TASK), name="reading")


@pytest.mark.slow
@pytest.mark.parametrize(("wrong", "where"), [([3], "in episode 3"), ([3, 8], "in at least 2 of 10 episodes")])
def test_few_faulty_episodes_are_found_and_named(wrong: list[int], where: str, tmp_path: Path) -> None:
    episodes = [drive(100 + i, 0.5 if i in wrong else 0.1) for i in range(10)]
    diagnosis = bs.diagnose(filter_(), bs.save_dataset(episodes, tmp_path / "data.h5"), profile_from=record())
    assert diagnosis.causes[0].cause.name == "gps.noise"
    assert where in diagnosis.headline
    assert list(diagnosis.causes[0].episodes) == wrong


@pytest.mark.slow
def test_healthy_episodes_are_not_outlying(tmp_path: Path) -> None:
    data = bs.save_dataset([drive(300 + i) for i in range(10)], tmp_path / "data.h5")
    assert bs.diagnose(filter_(), data, profile_from=record()).state == "healthy"


@pytest.mark.parametrize(
    ("value", "record", "expected"),
    [
        (2.7, np.linspace(0.0, 1.0, 20), True),  # further from 1 than 1.5 times the range
        (2.3, np.linspace(0.0, 1.0, 20), False),
        (-2.0, np.linspace(0.0, 1.0, 20), False),  # of a statistic whose decrease is no fault
        (2.6, np.append(np.linspace(0.0, 0.1, 19), 1.0), False),  # the record has such an episode itself
        (9.0, np.append(np.full(12, np.nan), np.linspace(0.0, 1.0, 8)), False),  # too few to know
    ],
)
def test_far_is_relative_to_the_range_and_the_gaps_of_the_record(
    value: float, record: np.ndarray, expected: bool
) -> None:
    far = _far_outside(record[:, None], np.array([[value]]), np.array([1e-3]), np.array([True]))
    assert far.tolist() == [[expected]]
