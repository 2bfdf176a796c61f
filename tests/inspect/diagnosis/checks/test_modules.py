"""Statistics of modules and equations against closed forms, on pretrained filters with changed parameters."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.filters.models.pf import MixtureParticleFilter
from beliefscope.inspect.diagnosis.checks.dynamics import module_dynamics_statistics
from beliefscope.inspect.diagnosis.checks.equations import equation_statistics
from beliefscope.inspect.diagnosis.checks.modules import (
    likelihood_moments,
    measurement_statistics,
    model_statistics,
    proposal,
    weight_statistics,
)
from beliefscope.inspect.trace import Trace, trace


@cache
def episode(task: str = "door") -> Episode:
    with open_dataset(sample_path(task)) as data:
        return data[data.held_out()[0]]


@cache
def run(name: str, task: str = "door") -> tuple[Checkpoint, Trace]:
    checkpoint = load_checkpoint(pretrained_path(task, name))
    return checkpoint, trace(checkpoint, episode(task), particles=50)


def with_observations(residual: np.ndarray, std: float) -> Trace:
    """The EKF's trace with virtual observations at the truth plus residuals (T, 1, n), of a standard deviation."""
    _, original = run("crossmodal-ekf")
    truth = original.episode.states[:, None]
    n = truth.shape[-1]
    return replace(
        original,
        observation_mean=(truth + residual * np.ones((1, 2, 1))).astype(np.float32),
        observation_covariance=np.broadcast_to(std**2 * np.eye(n), (len(original), 2, n, n)).astype(np.float32),
    )


def test_measurement_statistics_are_moments_of_the_residuals() -> None:
    checkpoint, _ = run("crossmodal-ekf")
    r = 0.02 + 0.01 * np.random.default_rng(0).standard_normal((len(episode()), 1, 3))
    values = measurement_statistics(with_observations(r, 0.05), checkpoint)
    for i, component in enumerate(c.name for c in checkpoint.task.components):
        expected = {"bias": r[:, 0, i].mean(), "spread": r[:, 0, i].std(), "std": 0.05}
        expected |= {"error": np.sqrt(np.square(r[:, 0, i]).mean()), "nis": np.square(r[:, 0, i] / 0.05).mean()}
        for kind, value in expected.items():
            assert values[f"module {kind}/haptics {component}/all"] == pytest.approx(value, rel=2e-3)


def test_a_bias_of_the_dynamics_changes_only_bias_error_and_nis() -> None:
    checkpoint, _ = run("crossmodal-ekf")
    before = module_dynamics_statistics(episode(), checkpoint)
    biased = copy.deepcopy(checkpoint.filter)
    forward = biased.dynamics.forward
    std = checkpoint.filter.statistics.mean_std("state")[1]
    biased.dynamics.forward = lambda states, control: forward(states, control) + 0.004 / std
    after = module_dynamics_statistics(episode(), replace(checkpoint, filter=biased))
    for component in (c.name for c in checkpoint.task.components):
        shift = after[f"dynamics bias/{component}/all"] - before[f"dynamics bias/{component}/all"]
        assert shift == pytest.approx(0.004, rel=1e-3)
        same = [f"dynamics spread/{component}/all", f"dynamics slope/{component}/all"]
        for name in same:
            assert after[name] == pytest.approx(before[name], rel=1e-2, nan_ok=True)


def test_frozen_dynamics_have_slope_zero_and_process_noise_is_reported() -> None:
    checkpoint, _ = run("crossmodal-ekf")
    frozen = copy.deepcopy(checkpoint.filter)
    frozen.dynamics.forward = lambda states, control: states
    values = module_dynamics_statistics(episode(), replace(checkpoint, filter=frozen))
    assert values["dynamics slope/angle/all"] == pytest.approx(0.0, abs=1e-4)
    assert values["dynamics spread/angle/all"] == pytest.approx(0.0, abs=1e-6)
    assert values["dynamics bias/angle/all"] == pytest.approx(0.0, abs=1e-6)  # the slope explains the missing change
    noise = checkpoint.filter.dynamics.noise[2] * checkpoint.filter.statistics.mean_std("state")[1][2]
    assert values["process noise/angle/all"] == pytest.approx(float(noise))


def test_delayed_states_follow_the_predicted_changes() -> None:
    checkpoint, _ = run("crossmodal-ekf")
    for steps in (0, 3):
        states = np.concatenate([np.repeat(episode().states[:1], steps, axis=0), episode().states[: 100 - steps]])
        late = replace(episode(), states=states)
        assert module_dynamics_statistics(late, checkpoint)["lag/dynamics/all"] == steps


def test_moments_of_a_gaussian_likelihood(monkeypatch: pytest.MonkeyPatch) -> None:
    """Importance sampling recovers mean and variance of a Gaussian of any width between the scales."""
    checkpoint, _ = run("crossmodal-pf")
    filter_ = checkpoint.filter
    assert isinstance(filter_, MixtureParticleFilter)
    truth = filter_.statistics.standardise("state", torch.from_numpy(episode().states[:8]))
    for bias, std in ((0.0, 0.1), (0.2, 0.2), (0.3, 0.5)):
        centre = (truth + bias)[:, None, None]
        gaussian = lambda _, x, c=centre, s=std: -0.5 * ((x[:, None] - c) / s).square().sum(-1)  # noqa: E731
        monkeypatch.setattr(filter_, "log_likelihood", gaussian)
        mean, variance, _ = likelihood_moments(filter_, episode(), np.arange(8))
        scale = filter_.statistics.mean_std("state")[1].numpy()
        error = (mean - episode().states[:8, None])[:, 0] / scale
        assert np.abs(error - bias).max() < 0.5 * std
        assert np.abs(np.log(variance[:, 0] / (scale * std) ** 2)).max() < 1.0


def test_the_power_of_a_likelihood_does_not_change_its_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    filter_ = run("crossmodal-pf")[0].filter
    assert isinstance(filter_, MixtureParticleFilter)
    before = likelihood_moments(filter_, episode(), np.arange(8))
    likelihood = filter_.log_likelihood
    monkeypatch.setattr(filter_, "log_likelihood", lambda evidence, states: 4.0 * likelihood(evidence, states))
    after = likelihood_moments(filter_, episode(), np.arange(8))
    np.testing.assert_allclose(after[0], before[0], atol=1e-4)
    np.testing.assert_allclose(after[2], 16.0 * before[2], rtol=1e-3)


def test_the_proposal_is_a_density() -> None:
    """The mean of N(0, s^2) / q over samples of q is 1."""
    offsets, log_density = proposal(3)
    for s in (0.1, 0.3):
        normal = -0.5 * (offsets / s).square().sum(-1) - 3.0 * np.log(s * np.sqrt(2.0 * np.pi))
        assert float((normal - log_density).exp().mean()) == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("name", ["crossmodal-ekf", "unimodal-ekf", "image-ekf", "crossmodal-pf", "unimodal-pf"])
def test_equations_of_a_filter_hold_exactly(name: str) -> None:
    values = equation_statistics(run(name)[1], run(name)[0])
    for kind in ("reported variance", "fusion variance"):
        assert values.get(f"{kind}//all", 0.0) == pytest.approx(0.0, abs=1e-3)
    assert values["fusion mean//all"] == pytest.approx(0.0, abs=1e-3)
    assert values.get("prior ess//all", 1.0) == pytest.approx(1.0)
    assert values.get("offspring//all", 0.0) < 1.0  # systematic resampling: less than one from the expectation


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_a_scaled_report_and_fusion_are_measured(name: str) -> None:
    checkpoint, original = run(name)
    scaled = replace(original, estimate_covariance=0.5 * original.estimate_covariance)
    values = equation_statistics(scaled, checkpoint)
    assert values["reported variance//all"] == pytest.approx(np.log(0.5), abs=1e-3)
    assert values["fusion variance//all"] == pytest.approx(0.0, abs=1e-3)


def test_the_report_of_an_information_filter_is_compared_with_its_next_prediction() -> None:
    """Its belief also has biases, but the prediction of the state depends on the state's covariance only."""
    checkpoint = load_checkpoint(pretrained_path("push-field", "information-ekf"))
    with open_dataset(sample_path("push-field")) as data:
        original = trace(checkpoint, data[0], 0)
    assert equation_statistics(original, checkpoint) == {"reported variance//all": pytest.approx(0.0, abs=1e-3)}
    scaled = replace(original, estimate_covariance=3.0 * original.estimate_covariance)
    values = equation_statistics(scaled, checkpoint)
    assert values["reported variance//all"] == pytest.approx(np.log(3.0), abs=1e-3)


def test_the_power_of_the_likelihood_is_the_inverse_of_a_variance() -> None:
    checkpoint, original = run("crossmodal-pf")
    assert original.log_weights is not None
    powered = 2.0 * original.log_weights.astype(np.float64)
    powered -= np.logaddexp.reduce(powered, axis=1, keepdims=True)
    values = equation_statistics(replace(original, log_weights=powered.astype(np.float32)), checkpoint)
    assert values["fusion variance//all"] == pytest.approx(-np.log(2.0), abs=1e-2)


def test_log_odds_of_the_weights_before_the_bound() -> None:
    original = run("crossmodal-pf")[1]
    logit = np.linspace(-2.0, 4.0, len(original))
    odds = 6.0 * np.tanh(logit / 6.0)
    beta = 1.0 / (1.0 + np.exp(-odds))
    weights = np.stack([beta, 1.0 - beta], axis=1)[..., None].astype(np.float32)
    values = weight_statistics(replace(original, weights=weights))
    assert values["beta logit/image/all"] == pytest.approx(logit.mean(), rel=1e-3)
    assert values["beta spread/image/all"] == pytest.approx(logit.std(), rel=1e-3)


@pytest.mark.first(2)
@pytest.mark.parametrize("name", ["feature-ekf", "feature-pf", "image-pf", "haptics-ekf"])
def test_other_filters_have_the_statistics_that_apply(name: str) -> None:
    checkpoint, original = run(name)
    values = model_statistics(original, checkpoint)
    assert values["error//all"] > 0.0
    assert f"module error/{original.modalities[0]} angle/all" in values
    assert not any(key.startswith("beta") for key in values)


def test_without_ground_truth_only_weights_and_equations_remain() -> None:
    checkpoint, original = run("crossmodal-ekf")
    unknown = replace(original.episode, states=np.full_like(original.episode.states, np.nan))
    kinds = {name.split("/")[0] for name in model_statistics(replace(original, episode=unknown), checkpoint)}
    assert kinds <= {"beta logit", "beta spread", "beta contact", "fusion mean", "fusion variance", "reported variance"}
