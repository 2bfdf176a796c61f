"""Statistics of a filter's equations: its outputs compared with those recomputed from its own intermediate results.

In a filter that follows its equations, each of them has a fixed value, whatever the sensors and networks do.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from beliefscope.filters.angles import Angles
from beliefscope.filters.belief import Gaussian, moments
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.models.ekf import ExtendedKalmanFilter
from beliefscope.filters.models.fusion import in_one_turn, product_of_experts, weighted_average
from beliefscope.filters.models.information import InformationFilter
from beliefscope.filters.models.pf import MixtureParticleFilter
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.measures import Array
from beliefscope.inspect.trace import Trace

INDEPENDENT = 0.15
"""Largest deviation from 1 of the relative spread of independent draws."""

SMALLEST_STD = 1e-3
"""Smallest standard deviation of the particles of a step, relative to that of the states: moments of particles that are
almost equal depend on rounding."""

MOST_NUMBERS = 3_000_000
"""Numbers of particles from which only some of the steps count."""

NO_EVIDENCE = 1e-6
"""Variation of a log-likelihood over the particles of an episode, nats, below which its use cannot be seen."""


LOST = 0.1
"""Smallest change of the log-weights between two steps, relative to their spread, of weights that are not kept."""

MIN_STEPS = 10
"""Minimum number of steps of a statistic."""


@torch.no_grad()
def equation_statistics(trace: Trace, checkpoint: Checkpoint) -> dict[str, float]:
    """``KIND//all`` -> value.

    ``reported variance``: log-ratio of the variances of the estimate and of the belief that the recursion uses.
    ``fusion variance``: log-ratio of the variances of that belief and of the fusion rule's result.
    ``fusion mean``: root mean square distance of the estimate from the fusion rule's result, in standard deviations.
    Particle filters also have ``particles``: number M; ``ancestors``: share of particles with offspring;
    ``offspring``: mean square of the difference between the number of offspring and its expectation M w; and
    ``prior ess``: relative effective sample size of the weights after resampling.
    Information filters have no fusion rule: of them only the ``reported variance`` is compared, in Kalman filters.
    Traces without some of the particles have none of these statistics.
    """
    filter_ = checkpoint.filter
    if trace.all_particles_ess is not None:
        return {}
    if isinstance(filter_, MixtureParticleFilter) and trace.particles is not None:
        return _particle_statistics(trace, filter_)
    if isinstance(filter_, ExtendedKalmanFilter) and trace.predicted_covariance is not None and len(trace) > 1:
        return _kalman_statistics(trace, filter_)
    return {}


def _kalman_statistics(trace: Trace, filter_: ExtendedKalmanFilter) -> dict[str, float]:
    mean, covariance = _tensor(trace.estimate_mean), _tensor(trace.estimate_covariance)
    variance = covariance.diagonal(dim1=-2, dim2=-1).log()
    if isinstance(filter_, InformationFilter):
        return {"reported variance//all": float((variance[:-1] - _used_before(trace, filter_)).median())}
    rule = _fused(trace, filter_)
    by_rule = rule.covariance.diagonal(dim1=-2, dim2=-1).log()
    distance = measures.wrapped(filter_.task, (mean - rule.mean).numpy()) / by_rule.exp().sqrt().numpy()
    values = {"fusion mean//all": float(np.sqrt(np.square(distance).mean()))}
    if filter_.architecture.feedback:
        used = _used_before(trace, filter_)
        values["fusion variance//all"] = float((used - by_rule[:-1]).median())
        values["reported variance//all"] = float((variance[:-1] - used).median())
    else:
        values["reported variance//all"] = float((variance - by_rule).median())
    return values


def _fused(trace: Trace, filter_: ExtendedKalmanFilter) -> Gaussian:
    """Result of the fusion rule for the bank's posteriors, (T, n) and (T, n, n)."""
    bank = in_one_turn(Gaussian(_tensor(trace.modality_mean), _tensor(trace.modality_covariance)), filter_.angles)
    log_weights = None if trace.weights is None else _tensor(trace.weights).log()
    architecture = filter_.architecture
    if bank.mean.shape[1] == 1:
        return Gaussian(bank.mean[:, 0], bank.covariance[:, 0])
    if log_weights is None:
        return product_of_experts(bank)
    return weighted_average(bank, log_weights, architecture.covariance)


def _used_before(trace: Trace, filter_: ExtendedKalmanFilter) -> Tensor:
    """(T - 1, n) log-variances of the beliefs that the next predictions started from: ``A^-1 (P' - Q) A^-T``."""
    si = filter_.statistics
    std = si.mean_std("state")[1].double()
    controls = si.standardise("control", torch.from_numpy(trace.episode.controls[1:]))
    states = si.standardise("state", torch.from_numpy(trace.estimate_mean[:-1]))
    mean, jacobian = filter_.dynamics.with_jacobian(states, filter_.dynamics.control_part(controls))
    information = isinstance(filter_, InformationFilter)
    noise = filter_.process_noise(mean - states) if information else filter_.dynamics.noise
    predicted = _tensor(trace.predicted_covariance)[1:, 0] / (std * std[:, None])
    back = torch.linalg.inv(jacobian.double())
    before = back @ (predicted - torch.diag_embed(noise.double() ** 2)) @ back.transpose(-1, -2)
    variance = before.diagonal(dim1=-2, dim2=-1) * std.square()
    return variance.clamp_min(1e-12).log()


def _particle_statistics(trace: Trace, filter_: MixtureParticleFilter) -> dict[str, float]:
    assert trace.log_weights is not None
    assert trace.prior_log_weights is not None
    steps, count = trace.log_weights.shape
    log_weights, prior = _tensor(trace.log_weights), _tensor(trace.prior_log_weights)
    rule = moments(_tensor(trace.particles), log_weights, filter_.angles)
    variance, by_rule = (
        matrix.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12)
        for matrix in (_tensor(trace.estimate_covariance), rule.covariance)
    )
    distance = measures.wrapped(filter_.task, trace.estimate_mean - rule.mean.numpy()) / by_rule.sqrt().numpy()
    offspring = _offspring(trace.ancestors, steps, count)
    return {
        "reported variance//all": float((variance.log() - by_rule.log()).median()),
        "fusion mean//all": float(np.sqrt(np.square(distance).mean())),
        "fusion variance//all": -float(np.log(max(_likelihood_power(trace, filter_, prior, log_weights), 1e-3))),
        "particles//all": float(count),
        "ancestors//all": float((offspring > 0).mean()),
        "offspring//all": float(np.square(offspring - count * log_weights.exp().numpy()).mean()),
        "prior ess//all": float((1.0 / (2.0 * prior).exp().sum(-1)).mean() / count),
    }


def reported_particle_statistics(trace: Trace) -> dict[str, float]:
    """Of the particles that an external filter reports: those of ``equation_statistics`` that need no equations of it.

    ``prior ess`` is of the steps after a resampling, of all steps if there is none: not every filter resamples always.
    ``offspring`` (``relative_spread``) and ``relative ancestors``, the share of particles with offspring relative to
    its largest one by the weights w, the mean of min(1, M w), are of the steps with a resampling.
    ``lost weights``: share of the steps without resampling after which the weights are not kept.
    ``likelihood share``, of each measurement model: the power to which its likelihood is in the ratio of the posterior
    to the prior weights, 1 if it is a factor of them and 0 if the weights ignore it. ``estimate mean`` and
    ``reported variance``: as ``_estimate_statistics``. Of an ensemble without weights, ``particles`` alone.
    """
    if trace.all_particles_ess is not None or trace.particles is None:
        return {}
    if trace.log_weights is None or trace.prior_log_weights is None:
        return {"particles//all": float(trace.particles.shape[1])}
    log_weights, prior = _tensor(trace.log_weights), _tensor(trace.prior_log_weights)
    count = log_weights.shape[1]
    values = {"particles//all": float(count), "prior ess//all": _ess_after_resampling(log_weights, prior)}
    values |= _estimate_statistics(trace)
    values |= _lost_weights(trace, log_weights.numpy(), prior.numpy())
    ancestors = np.arange(count)[None] if trace.ancestors is None else trace.ancestors
    resampled = np.flatnonzero((ancestors != np.arange(count)).any(-1) & (ancestors >= 0).all(-1))
    if len(resampled):
        offspring = _offspring(ancestors[resampled], len(resampled), count)
        expected = count * log_weights[torch.from_numpy(resampled)].exp().numpy()
        values["relative ancestors//all"] = float((offspring > 0).mean() / np.minimum(expected, 1.0).mean())
        values["offspring//all"] = relative_spread(offspring, expected)
    if trace.log_likelihood is None:
        return values
    values |= _absent_updates(trace)
    weight = log_weights.exp()
    valid = torch.isfinite(log_weights - prior) & torch.isfinite(_tensor(trace.log_likelihood)).all(1)
    weight = torch.where(valid, weight, 0.0)
    columns = [torch.where(valid, v, 0.0) for v in (*_tensor(trace.log_likelihood).unbind(1), log_weights - prior)]
    total = weight.sum(-1, keepdim=True).clamp_min(1e-12)
    centred = torch.stack([(v - (weight * v).sum(-1, keepdim=True) / total) * weight.sqrt() for v in columns], -1)
    flat = centred.reshape(-1, len(columns))
    if bool((flat.norm(dim=0)[:-1] < NO_EVIDENCE).any()):
        return values
    share = torch.linalg.lstsq(flat[:, :-1], flat[:, -1:], driver="gelsd").solution[:, 0]
    names = trace.modalities if len(trace.modalities) == len(share) else ()
    return values | {f"likelihood share/{name}/all": float(x) for name, x in zip(names, share, strict=False)}


def _estimate_statistics(trace: Trace) -> dict[str, float]:
    """The estimate against the moments of the weighted particles.

    ``estimate mean``: root mean square distance from their mean, in standard deviations; ``reported variance``:
    log-ratio of the variances. Of components whose particles differ.
    """
    assert trace.particles is not None
    assert trace.log_weights is not None
    if trace.task.rotations:
        return {}
    every = np.s_[:: 1 + trace.particles.size // MOST_NUMBERS]
    angles = Angles(trace.task.angles)
    rule = moments(_tensor(trace.particles[every]), _tensor(trace.log_weights[every]), angles)
    variance = rule.covariance.diagonal(dim1=-2, dim2=-1).numpy()
    differ = variance > np.square(SMALLEST_STD * trace.episode.states.std(0))
    if not differ.any():
        return {}
    distance = np.square(trace.task.difference(trace.estimate_mean[every].astype(np.float64), rule.mean.numpy()))
    values = {"estimate mean//all": math.sqrt((distance[differ] / variance[differ]).mean())}
    if trace.has_covariance:
        reported = np.diagonal(trace.estimate_covariance[every], axis1=-2, axis2=-1)[differ]
        values["reported variance//all"] = float(np.median(np.log(np.maximum(reported / variance[differ], 1e-12))))
    return values


def _absent_updates(trace: Trace) -> dict[str, float]:
    """``absent updates/MODALITY/all``: share of steps without a reading whose likelihood distinguishes particles."""
    assert trace.log_likelihood is not None
    values = {}
    for k, modality in enumerate(trace.modalities):
        absent = measures.absent(trace, modality) & measures.counted(trace)
        if absent.any():
            used = np.ptp(trace.log_likelihood[absent, k], axis=-1) > NO_EVIDENCE
            values[f"absent updates/{modality}/all"] = float(used.mean())
    return values


def _lost_weights(trace: Trace, log_weights: Array, prior: Array) -> dict[str, float]:
    """``lost weights//all``: share of steps without resampling whose weights (T, M) are not the next prior weights."""
    if trace.ancestors is None:
        return {}
    with np.errstate(invalid="ignore"):  # some weights may be 0
        spread = np.abs(log_weights - log_weights.mean(-1, keepdims=True)).mean(-1)[:-1]
    kept = (
        (trace.ancestors == np.arange(log_weights.shape[1])).all(-1)[:-1] & np.isfinite(spread) & (spread > NO_EVIDENCE)
    )
    if kept.sum() < MIN_STEPS:
        return {}
    normalised = log_weights - np.logaddexp.reduce(log_weights, axis=-1, keepdims=True)
    change = np.abs(prior[1:] - normalised[:-1]).mean(-1)
    return {"lost weights//all": float((change[kept] > LOST * spread[kept]).mean())}


def _ess_after_resampling(log_weights: Tensor, prior: Tensor) -> float:
    """Relative effective sample size of the prior weights (T, M), where that of the weights before is smaller."""
    before, after = (1.0 / (2.0 * values).exp().sum(-1) / values.shape[1] for values in (log_weights[:-1], prior[1:]))
    resampled = after > 1.001 * before
    return float(after[resampled if resampled.any() else slice(None)].mean()) if len(after) else math.nan


def _likelihood_power(trace: Trace, filter_: MixtureParticleFilter, prior: Tensor, log_weights: Tensor) -> float:
    """Power to which the fused likelihood has been raised: slope of ``log w - log w'`` on its logarithm."""
    log_likelihood = _tensor(trace.log_likelihood)
    scaled = log_likelihood - filter_.scale(prior, log_likelihood)
    if trace.weights is not None:
        scaled = scaled + _tensor(trace.weights).log()
    fused = torch.logsumexp(scaled, dim=1)
    weight = log_weights.exp() / len(log_weights)
    x, y = ((v - (weight * v).sum(-1, keepdim=True) * len(log_weights)) for v in (fused, log_weights - prior))
    return float((weight * x * y).sum() / (weight * x * x).sum().clamp_min(1e-12))


def relative_spread(offspring: NDArray[np.int64], expected: NDArray[np.float64]) -> float:
    """Mean square of the difference of numbers of offspring (T, M) from their expectations, relative to its own.

    That of independent (multinomial) draws if it is close to it, else that of systematic resampling, so that it is
    about 1 for either, whatever the weights.
    """
    squared, part = float(np.square(offspring - expected).mean()), expected % 1.0
    independent = squared / max(float((expected * (1.0 - expected / expected.shape[1])).mean()), 1e-12)
    systematic = squared / max(float((part * (1.0 - part)).mean()), 1e-12)
    return independent if abs(independent - 1.0) < INDEPENDENT else systematic


def _offspring(ancestors: NDArray[Any] | None, steps: int, count: int) -> NDArray[np.int64]:
    """(T, M): number of offspring of each particle."""
    index = (np.arange(count) if ancestors is None else ancestors) + count * np.arange(steps)[:, None]
    return np.bincount(index.ravel(), minlength=steps * count).reshape(steps, count)


def _tensor(values: NDArray[Any] | None) -> Tensor:
    assert values is not None
    return torch.from_numpy(values).double()
