"""Intervals over trajectories: coverage by simulation, closed forms and invariances."""

from __future__ import annotations

import math
import runpy
from pathlib import Path

import numpy as np
import pytest

from beliefscope.inspect.statistics.intervals import MIN_TRAJECTORIES, jackknife, mean_interval, nees_limit, too_few

COVERAGE = runpy.run_path(str(Path(__file__).parents[3] / "bench" / "coverage.py"))
REPEATS = 2000
LEAST = 0.92 - 2.0 * math.sqrt(0.92 * 0.08 / REPEATS)  # two standard errors of the simulation


@pytest.mark.parametrize("row", COVERAGE["ROWS"])
@pytest.mark.parametrize("trajectories", [5, 8, 14, 50])
def test_mean_covers_92_percent(row: str, trajectories: int) -> None:
    kind, parameter = COVERAGE["ROWS"][row]
    assert COVERAGE["mean_coverage"](kind, parameter, trajectories, REPEATS, seed=1) >= LEAST


@pytest.mark.parametrize("trajectories", [5, 14])
def test_change_and_correlation_cover_92_percent(trajectories: int) -> None:
    assert COVERAGE["change_coverage"](1.0, trajectories, REPEATS, seed=1) >= LEAST
    few = 500
    assert COVERAGE["correlation_coverage"](0.5, trajectories, few, seed=1) >= 0.92 - 2.0 * math.sqrt(0.07 / few)


def test_the_simulation_detects_the_percentile_bootstrap() -> None:
    assert 0.72 < COVERAGE["percentile_coverage"]("lognormal", 0.8, 5, 500) < 0.82


def test_jackknife_of_a_mean_is_students_interval() -> None:
    from scipy.stats import t  # takes 0.3 s to import

    values = np.random.default_rng(0).normal(size=9)
    value, low, high = jackknife(np.stack([values, np.ones(9)], -1), lambda sums: sums[..., 0] / sums[..., 1])
    half = t.ppf(0.975, 8) * values.std(ddof=1) / 3.0
    assert (value, low, high) == pytest.approx((values.mean(), values.mean() - half, values.mean() + half))


def test_mean_interval_scales_with_the_unit_and_ignores_the_order() -> None:
    rng = np.random.default_rng(1)
    sums, counts = rng.lognormal(size=8) * 50.0, rng.integers(30, 80, 8)
    interval = np.array(mean_interval(sums, counts))
    order = rng.permutation(8)
    np.testing.assert_allclose(mean_interval(7.0 * sums[order], counts[order]), 7.0 * interval)
    assert interval[0] == pytest.approx(sums.sum() / counts.sum())


def test_the_mean_of_a_diverging_quantity_is_above_its_median() -> None:
    """Six trajectories above 1, four of them by orders of magnitude: the log-normal limit alone would be below 1e-3."""
    value, low, high = mean_interval(np.array([3.0, 8.0, 1e3, 1e5, 1e8, 1e11]), np.ones(6))
    assert low == pytest.approx(3.0)
    assert low < value < high


@pytest.mark.parametrize("n", [1, 2, 5])
def test_dependent_steps_of_a_consistent_filter_exceed_the_limit_rarely(n: int) -> None:
    """Equal steps are the worst case up to a factor of about e; independent ones hardly exceed 1."""
    rng, limit = np.random.default_rng(n), nees_limit(n)
    equal = rng.chisquare(n, 100_000) / n
    assert 0.025 / 3.0 < (equal > limit).mean() < 0.025
    tail = np.quantile(equal, 0.975)
    assert limit == pytest.approx(equal[equal > tail].mean(), rel=0.02)
    assert not (rng.chisquare(n, (1000, 50)).mean(1) / n > limit).any()


def test_too_few_trajectories() -> None:
    value, low, high = mean_interval(np.ones(4), np.ones(4))
    assert value == 1.0
    assert math.isnan(low)
    assert math.isnan(high)
    assert too_few(MIN_TRAJECTORIES) is None
    assert too_few(4) == "too few episodes (4; at least 5 needed)"
