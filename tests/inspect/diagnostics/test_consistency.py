"""Consistency and calibration: exact filters of a simulated system, closed forms, and reference packages."""

from __future__ import annotations

import math
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics.consistency import Consistency, consistency, why_not
from beliefscope.inspect.diagnostics.layer_consistency import number
from beliefscope.inspect.failures.step_scores import scores_of
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.calibration import (
    gaussian_crps,
    gaussian_level,
    ljung_box,
    particle_crps,
    particle_level,
)
from beliefscope.inspect.statistics.innovations import innovations

sys.path.insert(0, str(Path(__file__).parent))
import planted_traces as plant


@pytest.fixture(scope="module")
def exact() -> Consistency:
    return consistency(plant.simulated())


def test_an_exact_filter_is_consistent(exact: Consistency) -> None:
    assert exact.layers == ("image", "haptics", "fused")
    for entry in exact.by_layer:
        # About 500 independent steps: the mean of chi2_3 / 3 has a standard error of sqrt(2 / 3 / 500) = 0.04.
        assert entry.nees == pytest.approx(1.0, abs=0.12), (entry.layer, entry.phase)
        assert entry.interval[0] < 1.0 < entry.interval[1] or not entry.inconsistent
        assert not entry.inconsistent
        assert entry.coverage95 == pytest.approx(0.95, abs=0.02)
        assert entry.miscalibration < 0.03
        np.testing.assert_allclose(entry.rmse, entry.sharpness, rtol=0.1)
        # The mean CRPS of a true N(m, s^2) is s / sqrt(pi).
        np.testing.assert_allclose(entry.crps, entry.sharpness / math.sqrt(math.pi), rtol=0.1)
        if entry.layer != "fused":
            assert entry.nis == pytest.approx(1.0, abs=0.1)
    assert exact.verdict.startswith("No healthy record of this filter; compared with theory. Consistent (NEES/n ")
    assert exact.alarms == ()
    assert "Also consistent in each phase: contact, free motion." in exact.verdict
    assert "All single-modality updates are consistent." in exact.verdict
    assert "Innovations are white." in exact.verdict


@pytest.mark.parametrize("entry", [(0, 0), (0, 1)])
def test_a_covariance_that_is_not_positive_definite_is_named(entry: tuple[int, int]) -> None:
    (run,) = plant.simulated(1)
    covariance = run.estimate_covariance.copy()
    first, second = entry
    limit = np.sqrt(covariance[-5:, first, first] * covariance[-5:, second, second])
    covariance[-5:, first, second] = covariance[-5:, second, first] = -1.1 * limit
    result = consistency([replace(run, estimate_covariance=covariance)])
    assert result.verdict.startswith("The covariance is not positive definite in 5 steps. No healthy record")
    assert result.alarms[0] == "the covariance is not positive definite in 5 steps"


def test_steps_with_a_covariance_of_zeros_are_unknown_as_in_evaluate() -> None:
    (run,) = plant.simulated(1)
    covariance = run.estimate_covariance.copy()
    covariance[-5:] = 0.0
    covariance[-8:-5, 0] = covariance[-8:-5, :, 0] = 0.0
    result = consistency([replace(run, estimate_covariance=covariance)])
    known = replace(
        run, estimate_covariance=np.where(np.arange(len(run))[:, None, None] < len(run) - 8, covariance, np.nan)
    )
    assert result.entry("fused").steps == int(measures.counted(run)[:-8].sum())
    assert result.entry("fused").nees == consistency([known]).entry("fused").nees
    assert np.isnan(measures.nees(replace(run, estimate_covariance=covariance))[-8:, -1]).all()
    assert result.alarms == ()


@pytest.mark.parametrize(
    ("components", "reason"), [(slice(None), "has no covariance"), (0, "reports a variance of zero at every step")]
)
def test_covariances_of_zeros_are_no_covariances(components: int | slice, reason: str) -> None:
    (run,) = plant.simulated(1)
    covariance = run.estimate_covariance.copy()
    covariance[:, components] = covariance[..., components] = 0.0
    zeros = replace(run, estimate_covariance=covariance)
    assert reason in (why_not(zeros) or "")
    assert scores_of(run.task)["nees"].why_not(zeros) == f"this filter {reason}"
    assert why_not(run) is None


def test_nll_of_a_consistent_filter_is_the_entropy(exact: Consistency) -> None:
    covariance = plant.simulated(1)[0].estimate_covariance[-1].astype(float)
    entropy = 0.5 * np.linalg.slogdet(2.0 * math.pi * math.e * covariance)[1]
    assert exact.entry("fused").nll == pytest.approx(entropy, abs=0.15)  # 1.5 x tolerance of NEES / n


@pytest.mark.parametrize(("scale", "prefix"), [(0.25, "Over"), (4.0, "Under")])
def test_scaled_covariances_are_over_or_underconfident(exact: Consistency, scale: float, prefix: str) -> None:
    from scipy.stats import chi2

    result = consistency(plant.simulated(scale=scale))
    assert re.search(rf"theory\. {prefix}confident by a factor of (1\.9|2|2\.1) ", result.verdict)
    compares_updates = "Least consistent single-modality update" in result.verdict
    assert measures.UPDATES_NOTE not in result.verdict  # these updates have their own priors
    with_common_prior = replace(result, updates_note=measures.UPDATES_NOTE).verdict
    assert compares_updates == (measures.UPDATES_NOTE in with_common_prior)
    assert compares_updates or scale > 1.0
    for layer in result.layers:
        # Same errors, other covariances.
        assert result.entry(layer).nees == pytest.approx(exact.entry(layer).nees / scale, rel=1e-5)
        assert np.all(result.entry(layer).rmse == exact.entry(layer).rmse)
    assert result.entry("fused").nll > exact.entry("fused").nll + 0.3
    coverage = result.entry("fused").coverage95
    assert coverage == pytest.approx(chi2.cdf(scale * chi2.ppf(0.95, 3), 3), abs=0.04)
    assert result.entry("fused").crps.mean() > exact.entry("fused").crps.mean()


def test_correlated_noise_is_not_white() -> None:
    result = consistency(plant.simulated(memory=0.9))
    assert "Innovations are not white" in result.verdict
    assert "errors persist over steps" in result.verdict
    assert max(entry.p_value for entry in result.whiteness) < 1e-6
    assert "theory. Overconfident" in result.verdict
    assert any(alarm.startswith("innovations of ") for alarm in result.alarms)


def test_angles_wrap(exact: Consistency) -> None:
    turned = []
    for trace in plant.simulated():
        move = {}
        for name, turns in (("estimate_mean", 1), ("modality_mean", -1), ("observation_mean", 2)):
            move[name] = getattr(trace, name).copy()
            move[name][..., 2] += turns * 2.0 * np.pi
        turned.append(replace(trace, **move))
    again = consistency(turned)
    for entry, other in zip(exact.by_layer, again.by_layer, strict=True):
        assert entry.nees == pytest.approx(other.nees, rel=1e-3)  # float32 at 4 pi: 1e-6 rad of 0.03
        np.testing.assert_allclose(entry.crps, other.crps, rtol=1e-3)
    result = innovations(turned[0])
    assert result is not None
    assert np.abs(result[0][..., 2]).max() < 1.0


def test_order_of_modalities_is_irrelevant() -> None:
    traces = plant.simulated(5)
    entry, other = consistency(traces), consistency([plant.swapped(trace) for trace in traces])
    assert other.layers == ("haptics", "image", "fused")
    for result in entry.by_layer:
        assert result.nees == other.entry(result.layer, result.phase).nees
    assert {(w.modality, w.component, w.p_value) for w in entry.whiteness} == {
        (w.modality, w.component, w.p_value) for w in other.whiteness
    }


def test_few_trajectories_qualify_the_verdict() -> None:
    result = consistency(plant.simulated(1))
    assert "Too few episodes (1; at least 5 needed)" in result.verdict
    assert result.alarms == ()
    assert math.isnan(result.entry("fused").interval[1])
    assert result.nees.shape == (130, 3)
    assert result.nis.shape == (130, 2)
    assert len(consistency(plant.simulated(2)).curves()) == 0


def test_one_trajectory_far_beyond_any_consistent_one_is_overconfident() -> None:
    result = consistency(plant.simulated(1, scale=0.01))
    fused = result.entry("fused")
    assert fused.nees > 50.0
    assert "Overconfident by a factor of" in result.verdict
    assert "with 95 % confidence at least" in result.verdict
    assert "consistent in each phase" not in result.verdict
    assert any("fused" in alarm for alarm in result.alarms)


def test_exact_particle_set_is_calibrated() -> None:
    """True states and particles of one distribution: levels are uniform, and the mean CRPS is s / sqrt(pi)."""
    rng = np.random.default_rng(3)
    steps, count = 630, 400
    centre = np.array([0.5, -0.2, np.pi])
    truth = centre + rng.normal(size=(steps, 3)) * plant.SCALE
    particles = centre + rng.normal(size=(steps, count, 3)) * plant.SCALE
    truth[:, 2] -= 2.0 * np.pi  # the same angle
    mean, away = particles.mean(1), particles - particles.mean(1, keepdims=True)
    covariance = np.einsum("tmi,tmj->tij", away, away) / count
    flat = np.full((steps, count), -np.log(count))
    result = consistency(
        [
            plant.planted(
                plant.real("crossmodal-pf"),
                truth,
                estimate_mean=mean,
                estimate_covariance=covariance,
                modality_mean=np.stack([mean, mean], 1),
                modality_covariance=np.stack([covariance, covariance], 1),
                particles=particles,
                prior_log_weights=flat,
                log_weights=flat,
                log_likelihood=np.zeros((steps, 2, count)),
                ancestors=np.tile(np.arange(count, dtype=np.int32), (steps, 1)),
            )
        ]
    )
    assert result.whiteness == ()
    for layer in result.layers:
        entry = result.entry(layer)
        assert entry.nees == pytest.approx(1.0, abs=0.1)  # sqrt(2 / 3 / 600) = 0.033
        assert entry.miscalibration < 0.03
        assert entry.coverage95 == pytest.approx(0.95, abs=0.03)
        np.testing.assert_allclose(entry.crps, plant.SCALE / math.sqrt(math.pi), rtol=0.1)


@pytest.mark.slow
def test_crps_of_a_gaussian() -> None:
    from scipy.stats import norm
    from uncertainty_toolbox.metrics_scoring_rule import crps_gaussian

    rng = np.random.default_rng(0)
    error, deviation = rng.normal(size=200), rng.uniform(0.2, 3.0, 200)
    theirs = crps_gaussian(np.zeros(200), deviation, -error)
    assert gaussian_crps(error, deviation).mean() == pytest.approx(theirs, rel=1e-12)
    assert gaussian_crps(np.zeros(1), np.full(1, 2.0))[0] == pytest.approx(
        2.0 * (math.sqrt(2) - 1) / math.sqrt(math.pi)
    )
    # By its definition, the integral of (F(x) - [x > y])^2, y = 0, on cells of 1e-3.
    x = np.arange(-20.0, 20.0, 1e-3) + 5e-4
    integral = np.square(norm.cdf(x, 0.7, 1.3) - (x > 0)).sum() * 1e-3
    assert gaussian_crps(np.array([0.7]), np.array([1.3]))[0] == pytest.approx(integral, rel=1e-5)


def test_crps_of_particles() -> None:
    from scipy.stats import norm

    rng = np.random.default_rng(1)
    x, w = rng.normal(size=(4, 40)), rng.dirichlet(np.full(40, 0.3), 4)
    pairs = (w[:, :, None] * w[:, None] * np.abs(x[:, :, None] - x[:, None])).sum((1, 2))
    np.testing.assert_allclose(particle_crps(x, w), (w * np.abs(x)).sum(1) - 0.5 * pairs, rtol=1e-12)
    assert particle_crps(np.full(5, -0.3), np.full(5, 0.2)) == pytest.approx(0.3)  # distance of a point
    # With quantiles of N(0.5, 2^2) as particles it converges to the CRPS of the Gaussian.
    exact = gaussian_crps(np.array(0.5), np.array(2.0))
    errors_of = []
    for count in (10, 100, 1000):
        quantiles = 0.5 + 2.0 * norm.ppf((np.arange(count) + 0.5) / count)
        errors_of.append(abs(particle_crps(quantiles, np.full(count, 1.0 / count)) - exact))
    assert errors_of[0] > 4.0 * errors_of[1] > 16.0 * errors_of[2]
    # The same Gaussian by importance sampling; standard error of order 1 / sqrt(200000).
    draws = rng.normal(0.0, 3.0, 200_000)
    weights = norm.pdf(draws, 0.5, 2.0) / norm.pdf(draws, 0.0, 3.0)
    assert particle_crps(draws, weights / weights.sum()) == pytest.approx(exact, rel=0.02)


def test_levels_are_uniform_for_an_exact_distribution() -> None:
    from scipy.stats import kstest

    rng = np.random.default_rng(2)
    covariance = np.diag(np.square(plant.SCALE))
    error = rng.multivariate_normal(np.zeros(3), covariance, 300)
    squared = np.square(error / plant.SCALE).sum(1)
    exact = gaussian_level(squared, 3)
    assert kstest(exact, "uniform").pvalue > 0.01
    particles = rng.multivariate_normal(np.zeros(3), covariance, (300, 1000))
    level = particle_level(particles, np.full((300, 1000), 1e-3), error, covariance)
    np.testing.assert_allclose(level, exact, atol=0.07)  # four of sqrt(0.25 / 1000)


def test_ljung_box_is_that_of_statsmodels() -> None:
    from statsmodels.stats.diagnostic import acorr_ljungbox

    rng = np.random.default_rng(4)
    series = np.stack([rng.normal(size=80), np.cumsum(rng.normal(size=80))], axis=1)
    statistic, correlation = ljung_box(series)
    theirs = [float(acorr_ljungbox(column, lags=[10]).lb_stat.iloc[0]) for column in series.T]
    np.testing.assert_allclose(statistic, theirs, rtol=1e-9)
    assert abs(correlation[0]) < 0.3 < 0.8 < correlation[1]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("constant", [0.0, 0.1, 1e9])
def test_a_constant_series_has_no_autocorrelation(constant: float) -> None:
    white = np.random.default_rng(5).normal(size=80)
    statistic, correlation = ljung_box(np.stack([np.full(80, constant), white], axis=1))
    assert np.isnan([statistic[0], correlation[0]]).all()
    alone = [part[0] for part in ljung_box(white[:, None])]
    assert [statistic[1], correlation[1]] == pytest.approx(alone)


def test_phases_of_few_steps_get_no_verdict(exact: Consistency) -> None:
    entry = replace(exact.entry("fused"), steps=9, nees=50.0, interval=(40.0, 60.0), adjusted=(40.0, 60.0))
    assert entry.assessment == "too few steps (9; at least 10 needed)"
    assert not entry.inconsistent
    assert replace(entry, steps=10).inconsistent


def test_a_pretrained_filter_is_compared_with_its_healthy_record() -> None:
    run = plant.real("crossmodal-ekf")
    result = DIAGNOSTICS["consistency"]([run])
    assert isinstance(result, Consistency)
    assert result.healthy is not None
    assert {d.statistic for d in result.healthy.deviations} >= {"nees/fused/all", "nis/image/all"}
    # A single trace may raise an alarm; bench/false_alarms.py measures how often five episodes do.
    assert f"the healthy record of {result.healthy.healthy_trajectories} episodes" in result.verdict
    assert not any(alarm.startswith("NEES/n") for alarm in result.alarms)
    # An overconfident copy: the same errors, standard deviations a fifth.
    planted = replace(
        run,
        estimate_covariance=run.estimate_covariance / 25.0,
        modality_covariance=run.modality_covariance / 25.0,
        predicted_covariance=None if run.predicted_covariance is None else run.predicted_covariance / 25.0,
    )
    alarms = DIAGNOSTICS["consistency"]([planted]).alarms
    assert alarms
    assert any(alarm.startswith("NEES/n") for alarm in alarms)


def test_few_correlated_trajectories_of_a_healthy_filter_are_white_enough() -> None:
    """Weak autocorrelation is significant for white noise over many steps, but needs enough trajectories here."""
    result = consistency(plant.simulated(3, memory=0.3))
    assert "Innovations" not in result.verdict
    assert min(test.p_value for test in result.whiteness) < 0.05


def test_large_numbers_are_in_scientific_notation() -> None:
    """NEES of an imported estimate whose covariance is zero."""
    assert [number(value) for value in (0.00667, 3.14, 123.4, 3.33e25)] == ["0.0067", "3.1", "123", "3.3e+25"]


def test_innovations_and_gates_refers_to_the_innovations_of_virtual_sensors() -> None:
    refusal = DIAGNOSTICS["innovations"].refusal(plant.real("crossmodal-ekf"), None)
    assert refusal == (
        "the virtual sensors of filter crossmodal-ekf measure the state; their innovations, NIS/n, are in the "
        "diagnostic Consistency"
    )
    refusal = DIAGNOSTICS["innovations"].refusal(plant.real("crossmodal-pf"), None)
    assert refusal == "filter crossmodal-pf reports no innovations of its measurements"
