"""Innovations of Kalman filters, in the space of the measurement or the state, and their whiteness test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from beliefscope.datasets.task import Component, Task
from beliefscope.inspect.statistics.calibration import LAGS, ljung_box
from beliefscope.inspect.statistics.intervals import correlation_interval
from beliefscope.inspect.statistics.measures import Array, absent_modalities, counted, deviations
from beliefscope.inspect.traces.data import Trace

AnyArray = NDArray[np.floating[Any]]

SAME_SIZE = 0.2
"""Largest difference of the log-determinants of covariances of about the same belief."""

TAIL = 0.001
"""Probability of a larger innovation in a consistent filter below which an innovation is extreme."""


@dataclass(frozen=True)
class Whiteness:
    """Whiteness test of the innovations of one modality in one component.

    Attributes:
        autocorrelation: at lag 1, mean over trajectories, plus 1 / T: that of T white values has the mean -1 / T.
        low, high: its 95 % interval over trajectories, simultaneous over modalities and components and computed on
            Fisher's scale; NaN for too few trajectories.
        statistic: Ljung-Box statistic, summed over trajectories.
        degrees: its degrees of freedom.
        p_value: probability of a larger statistic for white innovations; too small for small departures from it over
            many steps, so no verdict uses it.
    """

    modality: str
    component: str
    autocorrelation: float
    low: float
    high: float
    statistic: float
    degrees: int
    p_value: float

    @property
    def white(self) -> bool:
        """Whether the interval contains zero, or is unknown."""
        return not (self.low > 0.0 or self.high < 0.0)


def innovations(trace: Trace) -> tuple[Array, Array] | None:
    """Innovations and their predicted covariance S; None unless a Kalman filter.

    (T, K, m) and (T, K, m, m) in the spaces of the measurements if the filter reports them, NaN where there is none;
    else (T, K, n) and (T, K, n, n) of the virtual observations.
    """
    return reported_innovations(trace) or virtual_innovations(trace)


def reported_innovations(trace: Trace) -> tuple[Array, Array] | None:
    """Innovations (T, K, m) and S (T, K, m, m) in the spaces of the measurements; None if they are not reported."""
    if trace.innovation is None or trace.innovation_covariance is None:
        return None
    return trace.innovation.astype(np.float64), trace.innovation_covariance.astype(np.float64)


def virtual_innovations(trace: Trace) -> tuple[Array, Array] | None:
    """``z - H x`` (T, K, n), angles wrapped, and ``P + R`` (T, K, n, n), H = I; None without virtual observations.

    ``z - H x`` is NaN at steps without a reading.
    """
    parts = (
        trace.observation_mean,
        trace.predicted_mean,
        trace.observation_covariance,
        trace.predicted_covariance,
    )
    if any(part is None for part in parts):
        return None
    z, predicted, r, p = (np.asarray(part, dtype=np.float64) for part in parts)
    innovation = trace.task.difference(z, predicted)
    return np.where(absent_modalities(trace)[..., None], np.nan, innovation), p + r


@dataclass(frozen=True)
class Moments:
    """mean (T, n), covariance (T, n, n), None if unknown."""

    mean: Array
    covariance: Array | None


def prediction(trace: Trace) -> Moments | None:
    """Moments of the belief before all updates of each step; None if it is not reported, or its particles are not kept.

    Of a filter that reports the belief before each of several updates, it is the least certain one, and of a particle
    filter that of the particles with their weights before the observation.
    """
    particles = trace.particles if trace.all_particles_ess is None else None
    return prediction_of(
        trace.task, trace.predicted_mean, trace.predicted_covariance, particles, trace.prior_log_weights
    )


def update_sizes(trace: Trace) -> Array | None:
    """(T, K, n): how far each single-modality update moves the prediction, in predicted standard deviations.

    None if the prediction is not reported, or its particles are not kept.
    """
    mean: AnyArray | None = trace.predicted_mean
    covariance: AnyArray | None = trace.predicted_covariance
    if mean is None and (moments := prediction(trace)) is not None and moments.covariance is not None:
        mean, covariance = moments.mean[:, None], moments.covariance[:, None]
    if mean is None or covariance is None:
        return None
    difference = trace.task.difference(trace.modality_mean.astype(np.float64), mean.astype(np.float64))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.abs(difference) / deviations(covariance))


def prediction_of(
    task: Task,
    mean: AnyArray | None = None,
    covariance: AnyArray | None = None,
    particles: AnyArray | None = None,
    log_weights: AnyArray | None = None,
) -> Moments | None:
    """As ``prediction``, from mean (T, K, n) and covariance (T, K, n, n) before each of K updates, or from particles
    (T, M, n) with their prior log-weights (T, M).
    """
    if mean is None:
        return None if particles is None or log_weights is None else _particle_moments(task, particles, log_weights)
    means, covariances = mean.astype(np.float64), None if covariance is None else covariance.astype(np.float64)
    if np.allclose(means, means[:, :1], rtol=1e-3):
        return Moments(means[:, 0], None if covariances is None else covariances[:, 0])
    if covariances is None or not np.isfinite(covariances).all():
        return None
    steps, first = np.arange(len(means)), least_certain(covariances)
    return Moments(means[steps, first], covariances[steps, first])


def least_certain(covariance: Array) -> NDArray[np.intp]:
    """(T,) index of the belief before all updates, from covariances (T, K, n, n) before each of them.

    The same at all steps but for those where another one is clearly less certain: updates by weak measurements change
    the sample covariance of an ensemble by less than chance does.
    """
    sizes = np.linalg.slogdet(covariance)[1]
    with np.errstate(invalid="ignore"):  # of particles that are all equal
        smaller = np.nan_to_num(sizes.max(-1, keepdims=True) - sizes)
    usual = int(np.median(smaller, axis=0).argmin())
    return np.where(smaller[:, usual] < SAME_SIZE, usual, sizes.argmax(-1))


def _particle_moments(task: Task, particles: AnyArray, log_weights: AnyArray) -> Moments:
    start, weights = particles[:, 0].astype(np.float64), np.exp(log_weights.astype(np.float64))
    from_start = task.difference(particles.astype(np.float64), start[:, None])  # angles may wrap around
    mean = np.einsum("tm,tmn->tn", weights, from_start)
    around = from_start - mean[:, None]
    return Moments(start + mean, np.einsum("tm,tmi,tmj->tij", weights, around, around))


def squared_innovations(trace: Trace) -> tuple[Array, NDArray[np.int64]] | None:
    """``nu^T S^-1 nu`` (T, K) and the number of its channels (T, K); None unless a Kalman filter.

    NaN without a measurement, or if S is not positive definite, as that of a filter that diverges.
    """
    if (pair := innovations(trace)) is None:
        return None
    nu, s = pair
    used = np.isfinite(nu)
    both = used[..., :, None] & used[..., None, :]
    s = np.where(both, s, np.eye(nu.shape[-1]))  # unused channels add nothing
    nu = np.where(used, nu, 0.0)
    valid = np.asarray(np.isfinite(s).all((-2, -1)))
    s = np.where(valid[..., None, None], s, np.eye(nu.shape[-1]))
    valid &= (np.linalg.slogdet(s).sign > 0.0) & (np.linalg.eigvalsh(s)[..., 0] > 0.0)
    s = np.where(valid[..., None, None], s, np.eye(nu.shape[-1]))
    squared = np.einsum("tkm,tkm->tk", nu, np.linalg.solve(s, nu[..., None])[..., 0])
    channels = used.sum(-1)
    return np.where((channels > 0) & valid, squared, np.nan), channels


def are_extreme(squared: Array, channels: NDArray[np.int64], tail: float = TAIL) -> NDArray[np.bool_]:
    """Whether squared innovations with numbers of channels are larger than all but a share of a consistent filter's."""
    return np.asarray(chdtrc(np.maximum(channels, 1), squared) < tail)


def nis_of(trace: Trace) -> Array | None:
    """(T, K): ``nu^T S^-1 nu / m`` of the innovations; mean 1 if consistent, NaN without a measurement.

    None unless a Kalman filter.
    """
    if (pair := squared_innovations(trace)) is None:
        return None
    return pair[0] / np.maximum(pair[1], 1)


def autocorrelations(trace: Trace) -> dict[tuple[str, str], float]:
    """(modality, component) -> autocorrelation at lag 1 over the counted steps; empty for too few steps."""
    return {name: r for name, (_, r, _) in _ljung_box(trace).items()}


def whiteness_of(traces: Sequence[Trace]) -> list[Whiteness]:
    """Test innovations in predicted standard deviations; statistics of independent trajectories add up.

    Of the series that all trajectories with enough steps have.
    """
    results = [tests for trace in traces if (tests := _ljung_box(trace))]
    names = [name for name in results[0] if all(name in tests for tests in results)] if results else []
    if not names:
        return []
    values = np.array([[tests[name] for name in names] for tests in results])  # (E, S, 3)
    statistic = values[..., 0].sum(0)
    unbiased = np.stack([values[..., 1] + 1.0 / values[..., 2].min(1, keepdims=True), np.ones_like(values[..., 1])], -1)
    correlation, low, high = correlation_interval(unbiased, lambda s: s[..., 0] / s[..., 1], 1.0 - 0.05 / len(names))
    degrees = LAGS * len(results)
    return [
        Whiteness(*name, float(r), float(a), float(b), float(q), degrees, float(chdtrc(degrees, q)))
        for name, q, r, a, b in zip(names, statistic, correlation, low, high, strict=True)
    ]


def channels_of(trace: Trace, innovation: NDArray[Any]) -> list[list[Component]]:
    """(K, m) channels of reported innovations (T, K, m), with their units.

    They are those of the modality's sensors, such as ``gps x``, if these have as many, else numbers from 0 without a
    unit.
    """
    result = []
    for k, modality in enumerate(trace.modalities):
        used = np.flatnonzero(np.isfinite(innovation[:, k]).any(0)).max(initial=-1) + 1
        shapes = [(key, trace.task.observations[key]) for key in trace.task.modalities.get(modality, ())]
        channels = [trace.task.channel(key, i) for key, shape in shapes if len(shape) == 1 for i in range(shape[0])]
        channels = channels if len(channels) == used else []
        numbers = range(len(channels), innovation.shape[-1])
        result.append([*channels, *(Component(f"channel {i}", "") for i in numbers)])
    return result


def channel_names(trace: Trace, innovation: NDArray[Any]) -> list[list[str]]:
    """(K, m) names of the channels of reported innovations (T, K, m), as in ``channels_of``."""
    return [[channel.name for channel in channels] for channels in channels_of(trace, innovation)]


def _names(trace: Trace, innovation: Array) -> list[tuple[str, str]]:
    """(modality, channel) of the K m series of innovations: components of the state, or channels of the measurement."""
    if trace.innovation is None:
        return [(modality, c.name) for modality in trace.modalities for c in trace.task.components]
    names = channel_names(trace, innovation)
    return [(modality, name) for modality, own in zip(trace.modalities, names, strict=True) for name in own]


def _ljung_box(trace: Trace) -> dict[tuple[str, str], tuple[float, float, int]]:
    """(modality, channel) -> Ljung-Box statistic, autocorrelation at lag 1 and number of steps; empty for too few.

    Steps without a measurement, or with an invalid variance, do not count.
    """
    pair, keep = innovations(trace), counted(trace)
    if pair is None:
        return {}
    nu, s = pair
    variance = np.diagonal(s, axis1=-2, axis2=-1)
    normalised = (nu / np.sqrt(np.where(variance > 0.0, variance, np.nan)))[keep].reshape(keep.sum(), -1)
    columns = dict(zip(_names(trace, nu), normalised.T, strict=True))
    series = {name: column[np.isfinite(column)] for name, column in columns.items() if np.isfinite(column).any()}
    if not series or min(map(len, series.values())) <= 2 * LAGS:
        return {}
    by_length = {len(column): [n for n in series if len(series[n]) == len(column)] for column in series.values()}
    result: dict[tuple[str, str], tuple[float, float, int]] = {}
    for steps, names in by_length.items():
        q, r = ljung_box(np.stack([series[name] for name in names], axis=1))
        result |= {name: (float(a), float(b), steps) for name, a, b in zip(names, q, r, strict=True)}
    return {name: result[name] for name in series}
