"""Beliefs and what one step of a filter knew. All in standardised units, batched over N trajectories.

Steps are pure: ``step(belief, control, evidence, generator) -> (belief, StepTrace)``. No belief is kept on a module.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor


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


Belief = Gaussian | Particles


@dataclass(frozen=True)
class StepTrace:
    """Everything one step knew. K modalities in the filter's order; W is n for weights per component, 1 for scalars.

    Attributes:
        predicted: belief after the dynamics and before the observation (EKF bank: (N, K, n); PF: particles with their
            prior weights).
        posterior: fused belief after the observation and, for a PF, before resampling: Gaussian (N, n) or Particles.
        estimate: Gaussian (N, n), (N, n, n): posterior mean and covariance; what is reported as the estimate.
        modality: Gaussian (N, K, n), (N, K, n, n): what each modality alone believes after this step (EKF: its own
            filter's posterior; PF: the predicted particles weighted by its likelihood alone).
        observation: EKF only: the virtual sensors' z and R, Gaussian (N, K, n).
        log_likelihood: PF only: modality -> (N, M), of each predicted particle, not normalised.
        weights: (N, K, W) beta as the weight model gave it, or None where a filter has none.
        acting: (N, K, W) share of each modality in the fused result as it acted; sums to one over K. EKF: beta / sum of
            betas; PF: sum over particles of prior weight x beta x likelihood of that modality, over that of all.
        ancestors: PF only: (N, M) int64 index of the particle each resampled one came from.
    """

    predicted: Belief
    posterior: Belief
    estimate: Gaussian
    modality: Gaussian
    observation: Gaussian | None
    log_likelihood: Mapping[str, Tensor] | None
    weights: Tensor | None
    acting: Tensor | None
    ancestors: Tensor | None
