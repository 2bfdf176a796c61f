"""Lags of the labels behind the modalities of an external filter, from its innovations at true states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnosis.checks.innovations import angle_columns
from beliefscope.inspect.diagnosis.checks.labels import common_part
from beliefscope.inspect.diagnosis.checks.true_starts import run_from_truth, smallest_std, some_steps
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.measures import Array
from beliefscope.inspect.statistics.signals import wrapped
from beliefscope.inspect.trace import Trace

MIN_STEPS = 10
"""Minimum number of steps with a reading."""

UNCERTAIN = 0.5
"""Largest standard error of a lag in steps, for readings with the noise R."""


def innovation_lags(trace: Trace, near_truth: Trace, checkpoint: ExternalFilter) -> dict[str, float]:
    """``lag/labels MODALITY/all``: steps by which the labels follow a modality, less what all have in common.

    Of filters that report innovations nu, but no measured states. The reading of step t is compared with the true
    states of t and of the step before, ``d = nu(t - 1) - nu(t)`` being the change of h(x). A reading that is late by L
    has ``nu(t) = -L d``: the lag is the slope of nu on d, weighted by 1 / S, around their means, since a bias is no
    delay. What is common is an error of the dynamics, by which both steps begin. None if fewer than two are known.

    near_truth: the trace with the innovations of steps from true states (``with_innovations_near_truth``).
    """
    is_known = trace.observation_mean is not None or len(trace.modalities_with_posterior) > 0
    at, covariance = near_truth.innovation, near_truth.innovation_covariance
    if at is None or covariance is None or at is trace.innovation or is_known:
        return {}
    steps, episode = some_steps(trace, checkpoint), trace.episode
    steps = steps[steps > 1]
    later = {key: np.roll(values, -1, axis=0) for key, values in episode.observations.items()}
    masks = {key: np.roll(values, -1, axis=0) for key, values in episode.covariates.items()}
    before = replace(trace, episode=replace(episode, observations=later, covariates=masks))
    earlier = run_from_truth(before, checkpoint, steps - 1, smallest_std(trace))
    if earlier is None or "innovation" not in earlier:
        return {}
    nu = at[steps].astype(np.float64)
    change = earlier["innovation"].astype(np.float64) - nu
    variance = np.diagonal(covariance[steps], axis1=-2, axis2=-1).astype(np.float64)
    lags: dict[str, float] = {}
    for k, modality in enumerate(trace.modalities):
        keep = ~measures.absent(trace, modality)[steps]
        angles = [i for i in angle_columns(trace, modality) if i < nu.shape[-1]]  # fewer channels: it is never used
        own = nu[keep, k], change[keep, k]
        for values in own:
            values[:, angles] = wrapped(values[:, angles])
        lags[modality] = _slope(*own, variance[keep, k])
    known = np.array([value for value in lags.values() if np.isfinite(value)])
    if len(known) < 2:
        return {}
    common = float(common_part(known[:, None])[0])
    return {f"lag/labels {modality}/all": value - common for modality, value in lags.items() if np.isfinite(value)}


def _slope(nu: Array, change: Array, variance: Array) -> float:
    """Slope of innovations (S, m) on changes, around their means; NaN if it is uncertain."""
    known = np.isfinite(nu) & np.isfinite(change) & (variance > 0.0)
    if known.any(-1).sum() < MIN_STEPS:
        return np.nan
    weight = np.where(known, 1.0 / np.where(known, variance, 1.0), 0.0)
    total = np.maximum(weight.sum(0), 1e-300)
    nu, change = (x - (weight * x).sum(0) / total for x in (np.where(known, nu, 0.0), np.where(known, change, 0.0)))
    power = float((weight * np.square(change)).sum())
    return float((weight * nu * change).sum()) / power if power * UNCERTAIN**2 > 1.0 else np.nan
