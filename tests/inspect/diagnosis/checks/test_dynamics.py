"""Statistics of predictions that start at true states: those of the dynamics, whatever the rest of the filter does."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from tests.inspect.diagnosis.checks.test_innovations import Boat, loaded, sail
from tests.inspect.diagnosis.test_catalog import deviation
from tests.inspect.diagnosis.test_external_dynamics import SENSORS, TASK, Cart, drive, loaded as of_cart, profile

import beliefscope as bs
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnosis.catalog import causes_in
from beliefscope.inspect.diagnosis.cause import matches
from beliefscope.inspect.diagnosis.causes.external_filters import OF_DYNAMICS, OF_TRUE_STATES
from beliefscope.inspect.diagnosis.checks.dynamics import dynamics_statistics
from beliefscope.inspect.diagnosis.checks.measurements import measurement_model_statistics
from beliefscope.inspect.diagnosis.checks.modules import model_statistics
from beliefscope.inspect.diagnosis.checks.true_starts import (
    has_true_starts,
    predictions_from_truth,
    some_steps,
    with_innovations_near_truth,
)
from beliefscope.inspect.diagnosis.diagnose import diagnose
from beliefscope.inspect.diagnosis.scoring import explain
from beliefscope.inspect.diagnostics.kalman_equations import jacobian_statistics
from beliefscope.inspect.healthy import profile_of, sensor_record

STD = 0.005
"""Standard deviation of the cart's process noise, m."""


def of_boat(boat: Boat, faulty: bool = False) -> dict[str, float]:
    """Its statistics; faulty: with readings of the radar that are too large, so that the filter loses the state."""
    checkpoint, episode = loaded(boat), sail(3)
    if faulty:
        episode.observations["radar"] *= np.float32(1.4)
    return dynamics_statistics(bs.trace(checkpoint, [episode]), checkpoint)


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("boat", "faulty"), [(Boat(), True), (Boat(radar=0.01), False), (Boat(offset=2.0), False), (Boat(gain=0.1), False)]
)
def test_other_faults_do_not_change_them(boat: Boat, faulty: bool) -> None:
    """Only those that start at the estimates: the offset of the run's predictions, and their lag."""
    healthy, values = of_boat(Boat()), of_boat(boat, faulty)
    assert values.keys() == healthy.keys()
    same = [name for name in healthy if not name.startswith(("dynamics offset/", "lag/"))]
    assert [values[name] for name in same] == pytest.approx([healthy[name] for name in same], rel=1e-6, nan_ok=True)
    changed = [name for name in healthy if name.startswith("dynamics offset/")]
    assert [values[name] for name in changed] != pytest.approx([healthy[name] for name in changed], rel=1e-3)


def test_process_noise_is_that_of_the_filter() -> None:
    values = of_boat(Boat())
    for name, std in (("x", 1e-2), ("y", 1e-2), ("heading", 2e-3)):
        # What remains is the belief at the start, whose variance the prediction turns from one component to another.
        assert values[f"process noise/{name}/all"] == pytest.approx(std, rel=0.05)


def test_slope_and_bias_are_those_of_the_dynamics() -> None:
    healthy, inverted = of_boat(Boat()), of_boat(Boat(turn=-1.0))
    assert healthy["dynamics slope/heading/all"] == pytest.approx(1.0, abs=0.05)
    assert inverted["dynamics slope/heading/all"] == pytest.approx(-1.0, abs=0.05)
    assert inverted["dynamics slope/x/all"] == pytest.approx(healthy["dynamics slope/x/all"], abs=1e-3)


class LateCart(Cart):
    """Its first call updates the belief without a prediction."""

    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        super().initialize_beliefs(mean=mean, covariance=covariance)
        self.first = True

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        noise, self.noise = self.noise, 0.0 if self.first else self.noise
        result = super().__call__(observations=observations, controls=0.0 * controls if self.first else controls)
        self.first, self.noise = False, noise
        return result


class ParticleCart(torch.nn.Module):
    """A particle filter of N trajectories; every reading has the same likelihood, so that the filter drifts."""

    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        root = torch.linalg.cholesky(covariance)
        self.particles = mean[:, None] + torch.randn(len(mean), 2000, 2) @ root.mT

    def forward(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        self.particles = self.particles + controls[:, None] + STD * torch.randn_like(self.particles)
        equal = torch.full(self.particles.shape[:2], -math.log(2000))
        return {
            "estimate_mean": self.particles.mean(1),
            "particles": self.particles,
            "log_weights": equal,
            "prior_log_weights": equal,
            "log_likelihood": torch.zeros(len(controls), len(SENSORS), 2000),
        }


class SharedNoise(ParticleCart):
    """All particles have the same noise, as large as the motion, so that the predicted mean is random."""

    def forward(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        noise = 0.05 * torch.randn_like(controls)
        return super().forward(observations=observations, controls=controls + noise)


class SeeingCart(ParticleCart):
    """Its weights ignore the likelihoods, and its particles stay where they are, so that it loses the state."""

    def __init__(self, offset: float = 0.0, noise: float = 1.0) -> None:
        super().__init__()
        self.offset, self.noise = offset, noise

    def forward(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        result = super().forward(observations=observations, controls=0.0 * controls)
        errors = [
            (observations[k][:, None] - self.particles - self.offset) / (self.noise * s) for k, s in SENSORS.items()
        ]
        return result | {"log_likelihood": torch.stack([-0.5 * e.square().sum(-1) for e in errors], 1)}


def cart(filter_: Any) -> ExternalFilter:
    is_batched = isinstance(filter_, torch.nn.Module)
    adapter = bs.Adapter(filter_, batched=is_batched, modalities=tuple(SENSORS), initial_std=(0.02, 0.02))
    checkpoint = bs.load_filter(adapter, TASK, name="cart")
    assert isinstance(checkpoint, ExternalFilter)
    return checkpoint


@pytest.mark.parametrize(("filter_", "error"), [(Cart(), 1e-6), (LateCart(), 5e-5), (ParticleCart(), 5e-4)])
def test_predicted_changes_are_the_controls_with_the_process_noise(filter_: Any, error: float) -> None:
    """Errors: an update of the belief at the start, and 4 standard deviations of a mean, ``4 * 0.005 / sqrt(2000)``."""
    checkpoint, episode, steps = cart(filter_), drive(0), np.arange(1, 60, 7)
    result = predictions_from_truth(bs.trace(checkpoint, [episode]), checkpoint, steps)
    assert result is not None
    np.testing.assert_allclose(result.change, episode.controls[steps], atol=error)
    assert result.added is not None
    np.testing.assert_allclose(np.sqrt(np.diagonal(result.added, axis1=1, axis2=2)), STD, rtol=0.1)


def test_random_numbers_of_predictions_do_not_change_their_gain() -> None:
    checkpoint = cart(SharedNoise())
    gains = []
    for seed in range(10):
        values = dynamics_statistics(bs.trace(checkpoint, [drive(seed)]), checkpoint)
        gains += [1.0 / values[f"dynamics slope/{name}/all"] for name in "xy"]
    assert np.mean(gains) == pytest.approx(1.0, abs=4.0 * float(np.std(gains)) / math.sqrt(len(gains)))
    assert np.mean(gains) > 0.8, "half of the power of the predicted changes is random"


def test_their_number_is_limited() -> None:
    """By the calls of a filter of single trajectories, and by the particles of one of many."""
    one, many = loaded(Boat()), cart(ParticleCart())
    steps = some_steps(bs.trace(one, [sail(3)]), one)
    assert len(steps) == 60
    assert set(np.diff(steps)) == {1, 2}
    trace = bs.trace(many, [drive(0)])
    assert len(some_steps(trace, many)) == 30
    assert len(some_steps(replace(trace, particles=np.zeros((60, 30_000, 2), np.float32)), many)) == 12


class Started(Cart):
    """Starts at a belief of its own."""

    def initialize_beliefs(self) -> None:  # type: ignore[override]
        self.mean, self.covariance = np.zeros(2), 4e-4 * np.eye(2)


def test_a_filter_with_a_start_of_its_own_has_those_of_its_run() -> None:
    checkpoint, with_starts = cart(Started()), cart(Cart())
    assert has_true_starts(with_starts)
    assert not has_true_starts(checkpoint)
    values = dynamics_statistics(bs.trace(checkpoint, [drive(0)]), checkpoint)
    assert values["process noise/x/all"] > 0.0
    assert values["dynamics slope/x/all"] == pytest.approx(1.0, abs=0.2)


def test_jacobians_do_not_depend_on_wrong_readings_of_other_sensors() -> None:
    """An update before another one changes the state at which the latter is linear."""
    checkpoint, wrong = loaded(Boat(separate=True)), sail(3, every=1)
    wrong.observations["radar"][:, 0] *= np.float32(1.4)
    for episode in (sail(3, every=1), wrong):
        values = jacobian_statistics(bs.trace(checkpoint, [episode]), checkpoint)
        for key in ("radar", "compass"):
            assert values[f"measurement jacobian/{key}/all"] < 0.02


def test_only_faults_of_the_dynamics_explain_them() -> None:
    """In filters whose single steps can start at true states."""
    names = [f"{kind}x/all" for kind in OF_TRUE_STATES]
    explaining: dict[type, set[str]] = {}
    for filter_ in (Cart(), Started()):
        causes = causes_in(cart(filter_))
        explaining[type(filter_)] = {c.name for c in causes if any(matches(c.consequences, n) for n in names)}
    assert {start for start in OF_DYNAMICS if any(c.startswith(start) for c in explaining[Cart])} == {*OF_DYNAMICS}
    assert all(name.startswith(OF_DYNAMICS) for name in explaining[Cart])
    assert explaining[Started] > explaining[Cart] | {"resampling.off", "measurement_noise.front.small", "front.bias"}


@pytest.mark.parametrize(("t", "explained"), [(5.0, True), (-5.0, False)])
def test_a_bias_that_is_not_estimated_explains_only_larger_measurement_noise(t: float, explained: bool) -> None:
    """Its updates are smaller, as with a larger R; a smaller R makes the estimates, and so the errors, worse."""
    deviations = [deviation("dynamics scatter/x/all", 5.0), deviation("measurement noise/front/all", t)]
    (drift,) = (cause for cause in causes_in(cart(Cart())) if cause.name == "dynamics.drift")
    assert (explain(drift, deviations).unexplained == {}) == explained


@pytest.mark.parametrize(("t", "explained"), [(5.0, True), (-5.0, False)])
def test_a_small_gain_explains_only_larger_measurement_noise(t: float, explained: bool) -> None:
    deviations = [deviation("correction slope/front/all", -5.0), deviation("measurement noise/rear/all", t)]
    (gain,) = (cause for cause in causes_in(cart(Cart())) if cause.name == "updates.front.gain")
    assert (explain(gain, deviations).unexplained == {}) == explained


@pytest.mark.slow
@pytest.mark.long
def test_predicted_changes_that_are_all_too_small_are_not_broken() -> None:
    record = profile()
    result = diagnose(of_cart(Cart(gain=0.6)), {seed: drive(seed) for seed in range(20, 30)}, profile=record)
    assert result.causes[0].cause.name == "dynamics.frozen"
    assert result.causes[0].probability > 0.9


@pytest.mark.slow
@pytest.mark.parametrize(
    ("filter_", "episode", "finding"),
    [
        pytest.param(
            Boat(compass=0.01),
            sail,
            r"measurement noise is too small for its innovations \(compass: NIS/m \d+\)",
            marks=pytest.mark.long,
        ),
        (
            Cart(noise=0.0003),
            drive,
            r"process noise is too small for the squared errors of its dynamics \(.: \d+ times Q",
        ),
    ],
)
def test_the_noise_of_a_filter_that_has_always_been_overconfident_is_named(
    filter_: Boat | Cart, episode: Callable[[int], bs.Episode], finding: str
) -> None:
    """The comparison with its own record shows nothing."""
    checkpoint = loaded(filter_) if isinstance(filter_, Boat) else of_cart(filter_)
    record = profile_of(checkpoint, [episode(seed) for seed in range(12)], "clean")
    result = diagnose(checkpoint, {seed: episode(seed) for seed in range(40, 43)}, profile=record)
    start = rf"Always overconfident \(median NEES/n .*\), even in its healthy record: its {finding}"
    assert re.match(start, result.headline), result.headline


@pytest.mark.first(1)
@pytest.mark.parametrize("boat", [Boat(turn=-1.0), Boat(gain=-1.0), Boat(offset=2.0)])
def test_innovations_at_true_states_show_the_measurement_functions_only(boat: Boat) -> None:
    """Whatever the dynamics and updates do: that of the radar's range has an offset of 2 m, with a noise of 0.3 m."""
    readings = sensor_record([sail(seed) for seed in range(20)]).readings
    checkpoint = loaded(boat)
    trace = bs.trace(checkpoint, [sail(30)])
    values = measurement_model_statistics(trace, readings, with_innovations_near_truth(trace, checkpoint))
    errors = [values[f"measurement function/{name}/all"] for name in ("radar x", "radar y", "compass")]
    assert errors[0] == pytest.approx(boat.offset / 0.3, rel=0.1, abs=0.1)
    assert max(errors[1:]) < 0.1


def test_likelihoods_show_the_measurement_model_of_a_filter_that_has_lost_the_state() -> None:
    readings = sensor_record([drive(seed) for seed in range(20)]).readings
    checkpoint = cart(SeeingCart(offset=0.03, noise=2.0))
    trace = bs.trace(checkpoint, [drive(30)])
    assert not any("front" in name for name in measurement_model_statistics(trace, readings))
    values = model_statistics(trace, checkpoint, readings)
    for key, std in SENSORS.items():
        assert values[f"measurement noise/{key}/all"] == pytest.approx(2.0 * std, rel=0.1)
        for axis in "xy":
            assert values[f"measurement function/{key} {axis}/all"] == pytest.approx(0.03 / std, rel=0.3)


def test_bias_and_gain_of_exact_predictions_do_not_depend_on_process_noise_and_speed() -> None:
    """A slope on the true changes decreases with the process noise, and its intercept grows with the mean change."""
    biases = {}
    for speed in (0.0, 0.02, 0.06):
        rng, rows = np.random.default_rng(0), []
        for seed in range(4):
            slow = drive(seed)
            controls = slow.controls + np.float32(speed)
            states = np.cumsum(controls + rng.normal(0.0, 0.05, controls.shape), axis=0)
            readings = {key: states + rng.normal(0.0, std, states.shape) for key, std in SENSORS.items()}
            episode = bs.Episode(TASK, states, controls, readings, seed=seed, split="test")
            values = dynamics_statistics(bs.trace(of_cart(Cart(noise=0.05)), [episode]), of_cart(Cart(noise=0.05)))
            rows.append(values["dynamics bias/x/all"])
            predicted, noise = float(episode.controls[1:, 0].std()), 0.05 / math.sqrt(len(episode))
            assert 1.0 / values["dynamics slope/x/all"] == pytest.approx(1.0, abs=4.0 * noise / predicted)
        biases[speed] = np.mean(rows)
    deviation = 0.05 / math.sqrt(4 * 60)
    assert biases == pytest.approx(dict.fromkeys(biases, 0.0), abs=4.0 * deviation)
