"""Particle filter with calibrated virtual sensors, whose likelihoods are multiplied."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from beliefscope.filters.belief import Belief, Evidence, Gaussian, Particles, StepTrace
from beliefscope.filters.models.fusion import powers
from beliefscope.filters.models.information import InformationFilter
from beliefscope.filters.models.pf import ParticleFilter

TINY = 1e-12
"""Lower limit of an inverse variance before its logarithm."""


class InformationParticleFilter(ParticleFilter, InformationFilter):
    """The model of ``InformationFilter`` with particles of the state: ``w_i = prod_k N(z_k; x_i + r_k mu_ik, V_k)``.

    It has the same modules, so it runs with the weights of a trained ``InformationFilter``. Given the path of a
    particle, the biases of the sensors are linear and Gaussian: each particle has their means mu and variances s
    (Rao-Blackwellised), and ``V_k = r_k^2 s_k + R_k / p_k``, r_k the noise that a sensor reports. A belief has states
    (N, M, n (1 + 2 K)): x, mu, s; traces contain x. With linear dynamics, process noise that does not depend on the
    motion, and many particles, the posterior is that of the Kalman filter.
    """

    def start(self, belief: Gaussian, particles: int, generator: torch.Generator) -> Particles:
        x = super().start(belief, particles, generator)
        mean, variance = torch.zeros_like(self.bias), self.bias.square()
        return Particles(_joined(x.states, mean.expand(*x.states.shape[:2], -1, -1), variance), x.log_weights)

    def step(self, belief: Belief, evidence: Evidence, generator: torch.Generator) -> tuple[Belief, StepTrace]:
        assert isinstance(belief, Particles)
        assert evidence.log_weights is not None
        x, mean, variance = self._parts(belief.states)
        x = self.propagate(x, evidence, generator)
        mean = self.phi * mean
        variance = self.phi.square() * variance + (1.0 - self.phi.square()) * self.bias.square()
        assert evidence.noise is not None
        size = evidence.noise.unsqueeze(1)  # of a bias of 1
        error = self._errors(evidence, x) - size * mean
        information = self._information(evidence, variance, powers(evidence.log_weights, evidence.present))
        fused = log_normal(error, information).sum(1)
        log_weights = torch.log_softmax(belief.log_weights + fused, dim=-1)
        gain = size * variance * information
        updated = _joined(x, mean + gain * error, variance * (1.0 - size * gain))
        resampled, ancestors = self.resample(Particles(updated, log_weights), generator)
        posterior = Particles(x, log_weights)
        return resampled, StepTrace(
            predicted=Particles(x, belief.log_weights),
            posterior=posterior,
            estimate=posterior.moments(self.angles),
            log_likelihood=log_normal(error, self._information(evidence, variance)),
            ancestors=ancestors,
        )

    def log_likelihood(self, evidence: Evidence, states: Tensor) -> Tensor:
        """Of each modality, for states (N, M, n) at one step, with the biases' stationary distribution: (N, K, M)."""
        return log_normal(self._errors(evidence, states), self._information(evidence, self.bias.square()))

    def _errors(self, evidence: Evidence, x: Tensor) -> Tensor:
        """(N, M, K, n): ``z_k - x``."""
        return self.angles.difference(evidence.observation.unsqueeze(1), x.unsqueeze(2))

    def _information(self, evidence: Evidence, variance: Tensor, power: Tensor | float = 1.0) -> Tensor:
        """``1 / (r_k^2 s_k + R_k / p_k)``, zero for components of observations that are not used; (N, M or 1, K, n).

        Args:
            variance: (..., K, n) s. power: (N, K, n) p.
        """
        assert evidence.noise is not None
        precision = (self.inverse_noise(evidence).square() * power).unsqueeze(1)
        return precision / (1.0 + precision * evidence.noise.square().unsqueeze(1) * variance)

    def _parts(self, states: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """x (N, M, n), and means and variances (N, M, K, n) of the biases."""
        x, biases = states.split([self.n, states.shape[-1] - self.n], dim=-1)
        mean, variance = biases.unflatten(-1, (2, len(self.names), self.n)).unbind(2)
        return x, mean, variance


def with_particles(filter_: InformationFilter) -> InformationParticleFilter:
    """The particle filter with the weights of an information filter."""
    result = InformationParticleFilter(replace(filter_.architecture, kind="pf"))
    result.load_state_dict(filter_.state_dict())
    return result


def _joined(x: Tensor, mean: Tensor, variance: Tensor) -> Tensor:
    """States of a belief, the inverse of ``_parts``."""
    return torch.cat([x, mean.flatten(2), variance.expand_as(mean).flatten(2)], dim=-1)


def log_normal(error: Tensor, information: Tensor) -> Tensor:
    """Log density (N, K, M) of errors (N, M, K, n) with inverse variances; components with inverse zero add zero."""
    log_scale = torch.where(information > 0.0, (information.clamp_min(TINY) / (2.0 * math.pi)).log(), 0.0)
    return 0.5 * (log_scale - information * error.square()).sum(-1).transpose(1, 2)
