"""Laws of the robust estimates."""

from __future__ import annotations

import numpy as np
import pytest

from beliefscope.inspect.statistics.signals import (
    MAX_LAG,
    deviating_interval,
    drifting_lag,
    fitted_lag,
    lag,
    long_runs,
    noise_level,
    repeats,
    robust_fit,
    robust_line,
)


def smooth(steps: int, columns: int, seed: int = 0) -> np.ndarray:
    values = np.random.default_rng(seed).normal(size=(steps + 8, columns))
    return np.stack([np.convolve(column, np.ones(9) / 3.0, mode="valid") for column in values.T], axis=1)


def test_line_is_equivariant_and_ignores_outliers() -> None:
    rng = np.random.default_rng(1)
    values, at = rng.normal(size=(60, 2)), rng.random(60) < 0.7
    level, slope = robust_line(values, at)
    moved = values + 3.0 + 0.25 * np.arange(60)[:, None]
    np.testing.assert_allclose(robust_line(moved, at)[0] - level, 3.0, atol=1e-9)
    np.testing.assert_allclose(robust_line(moved, at)[1] - slope, 0.25, atol=1e-9)
    outliers = np.where((np.arange(60) % 6 == 0)[:, None], 1e6, values)
    assert np.abs(robust_line(outliers, at)[0] - level).max() < 1.0
    assert np.isnan(robust_line(values, np.arange(60) < 5)[0]).all()


def test_noise_level_is_that_of_the_noise_whatever_the_signal() -> None:
    noise = np.random.default_rng(2).normal(0.0, 0.3, 4000)
    for signal in (np.zeros(4000), np.sin(np.arange(4000) / 50.0), 0.01 * np.arange(4000)):
        assert noise_level(noise + signal) == pytest.approx(0.3, rel=0.06)


@pytest.mark.parametrize("delay", [-MAX_LAG, -3, 0, 1, 7, MAX_LAG])
def test_lag_is_the_planted_delay(delay: int) -> None:
    signal = smooth(140, 2)
    late, early = signal[20 - delay : 120 - delay], signal[20:120]
    rng = np.random.default_rng(3)
    steps, correlation = lag(-5.0 + 4.0 * late + rng.normal(0.0, 0.3, late.shape), early)
    assert steps == delay
    assert correlation > 0.9
    assert lag(early, late)[0] == -delay
    some = np.where(rng.random((100, 1)) < 0.3, np.nan, late)
    assert lag(some, early)[0] == delay


def test_unrelated_and_constant_signals_have_no_lag() -> None:
    rng = np.random.default_rng(4)
    lags = [lag(rng.normal(size=(100, 1)), rng.normal(size=(100, 1)))[0] for _ in range(50)]
    assert np.isnan(lags).sum() >= 45
    assert np.isnan(lag(np.ones((100, 1)), rng.normal(size=(100, 1)))[0])


def test_a_lag_that_hardly_correlates_more_is_unknown() -> None:
    """A slow signal with independent noise correlates with a copy at any lag: its largest value is chance.

    Without the comparison with lag zero, 45 % of such pairs have a lag of more than one step.
    """
    rng = np.random.default_rng(5)
    slow = np.sin(np.linspace(0.0, 3.0, 100))[:, None]
    pairs = [[slow + rng.normal(0.0, 0.5, slow.shape) for _ in range(2)] for _ in range(200)]
    lags = [steps for late, early in pairs if not np.isnan(steps := lag(late, early)[0])]
    assert sum(abs(steps) > 1 for steps in lags) <= 0.2 * len(pairs)


def test_interval_and_runs() -> None:
    series = np.random.default_rng(5).normal(0.0, 0.2, 100)
    series[37:61] += 1.0
    assert deviating_interval(series) == (37, 60)
    assert deviating_interval(np.repeat(series, 1000)) == (37_000, 60_999)
    mask = np.array([1, 0, 1, 1, 0, 1, 1, 1, 0, 1, 1, 1, 1], dtype=bool)
    np.testing.assert_array_equal(np.flatnonzero(long_runs(mask)), [5, 6, 7, 9, 10, 11, 12])
    assert not long_runs(np.zeros(5, dtype=bool)).any()


def test_repeats_at_the_start_are_a_delay() -> None:
    values = np.arange(40.0)[:, None] * np.ones(2)
    delayed = values[np.maximum(np.arange(40) - 5, 0)]
    assert not repeats(delayed).any()
    assert repeats(np.where(np.arange(40)[:, None] < 20, values, values[20])).sum() == 19
    assert repeats(np.zeros((40, 1))).sum() == 39


def test_robust_fit_recovers_coefficients_beside_outliers() -> None:
    """Of any unit: the columns differ by six orders of magnitude."""
    rng = np.random.default_rng(3)
    columns = rng.normal(size=(2, 200, 3)) * np.array([1.0, 1e3, 1e-3])
    coefficients = np.array([[2.0, -1e-3, 5e2], [-1.0, 4e-3, 0.0]])
    exact = (columns @ coefficients[..., None])[..., 0]
    np.testing.assert_allclose(robust_fit(columns, exact), coefficients, rtol=1e-9, atol=1e-9)
    values = exact + rng.normal(scale=0.01, size=exact.shape)
    values[:, ::10] += 50.0
    np.testing.assert_allclose(robust_fit(columns, values), coefficients, rtol=0.02, atol=2.0)


@pytest.mark.parametrize("delay", [-7, 0, 1, 5, MAX_LAG])
@pytest.mark.parametrize("gain", [0.2, 30.0])
def test_a_fitted_lag_is_that_of_a_smooth_signal_with_noise_whatever_its_gain(delay: int, gain: float) -> None:
    """Of columns that another signal does not predict, the lag does not depend."""
    steps = np.arange(MAX_LAG, 200 - MAX_LAG)
    signal, other = smooth(200, 2), np.random.default_rng(5).normal(size=(len(steps), 1))
    late = gain * signal[steps - delay] + 7.0 + 0.02 * gain * np.random.default_rng(3).normal(size=(len(steps), 2))
    known = np.ones(len(steps), dtype=bool)
    pair = np.hstack([late, other]), np.hstack([signal[steps], smooth(len(steps), 1, seed=9)])
    assert fitted_lag(*pair, known, known) == delay
    assert fitted_lag(*pair, np.arange(len(steps)) % 4 == 0, known) == delay, "readings at every fourth step"


@pytest.mark.parametrize("rate", [-0.1, 0.08, 0.2])
def test_the_lag_of_a_clock_that_drifts_is_half_of_the_last_one(rate: float) -> None:
    steps, known = np.arange(200), np.ones(200, dtype=bool)
    rng, signal = np.random.default_rng(3), smooth(200, 2, seed=6)
    late = np.stack([np.interp(steps * (1.0 - rate), steps, column) for column in signal.T], -1)
    late = 3.0 * late + rng.normal(0.0, 0.2, late.shape)
    assert drifting_lag(late, signal, known & (steps % 2 == 0), known) == pytest.approx(100.0 * rate, abs=1.0)


def test_other_changes_of_a_signal_are_no_drift_of_its_clock() -> None:
    steps, known = np.arange(200), np.ones(200, dtype=bool)
    signal = smooth(200, 2, seed=6)
    size = float(signal.std())
    noise = np.random.default_rng(3).normal(0.0, size, signal.shape)
    bias = 3.0 * size * ((steps > 60) & (steps < 120))[:, None]
    drift = np.linspace(0.0, 5.0 * size, 200)[:, None]
    for late in (signal, 2.0 * signal, signal + noise, signal + bias, signal + drift, 0.0 * signal, -signal):
        assert np.isnan(drifting_lag(late, signal, known, known))


def test_a_fitted_lag_needs_a_signal_of_the_same_sign_and_enough_steps() -> None:
    signal, known = smooth(100, 1), np.ones(100, dtype=bool)
    assert np.isnan(fitted_lag(smooth(100, 1, seed=4), signal, known, known))
    assert np.isnan(fitted_lag(signal, signal, np.arange(100) < 5, known))
    assert fitted_lag(signal, signal, known, known, largest=0) == 0.0
