"""Noise around the expected readings: that of the sensor, whatever the motion, the gaps and the delay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.inspect.statistics.test_reading_model import DT, NEW, NOISE, PLANE, STEPS, models, with_readings

from beliefscope.datasets.covariate import CONTACT
from beliefscope.datasets.episode import Episode
from beliefscope.inspect.diagnosis.checks.readings import with_errors, without_explained
from beliefscope.inspect.diagnosis.checks.sensors import localise, sensor_statistics

NAMES = ("noise/gps x/all", "noise/gps x/expected", "noise/gps x/expected extreme")


def noises(episode: Episode) -> list[float]:
    """Of all readings, around the expected ones, and the latter in the noisiest window."""
    values = sensor_statistics(episode, None, models())
    return [values[name] for name in NAMES]


def circling(seconds: float) -> Episode:
    """A motion on a circle with a radius of 0.5 m, with readings of the GPS."""
    angle = 2.0 * np.pi * DT / seconds * np.arange(STEPS)
    states = np.column_stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), np.zeros(STEPS)])
    noise = np.random.default_rng(0).normal(0.0, NOISE, (STEPS, 2))
    episode = replace(NEW, states=states.astype(np.float32))
    return with_readings(episode, "gps", states[:, :2] + np.array([3.0, -2.0]) + noise)


def test_it_is_the_noise_of_the_sensor_at_any_speed() -> None:
    (slow, *of_slow), (fast, *of_fast) = noises(circling(4.0)), noises(circling(0.5))
    assert slow == pytest.approx(NOISE, rel=0.3)
    assert fast > 5.0 * slow, "the second differences of the motion"
    # The models are fitted to the readings of other episodes: errors of 1 % of the motion are small compared with it.
    assert of_slow[0] == pytest.approx(NOISE, rel=0.3)
    assert of_fast == pytest.approx(of_slow, rel=0.3)


def test_gaps_and_delays_do_not_change_it() -> None:
    task = replace(PLANE, masks={"gps": "fix"}, covariates={"contact": CONTACT, "fix": CONTACT})
    fix = (np.arange(STEPS) % 6 == 0).astype(np.float32)
    rare = noises(replace(NEW, task=task, covariates={"fix": fix}))
    late = noises(with_readings(NEW, "gps", NEW.observations["gps"][np.maximum(np.arange(STEPS) - 4, 0)]))
    assert rare[0] > 3.0 * NOISE
    for around in (rare[1], late[1]):
        assert around == pytest.approx(NOISE, rel=0.4)  # of 18 second differences


def test_a_noisy_interval_shows_in_its_windows_and_is_localised() -> None:
    noisy = (np.arange(STEPS) >= 60) & (np.arange(STEPS) < 100)
    noise = np.random.default_rng(1).normal(0.0, 5.0 * NOISE, (STEPS, 2)) * noisy[:, None]
    episode = with_readings(NEW, "gps", NEW.observations["gps"] + noise)
    _, around, extreme = noises(episode)
    assert around < 3.0 * NOISE < extreme == pytest.approx(5.0 * NOISE, rel=0.4)
    assert localise(NAMES[2], episode, None, models=models()) == pytest.approx((60, 99), abs=4)
    assert np.abs(with_errors(episode, models()).observations["gps"][~noisy]).max() < 6.0 * NOISE


def test_it_replaces_the_noise_of_all_readings() -> None:
    values = without_explained(sensor_statistics(NEW, None, models()))
    assert {name for name in values if name.startswith("noise/gps x/")} == {*NAMES[1:]}
    assert {"noise/battery/all", "noise/battery/extreme"} <= {*values}, "which has no model"
