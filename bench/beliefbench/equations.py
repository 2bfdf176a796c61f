"""Subclasses of filters with faulty equations. They are mixed into the class of a filter (``with_equations``)."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from beliefscope.filters.belief import Belief, Evidence, Gaussian, Particles, StepTrace
from beliefscope.filters.filter import Filter
from beliefscope.filters.models import common_random_numbers
from beliefscope.filters.models.fusion import product_of_experts
from beliefscope.filters.models.resampling import select_by_weight, systematic, uniform


class FaultyFilter(Filter):
    """magnitude: of the fault."""

    magnitude: float


class ReportedCovariance(FaultyFilter):
    """The covariance of the estimate is scaled; the recursion is not affected."""

    def step(self, belief: Belief, evidence: Evidence, generator: torch.Generator) -> tuple[Belief, StepTrace]:
        belief, trace = super().step(belief, evidence, generator)
        estimate = Gaussian(trace.estimate.mean, self.magnitude * trace.estimate.covariance)
        return belief, replace(trace, estimate=estimate)


class SharedPrior(FaultyFilter):
    """The posteriors of the bank, which share one prior, are multiplied: the prior counts once for each of them."""

    def fuse(self, bank: Gaussian, log_weights: Tensor | None, present: Tensor | None = None) -> Gaussian:
        return product_of_experts(bank, present)

    def step(self, belief: Belief, evidence: Evidence, generator: torch.Generator) -> tuple[Belief, StepTrace]:
        _, trace = super().step(belief, evidence, generator)
        return self.bank_of(trace.posterior), trace


class MiscalibratedFusion(FaultyFilter):
    """Kalman filters: the fused covariance is scaled in the recursion.

    PF: the fused likelihood is raised to the power 1 / scale.
    """

    def fuse(self, bank: Gaussian, log_weights: Tensor | None, present: Tensor | None = None) -> Gaussian:
        fused = super().fuse(bank, log_weights, present)
        return Gaussian(fused.mean, self.magnitude * fused.covariance)

    def step(self, belief: Belief, evidence: Evidence, generator: torch.Generator) -> tuple[Belief, StepTrace]:
        new, trace = super().step(belief, evidence, generator)
        if not isinstance(trace.posterior, Particles):
            return new, trace
        prior = trace.predicted.log_weights
        log_weights = torch.log_softmax(prior + (trace.posterior.log_weights - prior) / self.magnitude, dim=-1)
        posterior = Particles(trace.posterior.states, log_weights)
        return resampled(replace(trace, posterior=posterior), systematic(log_weights, generator))


class NoResampling(FaultyFilter):
    """Every particle is its own successor and keeps its weight."""

    def step(self, belief: Belief, evidence: Evidence, generator: torch.Generator) -> tuple[Belief, StepTrace]:
        _, trace = super().step(belief, evidence, generator)
        ancestors = torch.arange(trace.ancestors.shape[1]).expand_as(trace.ancestors)
        return trace.posterior, replace(trace, ancestors=ancestors)


class BiasedResampling(FaultyFilter):
    """Ancestors are sampled with the weights to the power ``magnitude``, and all weights become equal."""

    def step(self, belief: Belief, evidence: Evidence, generator: torch.Generator) -> tuple[Belief, StepTrace]:
        _, trace = super().step(belief, evidence, generator)
        proposal = torch.log_softmax(self.magnitude * trace.posterior.log_weights, dim=-1)
        return resampled(trace, systematic(proposal, generator))


class FewAncestors(FaultyFilter):
    """``magnitude`` ancestors are sampled with the weights; each is copied equally often."""

    def step(self, belief: Belief, evidence: Evidence, generator: torch.Generator) -> tuple[Belief, StepTrace]:
        _, trace = super().step(belief, evidence, generator)
        log_weights, count = trace.posterior.log_weights, int(self.magnitude)
        offset = common_random_numbers.uniform((len(log_weights), 1), generator)
        chosen = select_by_weight(log_weights, (torch.arange(count) + offset) / count)
        copies = -(-log_weights.shape[1] // count)
        return resampled(trace, chosen.repeat_interleave(copies, dim=1)[:, : log_weights.shape[1]])


def resampled(trace: StepTrace, ancestors: Tensor) -> tuple[Particles, StepTrace]:
    """The belief after resampling with these ancestors (N, M), and the trace with them."""
    posterior = trace.posterior
    states = posterior.states.gather(1, ancestors.unsqueeze(-1).expand_as(posterior.states))
    estimate = posterior.moments()
    return Particles(states, uniform(posterior.log_weights)), replace(trace, ancestors=ancestors, estimate=estimate)
