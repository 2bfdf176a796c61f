"""Measurement noise, unwrapped innovations and missing updates of an external Kalman filter, from what it reports."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

import beliefscope as bs
from beliefscope.datasets.task import Component
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnosis.checks.dynamics import external_dynamics_statistics
from beliefscope.inspect.diagnosis.checks.innovations import REJECTABLE, innovation_statistics, measurement_noise
from beliefscope.inspect.diagnosis.checks.measurements import measurement_model_statistics
from beliefscope.inspect.diagnosis.checks.vectors import stuck
from beliefscope.inspect.diagnosis.diagnose import diagnose
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.healthy import profile_of
from beliefscope.inspect.trace import Trace

Array = NDArray[np.float64]

STD = {"radar": (0.3, 0.02), "compass": (0.05,)}
"""Range and bearing of the origin, m and rad; heading, rad."""

BIAS = 0.05
"""Standard deviation of the bias of the turn rate, rad/s."""

COMPONENTS = (
    *(bs.Component(name, "m") for name in ("x", "y")),
    bs.Component("heading", "rad", wraps=True),
    bs.Component("bias", "rad/s"),
)


def task(every: int) -> bs.Task:
    """every: steps between two readings of the radar."""
    return bs.Task(
        name="boat",
        components=COMPONENTS,
        observations={key: (len(std),) for key, std in STD.items()},
        modalities={key: (key,) for key in STD},
        masks={"radar": "radar_reading"},
        covariates={"radar_reading": bs.Covariate("boolean")},
        control_size=2,
        dt=0.1,
    )


def wrapped(angle: Any) -> Any:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def sail(seed: int, every: int = 4) -> bs.Episode:
    """The controls are speed in m/s and turn rate in rad/s, with a bias."""
    rng, steps = np.random.default_rng(seed), 100
    turn = np.repeat(rng.normal(0.0, 0.6, steps // 10), 10)
    heading = rng.uniform(-math.pi, math.pi) + 0.1 * np.cumsum(turn)
    place = rng.normal(0.0, 4.0, 2) + 0.1 * np.cumsum(2.0 * np.stack([np.cos(heading), np.sin(heading)], 1), 0)
    bias = np.full(steps, rng.normal(0.0, BIAS))
    controls = np.stack([2.0 + rng.normal(0.0, 0.1, steps), turn + bias + rng.normal(0.0, 0.02, steps)], 1)
    clean = {"radar": np.stack([np.hypot(*place.T), np.arctan2(*place.T[::-1])], 1), "compass": heading[:, None]}
    readings = {key: values + STD[key] * rng.standard_normal(values.shape) for key, values in clean.items()}
    readings["radar"][:, 1], readings["compass"] = wrapped(readings["radar"][:, 1]), wrapped(readings["compass"])
    mask = (np.arange(steps) % every == 0).astype(np.float32)
    states = np.stack([*place.T, wrapped(heading), bias], 1)
    return bs.Episode(
        task(every), states, controls, readings, seed=seed, split="test", covariates={"radar_reading": mask}
    )


FLIPPED = np.array([[1.0, 1.0, 1.0, 1.0], [-1.0, 1.0, 1.0, 1.0]])
"""Signs of the radar's Jacobian: that of the bearing by x is wrong."""


class Boat:
    """An extended Kalman filter with one update after another. Its arguments are the defects."""

    H: ClassVar = {"compass": np.eye(4)[2:3]}

    def __init__(
        self,
        radar: float = 1.0,
        compass: float = 1.0,
        wraps: bool = True,
        has_bias: bool = True,
        updates: float = 1.0,
        turn: float = 1.0,
        offset: float = 0.0,
        separate: bool = False,
        jacobian: float | Array = 1.0,
        heading_jacobian: float = 1.0,
        gain: float = 1.0,
        reduction: float = 1.0,
        absent: bool = False,
    ) -> None:
        self.factors = {"radar": radar, "compass": compass}
        self.wraps, self.has_bias, self.updates = wraps, has_bias, updates
        self.turn, self.offset, self.separate = turn, offset, separate
        self.jacobian, self.heading_jacobian = np.asarray(jacobian), heading_jacobian
        self.gain, self.reduction, self.absent = gain, reduction, absent

    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        self.mean, self.covariance, self.random = mean, covariance, np.random.default_rng(0)

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        x, y, heading, bias = self.mean
        speed, c, s = 0.1 * controls[0], math.cos(heading), math.sin(heading)
        turn = 0.1 * self.turn * (controls[1] - (bias if self.has_bias else 0.0))
        mean, jacobian = np.array([x + speed * c, y + speed * s, heading + turn, bias]), np.eye(4)
        jacobian[:2, 2], jacobian[2, 3] = (-speed * s, speed * c), -0.1 if self.has_bias else 0.0
        jacobian[:2, 2] *= self.heading_jacobian
        noise = np.diag([1e-4, 1e-4, 4e-6, 1e-8])
        covariance = jacobian @ self.covariance @ jacobian.T + noise
        beliefs, innovations, covariances = [], [], []
        for key in STD:
            beliefs.append((mean, covariance))
            is_absent = not observations.get(f"{key}.present", True) and not self.absent
            if is_absent or (key == "compass" and self.random.random() > self.updates):
                innovations.append(None)
                covariances.append(None)
                continue
            h, expected = self.measure(key, mean)
            innovation = observations[key] - expected
            if self.wraps:
                innovation[-1] = wrapped(innovation[-1])
            r = self.factors[key] * np.diag(np.square(STD[key]))
            size = h @ covariance @ h.T + r
            gain = covariance @ h.T @ np.linalg.inv(size)
            used = self.gain if key == "radar" else 1.0
            mean, covariance = mean + used * gain @ innovation, covariance - self.reduction * gain @ size @ gain.T
            innovations.append(innovation)
            covariances.append(size)
        mean[2] = wrapped(mean[2])
        predicted = [np.stack(parts) for parts in zip(*(beliefs if self.separate else [beliefs[0]] * 2), strict=True)]
        self.mean, self.covariance = mean, covariance
        return {
            "estimate_mean": mean,
            "estimate_covariance": covariance,
            "predicted_mean": predicted[0],
            "predicted_covariance": predicted[1],
            "innovation": innovations,
            "innovation_covariance": covariances,
        }

    def measure(self, key: str, mean: Array) -> tuple[Array, Array]:
        """Jacobian and value of a measurement."""
        if key == "compass":
            return self.H["compass"], mean[2:3]
        x, y = mean[:2]
        r = math.hypot(x, y)
        expected = np.array([r + self.offset, math.atan2(y, x)])
        return self.jacobian * np.array([[x / r, y / r, 0, 0], [-y / r**2, x / r**2, 0, 0]]), expected


def loaded(filter_: Boat, every: int = 4) -> Checkpoint:
    adapter = bs.Adapter(filter_, batched=False, modalities=tuple(STD), initial_std=(0.5, 0.5, 0.1, BIAS))
    return bs.load_filter(adapter, task(every), name="boat")


def run(filter_: Boat, every: int = 4) -> Trace:
    return bs.trace(loaded(filter_, every), [sail(3, every)])


@cache
def profile() -> HealthyProfile:
    return profile_of(loaded(Boat()), [sail(seed) for seed in range(15)], "boat")


@pytest.mark.parametrize(("radar", "compass"), [(1.0, 1.0), (0.1, 1.0), (5.0, 0.3)])
def test_measurement_noise_is_that_of_the_filter_whatever_its_measurement_functions(
    radar: float, compass: float
) -> None:
    """``det P / det P+ = det S / det R``: the compass alone at three of four steps, and both at the others."""
    values = innovation_statistics(run(Boat(radar, compass)))
    expected = math.sqrt(radar * STD["radar"][0] * STD["radar"][1])
    assert values["measurement noise/radar/all"] == pytest.approx(expected, rel=1e-3)  # the trace has float32
    assert values["measurement noise/compass/all"] == pytest.approx(math.sqrt(compass) * STD["compass"][0], rel=1e-3)


def test_channels_are_named_as_those_of_the_sensors() -> None:
    names = [name for name in innovation_statistics(run(Boat())) if name.startswith("innovation bias/")]
    assert names == [f"innovation bias/{name}/all" for name in ("radar radar x", "radar radar y", "compass compass")]


def test_modalities_that_are_always_used_together_have_a_mean_measurement_noise() -> None:
    values = innovation_statistics(run(Boat(), every=1))
    product = STD["radar"][0] * STD["radar"][1] * STD["compass"][0]
    assert values["measurement noise//all"] == pytest.approx(product ** (1 / 3), rel=1e-3)
    assert "measurement noise/radar/all" not in values
    shares = [values[f"innovation share/{key}/all"] for key in STD]
    assert math.prod(shares) == pytest.approx(1.0)


def with_gate(whole: Trace, used: float, noise: float) -> Trace:
    """A trace with a third modality of variance ``noise``, of which a share is used: each halves the squared volume."""
    accepted = np.random.default_rng(1).random(len(whole)) < used
    assert whole.innovation is not None
    assert whole.innovation_covariance is not None
    assert whole.predicted_mean is not None
    assert whole.predicted_covariance is not None
    nu, s = np.full((len(whole), 1, 2), np.nan), np.full((len(whole), 1, 2, 2), np.nan)
    nu[:, 0, 0], s[:, 0, 0, 0] = 0.1, 2.0 * noise
    size = np.where(accepted, 0.5, 1.0) ** (1.0 / whole.estimate_covariance.shape[-1])
    return replace(
        whole,
        modalities=(*whole.modalities, "gps"),
        innovation=np.concatenate([whole.innovation, nu], axis=1),
        innovation_covariance=np.concatenate([whole.innovation_covariance, s], axis=1),
        predicted_mean=whole.predicted_mean[:, [0, 1, 1]],
        predicted_covariance=whole.predicted_covariance[:, [0, 1, 1]],
        estimate_covariance=whole.estimate_covariance * size[:, None, None],
        accepted=np.stack([np.ones(len(whole)), np.ones(len(whole)), accepted], axis=1),
    )


@pytest.mark.parametrize("used", [0.6, 0.3, 0.02])
def test_the_mean_measurement_noise_does_not_depend_on_the_share_of_used_measurements(used: float) -> None:
    trace, noise = with_gate(run(Boat(), every=1), used, 1e-4), [*STD["radar"], *STD["compass"], 1e-2]
    assert trace.innovation is not None
    assert trace.innovation_covariance is not None
    values = measurement_noise(trace, trace.innovation, trace.innovation_covariance.astype(np.float64))
    if used == 0.02:
        assert "measurement noise//all" not in values, "too few steps with all of them"
    else:
        assert values["measurement noise//all"] == pytest.approx(float(np.prod(noise)) ** 0.25, rel=1e-3)


def test_rejected_measurements_change_no_covariance() -> None:
    whole = run(Boat())
    gated = replace(whole, accepted=np.where(np.isfinite(whole.innovation).any(-1), 1.0, np.nan))
    assert innovation_statistics(gated) == innovation_statistics(whole)
    gated.accepted[:, 1] = 0.0
    assert innovation_statistics(gated)["updates/compass/all"] == pytest.approx(REJECTABLE, abs=0.04)
    lost = replace(gated, innovation=gated.innovation + 100.0 * np.sqrt(np.nanmax(gated.innovation_covariance)))
    assert innovation_statistics(lost)["updates/compass/all"] == 1.0, "a correct gate rejects them as well"


@pytest.mark.parametrize("separate", [False, True])
def test_updates_that_do_not_change_the_belief_are_missing(separate: bool) -> None:
    whole = run(Boat(separate=separate))
    assert whole.predicted_mean is not None
    assert whole.predicted_covariance is not None
    alone = ~np.isfinite(whole.innovation[:, 0]).all(-1)  # the compass, at three of four steps
    assert 0.7 < alone.mean() < 0.8
    estimates = whole.estimate_mean.copy(), whole.estimate_covariance.copy()
    for estimate, predicted in zip(estimates, (whole.predicted_mean, whole.predicted_covariance), strict=True):
        estimate[alone] = predicted[alone, 1]
    without = replace(whole, estimate_mean=estimates[0], estimate_covariance=estimates[1])
    before, after = innovation_statistics(whole), innovation_statistics(without)
    assert (before["updates/compass/all"], before["updates/radar/all"]) == (1.0, after["updates/radar/all"])
    assert after["updates/compass/all"] == pytest.approx(1.0 - alone[1:].mean(), abs=0.02)
    assert "measurement noise/compass/all" not in after, "no equation of the compass alone is left"


@pytest.mark.parametrize("readings", [0, 1, 2])
def test_repeated_readings_of_a_masked_sensor_are_those_of_its_readings(readings: int) -> None:
    """What stands in the steps without a reading does not matter."""
    episode = sail(3)
    present = np.zeros(len(episode), dtype=bool)
    present[: 20 * readings : 20] = True
    held = np.maximum.accumulate(np.where(present, np.arange(len(episode)), 0))
    episode.covariates["radar_reading"][:] = present
    episode.observations["radar"][:] = episode.observations["radar"][held]
    assert not stuck(episode, "radar", 0).any()
    episode.covariates["radar_reading"][:] = np.arange(len(episode)) % 4 == 0
    episode.observations["radar"][:] = np.where(np.arange(len(episode)) < 20, episode.observations["radar"].T, 7.0).T
    episode.observations["radar"][1::4] = 0.0
    assert stuck(episode, "radar", 0).sum() == 19


def test_a_sensor_whose_few_readings_are_all_equal_is_stuck() -> None:
    """A delay repeats as many at the start of an episode, but other readings follow."""
    episode = sail(3, every=20)
    episode.observations["radar"][:] = 3.0
    assert stuck(episode, "radar", 0).sum() == 4


def test_predictions_before_each_update_have_the_statistics_of_those_before_all() -> None:
    shared, separate = run(Boat()), run(Boat(separate=True))
    assert not np.array_equal(shared.predicted_mean, separate.predicted_mean)
    assert innovation_statistics(separate) == pytest.approx(innovation_statistics(shared))
    of_dynamics = external_dynamics_statistics(shared, loaded(Boat()))
    of_separate = external_dynamics_statistics(separate, loaded(Boat(separate=True)))
    assert of_separate == pytest.approx(of_dynamics, nan_ok=True)


def test_innovations_at_true_states_show_offsets_and_differences_that_are_not_wrapped() -> None:
    trace, rng = run(Boat()), np.random.default_rng(0)
    assert trace.innovation is not None
    nu = np.where(np.isfinite(trace.innovation), rng.normal(0.05, 0.1, trace.innovation.shape), np.nan)
    compass = trace.modalities.index("compass")
    far = np.flatnonzero(np.isfinite(nu[:, compass, 0]))[::10]
    nu[far, compass, 0] -= 2.0 * np.pi
    values = measurement_model_statistics(trace, [], replace(trace, innovation=nu.astype(np.float32)))
    own = nu[:, trace.modalities.index("radar"), 0]
    expected = np.nanmean(own) / np.nanstd(own)
    assert values["innovation offset/radar radar x/all"] == pytest.approx(expected, rel=1e-5)
    assert values["innovation spread/radar radar x/all"] == pytest.approx(np.nanstd(own), rel=1e-5)
    assert abs(values["innovation drift/radar radar x/all"]) < 1.0
    ramp = np.linspace(0.0, 0.4, len(nu))[:, None, None]
    moved = measurement_model_statistics(trace, [], replace(trace, innovation=(nu + ramp).astype(np.float32)))
    change = moved["innovation drift/radar radar x/all"] - values["innovation drift/radar radar x/all"]
    assert change == pytest.approx(0.4 / np.nanstd(own), rel=0.1)  # the line through the few readings also varies
    assert values["innovation turns/radar/all"] == 0.0
    assert values["innovation turns/compass/all"] == pytest.approx(0.1, abs=0.01)
    other = measurement_model_statistics(trace, [], replace(trace))  # the innovations of the run, not at true states
    assert not any(name.startswith(("innovation offset/", "innovation spread/")) for name in other)
    for unit, turns in (("m", 0.0), ("rad", 0.1)):
        task = replace(trace.task, channels={**trace.task.channels, "compass": (Component("north", unit),)})
        named = replace(trace, episode=replace(trace.episode, task=task))
        values = measurement_model_statistics(named, [], replace(named, innovation=nu.astype(np.float32)))
        assert values["innovation turns/compass/all"] == pytest.approx(turns, abs=0.01)
    wide = replace(trace, innovation=(30.0 * nu).astype(np.float32))  # no angle
    assert measurement_model_statistics(trace, [], wide)["innovation turns/radar/all"] == 0.0


def test_filters_that_report_no_innovations_have_no_statistics_of_them() -> None:
    assert innovation_statistics(replace(run(Boat()), innovation=None, innovation_covariance=None)) == {}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("filter_", "cause"),
    [
        pytest.param(Boat(radar=0.1), "measurement_noise.radar.small", marks=pytest.mark.long),
        pytest.param(Boat(compass=10.0), "measurement_noise.compass.large", marks=pytest.mark.long),
        pytest.param(Boat(wraps=False), "innovation.compass.turns", marks=pytest.mark.long),
        pytest.param(Boat(has_bias=False), "dynamics.drift", marks=pytest.mark.long),
        pytest.param(Boat(updates=0.5), "updates.compass.missing", marks=pytest.mark.long),
        pytest.param(Boat(turn=-1.0), "dynamics.inverted", marks=pytest.mark.long),
        pytest.param(Boat(turn=0.6), "dynamics.frozen", marks=pytest.mark.long),
        pytest.param(Boat(turn=2.0), "dynamics.large", marks=pytest.mark.long),
        pytest.param(Boat(offset=0.5), "measurement.radar.function", marks=pytest.mark.long),
        pytest.param(Boat(radar=0.1, separate=True), "measurement_noise.radar.small", marks=pytest.mark.long),
        pytest.param(Boat(jacobian=FLIPPED), "measurement.radar.jacobian", marks=pytest.mark.long),
        pytest.param(Boat(jacobian=-1.0), "measurement.radar.jacobian", marks=pytest.mark.long),
        pytest.param(Boat(jacobian=0.5), "measurement.radar.jacobian", marks=pytest.mark.long),
        pytest.param(Boat(heading_jacobian=-1.0), "dynamics.jacobian", marks=pytest.mark.long),
        pytest.param(Boat(gain=0.5), "updates.radar.gain", marks=pytest.mark.long),
        pytest.param(Boat(reduction=0.0), "updates.covariance", marks=pytest.mark.long),
        pytest.param(Boat(reduction=-0.2), "updates.covariance", marks=pytest.mark.long),
        pytest.param(Boat(absent=True), "updates.radar.absent", marks=pytest.mark.long),
    ],
)
def test_defects_of_the_equations_are_named(filter_: Boat, cause: str) -> None:
    result = diagnose(loaded(filter_), {seed: sail(seed) for seed in range(40, 50)}, profile=profile())
    assert result.causes, result.headline
    assert (result.causes[0].cause.name, result.causes[0].probability > 0.5) == (cause, True), result.headline


@pytest.mark.long
def test_innovations_that_are_not_wrapped_are_mentioned_although_the_record_has_them_too() -> None:
    unwrapped = loaded(Boat(wraps=False))
    record = profile_of(unwrapped, [sail(seed) for seed in range(12)], "boat")
    result = diagnose(unwrapped, {seed: sail(seed) for seed in range(47, 51)}, profile=record)
    assert (result.state, result.provenance["miscalibrated"]) == ("healthy", True)
    assert result.headline.startswith("Innovations of compass not wrapped in episodes 47, 49, 50; otherwise no ")
