"""Beliefs, evidence, and the trace of one filter step. All in standardised units, batched over N trajectories.

Steps are pure: ``step(belief, evidence, generator) -> (belief, StepTrace)``. Modules store no belief.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import repeat

import torch
from torch import Tensor

from beliefscope.filters.angles import NO_ANGLES, Angles


@dataclass(frozen=True)
class Gaussian:
    """mean (..., n), covariance (..., n, n). A bank of K unimodal filters has (N, K, n) and (N, K, n, n)."""

    mean: Tensor
    covariance: Tensor


@dataclass(frozen=True)
class Particles:
    """states (N, M, n), log_weights (N, M) normalised: logsumexp over M is 0."""

    states: Tensor
    log_weights: Tensor

    def moments(self, angles: Angles = NO_ANGLES) -> Gaussian:
        """Weighted mean (N, n) and covariance (N, n, n); angles: those of the state that wrap."""
        return moments(self.states, self.log_weights, angles)


@dataclass(frozen=True)
class Recurrent:
    """hidden (N, L, S, H): S vectors of each of L layers. mean (N, n): the estimate, without a covariance."""

    hidden: Tensor
    mean: Tensor


Belief = Gaussian | Particles | Recurrent


def moments(states: Tensor, log_weights: Tensor, angles: Angles = NO_ANGLES) -> Gaussian:
    """Mean (..., n) and covariance (..., n, n) of particles (..., M, n) with normalised log-weights (..., M).

    angles: components that wrap, whose mean is near their mean direction.
    """
    states = angles.centred(states, log_weights)
    weights = log_weights.exp().unsqueeze(-2)
    mean = weights @ states
    deviation = states - mean
    covariance = (weights.transpose(-1, -2) * deviation).transpose(-1, -2) @ deviation
    return Gaussian(angles.wrapped(mean.squeeze(-2)), covariance)


def reweighted(particles: Particles, log_likelihood: Tensor, angles: Angles = NO_ANGLES) -> Gaussian:
    """Moments (N, K, n), (N, K, n, n) of the particles updated with each of K log-likelihoods (N, K, M)."""
    log_weights = torch.log_softmax(particles.log_weights.unsqueeze(1) + log_likelihood, dim=-1)
    return moments(particles.states.unsqueeze(1), log_weights, angles)


@dataclass(frozen=True)
class Evidence:
    """Encoded observations and controls, computed once for all T x N before the time recursion.

    K is the number of measurement models, u the width of the networks. ``evidence[t]`` is step t,
    ``evidence[a:b]`` a range of steps.

    Attributes:
        control: (T, N, u) the controls' part of the dynamics model. Sequence models: the encoded controls.
        observation: EKF, UKF: (T, N, K, n) virtual observations z. PF: (T, N, K, u) observations' part of the
            likelihood. Sequence models: (T, N, 1, u) observations and controls, encoded and joined.
        noise: EKF, UKF: (T, N, K, n) standard deviations of z, the square root of R's diagonal. Others: None.
        log_weights: (T, N, K, W) log beta, W = n for weights per component, 1 for scalars; None without a weight model.
        present: (T, N, K) bool, which models' evidence is used; None for all. See ``select_models``.
    """

    control: Tensor
    observation: Tensor
    noise: Tensor | None
    log_weights: Tensor | None
    present: Tensor | None = None

    def __getitem__(self, index: int | slice) -> Evidence:
        return self._map(lambda tensor: tensor[index])

    def __iter__(self) -> Iterator[Evidence]:
        """The evidence of each step."""
        tensors = (self.control, self.observation, self.noise, self.log_weights, self.present)
        columns = (repeat(None) if tensor is None else tensor.unbind() for tensor in tensors)
        return (Evidence(*row) for row in zip(*columns, strict=False))

    def __len__(self) -> int:
        return len(self.control)

    def _map(self, function: Callable[[Tensor], Tensor]) -> Evidence:
        return Evidence(
            control=function(self.control),
            observation=function(self.observation),
            noise=None if self.noise is None else function(self.noise),
            log_weights=None if self.log_weights is None else function(self.log_weights),
            present=None if self.present is None else function(self.present),
        )

    def repeated(self, count: int) -> Evidence:
        """``count`` copies of the evidence of one trajectory."""
        return self._map(lambda tensor: tensor.expand(-1, count, *tensor.shape[2:]))

    def trajectory(self, i: int) -> Evidence:
        """The evidence of trajectory i, N = 1."""
        return self._map(lambda tensor: tensor[:, i : i + 1])

    def only(self, k: int) -> Evidence:
        """The same evidence with beta one-hot on measurement model k; unchanged without a weight model.

        For training. ``select_models`` excludes models of every filter.
        """
        if self.log_weights is None:
            return self
        log_weights = torch.full_like(self.log_weights, -torch.inf)
        log_weights[..., k, :] = 0.0
        return self.with_log_weights(log_weights)

    def with_log_weights(self, log_weights: Tensor) -> Evidence:
        """The same evidence with other log beta (T, N, K, W); absent models stay excluded."""
        evidence = replace(self, log_weights=log_weights)
        return evidence if self.present is None else evidence.select_models(self.present)

    def select_models(self, present: Tensor) -> Evidence:
        """The same evidence with only some of the models, as if the other sensors did not exist.

        EKF, UKF: an absent model does not update, and is excluded from the fusion. PF: its likelihood is excluded from
        the mixture. The other models' beta keeps its proportions; a model with beta zero counts as absent. If no model
        is present, the belief is only predicted. Models that are absent already stay absent.

        Args:
            present: (T, N, K) bool. If the evidence has N = 1, N may be any number: one trajectory per subset.
        """
        n = present.shape[1]
        present = present if self.present is None else present & self.present
        subset = replace(self.repeated(n), present=present)
        if subset.log_weights is None:
            return subset
        used = present & (subset.log_weights > -torch.inf).any(-1)
        absent = used.any(-1, keepdim=True) & ~used
        log_weights = subset.log_weights.masked_fill(absent.unsqueeze(-1), -torch.inf)
        return replace(subset, present=used, log_weights=log_weights)


@dataclass(frozen=True)
class StepTrace:
    """Intermediate results of one step that cannot be recomputed from the others.

    Attributes:
        predicted: belief after the prediction, before the update. EKF, UKF: bank (N, K, n); PF: particles with
            their prior weights; sequence models, which have no prediction: the belief before the step.
        posterior: fused belief after the observation and, for a PF, before resampling. EKF, UKF: Gaussian (N, n).
        estimate: Gaussian (N, n), (N, n, n): mean and covariance of the posterior, the filter's output. LSTM: the
            covariance is NaN.
        modality: EKF, UKF only: posterior of the bank's filters, each updated with one modality; Gaussian (N, K, n).
        log_likelihood: PF only: (N, K, M) of each predicted particle, unnormalised; 0 for models that are not used.
        ancestors: PF only: (N, M) int64, index of each resampled particle's ancestor.
    """

    predicted: Belief
    posterior: Belief
    estimate: Gaussian
    modality: Gaussian | None = None
    log_likelihood: Tensor | None = None
    ancestors: Tensor | None = None

    def updates(self, angles: Angles = NO_ANGLES) -> Gaussian | None:
        """Single-modality updates, Gaussian (N, K, n): the step's prior after the update with one modality only.

        The prior is that of the fused filter, which has used all modalities in earlier steps, so an update is more
        accurate than the standalone filter of its modality (``filters/subsets.py``). The two are equal only in a bank
        without feedback. PF: the predicted particles weighted by one likelihood; angles: those of the state that wrap.
        None without measurement models.
        """
        if self.modality is not None or self.log_likelihood is None:
            return self.modality
        assert isinstance(self.predicted, Particles)
        return reweighted(self.predicted, self.log_likelihood, angles)
