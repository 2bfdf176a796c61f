"""Innovations of Kalman filters and their whiteness test."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from beliefscope.inspect.statistics.calibration import LAGS, ljung_box
from beliefscope.inspect.statistics.intervals import jackknife
from beliefscope.inspect.statistics.measures import Array, counted, wrapped
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
    """``z - H x`` (T, K, n), angles wrapped, and ``P + R`` (T, K, n, n), H = I; None unless a Kalman filter."""
    parts = (
        trace.observation_mean,
        trace.predicted_mean,
        trace.observation_covariance,
        trace.predicted_covariance,
    )
    if any(part is None for part in parts):
        return None
    z, predicted, r, p = (np.asarray(part, dtype=np.float64) for part in parts)
    return wrapped(trace.task, z - predicted), p + r


def nis_of(trace: Trace) -> Array | None:
    """(T, K): ``nu^T S^-1 nu / n`` of the innovations; mean 1 if consistent. None unless a Kalman filter."""
    if (pair := innovations(trace)) is None:
        return None
    nu, s = pair
    return np.einsum("tkn,tkn->tk", nu, np.linalg.solve(s, nu[..., None])[..., 0]) / nu.shape[-1]


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
    return [(modality, c.name) for modality in trace.modalities for c in trace.task.components]


def _ljung_box(trace: Trace) -> tuple[Array, Array, int] | None:
    """Ljung-Box statistic and autocorrelation at lag 1, (K n,) each, and the number of steps; None for too few."""
    pair, keep = innovations(trace), counted(trace)
    if pair is None or keep.sum() <= 2 * LAGS:
        return None
    nu, s = pair
    normalised = nu / np.sqrt(np.diagonal(s, axis1=-2, axis2=-1))
    return *ljung_box(normalised[keep].reshape(keep.sum(), -1)), int(keep.sum())
