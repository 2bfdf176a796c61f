"""A shift of the labels: one of them explains the errors of all sensors of the position, a bias those of its own."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Component, Task
from beliefscope.inspect.diagnosis.case import Case
from beliefscope.inspect.diagnosis.catalog import causes_of
from beliefscope.inspect.diagnosis.checks.label_shift import label_shift_statistics
from beliefscope.inspect.diagnosis.scoring import explain, probabilities
from beliefscope.inspect.diagnosis.unmeasured import statistics_by_subject
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation
from beliefscope.inspect.statistics.reading_fit import fit_reading_models
from beliefscope.inspect.statistics.reading_model import ReadingModel

NOISE, STEPS = {"gps": 0.1, "radio": 0.2}, 80
TASK = Task(
    name="yard",
    components=(Component("x", "m"), Component("y", "m"), Component("speed", "m/s")),
    observations={"gps": (2,), "radio": (2,), "wheel": (1,)},
    modalities={"gps": ("gps",), "radio": ("radio",), "wheel": ("wheel",)},
    control_size=0,
    dt=0.1,
)


def drive(seed: int) -> Episode:
    """GPS in the axes of the world, radio in axes that are turned and scaled, and wheels without the position."""
    rng = np.random.default_rng(seed)
    place = np.cumsum(rng.normal(0.0, 0.5, (STEPS, 2)), axis=0)
    speed = rng.normal(1.0, 0.3, (STEPS, 1))
    readings = {"gps": place, "radio": place @ np.array([[0.0, 2.0], [-2.0, 0.0]]), "wheel": speed}
    noise = {**NOISE, "wheel": 0.02}
    readings = {key: z + rng.normal(0.0, noise[key], z.shape) for key, z in readings.items()}
    return Episode(TASK, np.column_stack([place, speed]), np.zeros((STEPS, 0)), readings)


@cache
def models() -> tuple[ReadingModel, ...]:
    return fit_reading_models([drive(seed) for seed in range(12)], list(TASK.observations))


def shifted(episode: Episode, by: tuple[float, float]) -> Episode:
    return replace(episode, states=episode.states + np.array([*by, 0.0], np.float32))


def biased(episode: Episode, key: str, by: float) -> Episode:
    return replace(episode, observations={**episode.observations, key: episode.observations[key] + np.float32(by)})


@pytest.mark.parametrize("size", [0.5, 2.0])
def test_a_shift_of_the_labels_has_the_log_ratio_of_its_square_to_the_noise(size: float) -> None:
    """Of the less exact sensor, whose noise is 0.1 m in the axes of the world, as that of the other one."""
    values = label_shift_statistics(shifted(drive(100), (size, 0.0)), models())
    mean = 1.0 + 0.5 * np.square(size / 0.1)  # mean square of two channels in their noise: one of them is shifted
    assert values["label shift//all"] == pytest.approx(0.5 * np.log(mean), abs=0.2)


@pytest.mark.parametrize("key", ["gps", "radio"])
def test_a_bias_of_one_sensor_is_no_shift(key: str) -> None:
    for episode in (drive(100), biased(drive(100), key, 2.0)):
        assert label_shift_statistics(episode, models())["label shift//all"] < 0.1


def test_one_sensor_of_the_position_cannot_tell() -> None:
    others = [model for model in models() if model.key != "radio"]
    assert [model.key for model in others] == ["gps", "wheel"]
    assert label_shift_statistics(shifted(drive(100), (2.0, 0.0)), others) == {}
    assert label_shift_statistics(shifted(drive(100), (2.0, 0.0)), others[:1]) == {}


def test_states_without_a_position_have_no_shift() -> None:
    heated = replace(TASK, components=tuple(replace(component, unit="K") for component in TASK.components))
    assert label_shift_statistics(replace(drive(100), task=heated), models()) == {}


def test_the_cause_is_the_labels_and_not_each_of_the_sensors() -> None:
    deviations = [Deviation("label shift//all", 3.0, 0.0, 0.0, 0.1, 0.0, True, 20.0)]
    for key in ("gps", "radio"):
        deviations.append(Deviation(f"reading bias/{key} x/all", 9.0, 0.0, -0.1, 0.1, 0.0, True, 20.0))
    result = probabilities({cause.name: explain(cause, deviations) for cause in causes_of(TASK)})
    assert result["labels.offset"] > 0.8


def test_the_statistic_counts_as_one_of_the_labels() -> None:
    names = ["label shift//all", "reading bias/gps x/all", "error//all"]
    case = SimpleNamespace(
        inputs=SimpleNamespace(checkpoint=SimpleNamespace(task=TASK)),
        deviations=[Deviation(name, 0.0, 0.0, 0.0, 0.0, 1.0, False, 0.0) for name in names],
        sensors=[dict.fromkeys(names[:2], 0.0)],
    )
    assert statistics_by_subject(cast(Case, case)) == {"gps": 1, "labels": 1, "filter": 1}
