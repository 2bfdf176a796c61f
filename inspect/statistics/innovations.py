"""Innovations of Kalman filters, in the space of the measurement or the state, and their whiteness test."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from beliefscope.inspect.statistics.calibration import LAGS, ljung_box
from beliefscope.inspect.statistics.intervals import jackknife
from beliefscope.inspect.statistics.measures import Array, counted
from beliefscope.inspect.traces.data import Trace


@dataclass(frozen=True)
class Whiteness:
    """Whiteness test of the innovations of one modality in one component.

    Attributes:
        autocorrelation: at lag 1, mean over trajectories.
        low, high: its 95 % interval over trajectories, simultaneous over modalities and components; NaN for too few
            trajectories. The autocorrelation of T white values has the mean -1 / T, which is added.
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

    @property
    def ends(self) -> tuple[float | None, float | None]:
        """The interval, None if unknown."""
        return (None, None) if math.isnan(self.low) else (self.low, self.high)


def innovations(trace: Trace) -> tuple[Array, Array] | None:
    """Innovations and their predicted covariance S; None unless a Kalman filter.

    (T, K, m) and (T, K, m, m) in the spaces of the measurements if the filter reports them, NaN where there is none;
    else (T, K, n) and (T, K, n, n) of the virtual observations.
    """
    if trace.innovation is not None and trace.innovation_covariance is not None:
        return trace.innovation.astype(np.float64), trace.innovation_covariance.astype(np.float64)
    return virtual_innovations(trace)


def virtual_innovations(trace: Trace) -> tuple[Array, Array] | None:
    """``z - H x`` (T, K, n), angles wrapped, and ``P + R`` (T, K, n, n), H = I; None without virtual observations."""
    parts = (
        trace.observation_mean,
        trace.predicted_mean,
        trace.observation_covariance,
        trace.predicted_covariance,
    )
    if any(part is None for part in parts):
        return None
    z, predicted, r, p = (np.asarray(part, dtype=np.float64) for part in parts)
    return trace.task.difference(z, predicted), p + r


def squared_innovations(trace: Trace) -> tuple[Array, NDArray[np.int64]] | None:
    """``nu^T S^-1 nu`` (T, K), NaN without a measurement, and the number of its channels (T, K).

    None unless a Kalman filter.
    """
    if (pair := innovations(trace)) is None:
        return None
    nu, s = pair
    used = np.isfinite(nu)
    both = used[..., :, None] & used[..., None, :]
    s = np.where(both, s, np.eye(nu.shape[-1]))  # unused channels add nothing
    nu = np.where(used, nu, 0.0)
    squared = np.einsum("tkm,tkm->tk", nu, np.linalg.solve(s, nu[..., None])[..., 0])
    channels = used.sum(-1)
    return np.where(channels > 0, squared, np.nan), channels


def nis_of(trace: Trace) -> Array | None:
    """(T, K): ``nu^T S^-1 nu / m`` of the innovations; mean 1 if consistent, NaN without a measurement.

    None unless a Kalman filter.
    """
    if (pair := squared_innovations(trace)) is None:
        return None
    return pair[0] / np.maximum(pair[1], 1)


def autocorrelations(trace: Trace) -> dict[tuple[str, str], float]:
    """(modality, component) -> autocorrelation at lag 1 over the counted steps; empty for too few steps."""
    tests = _ljung_box(trace)
    return {} if tests is None else dict(zip(_names(trace), map(float, tests[1]), strict=True))


def whiteness_of(traces: Sequence[Trace]) -> list[Whiteness]:
    """Test innovations in predicted standard deviations; statistics of independent trajectories add up."""
    results = [tests for trace in traces if (tests := _ljung_box(trace)) is not None]
    if not results:
        return []
    statistic = np.sum([q for q, _, _ in results], axis=0)
    correlation = np.mean([r for _, r, _ in results], axis=0)
    unbiased = np.stack([np.stack([r + 1.0 / steps, np.ones_like(r)], axis=-1) for _, r, steps in results])
    _, low, high = jackknife(unbiased, lambda sums: sums[..., 0] / sums[..., 1], 1.0 - 0.05 / len(correlation))
    degrees = LAGS * len(results)
    return [
        Whiteness(modality, component, float(r), float(a), float(b), float(q), degrees, float(chdtrc(degrees, q)))
        for (modality, component), q, r, a, b in zip(_names(traces[0]), statistic, correlation, low, high, strict=True)
    ]


def _names(trace: Trace) -> list[tuple[str, str]]:
    """(modality, channel) of each series of ``_ljung_box``: components of the state, or channels of the measurement."""
    if trace.innovation is None:
        return [(modality, c.name) for modality in trace.modalities for c in trace.task.components]
    keep = np.isfinite(trace.innovation).any(0)  # (K, m)
    return [(trace.modalities[k], f"channel {i + 1}") for k, i in np.argwhere(keep)]


def _ljung_box(trace: Trace) -> tuple[Array, Array, int] | None:
    """Ljung-Box statistic and autocorrelation at lag 1 of each series, and the number of steps; None for too few.

    Steps without a measurement do not count.
    """
    pair, keep = innovations(trace), counted(trace)
    if pair is None:
        return None
    nu, s = pair
    normalised = (nu / np.sqrt(np.diagonal(s, axis1=-2, axis2=-1)))[keep].reshape(keep.sum(), -1)
    series = [column[np.isfinite(column)] for column in normalised.T if np.isfinite(column).any()]
    if not series or min(map(len, series)) <= 2 * LAGS:
        return None
    if len({len(column) for column in series}) == 1:
        return *ljung_box(np.stack(series, axis=1)), len(series[0])
    tests = [ljung_box(column[:, None]) for column in series]
    q, r = (np.concatenate(parts) for parts in zip(*tests, strict=True))
    return q, r, min(map(len, series))
