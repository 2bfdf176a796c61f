"""Measurement functions and noise of external filters, by what they report."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from tests.inspect.diagnosis.checks.test_innovations import STD, Boat, loaded, run, sail, wrapped

from beliefscope.inspect.diagnosis.checks.measurements import is_of_readings, measurement_model_statistics
from beliefscope.inspect.statistics.reading_fit import fit_reading_models
from beliefscope.inspect.statistics.reading_model import ReadingModel
from beliefscope.inspect.trace import Trace


@cache
def models() -> tuple[ReadingModel, ...]:
    """Of the radar and the compass."""
    return fit_reading_models([sail(seed) for seed in range(30)], list(STD))


def rms(values: dict[str, float]) -> list[float]:
    """Of the range and the bearing of the radar, relative to their noise."""
    return [values[f"measurement function/radar {axis}/all"] for axis in "xy"]


def test_the_models_are_exact() -> None:
    radar, compass = models()
    np.testing.assert_allclose(radar.noise, STD["radar"], rtol=0.1)
    np.testing.assert_allclose(compass.noise, STD["compass"], rtol=0.1)
    for channel in radar.of_channels:
        np.testing.assert_allclose(channel.landmark, [0.0, 0.0], atol=0.1)


def test_an_offset_of_the_measurement_function_shows_whatever_the_readings() -> None:
    """h(x) = z - nu: 0.5 m in a noise of 0.3 m, with and without a fault of the sensor."""
    assert max(rms(measurement_model_statistics(run(Boat()), models()))) < 0.2
    wrong = run(Boat(offset=0.5))
    radar_range, bearing = rms(measurement_model_statistics(wrong, models()))
    assert radar_range == pytest.approx(0.5 / models()[0].noise[0], rel=0.15)
    assert bearing < 0.2
    shift = np.array([3.0, 0.2], np.float32)
    observations = {**wrong.episode.observations, "radar": wrong.episode.observations["radar"] + shift}
    shifted = replace(
        wrong,
        episode=replace(wrong.episode, observations=observations),
        innovation=wrong.innovation + np.stack([shift, [0.0, 0.0]]).astype(np.float32),
    )
    assert rms(measurement_model_statistics(shifted, models())) == pytest.approx([radar_range, bearing], rel=1e-3)


class Scaled(Boat):
    """Reports the innovations of the range in another unit, or those of a virtual sensor whose gain varies."""

    def __init__(self, factor: float, is_virtual: bool = False) -> None:
        super().__init__()
        self.factor, self.is_virtual = factor, is_virtual

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        gain = self.factor * (1.0 + abs(self.mean[0]) if self.is_virtual else 1.0)
        result = super().__call__(observations=observations, controls=controls)
        if result["innovation"][0] is not None:
            result["innovation"][0] = result["innovation"][0] * np.array([gain, 1.0])
        return result


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("filter_", "expected"),
    [(Boat(), True), (Boat(offset=5.0), True), (Scaled(100.0), True), (Scaled(1.0, True), False)],
)
def test_innovations_of_a_virtual_sensor_are_not_those_of_its_readings(filter_: Boat, expected: bool) -> None:
    assert is_of_readings(run(filter_), loaded(filter_), models(), "radar x") == expected
    assert is_of_readings(run(filter_), loaded(filter_), models(), "radar y")


def test_a_belief_before_each_update_is_that_of_its_measurement_function() -> None:
    """An update that comes first may move the belief away from both ends, the prediction and the estimate."""
    separate = run(Boat(separate=True))
    moved = separate.predicted_mean - np.float32([0, 0, 0.5, 0]) * np.arange(2, dtype=np.float32)[:, None]
    trace = replace(
        separate,
        predicted_mean=moved,
        innovation=separate.innovation + np.float32([[0, 0], [0.5, np.nan]]),
        estimate_mean=separate.predicted_mean[:, 0],
    )
    compass = "measurement function/compass/all"
    assert measurement_model_statistics(trace, models())[compass] < 0.2
    shared = replace(trace, predicted_mean=separate.predicted_mean)
    assert measurement_model_statistics(shared, models())[compass] > 5.0


@pytest.mark.parametrize("late", [0, 1, 3])
@pytest.mark.parametrize("key", STD)
def test_innovations_show_by_how_many_readings_the_used_one_is_late(key: str, late: int) -> None:
    """The radar has a reading at every fourth step only; with the used reading, the measurement function is right."""
    trace, k = run(Boat()), list(STD).index(key)
    steps, readings = np.flatnonzero(trace.episode.present(key)), trace.episode.observations[key]
    used = readings[np.concatenate([steps[:late], steps[: len(steps) - late]])]
    innovation = trace.innovation.copy()
    innovation[steps, k, : readings.shape[1]] += wrapped(used - readings[steps])
    values = measurement_model_statistics(replace(trace, innovation=innovation), models())
    assert {name: values[f"late readings/{name}/all"] for name in STD} == {**dict.fromkeys(STD, 0.0), key: late}
    assert max(value for name, value in values.items() if name.startswith("measurement function")) < 0.3


def with_likelihoods(trace: Trace, scale: float, offset: float, spread: float | tuple[float, ...] = 0.3) -> Trace:
    """Particles around the estimates with Gaussian likelihoods of a scaled noise and of ranges with an offset, m.

    spread: standard deviation of the particles, of all components or of each.
    """
    rng = np.random.default_rng(0)
    steps, count, n = len(trace), 80, trace.estimate_mean.shape[1]
    particles = trace.estimate_mean[:, None] + rng.normal(0.0, spread, (steps, count, n))
    distance = np.hypot(particles[..., 0], particles[..., 1]) + offset
    expected = np.stack([distance, np.arctan2(particles[..., 1], particles[..., 0])], axis=-1)
    error = trace.episode.observations["radar"][:, None] - expected
    error[..., 1] = (error[..., 1] + math.pi) % (2.0 * math.pi) - math.pi
    radar = -0.5 * np.square(error / (scale * models()[0].noise)).sum(-1)
    likelihood = np.stack([radar, np.zeros((steps, count))], axis=1).astype(np.float32)
    return replace(trace, particles=particles.astype(np.float32), log_likelihood=likelihood, innovation=None)


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (0.3, 0.0), (3.0, 0.6)])
def test_log_likelihoods_over_particles_show_noise_and_function(scale: float, offset: float) -> None:
    values = measurement_model_statistics(with_likelihoods(run(Boat()), scale, offset), models())
    noise = models()[0].noise
    assert values["measurement noise/radar/all"] == pytest.approx(scale * math.sqrt(noise[0] * noise[1]), rel=0.03)
    assert rms(values)[0] == pytest.approx(offset / noise[0], abs=0.2)
    assert "measurement noise/compass/all" not in values, "likelihoods without evidence"


def test_likelihoods_that_grow_with_the_error_are_inverted() -> None:
    trace = with_likelihoods(run(Boat()), 1.0, 0.0)
    assert measurement_model_statistics(trace, models())["inverted likelihood/radar/all"] == 0.0
    inverted = measurement_model_statistics(replace(trace, log_likelihood=-trace.log_likelihood), models())
    assert inverted["inverted likelihood/radar/all"] == 1.0
    assert "measurement noise/radar/all" not in inverted


def test_a_channel_that_a_likelihood_ignores_is_not_inverted() -> None:
    """Its curvature has either sign: here that of a learned likelihood which changes from step to step."""
    trace, rng = with_likelihoods(run(Boat()), 1.0, 0.0), np.random.default_rng(0)
    distance = np.hypot(trace.particles[..., 0], trace.particles[..., 1])
    error = (trace.episode.observations["radar"][:, :1] - distance) / models()[0].noise[0]
    changed = trace.log_likelihood.copy()
    signs = np.where(rng.random(len(trace)) < 0.6, 1.5, 0.0)[:, None]  # the sign changes at more than half of the steps
    changed[:, 0] += 0.5 * signs * np.square(error)
    values = measurement_model_statistics(replace(trace, log_likelihood=changed), models())
    assert values["inverted likelihood/radar/all"] == 0.0


def test_channels_that_the_particles_do_not_separate_have_the_same_error() -> None:
    """Particles on a line show how much the measurement function of the radar is wrong, not in which channel."""
    n = run(Boat()).estimate_mean.shape[1]
    on_line = (0.3, *[0.0] * (n - 1))
    right, wrong = (
        measurement_model_statistics(with_likelihoods(run(Boat()), 1.0, d, on_line), models()) for d in (0.0, 0.6)
    )
    assert rms(wrong)[0] == rms(wrong)[1] > 3.0 * rms(right)[0]


@pytest.mark.parametrize("wraps", [True, False])
def test_likelihoods_of_angles_that_are_not_wrapped_jump(wraps: bool) -> None:
    """The heading is near half a turn, with particles on both sides of it."""
    trace = run(Boat())
    rng, (steps, n) = np.random.default_rng(0), trace.estimate_mean.shape
    std = models()[1].noise[0]
    states = trace.episode.states.copy()
    shift = math.pi - trace.episode.observations["compass"][:, 0]
    states[:, 2] = (states[:, 2] + shift + math.pi) % (2.0 * math.pi) - math.pi
    compass = np.full((steps, 1), math.pi - 0.2 * std, np.float32)
    particles = states[:, None] + rng.normal(0.0, std, (steps, 50, n))
    particles[..., 2] = (particles[..., 2] + math.pi) % (2.0 * math.pi) - math.pi
    error = compass - particles[..., 2]
    error = (error + math.pi) % (2.0 * math.pi) - math.pi if wraps else error
    likelihood = np.stack([0.0 * error, -0.5 * np.square(error / std)], axis=1).astype(np.float32)
    observations = {**trace.episode.observations, "compass": compass}
    changed = replace(
        trace,
        episode=replace(trace.episode, states=states, observations=observations),
        particles=particles.astype(np.float32),
        log_likelihood=likelihood,
        innovation=None,
    )
    values = measurement_model_statistics(changed, models())
    assert values["innovation turns/compass/all"] == (0.0 if wraps else 1.0)


@pytest.mark.parametrize("turns", [0, 1])
def test_likelihoods_of_particles_a_turn_away_show_it(turns: int) -> None:
    """Particles whose heading is not wrapped have no jump between them, but innovations of a full turn."""
    trace = run(Boat())
    std = models()[1].noise[0]
    offsets = np.random.default_rng(0).normal(0.0, std, (len(trace), 50, 4))
    particles = trace.episode.states[:, None] + offsets
    particles[..., 2] = trace.episode.observations["compass"] + offsets[..., 2]
    error = -offsets[..., 2] - 2.0 * math.pi * turns
    likelihood = np.stack([0.0 * error, -0.5 * np.square(error / std)], axis=1)
    changed = replace(
        trace, particles=particles.astype(np.float32), log_likelihood=likelihood.astype(np.float32), innovation=None
    )
    values = measurement_model_statistics(changed, models())
    assert values["innovation turns/compass/all"] == turns


def test_sensors_without_models_have_no_statistics() -> None:
    assert measurement_model_statistics(run(Boat()), ()) == {}
