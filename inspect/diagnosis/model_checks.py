"""Statistics of a filter's modules, each by itself and against the true state, not through the filter's belief.

Measurement models are compared with the true state of their step; the dynamics model starts at the true previous state.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Task, axis_name
from beliefscope.filters.batch import Steps
from beliefscope.filters.belief import Evidence
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.models.dynamics import Dynamics
from beliefscope.filters.models.information import InformationFilter
from beliefscope.filters.models.pf import MixtureParticleFilter
from beliefscope.filters.models.weight_model import MAX_LOGIT
from beliefscope.inspect.diagnosis.equation_checks import equation_statistics, reported_particle_statistics
from beliefscope.inspect.diagnosis.innovation_checks import innovation_statistics
from beliefscope.inspect.diagnosis.measurement_checks import measurement_model_statistics
from beliefscope.inspect.diagnosis.vector_checks import commands_hand
from beliefscope.inspect.diagnostics.kalman_equations import jacobian_statistics
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.innovations import prediction
from beliefscope.inspect.statistics.measures import Array
from beliefscope.inspect.statistics.reading_model import ReadingModel
from beliefscope.inspect.statistics.signals import lag
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

MIN_PATH = 0.3
"""Minimum path of a component for a slope of the dynamics, in standard deviations of the training data."""

ROUNDING = 1e-12
"""Largest variance that a prediction adds by rounding, relative to that of the states."""

MIN_STEPS = 10
"""Minimum number of steps of a statistic."""


def model_statistics(trace: Trace, checkpoint: Checkpoint, readings: Sequence[ReadingModel] = ()) -> dict[str, float]:
    """``KIND/SUBJECT/PHASE`` -> value, SI units, of all modules; of an external filter those of its reported values.

    Statistics that do not apply are absent, such as those of measurement functions without models of the readings.
    """
    has_truth, external = bool(np.isfinite(trace.episode.states).all()), isinstance(checkpoint, ExternalFilter)
    if isinstance(checkpoint, ExternalFilter):
        values = reported_particle_statistics(trace) | innovation_statistics(trace) | weight_statistics(trace)
        values |= measurement_model_statistics(trace, readings) | jacobian_statistics(trace, checkpoint)
    else:
        values = weight_statistics(trace) | equation_statistics(trace, checkpoint)
    if has_truth:
        values |= error_statistics(trace) | measurement_statistics(trace, checkpoint)
    if has_truth:
        values |= reported_dynamics_statistics(trace) if external else dynamics_statistics(trace.episode, checkpoint)
    return {name: value for name, value in values.items() if math.isfinite(value)}


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


@torch.no_grad()
def dynamics_statistics(episode: Episode, checkpoint: Checkpoint) -> dict[str, float]:
    """Of the dynamics model from the true previous state, by component, with residual r and process noise q.

    ``dynamics error``: root mean square of r. ``dynamics nis``: mean of (r / q)^2, where the q of an information filter
    grows with the motion. ``dynamics slope``: slope of the
    predicted on the true change, for components that move enough. ``dynamics bias`` and ``dynamics spread``: mean and
    standard deviation of r that the slope does not explain. ``process noise``: q. ``lag/dynamics``: steps by which the
    true changes follow the predicted ones. ``opposed/control``, of controls that do not command a measured hand:
    log-ratio of the size of r to that with the opposite sign of the channel; 0 if the present sign fits better.
    """
    filter_ = checkpoint.filter
    if not isinstance(getattr(filter_, "dynamics", None), Dynamics) or len(episode) < MIN_STEPS:
        return {}
    si = filter_.statistics
    states = si.standardise("state", torch.from_numpy(episode.states))
    controls = si.standardise("control", torch.from_numpy(episode.controls))
    before, after = states[:-1], states[1:]
    predicted = filter_.dynamics(before, filter_.dynamics.control_part(controls[1:]))
    std = si.mean_std("state")[1].double().numpy()
    noise = filter_.dynamics.noise.double().numpy() * std
    used = (
        filter_.process_noise(predicted - before) if isinstance(filter_, InformationFilter) else filter_.dynamics.noise
    )
    residual = measures.wrapped(filter_.task, (predicted - after).double().numpy() * std)
    change = measures.wrapped(filter_.task, (after - before).double().numpy() * std)
    nis = (np.square(residual) / (used.double().numpy() * std) ** 2).mean(0)
    values = _of_changes(filter_.task, residual, change, {"dynamics nis": nis, "process noise": noise}, std)
    if commands_hand(episode.task):
        return values
    signs = 1.0 - 2.0 * torch.eye(controls.shape[1])[:, None]
    controls = si.standardise("control", signs * torch.from_numpy(episode.controls[1:]))
    opposite = filter_.dynamics(before, filter_.dynamics.control_part(controls))
    other = measures.wrapped(filter_.task, (opposite - after).double().numpy() * std)
    moved = np.abs(change).sum(0) > MIN_PATH * std
    size, sizes = (np.square((r / std)[..., moved]).sum((-2, -1)) for r in (residual, other))
    for i, ratio in enumerate(size / np.maximum(sizes, 1e-12)):
        values[f"opposed/{axis_name('control', i, len(signs))}/all"] = 0.5 * math.log(max(ratio, 1.0))
    return values


def reported_dynamics_statistics(trace: Trace) -> dict[str, float]:
    """Those of ``dynamics_statistics`` from the predictions of an external filter, which start at its estimates.

    The process noise is what a prediction adds to the variance of the estimate. ``dynamics offset``: mean residual,
    which differs between episodes if the filter does not estimate a bias.
    """
    belief = prediction(trace)
    states, task = trace.episode.states.astype(np.float64), trace.task
    keep = measures.counted(trace)[1:]
    if belief is None or task.rotations or keep.sum() < MIN_STEPS:
        return {}
    mean, covariance = belief
    predicted = task.difference(mean[1:], trace.estimate_mean[:-1].astype(np.float64))[keep]
    change = task.difference(states[1:], states[:-1])[keep]
    residual = measures.wrapped(task, predicted - change)
    more: dict[str, Array] = {"dynamics offset": residual.mean(0)}
    if covariance is not None and trace.has_covariance:
        added = covariance[1:] - trace.estimate_covariance[:-1].astype(np.float64)
        variance = np.median(np.diagonal(added, axis1=-2, axis2=-1)[keep], axis=0)
        variance = np.where(variance > ROUNDING * np.square(states.std(0)), variance, np.nan)
        more |= {"dynamics nis": np.square(residual).mean(0) / variance, "process noise": np.sqrt(variance)}
    return _of_changes(task, residual, change, more, states.std(0))


def _of_changes(task: Task, residual: Array, change: Array, more: Mapping[str, Array], std: Array) -> dict[str, float]:
    """Statistics of residuals (T, n) of predicted changes, of states with standard deviations (n,)."""
    values: dict[str, float] = {}
    moved = np.abs(change).sum(0) > MIN_PATH * std
    centred, around = residual - residual.mean(0), change - change.mean(0)
    excess = np.where(moved, (centred * around).sum(0) / np.maximum(np.square(around).sum(0), 1e-12), 0.0)
    columns = {
        "dynamics bias": residual.mean(0) - excess * change.mean(0),
        "dynamics error": np.sqrt(np.square(residual).mean(0)),
        "dynamics slope": np.where(moved, 1.0 + excess, np.nan),
        "dynamics spread": (centred - excess * around).std(0),
    }
    for kind, column in {**columns, **more}.items():
        for component, value in zip(task.components, column, strict=True):
            values[f"{kind}/{component.name}/all"] = float(value)
    if moved.any():
        scaled = (change + residual)[:, moved] / std[moved], change[:, moved] / std[moved]
        values["lag/dynamics/all"] = lag(scaled[1], scaled[0])[0]
    return values


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
