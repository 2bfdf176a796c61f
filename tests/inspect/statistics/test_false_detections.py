"""Isolated readings, such as false detections: they change neither models nor other statistics, but are counted."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.inspect.statistics.test_reading_model import EPISODES, NEW, NOISE, STEPS, models, with_readings

from beliefscope.datasets.episode import Episode
from beliefscope.inspect.diagnosis.checks.readings import reading_statistics, without_outliers
from beliefscope.inspect.diagnosis.checks.sensors import sensor_statistics
from beliefscope.inspect.statistics.reading_fit import fit_reading_models
from beliefscope.inspect.statistics.reading_model import ReadingModel
from beliefscope.inspect.statistics.signals import isolated

SHARE = 0.03
FAR = 20.0  # m


def detected(episode: Episode, seed: int, share: float = SHARE, far: float = FAR) -> Episode:
    """GPS positions with false ones at some steps, anywhere."""
    rng = np.random.default_rng(seed)
    readings, steps = episode.observations["gps"].copy(), rng.random(STEPS) < share
    readings[steps] += rng.uniform(-far, far, (steps.sum(), 2))
    return with_readings(episode, "gps", readings)


@cache
def disturbed() -> ReadingModel:
    episodes = [detected(episode, seed) for seed, episode in enumerate(EPISODES)]
    (model,) = fit_reading_models(episodes, ["gps"])
    return model


def statistics(episode: Episode) -> dict[str, float]:
    return reading_statistics(episode, [disturbed()])


def test_the_model_is_that_of_the_other_readings() -> None:
    right, model = models()[0], disturbed()
    assert right.outliers == 0.0
    assert model.outliers == pytest.approx(SHARE, abs=0.01)
    assert model.channels == right.channels
    assert model.noise == pytest.approx(right.noise, rel=0.1)
    # Other readings are fitted: as far apart as noise makes the fits to two halves of the episodes.
    assert model.expected(NEW) == pytest.approx(right.expected(NEW), abs=0.5 * NOISE)
    assert ReadingModel.from_json(model.to_json()).outliers == pytest.approx(model.outliers)


def test_statistics_are_those_without_them_and_their_share_is_known() -> None:
    clean, faulty = statistics(NEW), statistics(detected(NEW, 5, share=0.1))
    assert clean["reading outliers/gps/all"] == 0.0
    assert faulty["reading outliers/gps/all"] == pytest.approx(0.1, abs=0.05)
    for kind in ("bias", "drift", "noise"):
        name = f"reading {kind}/gps x/all"
        assert faulty[name] == pytest.approx(clean[name], abs=0.3)
    left_out, plain = (
        sensor_statistics(detected(NEW, 5, share=0.2), None, models)["noise/gps x/extreme"]
        for models in ([disturbed()], [])
    )
    assert left_out < 3.0 * NOISE < 10.0 * NOISE < plain


def test_faults_are_not_isolated() -> None:
    readings, late = NEW.observations["gps"], np.arange(STEPS)[:, None] >= STEPS // 3
    biased = statistics(with_readings(NEW, "gps", readings + np.where(late, 1.0, 0.0)))
    drifting = statistics(with_readings(NEW, "gps", readings + np.linspace(0.0, 1.0, STEPS)[:, None]))
    rng = np.random.default_rng(0)
    noisy = statistics(with_readings(NEW, "gps", readings + rng.normal(0.0, 0.3, readings.shape)))
    assert [values["reading outliers/gps/all"] for values in (biased, drifting, noisy)] == [0.0, 0.0, 0.0]
    assert biased["reading bias/gps x/all"] == pytest.approx(2.0 / 3.0 / disturbed().noise[0], rel=0.05)
    assert drifting["reading drift/gps x/all"] == pytest.approx(1.0 / disturbed().noise[0], rel=0.05)
    assert noisy["reading noise/gps x/all"] == pytest.approx(30.0, rel=0.2)


def test_other_episodes_are_unchanged() -> None:
    assert np.array_equal(without_outliers(NEW, [models()[0]]).observations["gps"], NEW.observations["gps"])
    gone = replace(NEW, observations={"odometry": NEW.observations["odometry"]})
    assert without_outliers(gone, [disturbed()]).observations.keys() == {"odometry"}
    weak = replace(disturbed(), of_channels=(), of_weak_channels=disturbed().of_channels)
    assert np.array_equal(without_outliers(NEW, [weak]).observations["gps"], NEW.observations["gps"])


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_isolated_errors_do_not_depend_on_scale_offset_and_slope(scale: float) -> None:
    rng = np.random.default_rng(1)
    errors = rng.normal(size=(200, 2))
    assert not isolated(errors).any()
    errors[[20, 100, 199], 1] += 15.0
    found = isolated(scale * (errors + np.array([50.0, -3.0]) + 0.1 * np.arange(200)[:, None]))
    assert np.argwhere(found).tolist() == [[20, 1], [100, 1], [199, 1]]
    assert not isolated(np.zeros((200, 1))).any()
    assert not isolated(errors[:8]).any()


@pytest.mark.parametrize(("shares", "expected"), [((0.25, 0.04), 0.0), ((0.15, 0.0), 0.15)])
def test_some_episodes_leave_readings_out_as_all_do(shares: tuple[float, float], expected: float) -> None:
    """Otherwise the statistics of the record, from models of some episodes, would not be those of new episodes."""
    half = len(EPISODES) // 2
    episodes = [detected(e, seed, shares[seed >= half], far=1.0) for seed, e in enumerate(EPISODES)]
    part = episodes[half:] if expected == 0.0 else episodes[:half]
    whole, alone = fit_reading_models(episodes, ["gps"]), fit_reading_models(part, ["gps"])
    assert (whole[0].outliers > 0.0) == (expected > 0.0) != (alone[0].outliers > 0.0)
    (model,) = fit_reading_models(part, ["gps"], whole)
    assert model.outliers == pytest.approx(expected, abs=0.03)


def test_some_episodes_have_models_of_the_channels_of_all() -> None:
    """Also where their own labels explain a channel: otherwise, statistics would be of some episodes only."""
    (gps, _), episodes = models(), EPISODES[:6]
    part = replace(gps, of_channels=gps.of_channels[:1], of_weak_channels=gps.of_channels[1:])
    (same,) = fit_reading_models(episodes, ["gps"], [part])
    assert (same.channels, [weak.index for weak in same.of_weak_channels]) == ((0,), [1])
    (alone,) = fit_reading_models(episodes, ["gps"])
    assert alone.channels == (0, 1)
    assert same.expected(NEW)[:, 0] == pytest.approx(alone.expected(NEW)[:, 0])


@pytest.mark.parametrize("degree", [2, 3])
def test_some_episodes_have_the_kind_of_features_of_all(degree: int) -> None:
    """Features that explain a channel about as well have other errors than those of the record's model."""
    gps, _ = models()
    assert gps.of_channels[0].kind == (False, 0)
    whole = replace(gps, of_channels=(replace(gps.of_channels[0], degree=degree), *gps.of_channels[1:]))
    (part,) = fit_reading_models(EPISODES[:6], ["gps"], [whole])
    assert [model.kind for model in part.of_channels] == [(False, degree), (False, 0)]
