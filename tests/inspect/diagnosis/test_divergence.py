"""Filters that diverge or fail are restarted at the true state, and the cause is named."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from tests.inspect.diagnosis.checks import test_innovations as boats
from tests.inspect.diagnosis.test_external_dynamics import SENSORS, TASK, drive

import beliefscope as bs
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.compare.two_runs import compare_runs
from beliefscope.inspect.diagnosis.diagnose import DIVERGED, diagnose
from beliefscope.inspect.diagnostics.errors import errors_of
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.healthy import profile_of
from beliefscope.inspect.traces.restarts import FAILURE, RESTARTS, restarts_text, trace_with_restarts


class Kalman:
    """One update after another of a position, m."""

    def __init__(self, sign: float = 1.0, fails_beyond: float = np.inf) -> None:
        self.sign, self.fails_beyond = sign, fails_beyond

    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        self.mean, self.covariance = mean, covariance

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        prior, covariance = self.mean + controls, self.covariance + 0.005**2 * np.eye(2)
        mean, values = (
            prior,
            {"predicted_mean": np.stack([prior] * 2), "predicted_covariance": np.stack([covariance] * 2)},
        )
        innovations, sizes = [], []
        for key, std in SENSORS.items():
            innovation, size = observations[key] - mean, covariance + std**2 * np.eye(2)
            gain = covariance @ np.linalg.inv(size)
            innovations.append(innovation)
            sizes.append(size)
            mean, covariance = mean + self.sign * gain @ innovation, (np.eye(2) - gain) @ covariance
        if np.abs(mean).max() > self.fails_beyond:
            raise np.linalg.LinAlgError("Matrix is not positive definite")
        self.mean, self.covariance = mean, covariance
        values |= {"innovation": innovations, "innovation_covariance": sizes}
        return values | {"estimate_mean": mean, "estimate_covariance": covariance}


def loaded(filter_: Kalman) -> ExternalFilter:
    adapter = bs.Adapter(filter_, batched=False, modalities=tuple(SENSORS), initial_std=(0.02, 0.02))
    checkpoint = bs.load_filter(adapter, TASK, name="kalman")
    assert isinstance(checkpoint, ExternalFilter)
    return checkpoint


@cache
def profile() -> HealthyProfile:
    return profile_of(loaded(Kalman()), [drive(seed) for seed in range(12)], "cart")


@pytest.mark.parametrize("filter_", [Kalman(sign=-1.0), Kalman(sign=-1.0, fails_beyond=1e3)])
def test_a_run_with_restarts_is_that_of_the_parts(filter_: Kalman) -> None:
    """From the true state at each of them, up to where the state is lost, and with the complete episode."""
    checkpoint, episode = loaded(filter_), drive(20)
    run = trace_with_restarts(checkpoint, episode, 7, largest=100.0)
    assert (run.episode_index, len(run), run.data_hash) == (7, len(episode), episode.digest())
    np.testing.assert_array_equal(run.episode.states, episode.states)
    reason = "fails at step" if np.isfinite(filter_.fails_beyond) else "Kalman diverges"
    assert reason in run.settings[FAILURE]
    starts = [0, *run.settings[RESTARTS], len(episode)]
    assert len(starts) > 3
    std = episode.states.std(0)
    for first, last in pairwise(starts):
        np.testing.assert_array_equal(
            run.estimate_mean[first:last], bs.trace(checkpoint, episode.part(first, last)).estimate_mean
        )
        assert (np.abs(run.estimate_mean[first : last - 1] - episode.states[first : last - 1]) < 10.0 * std).all()


def test_a_run_that_does_not_diverge_has_no_restarts() -> None:
    run, usual = trace_with_restarts(loaded(Kalman()), drive(20)), bs.trace(loaded(Kalman()), drive(20))
    assert RESTARTS not in run.settings
    assert (run.data_hash, run.settings) == (usual.data_hash, usual.settings)
    np.testing.assert_array_equal(run.estimate_mean, usual.estimate_mean)


def test_a_component_that_does_not_change_has_the_scale_of_the_first_belief() -> None:
    """The bias of the boat is constant."""
    assert RESTARTS not in trace_with_restarts(boats.loaded(boats.Boat()), boats.sail(3, 4), largest=DIVERGED).settings


class OwnStart(Kalman):
    def initialize_beliefs(self) -> None:  # type: ignore[override]
        super().initialize_beliefs(mean=np.zeros(2), covariance=np.eye(2))


@pytest.mark.parametrize("is_known", [True, False])
def test_a_filter_that_starts_at_its_own_belief_is_not_restarted(is_known: bool) -> None:
    episode = drive(20)
    blind = replace(episode, states=np.full_like(episode.states, np.nan))
    run = trace_with_restarts(loaded(OwnStart(sign=-1.0)), episode if is_known else blind, largest=100.0)
    assert np.abs(run.estimate_mean).max() > 100.0
    assert RESTARTS not in run.settings


@pytest.mark.slow
@pytest.mark.parametrize(
    "filter_", [Kalman(sign=-1.0), pytest.param(Kalman(sign=-1.0, fails_beyond=1e3), marks=pytest.mark.long)]
)
def test_the_cause_of_a_divergence_is_named(filter_: Kalman) -> None:
    result = diagnose(loaded(filter_), {seed: drive(seed) for seed in range(20, 25)}, profile=profile())
    assert result.causes[0].cause.name == "updates.sign", result.headline
    event = "is restarted" if np.isfinite(filter_.fails_beyond) else "diverges"
    assert f"; the filter {event} in 5 of 5 episodes, first at step " in result.headline
    assert set(result.provenance[RESTARTS]) == set(range(20, 25))


class Failing(Kalman):
    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        super().initialize_beliefs(mean=mean, covariance=covariance)
        self.steps = 0

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        self.steps += 1
        if self.steps > 20:
            raise np.linalg.LinAlgError("Matrix is not positive definite")
        return super().__call__(observations=observations, controls=controls)


def test_the_headline_states_the_failure_of_a_filter_that_does_not_diverge() -> None:
    """First, as no cause is known."""
    result = diagnose(loaded(Failing()), {20: drive(20)}, profile=profile())
    failure = "Failing fails at step 20: LinAlgError: Matrix is not positive definite"
    assert result.headline.startswith(f"The filter is restarted at step 20: {failure}; ")
    assert (result.state, ".;" in result.headline) == ("unsure", False)


class Occluded(Failing):
    """The first sensor, of two channels, has no readings after the first failure; the other one has one channel."""

    starts = 0

    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        super().initialize_beliefs(mean=mean, covariance=covariance)
        self.starts += 1

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        values = super().__call__(observations=observations, controls=controls)
        seen = self.starts <= 2  # the run that fails, and that of the steps before
        return values | {
            "innovation": [values["innovation"][0] if seen else None, np.zeros(1)],
            "innovation_covariance": [values["innovation_covariance"][0] if seen else None, np.eye(1)],
        }


def test_parts_of_a_run_have_different_channels() -> None:
    run = trace_with_restarts(loaded(Occluded()), drive(20))
    assert run.innovation is not None
    assert run.innovation.shape == (len(run), 2, 2)
    assert run.innovation_covariance is not None
    assert run.innovation_covariance.shape == (len(run), 2, 2, 2)
    np.testing.assert_array_equal(np.isnan(run.innovation[:, 0, 0]), np.arange(len(run)) >= 20)
    assert np.isnan(run.innovation[:, 1, 1]).all()


def test_restarts_are_named_in_comparisons_and_errors() -> None:
    failing, right = trace_with_restarts(loaded(Failing()), drive(20)), bs.trace(loaded(Kalman()), drive(20))
    reason = (
        "restarted at the true state 2 times: Failing fails at step 20: LinAlgError: Matrix is not positive definite"
    )
    assert restarts_text(failing) == reason
    assert compare_runs(right, failing, ("right", "failing")).verdict.startswith(f"failing is {reason}. RMSE over ")
    assert compare_runs(right, right).restarts == ("", "")
    text = "The filter fails and is restarted at the true state in "
    assert errors_of([failing]).verdict.startswith(f"{text}this run. Position RMSE")
    assert errors_of([failing, right]).verdict.startswith(f"{text}1 of 2 runs. ")


@pytest.mark.long
def test_episodes_in_which_a_filter_fails_at_once_are_left_out() -> None:
    """The cart of episode 23 is farther from the origin than all others."""
    episodes = {seed: drive(seed) for seed in range(20, 26)}
    far = replace(episodes[23], states=episodes[23].states + np.float32(50.0))
    far = replace(far, observations={key: values + np.float32(50.0) for key, values in far.observations.items()})
    others = {seed: episode for seed, episode in episodes.items() if seed != 23}
    for sign, seeds in ((1.0, others), (-1.0, others)):
        checkpoint = loaded(Kalman(sign, fails_beyond=45.0))
        expected = diagnose(checkpoint, seeds, profile=profile())
        result = diagnose(checkpoint, {**episodes, 23: far}, profile=profile())
        failure = "1 of 6 episodes are left out, as the filter fails within 5 steps of a start: Kalman fails at step 0"
        assert failure in result.headline
        assert result.headline.startswith(failure) == (expected.state != "fault")
        assert [c.cause.name for c in result.causes] == [c.cause.name for c in expected.causes]
        assert result.provenance["episodes"] == 5


def test_a_filter_that_fails_at_once_has_no_diagnosis() -> None:
    with pytest.raises(BadInput, match="Kalman fails at step 0: LinAlgError: Matrix is not positive definite"):
        diagnose(loaded(Kalman(fails_beyond=0.0)), {0: drive(20)}, profile=profile())
