"""The update that follows from a Kalman filter's prediction, innovations and their covariance, against its own."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice, permutations

import numpy as np

from beliefscope.inspect.diagnostics.repeated_steps import RepeatedSteps, inverse_std, relative, weights_of
from beliefscope.inspect.statistics.measures import Array

MAX_ORDERS = 6
"""Maximum number of orders of updates that are tried."""

SMALLEST_UPDATE = 0.02
"""Smallest update to which an error is relative: in standard deviations, and relative to the variances."""


KEPT = 0.05
"""Largest slope of the reductions of a covariance that is not updated."""


@dataclass(frozen=True)
class Updates:
    """Of J steps with K modalities of m channels.

    Attributes:
        noise: (J, K, m, m) measurement noise R that follows from S and H; 0 without a measurement.
        corrections: (J, K, n) of the mean, by each modality.
        covariance_error: (J, K) relative error of the reduction of the covariance, NaN without the measurement.
        correction_error: (J, K) relative error of the correction of the mean, as before.
        covariance_slope: of the reductions of the covariance on the expected ones: 1 if they are right, 0 if the
            covariance is not updated; NaN without a measurement.
    """

    noise: Array
    corrections: Array
    covariance_error: Array
    correction_error: Array
    covariance_slope: float


def expected_updates(steps: RepeatedSteps) -> Updates:
    """Updates with the filter's own P and S, and the H of its innovations: all measurements at once, or in turn.

    At once, ``K = P H^T S^-1`` with the cross-covariances ``H P H^T`` of the measurements; in turn, each measurement
    starts at the belief after the one before, or at its mean with the predicted covariance, if the filter does not
    update it. The kind and order with the smallest errors count.
    """
    orders = list(islice(permutations(range(steps.size.shape[2])), MAX_ORDERS))

    def error(updates: Updates) -> float:
        return _size(updates.covariance_error) + _size(updates.correction_error)

    best = min([_together(steps), *(_in_turn(steps, order, False) for order in orders)], key=error)
    if not abs(best.covariance_slope) < KEPT:
        return best
    return min([best, *(_in_turn(steps, order, True) for order in orders)], key=error)


def correction_slopes(steps: RepeatedSteps, updates: Updates) -> Array:
    """(K,) slopes of the filter's corrections on the expected ones, -1 to 1; NaN without a measurement.

    They show the sign of the H of its gains, which the products ``H P H^T`` do not show. Of more modalities than
    values, such as of four redundant sensors in one step, the slopes next to that of all together count.
    """
    scale = inverse_std(steps.covariance[:, 0])
    parts = updates.corrections * scale[:, None]
    columns = parts.swapaxes(1, 2).reshape(steps.correction.size, -1)
    correction, total = (steps.correction * scale).ravel(), columns.sum(1)
    common = float(total @ correction / max(float(total @ total), 1e-24))
    slopes = common + np.linalg.lstsq(columns, correction - common * total, rcond=1e-9)[0]
    return np.where(np.abs(columns).max(0) > 0.0, np.clip(slopes, -1.0, 1.0), np.nan)


def component_slopes(steps: RepeatedSteps, updates: Updates) -> Array:
    """(n,) slopes of the filter's corrections of each component on the expected ones, -1 to 1; NaN for tiny ones."""
    scale = inverse_std(steps.covariance[:, 0])
    expected, correction = scale * updates.corrections.sum(1), scale * steps.correction
    size = np.square(expected).sum(0)
    is_known = size > len(expected) * SMALLEST_UPDATE**2
    slopes = (expected * correction).sum(0) / np.where(is_known, size, np.nan)
    return np.asarray(np.clip(slopes, -1.0, 1.0))


def _size(errors: Array) -> float:
    known = errors[np.isfinite(errors)]
    return float(known.mean()) if len(known) else 0.0


def _together(steps: RepeatedSteps) -> Updates:
    j, _, k, m, _ = steps.size.shape
    prior, h = steps.covariance[:, 0], steps.measurement_jacobian
    noise = steps.size[:, 0] - h @ prior[:, None] @ h.mT
    rows = h.reshape(j, k * m, h.shape[-1])
    size = rows @ prior @ rows.mT
    for i in range(k):
        block = slice(i * m, (i + 1) * m)
        size[:, block, block] = steps.size[:, 0, i]
    gain = prior @ rows.mT @ np.linalg.pinv(_invertible(size))
    nu = np.nan_to_num(steps.innovation[:, 0]).reshape(j, 1, k * m)
    corrections = (gain * nu).reshape(j, h.shape[-1], k, m).sum(-1).swapaxes(1, 2)
    return _compared(steps, noise, prior - gain @ rows @ prior, corrections)


def _in_turn(steps: RepeatedSteps, order: tuple[int, ...], keeps: bool) -> Updates:
    """keeps: whether the gain of each measurement is that with the predicted covariance."""
    prior, unit = steps.covariance[:, 0], np.eye(steps.covariance.shape[-1])
    covariance, noise = prior, np.zeros_like(steps.size[:, 0])
    corrections = np.zeros((*noise.shape[:2], len(unit)))
    change = np.broadcast_to(unit, prior.shape)  # of the mean by the prediction
    for k in order:
        size, nu = steps.size[:, 0, k], np.nan_to_num(steps.innovation[:, 0, k])
        h = steps.measurement_jacobian[:, k] @ np.linalg.pinv(change)
        before = prior if keeps else covariance
        noise[:, k] = size - h @ before @ h.mT
        gain = before @ h.mT @ np.linalg.pinv(_invertible(size))
        corrections[:, k] = (gain @ nu[..., None])[..., 0]
        covariance = covariance - gain @ h @ covariance
        change = (unit - gain @ h) @ change
    return _compared(steps, noise, covariance, corrections)


def _invertible(size: Array) -> Array:
    """Covariances of innovations with 1 on the diagonal of absent channels, which are 0."""
    absent = np.diagonal(size, axis1=-2, axis2=-1) <= 0.0
    return np.asarray(size + absent[..., None] * np.eye(size.shape[-1]))


def _compared(steps: RepeatedSteps, noise: Array, covariance: Array, corrections: Array) -> Updates:
    """The errors of the filter's posterior, relative to the expected covariance and correction."""
    correction = corrections.sum(1)
    prior, scale = steps.covariance[:, 0], inverse_std(steps.covariance[:, 0])
    weights = weights_of(prior)
    used = np.isfinite(steps.innovation[:, 0]).any(-1)  # (J, K)
    difference, reduction = weights * (steps.posterior - covariance), weights * (prior - covariance)
    actual, size = weights * (prior - steps.posterior), np.square(reduction).sum()
    moved, expected = scale * (steps.correction - correction), scale * correction
    return Updates(
        noise,
        corrections,
        np.where(used, relative(difference, reduction, (-2, -1), SMALLEST_UPDATE)[:, None], np.nan),
        np.where(used, relative(moved, expected, (-1,), SMALLEST_UPDATE)[:, None], np.nan),
        float((actual * reduction).sum() / size) if size > 0.0 else np.nan,
    )
