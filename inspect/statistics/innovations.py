"""Innovations of Kalman filters and their whiteness test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from beliefscope.inspect.statistics.calibration import LAGS, ljung_box
from beliefscope.inspect.statistics.measures import Array, counted, task_of, wrapped
from beliefscope.inspect.traces.data import Trace


@dataclass(frozen=True)
class Whiteness:
    """Whiteness test of the innovations of one modality in one component.

    Attributes:
        autocorrelation: at lag 1, mean over trajectories.
        statistic: Ljung-Box statistic, summed over trajectories.
        degrees: its degrees of freedom.
        p_value: probability of a larger statistic for white innovations.
    """

    modality: str
    component: str
    autocorrelation: float
    statistic: float
    degrees: int
    p_value: float


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
    return wrapped(task_of(trace), z - predicted), p + r


def whiteness_of(traces: Sequence[Trace]) -> list[Whiteness]:
    """Test innovations in predicted standard deviations; statistics of independent trajectories add up."""
    results: list[tuple[Array, Array]] = []
    for trace in traces:
        pair = innovations(trace)
        keep = counted(trace)
        if pair is None or keep.sum() <= 2 * LAGS:
            continue
        nu, s = pair
        normalised = nu / np.sqrt(np.diagonal(s, axis1=-2, axis2=-1))
        results.append(ljung_box(normalised[keep].reshape(keep.sum(), -1)))
    if not results:
        return []
    statistic, correlation = np.sum([q for q, _ in results], axis=0), np.mean([r for _, r in results], axis=0)
    degrees = LAGS * len(results)
    pairs = [(m, c.name) for m in traces[0].modalities for c in task_of(traces[0]).components]
    return [
        Whiteness(modality, component, float(r), float(q), degrees, float(chdtrc(degrees, q)))
        for (modality, component), q, r in zip(pairs, statistic, correlation, strict=True)
    ]
