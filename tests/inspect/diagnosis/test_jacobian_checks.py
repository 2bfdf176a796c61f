"""Jacobians of external filters, by the covariances and corrections that they report."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.inspect.diagnosis.test_innovation_checks import FLIPPED, STD, Array, Boat, run
from tests.inspect.diagnosis.test_measurement_checks import models

from beliefscope.inspect.diagnosis.jacobian_checks import jacobian_statistics
from beliefscope.inspect.trace import Trace


def errors_and_slopes(trace: Trace) -> Array:
    """(2, 2): error of the Jacobian, and slope of the corrections, of radar and compass."""
    values = jacobian_statistics(trace, models())
    kinds = "measurement jacobian", "correction slope"
    return np.array([[values[f"{kind}/{key}/all"] for key in STD] for kind in kinds])


@pytest.mark.parametrize("filter_", [Boat(), Boat(separate=True), Boat(radar=5.0), Boat(offset=0.5), Boat(turn=-1.0)])
def test_the_derivative_of_the_filter_shows_whatever_its_noise_and_other_defects(filter_: Boat) -> None:
    for every in (1, 4):
        error, slope = errors_and_slopes(run(filter_, every))
        np.testing.assert_allclose(error, 0.0, atol=0.15)  # its compass updates after the radar, which the trace omits
        np.testing.assert_allclose(slope, 1.0, atol=0.1)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_the_error_of_a_scaled_jacobian_is_that_of_its_square(factor: float) -> None:
    """``S = f^2 H P H^T + R``."""
    error, _ = errors_and_slopes(run(Boat(jacobian=factor)))
    assert error[0] == pytest.approx(abs(factor**2 - 1.0), rel=0.05)


def test_corrections_with_the_wrong_sign_have_the_slope_minus_one() -> None:
    error, slope = errors_and_slopes(run(Boat(jacobian=-1.0)))
    assert error[0] == pytest.approx(0.0, abs=0.1)
    assert slope[0] == pytest.approx(-1.0, abs=0.1)


def test_a_wrong_sign_in_one_column_shows_in_the_covariance() -> None:
    error, _ = errors_and_slopes(run(Boat(jacobian=FLIPPED)))
    assert error[0] > 0.5 > 3.0 * error[1]


def test_without_models_or_covariances_there_are_no_statistics() -> None:
    trace = run(Boat())
    assert jacobian_statistics(trace, ()) == {}
    assert jacobian_statistics(replace(trace, predicted_covariance=None), models()) == {}
    assert jacobian_statistics(replace(trace, innovation=None, innovation_covariance=None), models()) == {}
