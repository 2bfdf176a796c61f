"""Loss functions of the training stages, of a filter and a batch of training windows, in standardised units."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Evidence, Gaussian
from beliefscope.filters.filter import Filter
from beliefscope.filters.models.information import InformationFilter
from beliefscope.filters.models.pf import MeasurementModel
from beliefscope.filters.rollout import START_VARIANCE, first_belief, rollout


def true_states(filter_: Filter, batch: Batch) -> Tensor:
    """(T, N, n), standardised."""
    return filter_.statistics.standardise("state", batch.states)


def errors(filter_: Filter, states: Tensor, batch: Batch) -> Tensor:
    """(T, N, n) standardised states minus the true ones, wrapping angles from -pi to pi."""
    return filter_.angles.difference(states, true_states(filter_, batch))


def prediction(filter_: Filter, batch: Batch) -> Tensor:
    """Mean squared error of the dynamics model, 1 to T steps ahead from the true state: a standardised scalar."""
    control = filter_.dynamics.control_part(filter_.statistics.standardise("control", batch.controls))
    target, total = true_states(filter_, batch), torch.zeros((), device=batch.states.device)
    x = filter_.statistics.standardise("state", batch.previous)
    for t in range(len(batch)):
        x = filter_.dynamics(x, control[t])
        total = total + filter_.angles.difference(x, target[t]).square().mean()
    return total / len(batch)


NOISE_FACTORS = tuple(10 ** (i / 10) for i in range(11))
"""Factors on a sensor's noise. Validation takes the best one, since calibration fits one afterwards.

Otherwise, of few training episodes, it would prefer the untrained sensor to an accurate one that is overconfident.
"""


def sensor_likelihood(filter_: InformationFilter, name: str, batch: Batch, factors: Sequence[float] = (1.0,)) -> Tensor:
    """Mean negative log-likelihood of the true state under the product of the prior N(0, I) and N(x; z, f^2 R).

    The product with the training distribution's prior makes N(x; z, R) a likelihood, which a filter may multiply at
    every step. Trained as a posterior, a sensor would repeat the prior: even a black image would carry information.
    The prior of angles that wrap is uniform.

    Args:
        factors: the result is the smallest of these f.
    """
    z, noise = filter_.sense(name, filter_.observations(batch))
    truth, values = true_states(filter_, batch), []
    prior = torch.ones(filter_.n, device=z.device)  # its inverse variance
    prior[list(filter_.angles.indices)] = 0.0
    for factor in factors:
        square = (factor * noise).square()
        shrinkage = 1.0 + prior * square
        variance = square / shrinkage
        error = filter_.angles.difference(z / shrinkage, truth)
        values.append(with_readings(filter_, name, batch, error.square() / variance + variance.log()).mean())
    return 0.5 * torch.stack(values).amin()


def with_readings(filter_: Filter, name: str, batch: Batch, values: Tensor) -> Tensor:
    """Values (T, N, ...) at the steps with a reading of a measurement model's sensors; all of them without any."""
    at = filter_.has_reading(batch, name.split("+"))
    return values if at.all() or not at.any() else values[at]


def likelihood(filter_: Filter, model: MeasurementModel, batch: Batch, noise: torch.Generator) -> Tensor:
    """Loss of a measurement model: ``log_density`` for steps with a visible image, ``contrast`` for all others."""
    modalities = list(model.encoders.by_modality)

    def used(values: Tensor) -> Tensor:
        return with_readings(filter_, "+".join(modalities), batch, values).reshape(-1, *values.shape[2:])

    part, truth = used(model.observation_part(filter_.observations(batch))), used(true_states(filter_, batch))
    visible = used(image_visible(batch, modalities))
    total = torch.zeros((), device=truth.device)
    if bool(visible.any()):
        total = total + visible.float().mean() * log_density(model, part[visible], truth[visible], noise)
    if not bool(visible.all()):
        total = total + (~visible).float().mean() * contrast(model, part[~visible], truth[~visible])
    return total


def image_visible(batch: Batch, modalities: Iterable[str]) -> Tensor:
    """(T, N) bool: whether one of these modalities is an image that is not blacked out."""
    visible = torch.zeros(batch.states.shape[:2], dtype=torch.bool, device=batch.states.device)
    for modality in modalities:
        values = batch.observations[modality]
        if values.dtype == torch.int64:
            visible = visible | (values >= 0)
        elif values.dtype == torch.uint8:
            visible = visible | (values.amax((-2, -1)) > 0)
    return visible


def log_density(model: MeasurementModel, part: Tensor, truth: Tensor, noise: torch.Generator) -> Tensor:
    """Regression of the Gaussian log density around the true state (B, n), covariance 0.1 I, as in the paper.

    Half of the 20 states per step are drawn from that Gaussian, half from a unit Gaussian, so that the likelihood is
    also accurate far from the true state, where maps show it. The constant is omitted; targets are clamped at -10.
    """
    scale = torch.ones(20, 1, device=truth.device)
    scale[:10] = START_VARIANCE**0.5
    offset = scale * torch.randn((len(truth), 20, truth.shape[-1]), generator=noise, device=truth.device)
    target = (-0.5 * offset.square().sum(-1) / START_VARIANCE).clamp_min(-10.0)
    value = model.log_likelihood(part.unsqueeze(1), model.state_part(truth.unsqueeze(1) + offset))
    return nn.functional.smooth_l1_loss(value, target)


def contrast(model: MeasurementModel, part: Tensor, states: Tensor) -> Tensor:
    """Contrastive loss: which of the states (B, n) belongs to an observation? Optimum: log p(z | x) / p(z) + c(z).

    Regression of the expected log density does not yield a likelihood where an observation carries little information:
    it has a bump where the training states end. This loss is flat there. The second term fixes c(z) at 0.
    """
    value = model.log_likelihood(part.unsqueeze(1), model.state_part(states))
    evidence = torch.logsumexp(value, dim=1) - math.log(len(value))
    return (evidence - value.diagonal()).mean() + 0.01 * evidence.square().mean()


def through_filter(
    filter_: Filter,
    evidence: Evidence,
    batch: Batch,
    noise: torch.Generator,
    particles: int,
    likelihood_weight: float,
    weight: Tensor | None = None,
) -> Tensor:
    """End-to-end loss over T steps: squared error and, if there is a covariance, negative log-likelihood.

    Args:
        noise: generator of the first belief and of the filter's own samples.
        weight: (T, N) of each step of each trajectory, sum 1; uniform if None.
    """
    start = perturbed(first_belief(filter_, batch), noise)
    estimate = rollout(filter_, evidence, start, noise, particles).estimate
    error = errors(filter_, estimate.mean, batch)
    total = averaged(error.square().sum(-1), weight)
    if not filter_.has_covariance:
        return total
    return total + likelihood_weight * averaged(negative_log_likelihood(error, estimate.covariance), weight)


def averaged(values: Tensor, weight: Tensor | None) -> Tensor:
    """The mean of (T, N), or the weighted sum."""
    return values.mean() if weight is None else (weight * values).sum()


def perturbed(start: Gaussian, noise: torch.Generator) -> Gaussian:
    """The first belief with its mean drawn from its own distribution, so that the filter learns to recover."""
    unit = torch.randn(start.mean.shape, generator=noise, device=start.mean.device)
    return replace(start, mean=start.mean + start.covariance.diagonal(dim1=-2, dim2=-1).sqrt() * unit)


def negative_log_likelihood(error: Tensor, covariance: Tensor) -> Tensor:
    """``0.5 (e^T S^-1 e + log det S)``, without the constant: (..., n), (..., n, n) to (...).

    A floor of 1e-4 on the diagonal bounds the gradient of a collapsed particle set.
    """
    covariance = covariance + 1e-4 * torch.eye(error.shape[-1], device=error.device)
    factor = torch.linalg.cholesky(covariance)
    white = torch.linalg.solve_triangular(factor, error.unsqueeze(-1), upper=False).squeeze(-1)
    log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return 0.5 * white.square().sum(-1) + log_det
