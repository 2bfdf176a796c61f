"""Jacobians of an external Kalman filter's updates, against the healthy record's models of the readings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.inspect.diagnosis.innovation_checks import MIN_STEPS, accepted_channels
from beliefscope.inspect.diagnosis.measurement_checks import sensors_in
from beliefscope.inspect.statistics.innovations import prediction
from beliefscope.inspect.statistics.measures import Array, Mask, counted
from beliefscope.inspect.statistics.reading_model import ReadingModel
from beliefscope.inspect.trace import Trace

OFFSET = 1e-3
"""Difference of states for derivatives, relative to the largest state: the states have single precision."""

SMALLEST = 1e-3
"""Smallest variation of ``H P H^T`` over the steps, relative to S, that can be compared."""


def jacobian_statistics(trace: Trace, models: Sequence[ReadingModel]) -> dict[str, float]:
    """``KIND/MODALITY/all`` -> value, from the record's derivative H of the readings at the predicted states.

    ``measurement jacobian``: root mean square of ``S - H P H^T`` around its mean, relative to that of ``H P H^T``. In a
    filter with the same derivative, the difference is the measurement noise R. Shows neither signs of whole rows nor
    updates with the wrong sign.
    ``correction slope``: slope of the filter's corrections on ``P+ H^T R^-1 nu``, which they are in an extended Kalman
    filter with joint updates, and nearly are with one update after another.

    Readings that depend on changes of the state have a derivative by the state only, in healthy episodes as well.
    """
    innovation, s_all = trace.innovation, trace.innovation_covariance
    means, covariances = trace.predicted_mean, trace.predicted_covariance
    if innovation is None or s_all is None or means is None or covariances is None or trace.task.rotations:
        return {}
    channels = accepted_channels(trace, np.isfinite(innovation))
    after = trace.estimate_covariance.astype(np.float64)
    values: dict[str, float] = {}
    corrections: dict[int, Array] = {}
    for k, modality in enumerate(trace.modalities):
        sensors = sensors_in(trace, k, models)
        columns = [column for sensor in sensors for column in sensor.columns]
        if not columns:
            continue
        noise = np.concatenate([sensor.model.noise for sensor in sensors])
        s = s_all[:, k][:, columns][:, :, columns] / (noise[:, None] * noise)
        h = _derivative(trace, means[:, k].astype(np.float64), [sensor.model for sensor in sensors])
        size = h @ covariances[:, k].astype(np.float64) @ h.mT
        keep = counted(trace) & np.isfinite(s - size).all((-2, -1))
        if keep.sum() < MIN_STEPS:
            continue
        rest, variation = (s - size)[keep], size[keep] - size[keep].mean(0)
        r, scale = rest.mean(0), np.sqrt(np.square(variation).mean())
        if scale > SMALLEST * np.sqrt(np.square(s[keep]).mean()):
            values[f"measurement jacobian/{modality}/all"] = float(np.sqrt(np.square(rest - r).mean()) / scale)
        if len(columns) == channels[:, k].any(0).sum():
            nu = innovation[:, k, columns].astype(np.float64) / noise
            corrections[k] = np.einsum("tij,taj,ab,tb->ti", after, h, np.linalg.pinv(r), nu)
    slopes = _slopes(trace, np.any(channels, axis=-1), corrections) if corrections else {}
    return values | {f"correction slope/{trace.modalities[k]}/all": slope for k, slope in slopes.items()}


def _derivative(trace: Trace, states: Array, models: Sequence[ReadingModel]) -> Array:
    """(T, A, n) derivatives of all expected readings, relative to their noise, by the states (T, n)."""
    turning = [i for i, component in enumerate(trace.task.components) if component.wraps]
    states[:, turning] = np.unwrap(states[:, turning], axis=0)  # no offset turns the series around
    derivatives = []
    for offset in OFFSET * np.abs(states).max(0, initial=1e-6) * np.eye(states.shape[1]):
        ends = [Episode(trace.task, (states + sign * offset).astype(np.float32)) for sign in (1.0, -1.0)]
        difference = (ends[0].states.astype(np.float64) - ends[1].states).sum(1, keepdims=True)
        columns = [model.relative(model.expected(ends[0]) - model.expected(ends[1])) for model in models]
        derivatives.append(np.concatenate(columns, axis=1) / difference)
    return np.stack(derivatives, axis=-1)


def _slopes(trace: Trace, used: Mask, corrections: dict[int, Array]) -> dict[int, float]:
    """Modality k -> slope on its corrections (T, n), in standard deviations of the prediction.

    Of the steps that use no modality without corrections. used: (T, K) whether there is an update.
    """
    belief = prediction(trace)
    if belief is None or (covariance := belief[1]) is None:
        return {}
    columns = np.stack([np.where(used[:, [k]], x, 0.0) for k, x in corrections.items()], axis=-1)  # (T, n, C)
    made = trace.task.difference(trace.estimate_mean.astype(np.float64), belief[0])
    others = np.delete(used, list(corrections), axis=1)
    finite = np.isfinite(columns).all((1, 2)) & np.isfinite(covariance).all((1, 2))
    keep = np.flatnonzero(counted(trace) & used.any(1) & ~others.any(1) & finite)
    keep = keep[(np.linalg.eigvalsh(covariance[keep]) > 0.0).all(-1)]
    if len(keep) < MIN_STEPS:
        return {}
    factor = np.linalg.cholesky(covariance[keep])
    x, y = np.linalg.solve(factor, columns[keep]), np.linalg.solve(factor, made[keep, :, None])
    slopes, _, rank, _ = np.linalg.lstsq(x.reshape(-1, x.shape[-1]), y.ravel(), rcond=1e-6)
    return dict(zip(corrections, slopes.tolist(), strict=True)) if rank == len(corrections) else {}
