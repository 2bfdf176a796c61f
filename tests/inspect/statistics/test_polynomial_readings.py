"""Models of nonlinear readings: polynomials in the state and the controls, and channels that vary little."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.inspect.statistics.test_reading_model import smooth

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Component, Task
from beliefscope.inspect.diagnosis.checks.readings import modelled_keys, reading_statistics
from beliefscope.inspect.statistics.reading_features import CONTROL, monomials
from beliefscope.inspect.statistics.reading_fit import fit_reading_models
from beliefscope.inspect.statistics.reading_model import ReadingModel

CART = Task(
    name="cart",
    components=(Component("x", "m"), Component("v", "m/s")),
    observations={"drag": (1,), "motor": (1,), "level": (2,)},
    modalities={key: (key,) for key in ("drag", "motor", "level")},
    control_size=1,
    dt=0.05,
)
STD = {"drag": [0.05], "motor": [0.1], "level": [0.05, 0.6]}


def drive(seed: int) -> Episode:
    """A quadratic drag, a current of command and speed, and a level whose second channel is mostly noise."""
    rng = np.random.default_rng(seed)
    x, v, u = smooth(rng, 3).T
    clean = {"drag": [v**2], "motor": [u - 0.5 * x * v], "level": [2.0 * x, 0.25 * v]}
    observations = {key: np.stack(c, 1) + rng.normal(0.0, STD[key], (len(x), len(c))) for key, c in clean.items()}
    return Episode(CART, np.stack([x, v], 1), u[:, None], observations)


def curved(seed: int, std: float) -> Episode:
    """A reading that is slightly curved in the speed."""
    episode = drive(seed)
    v = episode.states[:, 1:].astype(np.float64)
    readings = v + 0.04 * v**2 + np.random.default_rng(seed).normal(0.0, std, v.shape)
    return replace(episode, observations={**episode.observations, "drag": readings.astype(np.float32)})


@cache
def models() -> dict[str, ReadingModel]:
    return {m.key: m for m in fit_reading_models([drive(seed) for seed in range(20)], modelled_keys(CART))}


def test_monomials_are_products_of_the_values_of_the_step() -> None:
    episode = drive(0)
    x, v, u = *episode.states.T, episode.controls[:, 0]
    np.testing.assert_allclose(
        monomials(episode, True, 2), np.stack([x, v, u, x * x, x * v, x * u, v * v, v * u, u * u], 1), rtol=1e-6
    )
    cubic = [x, v, x * x, x * v, v * v, x**3, x * x * v, x * v * v, v**3]
    np.testing.assert_allclose(monomials(episode, False, 3), np.stack(cubic, 1), rtol=1e-6)
    many = replace(CART, control_size=20)
    assert monomials(Episode(many, episode.states, np.zeros((len(x), 20))), True, 2).shape == (len(x), 0)


@pytest.mark.parametrize("key", ["drag", "motor"])
def test_polynomials_leave_the_noise(key: str) -> None:
    model, episode = models()[key], drive(100)
    assert model.of_channels[0].degree == 2, "not more than needed"
    assert model.is_complete(episode)
    np.testing.assert_allclose(model.noise, STD[key], rtol=0.1)
    stored = ReadingModel.from_json(json.loads(json.dumps(model.to_json())))
    np.testing.assert_allclose(stored.expected(episode), model.expected(episode), atol=1e-5)
    gained = replace(episode, observations={**episode.observations, key: 1.2 * episode.observations[key]})
    assert reading_statistics(gained, [model])[f"reading gain/{key}/all"] == pytest.approx(1.2, abs=0.03)


def test_polynomials_are_not_extrapolated() -> None:
    model, episode = models()["motor"], drive(100)
    low, high = model.of_channels[0].limits
    values = np.concatenate([episode.states, episode.controls], axis=1)
    spread = values.std(0)
    assert (np.abs(low - values.min(0)) < spread).all(), "most episodes are within"
    assert (np.abs(high - values.max(0)) < spread).all()
    known = np.isfinite(model.expected(episode)[:, 0])
    controls = np.where(np.arange(len(episode))[:, None] < 5, high[2] + 0.3, episode.controls)
    outside = replace(episode, controls=controls.astype(np.float32))
    np.testing.assert_array_equal(np.isfinite(model.expected(outside)[:, 0]), known & (np.arange(len(episode)) >= 5))


def test_slightly_curved_readings_have_a_quadratic_model() -> None:
    """A line would err by several times the noise at the states that few episodes reach."""
    for std, degree in ((0.12, 2), (0.5, 0)):  # more noise hides it
        (model,) = fit_reading_models([curved(seed, std) for seed in range(20)], ["drag"])
        assert model.of_channels[0].degree == degree
        np.testing.assert_allclose(model.noise, std, rtol=0.1)


def test_the_controls_do_not_explain_themselves() -> None:
    assert CONTROL not in models(), "nothing else does"


def test_readings_of_the_state_alone_have_a_model_of_it_alone() -> None:
    """Noise would favour the model with its changes for about one of two sensors."""
    for seed in range(12):
        (level,) = fit_reading_models([drive(100 * seed + i) for i in range(8)], ["level"])
        assert level.is_complete(drive(0)) == (len(level.of_channels) == 2)
        assert level.with_weak_channels().is_complete(drive(0)), seed


def test_channels_that_vary_little_have_a_bias_and_a_drift_only() -> None:
    level = models()["level"]
    assert (level.channels, [m.index for m in level.of_weak_channels]) == ((0,), [1])
    assert level.with_weak_channels().channels == (0, 1)
    np.testing.assert_allclose(level.with_weak_channels().noise, STD["level"], rtol=0.1)
    kinds = {name.split("/")[0] for name in reading_statistics(drive(100), [level]) if "/level y/" in name}
    assert kinds == {"reading bias", "reading drift"}
    stored = ReadingModel.from_json(json.loads(json.dumps(level.to_json())))
    assert stored.with_weak_channels().channels == (0, 1)
    only_weak = replace(level, of_channels=())
    assert {name.split("/")[0] for name in reading_statistics(drive(100), [only_weak])} == kinds


def test_a_constant_channel_has_no_model() -> None:
    def constant(seed: int) -> Episode:
        episode = drive(seed)
        return replace(episode, observations={**episode.observations, "drag": np.full((len(episode), 1), 3.0)})

    assert fit_reading_models([constant(seed) for seed in range(8)], ["drag"]) == ()


def test_errors_that_depend_on_each_other_are_no_gain() -> None:
    """A slow error along with the expected readings in a part of the episode, 10 white standard errors."""
    episode, model = drive(100), models()["level"]
    x = episode.states[:, 0]
    part = np.arange(len(x)) < len(x) // 4
    level = episode.observations["level"] + np.stack([np.where(part, 0.4 * x, 0.0), 0.0 * x], 1)
    slow = replace(episode, observations={**episode.observations, "level": level.astype(np.float32)})
    assert reading_statistics(slow, [model])["reading gain/level x/all"] == pytest.approx(1.0, abs=0.02)
    whole = replace(episode, observations={**episode.observations, "level": 1.2 * episode.observations["level"]})
    assert reading_statistics(whole, [model])["reading gain/level x/all"] == pytest.approx(1.2, abs=0.02)


def test_noise_does_not_spread_gains_beyond_healthy_ones() -> None:
    """Slopes of readings with 20 times the noise would have 20 times the spread."""
    model = models()["drag"]
    spread, noise = model.gain_spreads[0], STD["drag"][0]
    gains = []
    for seed in range(100, 120):
        episode = drive(seed)
        more = np.random.default_rng(seed).normal(0.0, 20.0 * noise, (len(episode), 1))
        readings = (episode.observations["drag"] + more).astype(np.float32)
        noisy = replace(episode, observations={**episode.observations, "drag": readings})
        gains.append(reading_statistics(noisy, [model])["reading gain/drag/all"] - 1.0)
    assert np.std(gains) < spread
    healthy = [reading_statistics(drive(seed), [model])["reading gain/drag/all"] - 1.0 for seed in range(100, 120)]
    assert np.std(healthy) == pytest.approx(spread, rel=0.5), "not shrunk"
    old = ReadingModel.from_json(
        {
            "key": "drag",
            "of_channels": [{k: v for k, v in model.of_channels[0].to_json().items() if k != "gain_spread"}],
        }
    )
    assert reading_statistics(drive(100), [old])["reading gain/drag/all"] == 1.0, "of a record of an earlier version"


TANK = replace(CART, observations={"gauge": (1,)}, modalities={"gauge": ("gauge",)})
GAUGE = 0.05


def fill(seed: int, offset: float = 0.0, size: float = 1.0) -> Episode:
    """A gauge of a smooth level around an offset."""
    rng = np.random.default_rng(seed)
    x, v, u = smooth(rng, 3).T
    x = offset + size * x
    return Episode(TANK, np.stack([x, v], 1), u[:, None], {"gauge": x[:, None] + rng.normal(0.0, GAUGE, (len(x), 1))})


def changed(offset: float, size: float, change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> dict[str, float]:
    """Statistic of the errors of the gauge -> mean over new episodes with changed readings, by steps; of a drift
    over those in which it is not a bias as well."""
    (model,) = fit_reading_models([fill(seed, offset, size) for seed in range(20)], ["gauge"])
    rows = []
    for episode in (fill(100 + i, offset, size) for i in range(10)):
        readings = change(episode.observations["gauge"].astype(np.float64), np.arange(len(episode))[:, None])
        faulty = replace(episode, observations={"gauge": readings.astype(np.float32)})
        rows.append(reading_statistics(faulty, [model]))
    kinds = ("bias", "drift", "gain", "ratio", "noise")
    return {kind: float(np.nanmean([row[f"reading {kind}/gauge/all"] for row in rows])) for kind in kinds}


@pytest.mark.parametrize("onset", [0, 40, 80])
def test_a_ramp_from_any_step_on_is_a_drift(onset: int) -> None:
    values = changed(0.0, 0.5, lambda y, t: y + 0.005 * np.maximum(t - onset, 0))
    assert values["drift"] > 1.0
    assert values["gain"] == pytest.approx(1.0, abs=0.03)
    assert values["ratio"] == pytest.approx(1.0, abs=0.03)
    assert values["noise"] == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("gain", [0.8, 1.2])
def test_a_gain_is_no_drift(gain: float) -> None:
    values = changed(1.0, 0.5, lambda y, t: gain * y)
    assert values["gain"] == pytest.approx(gain, abs=0.03)
    assert values["ratio"] == pytest.approx(gain, abs=0.03)
    assert abs(values["drift"]) < 0.3


def test_a_gain_of_readings_that_hardly_vary_is_a_ratio() -> None:
    """Their slope is unknown. A bias has the same ratio, unless the expected readings vary."""
    gained = changed(2.0, 0.05, lambda y, t: 0.95 * y)
    assert gained["ratio"] == pytest.approx(0.95, abs=0.01)
    for offset, size in ((2.0, 0.5), (0.0, 0.05), (0.0, 1.0)):
        biased = changed(offset, size, lambda y, t: y - 0.1)
        assert biased["bias"] == pytest.approx(-0.1 / GAUGE, abs=0.3)
        assert biased["ratio"] == pytest.approx(1.0, abs=0.02)
        assert biased["gain"] == pytest.approx(1.0, abs=0.1)
