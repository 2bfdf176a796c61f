"""Readings and controls of slower and faster motions than those of the record are expected as well."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Component, Task
from beliefscope.inspect.diagnosis.checks.episode_statistics import with_slopes
from beliefscope.inspect.diagnosis.checks.readings import (
    UNCERTAIN,
    _is_own_arrangement,
    reading_statistics,
    without_explained,
)
from beliefscope.inspect.diagnosis.checks.sensors import sensor_statistics
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.statistics.reading_features import CONTROL
from beliefscope.inspect.statistics.reading_fit import fit_reading_models
from beliefscope.inspect.statistics.reading_model import ReadingModel

TASK = Task("swing", (Component("x", "m"), Component("tilt", "rad")), {"level": (2,)}, {"level": ("level",)}, 1, 0.1)
STEPS, MOVED, NOISE = 150, 0.05, 1.0  # number; process noise, m per step; m/s2


def swing(seed: int, size: float = 1.0, scale: float = 1.0, bias: float = 0.0, measured: float = 0.0) -> Episode:
    """Velocity as control; gravity along and across, which the tilt hardly explains.

    size: of the motion. scale, measured: factor and noise of the controls. bias: of gravity across.
    """
    rng = np.random.default_rng(seed)
    velocity = size * np.repeat(rng.normal(0.0, 1.0, STEPS // 5), 5)
    place = np.cumsum(0.1 * velocity + rng.normal(0.0, MOVED, STEPS))
    tilt = 0.5 * size * np.sin(0.2 * np.arange(STEPS) + rng.uniform(0.0, 6.0))
    gravity = 9.81 * np.stack([np.sin(tilt), np.cos(tilt)], 1) + rng.normal(0.0, NOISE, (STEPS, 2))
    controls = scale * (velocity + rng.normal(0.0, measured, STEPS))
    gravity[:, 1] += bias
    return Episode(TASK, np.stack([place, tilt], 1), controls[:, None], {"level": gravity})


@cache
def models(measured: float = 0.0) -> tuple[ReadingModel, ...]:
    return fit_reading_models([swing(seed, measured=measured) for seed in range(20)], ["level", CONTROL])


def mean(name: str, measured: float = 0.0, **options: float) -> float:
    """Over ten other episodes."""
    episodes = [swing(seed, measured=measured, **options) for seed in range(100, 110)]
    return float(np.nanmean([reading_statistics(episode, models(measured)).get(name, np.nan) for episode in episodes]))


@pytest.mark.parametrize("measured", [0.0, 0.5])
@pytest.mark.parametrize("size", [0.4, 0.6, 1.0, 1.6])
def test_slow_and_fast_controls_are_not_scaled(size: float, measured: float) -> None:
    """The labels have process noise, the controls noise or none: both flatten a slope of small motions."""
    one_sided = 1.0 / (1.0 + (MOVED / (0.1 * size)) ** 2) * (1.0 + (MOVED / 0.1) ** 2)
    assert size != 0.4 or one_sided < 0.5, "by a regression on the labels, slow controls would be scaled"
    assert mean("reading gain/control/all", measured, size=size) == pytest.approx(1.0, abs=0.08)


@pytest.mark.parametrize("measured", [0.0, 0.5])
@pytest.mark.parametrize("scale", [0.5, 2.5])
def test_scaled_controls_have_their_scale(scale: float, measured: float) -> None:
    gain = mean("reading gain/control/all", measured, scale=scale)
    assert gain == pytest.approx(scale, rel=0.25)  # an uncertain one is shrunk towards 1


def test_models_of_earlier_versions_have_the_slope_on_the_labels() -> None:
    (model,) = (model for model in models() if model.key == CONTROL)
    document = model.to_json()
    for channel in document["of_channels"]:
        assert channel.pop("explained") == pytest.approx(1.0 / (1.0 + (MOVED / 0.1) ** 2), abs=0.05)
    earlier = ReadingModel.from_json(document)
    assert math.isnan(earlier.explained[0])
    assert earlier.to_json() == document
    slow = [reading_statistics(swing(seed, 0.4), [earlier])["reading gain/control/all"] for seed in range(10)]
    assert np.mean(slow) < 0.85


@pytest.mark.parametrize("size", [0.5, 1.0])
@pytest.mark.parametrize("bias", [0.0, 0.8])
def test_the_level_of_readings_that_the_labels_explain_in_part_is_compared_with_the_expected_one(
    size: float, bias: float
) -> None:
    (model,) = (model for model in models() if model.key == "level")
    assert model.channels == (0,)
    assert [weak.index for weak in model.of_weak_channels] == [1]
    assert mean("reading bias/level y/all", size=size, bias=bias) == pytest.approx(bias / NOISE, abs=0.15)


def test_levels_without_an_expected_value_count() -> None:
    episode = swing(1)
    row = sensor_statistics(episode, None, models())
    assert "level/level y/free motion" in row
    kinds = {name.split("/")[0] for name in without_explained(row) if name.split("/")[1] == "level y"}
    assert {"reading bias", "reading drift", "noise"} <= kinds
    assert not {"level", "drift", "roughness"} & kinds
    assert "level/level y/free motion" in without_explained(sensor_statistics(episode, None, ()))


def test_a_noisy_channel_does_not_hide_a_short_delay() -> None:
    """Relative to its noise, the error of an exact reading is small as that of a noisy channel."""
    errors = np.array([[[4.0, 0.5], [900.0, 4.0]], [[9.0, 0.6], [900.0, 9.0]]])
    assert _is_own_arrangement(errors)
    errors[1, 0, 0] = 1.0
    assert not _is_own_arrangement(errors), "the opposite sign fits better"


def test_a_short_delay_is_unknown_where_the_readings_hardly_vary() -> None:
    """The standard error of a delay is the noise over the root of the summed squares of the changes by step."""
    (model,) = (model for model in models() if model.key == "level")
    for size in (0.02, 1.0):
        episode = swing(3, size)
        change = np.gradient(9.81 * np.sin(episode.states[:, 1].astype(np.float64)))
        error = NOISE / math.sqrt(np.square(change).sum())
        delay = reading_statistics(episode, [model])["reading lag/level/all"]
        assert math.isnan(delay) == (error > UNCERTAIN)


@pytest.mark.parametrize(
    ("slope", "response", "expected"),
    [
        (1.1, 0.8, 1.1),  # healthy: noise in the controls, and process noise
        (1.02, 0.8, 1.1),  # faster: less effect of noise in the controls
        (1.1, 0.6, 1.1),  # slower: more effect of the process noise
        (1.5, 0.6, 1.1),  # delayed
        (0.55, 0.4, 0.55),  # half of the changes
        (2.2, 1.6, 2.2),
        (-1.1, -0.8, -1.1),
        (1.5, math.nan, 1.5),
    ],
)
def test_a_gain_changes_the_slopes_on_both_changes(slope: float, response: float, expected: float) -> None:
    names = [f"dynamics {kind}/x/all" for kind in ("slope", "response")]
    columns = {names[0]: np.full(20, 1.1), names[1]: np.full(20, 0.8), "nees/x/all": np.ones(20)}
    record = HealthyProfile("", 20, None, columns)
    healthy, (row,) = with_slopes(record, [{names[0]: slope, names[1]: response, "nees/x/all": 2.0}])
    assert row == {names[0]: pytest.approx(expected), "nees/x/all": 2.0}
    assert sorted(healthy.statistics) == [names[0], "nees/x/all"]
    assert healthy.statistics[names[0]] == pytest.approx(1.1)


def test_components_that_never_move_have_no_slope() -> None:
    columns = {f"dynamics {kind}/x/all": np.full(20, math.nan) for kind in ("slope", "response")}
    healthy, (row,) = with_slopes(HealthyProfile("", 20, None, columns), [dict.fromkeys(columns, math.nan)])
    assert list(row) == list(healthy.statistics) == ["dynamics slope/x/all"]


def test_records_of_earlier_versions_have_the_slope_alone() -> None:
    record = HealthyProfile("", 20, None, {"dynamics slope/x/all": np.full(20, 1.1)})
    _, (row,) = with_slopes(record, [{"dynamics slope/x/all": 0.7, "dynamics response/x/all": 0.8}])
    assert row["dynamics slope/x/all"] == 0.7


FINGER = Task("finger", (Component("x", "m"), Component("y", "m")), {"gps": (2,)}, {"gps": ("gps",)}, 4, 0.1)


def slide(seed: int, delay: int = 0) -> Episode:
    """Controls: position of a finger, whose sensor drifts, and its exact change by step, both on two axes."""
    rng = np.random.default_rng(seed)
    goals = np.repeat(rng.normal(0.0, 0.05, (STEPS // 10, 2)), 10, axis=0)
    response = [0.3 * 0.7**k for k in range(40)]
    states = np.stack([np.convolve(goal, response)[:STEPS] for goal in goals.T], axis=1)
    change = np.diff(states, axis=0, prepend=states[:1]) + rng.normal(0.0, 0.001, (STEPS, 2))
    finger = states + np.cumsum(rng.normal(0.0, 0.006, (STEPS, 2)), axis=0)
    controls = np.concatenate([finger, change], axis=1)[np.maximum(np.arange(STEPS) - delay, 0)]
    return Episode(FINGER, states, controls, {"gps": states + rng.normal(0.0, 0.01, (STEPS, 2))})


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_noisy_controls_do_not_hide_the_delay_of_exact_ones(delay: int) -> None:
    """Relative to the noise of a position, a change by step is as near to it as to its own expected value."""
    record = fit_reading_models([slide(seed) for seed in range(20)], [CONTROL])
    lags = [reading_statistics(slide(seed, delay), record)["reading lag/control/all"] for seed in range(100, 106)]
    assert np.mean(lags) == pytest.approx(delay, abs=0.35)
