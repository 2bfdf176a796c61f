"""Statistics of a filter's modules, each by itself and against the true state, not through the filter's belief.

Measurement models are compared with the true state of their step; the dynamics model starts at the true previous state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Task
from beliefscope.filters.batch import Steps
from beliefscope.filters.belief import Evidence
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.filters.models.pf import MixtureParticleFilter
from beliefscope.filters.models.weight_model import MAX_LOGIT
from beliefscope.inspect.diagnosis.checks.dynamics import dynamics_statistics
from beliefscope.inspect.diagnosis.checks.equations import equation_statistics, reported_particle_statistics
from beliefscope.inspect.diagnosis.checks.innovation_lags import innovation_lags
from beliefscope.inspect.diagnosis.checks.innovations import innovation_statistics
from beliefscope.inspect.diagnosis.checks.measurements import measurement_model_statistics
from beliefscope.inspect.diagnosis.checks.true_starts import with_innovations_near_truth, with_particles_near_truth
from beliefscope.inspect.diagnosis.checks.used_readings import used_readings
from beliefscope.inspect.diagnostics.kalman_equations import jacobian_statistics
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.measures import Array
from beliefscope.inspect.statistics.reading_model import ReadingModel
from beliefscope.inspect.trace import Trace

EVERY = 4
"""The likelihoods of a particle filter are evaluated at every fourth step."""

SCALES = (0.03, 0.1, 0.3, 1.0)
"""Standard deviations of the states at which likelihoods are evaluated, in standard deviations of the training data."""

PER_SCALE = 64
"""Number of such states by scale."""

REFERENCE = slice(2 * PER_SCALE, 3 * PER_SCALE)
"""The states whose log-likelihoods measure the power of a likelihood: those of the third scale."""

POWER = 10.0
"""Standard deviation of log-likelihoods over these states to which they are scaled before their mean is computed."""

LARGEST = 0.9999
"""Largest absolute log-odds of fusion weights, as a share of the network's bound."""

MIN_STEPS = 10
"""Minimum number of steps of a statistic."""


def model_statistics(trace: Trace, checkpoint: Checkpoint, readings: Sequence[ReadingModel] = ()) -> dict[str, float]:
    """``KIND/SUBJECT/PHASE`` -> value, SI units, of all modules; of an external filter those of its reported values.

    Statistics that do not apply are absent, such as those of measurement functions without models of the readings.
    """
    has_truth = bool(np.isfinite(trace.episode.states).all())
    if isinstance(checkpoint, ExternalFilter):
        values = reported_particle_statistics(trace) | innovation_statistics(trace) | weight_statistics(trace)
        near_truth = trace
        if has_truth:
            near_truth = with_innovations_near_truth(with_particles_near_truth(trace, checkpoint), checkpoint)
            values |= innovation_lags(trace, near_truth, checkpoint) | used_readings(trace, checkpoint)
        values |= measurement_model_statistics(trace, readings, near_truth) | jacobian_statistics(trace, checkpoint)
        if isinstance(checkpoint, UnavailableFilter) or reports_estimates_only(trace):  # of others, its causes
            variance = np.diagonal(trace.estimate_covariance[measures.counted(trace)], axis1=-2, axis2=-1)
            values["belief variance//all"] = float(np.log(np.maximum(variance, 1e-24)).mean())
    else:
        values = weight_statistics(trace) | equation_statistics(trace, checkpoint)
    values |= error_statistics(trace)
    if has_truth:
        values |= measurement_statistics(trace, checkpoint) | dynamics_statistics(trace, checkpoint)
    return {name: value for name, value in values.items() if math.isfinite(value)}


def reports_estimates_only(trace: Trace) -> bool:
    """Whether an external filter reports nothing but estimates and weights, as a recurrent network does."""
    others = (trace.predicted_mean, trace.innovation, trace.observation_mean, trace.particles)
    return all(values is None for values in others)


def component_errors(task: Task) -> dict[str, int]:
    """``component error/NAME/all`` -> index of a component that is no length, no angle and not in the main error."""
    known = task.main_error.indices
    others = ((i, c.name) for i, c in enumerate(task.components) if c.unit not in ("m", "rad") and i not in known)
    return {f"component error/{name}/all": i for i, name in others}


def error_statistics(trace: Trace) -> dict[str, float]:
    """Root mean square errors of the estimate: ``error``, the task's main error; ``angle error`` of all angles, rad;
    ``component error``, of each other component, such as a velocity.
    """
    at = measures.counted(trace)
    values = {"error//all": float(np.sqrt(np.square(measures.main_error(trace)[at, -1]).mean()))}
    angles, errors = list(trace.task.angles), measures.errors(trace)[at, -1]
    if angles:
        values["angle error//all"] = float(np.sqrt(np.square(errors[:, angles]).mean()))
    others = component_errors(trace.task).items()
    return values | {name: float(np.sqrt(np.square(errors[:, i]).mean())) for name, i in others}


def measurement_statistics(trace: Trace, checkpoint: Checkpoint) -> dict[str, float]:
    """Of each measurement model and component, from its residuals r with standard deviation s.

    ``module bias``: mean of r. ``module spread``: standard deviation of r. ``module error``: root mean square of r.
    ``module std``: root mean square of s. ``module nis``: mean of (r / s)^2. ``module power``: in a Kalman filter the
    geometric mean of 1 / s^2, in a particle filter the variance of the log-likelihood over fixed states, which does
    not affect r. Steps with image blackout do not count for images.
    """
    if trace.observation_mean is not None and trace.observation_covariance is not None:
        steps = np.arange(len(trace))
        observed = trace.observation_mean.astype(np.float64)
        variance = np.diagonal(trace.observation_covariance, axis1=-2, axis2=-1).astype(np.float64)
        power = 1.0 / variance
    elif isinstance(checkpoint, ExternalFilter):
        return {}
    elif trace.log_likelihood is not None and isinstance(checkpoint.filter, MixtureParticleFilter):
        steps = np.arange(0, len(trace), EVERY)
        observed, variance, power = likelihood_moments(checkpoint.filter, trace.episode, steps)
    else:
        return {}
    task = trace.task
    truth = trace.episode.states[steps].astype(np.float64)
    residual = task.difference(observed, truth[:, None])
    black = measures.blackout(trace)[steps]
    values: dict[str, float] = {}
    for k, model in enumerate(trace.modalities):
        keep = ~black if "image" in model.split("+") else np.ones(len(steps), dtype=bool)
        if keep.sum() < min(MIN_STEPS, len(steps)):
            continue
        r, v = residual[keep, k], variance[keep, k]
        values[f"module power/{model}/all"] = float(np.exp(np.log(power[keep, k]).mean()))
        columns = {
            "module bias": r.mean(0),
            "module spread": r.std(0),
            "module error": np.sqrt(np.square(r).mean(0)),
            "module std": np.sqrt(v.mean(0)),
            "module nis": (np.square(r) / v).mean(0),
        }
        for kind, column in columns.items():
            for component, value in zip(task.components, column, strict=True):
                values[f"{kind}/{model} {component.name}/all"] = float(value)
    return values


@torch.no_grad()
def likelihood_moments(
    filter_: MixtureParticleFilter, episode: Episode, steps: np.ndarray
) -> tuple[Array, Array, Array]:
    """Means (S, K, n) and variances (S, K, n) of the likelihoods at some steps, as densities of the state; SI units.

    The means are those of likelihoods raised to a power, so that they have the same variance ``POWER^2`` of their
    logarithm over fixed states. Also returns this variance (S, K, 1) around the mean of the likelihood itself, where
    it does not depend on the true state.

    Self-normalised importance sampling from a mixture of Gaussians around the true state with the standard deviations
    ``SCALES``: wide enough for a biased likelihood and dense enough for a narrow one. All steps share the offsets.
    """
    batch = Steps.from_episodes(filter_.task, [episode]).episode(0)
    batch = type(batch)(
        {name: values[steps] for name, values in batch.observations.items()},
        batch.controls[steps],
        batch.states[steps],
        batch.contact[steps],
        batch.previous,
    )
    evidence = filter_.encode(batch)
    by_step = Evidence(evidence.control[:, 0], evidence.observation[:, 0], None, None)  # (S, K, u): steps as the batch
    offsets, log_density = proposal(filter_.n)
    truth = filter_.statistics.standardise("state", batch.states[:, 0])
    states = truth.unsqueeze(1) + offsets
    log_likelihood = filter_.log_likelihood(by_step, states)  # (S, K, G)
    spread = log_likelihood[..., REFERENCE].std(-1, keepdim=True).clamp_min(1e-6)
    mean, _ = _moments(POWER / spread * log_likelihood - log_density, offsets)
    _, variance = _moments(log_likelihood - log_density, offsets)
    around = truth[:, None, None] + mean.unsqueeze(2) + offsets[REFERENCE]  # (S, K, G', n)
    own = torch.stack([filter_.log_likelihood(by_step, around[:, k])[:, k] for k in range(around.shape[1])], dim=1)
    si, std = filter_.statistics, filter_.statistics.mean_std("state")[1]
    # One sample may have all the weight: the likelihood is then narrower than the spacing of the samples.
    variance = variance.clamp_min((0.1 * SCALES[0]) ** 2) * std.square()
    mean = si.state_to_si(truth.unsqueeze(1) + mean)
    return mean.double().numpy(), variance.double().numpy(), own.var(-1, keepdim=True).double().numpy()


def _moments(log_weights: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Means and variances (S, K, n) of offsets (G, n) with unnormalised log-weights (S, K, G)."""
    weights = torch.softmax(log_weights, dim=-1)
    mean = torch.einsum("skg,gn->skn", weights, offsets)
    return mean, torch.einsum("skg,skgn->skn", weights, (offsets - mean.unsqueeze(2)).square())


def proposal(n: int) -> tuple[Tensor, Tensor]:
    """Offsets (G, n) from the mixture of zero-mean Gaussians with standard deviations ``SCALES``; log-density (G,)."""
    unit = torch.randn(len(SCALES), PER_SCALE, n, generator=torch.Generator().manual_seed(0))
    scales = torch.tensor(SCALES)
    offsets = (unit * scales[:, None, None]).flatten(0, 1)
    log_each = -0.5 * (offsets.unsqueeze(1) / scales[:, None]).square().sum(-1) - n * scales.log()
    return offsets, torch.logsumexp(log_each, dim=-1) - math.log(len(SCALES)) - 0.5 * n * math.log(2.0 * math.pi)


def weight_statistics(trace: Trace) -> dict[str, float]:
    """Of the log-odds of each fusion weight before the network's bound.

    ``beta logit``: mean. ``beta spread``: standard deviation. ``beta contact``: slope on the contact flag, per standard
    deviation of the flag; absent in episodes without both phases.
    """
    if trace.weights is None or len(trace) < MIN_STEPS or trace.weights.shape[1] < 2:
        return {}
    names = [c.name for c in trace.task.components] if trace.weights.shape[-1] > 1 else [""]
    weights = np.clip(trace.weights.astype(np.float64), 1e-9, 1.0 - 1e-9)
    odds = np.log(weights / (1.0 - weights))
    logits = 2.0 * MAX_LOGIT * np.arctanh(np.clip(odds / (2.0 * MAX_LOGIT), -LARGEST, LARGEST))
    contact = trace.episode.contact.astype(np.float64)
    contact = (contact - contact.mean()) / contact.std() if contact.std() > 0.0 else np.full(len(trace), np.nan)
    columns = {
        "beta logit": logits.mean(0),
        "beta spread": logits.std(0),
        "beta contact": np.einsum("t,tkw->kw", contact, logits) / len(trace),
    }
    count = 1 if len(trace.modalities) == 2 else len(trace.modalities)
    return {
        f"{kind}/{trace.modalities[k]} {name}".rstrip() + "/all": float(column[k, w])
        for kind, column in columns.items()
        for k in range(count)
        for w, name in enumerate(names)
    }
