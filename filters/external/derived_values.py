"""Moments of particles and posteriors of single models, from the values that an external filter returns."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from beliefscope.datasets import rotations
from beliefscope.datasets.task import Task
from beliefscope.filters.angles import Angles
from beliefscope.filters.belief import Gaussian, moments
from beliefscope.filters.external.adapter import Values

BLOCK = 300_000
"""Numbers of particles that are processed together: intermediate results fit the caches, and no memory is fresh."""


def _blocks(particles: Tensor, *values: Tensor) -> Iterator[tuple[Tensor, ...]]:
    """Blocks of steps of several values (T, ...)."""
    rows = max(1, BLOCK // max(1, particles[0].numel()))
    return zip(*(value.split(rows) for value in values), strict=True)


def _posterior_is_of_one_model(values: Values) -> bool:
    """Whether the posterior weights are the prior ones times the likelihood of the only model, bit for bit."""
    if values["log_likelihood"].shape[-2] != 1:
        return False
    names = ("log_weights", "prior_log_weights", "log_likelihood")
    blocks = _blocks(values["particles"], *(values[name] for name in names))
    return all(torch.equal(posterior, prior + likelihood.squeeze(-2)) for posterior, prior, likelihood in blocks)


def _moments(task: Task, particles: Tensor, log_weights: Tensor) -> Gaussian:
    """Mean and covariance as ``moments``; of angles across half a turn and of rotations, those of the differences."""
    blocks = _blocks(particles, particles, log_weights)
    parts = [_turned(task, moments(states, weights), states, weights) for states, weights in blocks]
    linear = Gaussian(torch.cat([part.mean for part in parts]), torch.cat([part.covariance for part in parts]))
    if not task.rotations:
        return linear
    states, weights, mean = particles.double().numpy(), log_weights.double().exp().numpy(), linear.mean.numpy().copy()
    for where in task.rotations:
        mean[..., where] = rotations.mean(states[..., where], weights)
    deviation = task.difference(states, mean[..., None, :])
    covariance = np.einsum("...m,...mi,...mj->...ij", weights, deviation, deviation)
    return Gaussian(torch.from_numpy(mean).to(particles.dtype), torch.from_numpy(covariance).to(particles.dtype))


def _turned(task: Task, linear: Gaussian, particles: Tensor, log_weights: Tensor) -> Gaussian:
    """Moments in which angles on both sides of half a turn are close; those of all other particles are unchanged.

    Deviations are differences from the particle of the largest weight, wrapped to -pi..pi.
    """
    angles = [i for i in task.angles if not task.components[i].rotation]
    distances = particles[..., angles] - linear.mean[..., angles].unsqueeze(-2)
    apart = (distances.abs() > torch.pi).any(-1).any(-1)
    if not apart.any():
        return linear
    states = particles.expand(*log_weights.shape, particles.shape[-1])[apart].double()
    weights = log_weights[apart].double().exp().unsqueeze(-1)
    best = states.gather(1, weights.argmax(1, keepdim=True).expand(-1, -1, states.shape[-1]))
    mean = best + (weights * Angles(tuple(angles)).wrapped(states - best)).sum(1, keepdim=True)
    deviation = Angles(tuple(angles)).wrapped(states - mean)
    linear.mean[apart] = mean.squeeze(1).to(linear.mean.dtype)
    linear.covariance[apart] = ((weights * deviation).mT @ deviation).to(linear.covariance.dtype)
    return linear


def derived(values: Values, task: Task) -> Values:
    """Adds derived values: moments of the particles, and each measurement model's own posterior.

    Normalises the logarithms of weights in place. The effective weight of a single measurement model is always one, and
    removed.
    """
    if "effective_weights" in values and values["effective_weights"].shape[-2] < 2:
        values = {name: value for name, value in values.items() if name != "effective_weights"}
    particles = values.get("particles")
    if particles is None:
        return values
    has_likelihood = {"log_likelihood", "prior_log_weights"} <= values.keys()
    is_of_one_model = has_likelihood and _posterior_is_of_one_model(values)
    for name in ("log_weights", "prior_log_weights"):
        for (weights,) in _blocks(particles, values[name]) if name in values else ():
            weights.copy_(torch.log_softmax(weights, dim=-1))
    posterior = (
        _moments(task, particles, values["log_weights"])
        if is_of_one_model or "estimate_covariance" not in values
        else None
    )
    if posterior is not None:
        values.setdefault("estimate_covariance", posterior.covariance)
    if posterior is not None and is_of_one_model:
        values.setdefault("modality_mean", posterior.mean.unsqueeze(-2))
        values.setdefault("modality_covariance", posterior.covariance.unsqueeze(-3))
    elif has_likelihood and "modality_mean" not in values:
        log_weights = torch.log_softmax(values["prior_log_weights"].unsqueeze(-2) + values["log_likelihood"], dim=-1)
        posterior = _moments(task, particles.unsqueeze(-3), log_weights)
        values["modality_mean"], values["modality_covariance"] = posterior.mean, posterior.covariance
    return values
