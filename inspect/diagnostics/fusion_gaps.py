"""Reasons why fusion is less accurate than the modalities allow, each with a measured quantity.

Sensor biases and calibration use the sensors' own output, virtual observation z and covariance R, against the true
state. Filters without virtual sensors (particle filters, sequence models) have neither.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from beliefscope.datasets.task import display_name
from beliefscope.datasets.text import percent
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnostics.views import Array, Value
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.intervals import correlation_interval, jackknife, mean_interval
from beliefscope.inspect.statistics.oracle import simplex_minimum, squared_error
from beliefscope.inspect.trace import Trace

CALIBRATION, DRIFT, PRIOR, WEIGHTS = "uncalibrated R", "drifted sensor", "shared prior counted twice", "wrong weights"

MIN_FACTOR = 1.5
"""Factor by which NEES/n of a sensor must differ from 1."""

MIN_BIAS = 0.3
"""Smallest bias of a drifted sensor, relative to the root mean square of its error."""

MIN_COUNT = 1.25
"""Smallest number of times that a prior is counted twice."""

MIN_EXCESS = 1.05
"""Smallest ratio of errors for wrong weights."""


@dataclass(frozen=True)
class Reason:
    """A possible reason for a gap. ``modality``: the measurement model, empty for properties of the fusion.

    Attributes:
        quantity: what ``value`` is. ideal: its value without a gap.
        low, high: 95 % interval over episodes; NaN for too few of them.
        contributes: whether the interval excludes ``ideal`` and the difference is relevant.
        headline: the finding as a clause.
    """

    name: str
    modality: str
    quantity: str
    ideal: float
    value: float
    low: float
    high: float
    contributes: bool
    headline: str

    def row(self) -> dict[str, Value]:
        """As a row of a table."""
        reason: dict[str, Value] = {"reason": self.name, "modality": self.modality, "quantity": self.quantity}
        values: dict[str, Value] = {"ideal": self.ideal, "value": self.value, "95 % from": self.low, "to": self.high}
        verdict = "unknown" if math.isnan(self.low) else "yes" if self.contributes else "no"
        return reason | values | {"significant": verdict}


def reasons_of(traces: Sequence[Trace], checkpoint: Checkpoint) -> tuple[Reason, ...]:
    """All reasons that can be measured for this filter; of an external filter only the weights."""
    if isinstance(checkpoint, ExternalFilter):
        weighted = traces[0].effective_weights is not None and traces[0].modalities_with_posterior
        return (_weights(traces, of_sensors=False),) if weighted else ()
    architecture = checkpoint.filter.architecture
    one_prior = architecture.fusion in ("crossmodal", "unimodal") and architecture.feedback
    reasons = []
    if traces[0].observation_covariance is not None:
        std = checkpoint.filter.statistics.mean_std("state")[1]
        reasons += _sensor_reasons(traces, np.square(std.double().numpy()))
    if traces[0].predicted_covariance is not None and len(traces[0].modalities) > 1 and one_prior:
        reasons.append(_prior(traces))
    if traces[0].effective_weights is not None and traces[0].modalities_with_posterior:
        reasons.append(_weights(traces, of_sensors=architecture.fusion == "information"))
    return tuple(reasons)


def _sensor_errors(trace: Trace) -> tuple[Array, Array, measures.Mask]:
    """Errors (T, K, n) of the virtual sensors, inverses of R (T, K, n, n), and (T, K) steps with a reading; counted."""
    assert trace.observation_mean is not None
    assert trace.observation_covariance is not None
    error = trace.task.difference(trace.observation_mean, trace.episode.states[:, None])
    keep = measures.counted(trace)
    precision = np.linalg.inv(trace.observation_covariance[keep].astype(np.float64))
    return error[keep], precision, ~measures.absent_modalities(trace)[keep]


def _sensor_reasons(traces: Sequence[Trace], spread: Array) -> list[Reason]:
    """Bias and calibration of each virtual sensor.

    The calibration is that of the errors about the bias, at steps with an informative reading: R below ``spread`` in
    every component, or at all steps if there are none. A blacked-out image has a large R, but its error is no larger
    than the spread of the states.

    Args:
        spread: (n,) variance of the states in the training data.
    """
    task = traces[0].task
    units, scale = measures.display_units(task)
    sensors = [_sensor_errors(trace) for trace in traces]
    weighted = []
    for error, precision, has_reading in sensors:
        weight = np.einsum("tknn->tkn", precision) * has_reading[..., None]
        weighted.append(np.stack([weight, weight * error, weight * error**2], axis=-1).sum(0))
    sums = np.stack(weighted)  # (R, K, n, 3)
    total = sums.sum(0)
    bias = total[..., 1] / total[..., 0]  # (K, n)
    value, low, high = correlation_interval(sums, lambda s: s[..., 1] / np.sqrt(s[..., 0] * s[..., 2]))
    informative = [(np.einsum("tknn->tkn", np.linalg.inv(p)) < spread).all(-1) for _, p, _ in sensors]
    never = ~np.concatenate(informative).any(0)
    used = [(mask | never) & has_reading for mask, (_, _, has_reading) in zip(informative, sensors, strict=True)]
    squares = [np.einsum("tki,tkij,tkj->tk", e - bias, p, e - bias, optimize=True) / e.shape[-1] for e, p, _ in sensors]
    nees = np.stack([(value * mask).sum(0) for value, mask in zip(squares, used, strict=True)])
    counts = np.stack([mask.sum(0) for mask in used])
    reasons = []
    for k, name in enumerate(traces[0].modalities):
        i, has = int(np.abs(value[k]).argmax()), counts[:, k] > 0
        factor, factor_low, factor_high = map(float, mean_interval(nees[has, k], counts[has, k]))
        size = f"{scale[i] * bias[k, i]:+z.2f} {units[i]}"
        relevant = abs(value[k, i]) > MIN_BIAS and (low[k, i] > 0.0 or high[k, i] < 0.0)
        reasons.append(
            Reason(
                name=CALIBRATION,
                modality=name,
                quantity="NEES/n of the sensor about its bias",
                ideal=1.0,
                value=factor,
                low=factor_low,
                high=factor_high,
                contributes=(factor_low > 1.0 and factor > MIN_FACTOR)
                or (factor_high < 1.0 and factor < 1.0 / MIN_FACTOR),
                headline=f"uncalibrated R: standard deviations of the {display_name(name)} sensor are "
                f"{'too small' if factor > 1.0 else 'too large'} (NEES/n {factor:.2f})",
            )
        )
        reasons.append(
            Reason(
                name=DRIFT,
                modality=name,
                quantity=f"bias of {task.components[i].label} over its RMSE",
                ideal=0.0,
                value=float(value[k, i]),
                low=float(low[k, i]),
                high=float(high[k, i]),
                contributes=bool(relevant),
                headline=f"drifted sensor: {task.components[i].label} of the {display_name(name)} sensor has a bias of "
                f"{size}",
            )
        )
    return sorted(reasons, key=lambda reason: reason.name != CALIBRATION)


def _prior(traces: Sequence[Trace]) -> Reason:
    """How many times the fused mean counts the prior: ``odds(W) / odds(W_1)``, ``odds(W) = tr(W) / (n - tr(W))``.

    Posteriors ``m_k, S_k`` of one prior ``m', P'`` are fused with weights A_k, so ``m = sum_k A_k m_k`` has the part
    ``W m'``, ``W = sum_k A_k S_k P'^-1``. Used once, it is ``W_1 = (sum_k S_k^-1 - (K - 1) P'^-1)^-1 P'^-1``. Equal
    scalar sensors give K, both by the mean and by the product of the posteriors.
    """
    sums = np.array([_prior_weights(trace) for trace in traces])  # (R, 2, 2)
    logarithms = jackknife(sums, lambda s: np.log(s[..., 0, 0] * s[..., 1, 1] / (s[..., 0, 1] * s[..., 1, 0])))
    nees = measures.known_mean(np.concatenate([measures.nees(trace)[measures.counted(trace), -1] for trace in traces]))
    return _of_fusion(
        PRIOR,
        "number of times that the fused mean counts the prior",
        logarithms,
        MIN_COUNT,
        lambda value: (
            "shared prior counted twice: every fused posterior contains it, and their mean counts it "
            f"{value:.1f} times (NEES/n of the fused belief {nees:.2f})"
        ),
    )


def _of_fusion(
    name: str, quantity: str, logarithms: tuple[Array, Array, Array], smallest: float, headline: Callable[[float], str]
) -> Reason:
    """A property of the fusion that is 1 without a gap, from the logarithms of its value and interval."""
    value, low, high = (float(np.exp(v)) for v in logarithms)
    return Reason(name, "", quantity, 1.0, value, low, high, low > 1.0 and value > smallest, headline(value))


def _prior_weights(trace: Trace) -> Array:
    """(2, 2): sums over steps of W and W_1 of ``_prior``, and of their complements: tr and ``n - tr``."""
    assert trace.predicted_covariance is not None
    keep = measures.counted(trace)
    posterior = trace.modality_covariance[keep].astype(np.float64)  # (T, K, n, n)
    prior = np.linalg.inv(trace.predicted_covariance[keep].astype(np.float64))
    if trace.weights is None:  # product of experts: A_k = S S_k^-1
        weighted = np.broadcast_to(trace.estimate_covariance[keep, None].astype(np.float64), posterior.shape)
    else:
        weighted = trace.weights[keep, :, :, None].astype(np.float64) * posterior
    once = np.linalg.inv(np.linalg.inv(posterior).sum(1) - prior[:, 1:].sum(1))
    parts = np.stack([(weighted @ prior).sum(1), once @ prior[:, 0]])
    total, n = np.einsum("atnn->a", parts), posterior.shape[-1]
    return np.stack([total, n * keep.sum() - total], axis=-1)


def _weights(traces: Sequence[Trace], of_sensors: bool) -> Reason:
    """Position error of the modalities' mean with the effective weights, over that with the best convex weights.

    The best weights are constant in contact and free motion, with and without image blackout. Weighted are the
    single-modality updates, or the virtual sensors of a filter that fuses these.
    """
    parts = [_weighted_sums(trace, of_sensors) for trace in traces]
    sums = np.stack([part for part, _ in parts])  # (R, G, d, K K + K + 1)
    means = np.mean([mean for _, mean in parts], axis=0)
    count = means.shape[-1]
    logarithms = jackknife(sums, lambda s: 0.5 * np.log(s[..., -1].sum((-2, -1)) / _least(s, count)[0]))
    share = _least(sums.sum(0), count)[1]
    k = int(np.abs(means - share).round(6).argmax())  # of two, the first
    name = traces[0].modalities[k]
    return _of_fusion(
        WEIGHTS,
        "error with the effective weights over that with the best constant weights",
        logarithms,
        MIN_EXCESS,
        lambda value: (
            f"wrong weights: mean weight of {display_name(name)} {means[k]:.2f}, best {share[k]:.2f}; the "
            f"best constant weights would reduce the error of the weighted mean by {percent(1.0 - 1.0 / value)}"
        ),
    )


def _weighted_sums(trace: Trace, of_sensors: bool) -> tuple[Array, Array]:
    """Sums by group and coordinate (G, d, K K + 2): second moments, steps, squared error; and mean weights (K,).

    A scalar weight serves both coordinates of the position, d = 1; else d = 2.
    """
    assert trace.effective_weights is not None
    task = trace.task
    where = list(task.main_error.indices)
    estimates = trace.observation_mean if of_sensors else trace.modality_mean
    assert estimates is not None
    error = task.difference(estimates, trace.episode.states[:, None])[..., where]  # (T, K, 2)
    weights = trace.effective_weights.astype(np.float64)
    scalar = weights.shape[-1] == 1
    weights = np.broadcast_to(weights, error.shape) if scalar else weights[..., where]
    groups = measures.group_masks(trace)
    moments = np.einsum("gt,tkd,tld->gdkl", groups, error, error, optimize=True)
    cost = groups @ np.square((weights * error).sum(1))
    steps = np.broadcast_to(groups.sum(1)[:, None], cost.shape)
    parts = np.concatenate([moments.reshape(*cost.shape, -1), steps[..., None], cost[..., None]], axis=-1)
    return parts.sum(1, keepdims=True) if scalar else parts, weights[measures.counted(trace)].mean((0, 2))


def _least(sums: Array, count: int) -> tuple[Array, Array]:
    """Squared error (...) with the best weights of K = ``count`` estimates, and mean best weights (..., K)."""
    gram = sums[..., : count * count].reshape(*sums.shape[:-1], count, count)
    best = simplex_minimum(gram, np.full(gram.shape[:-1], 1.0 / count))
    steps = sums[..., -2, None]
    return squared_error(best, gram).sum((-2, -1)), (best * steps).sum((-3, -2)) / steps.sum((-3, -2))
