"""Particle filters with learned likelihoods, fused as a mixture."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from functools import partial

import torch
from torch import Tensor, nn

from beliefscope.datasets.task import Task
from beliefscope.filters.angles import Angles
from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Belief, Evidence, Gaussian, Particles, StepTrace
from beliefscope.filters.filter import Architecture, Filter, encoders
from beliefscope.filters.models import common_random_numbers
from beliefscope.filters.models.dynamics import Dynamics
from beliefscope.filters.models.fusion import mixture, only_present
from beliefscope.filters.models.networks import Residual, Stack, in_chunks, linear, vector_stack
from beliefscope.filters.models.resampling import resample
from beliefscope.filters.models.weight_model import WeightModel


class MeasurementModel(nn.Module):
    """log p(observation | state) up to a constant, from observations and the state of each particle.

    The first joint layer is split into two summands: ``observation_part`` is computed once per step, ``state_part``
    once per particle, and ``log_likelihood`` takes their sum.
    """

    def __init__(self, task: Task, model: str, architecture: Architecture) -> None:
        super().__init__()
        units = architecture.units
        self.encoders = encoders(task, model.split("+"), architecture)
        self.join_observation = nn.Linear(self.encoders.size, units)
        self.angles = Angles.from_task(task)
        self.state_encoder = vector_stack(len(task.components) + len(self.angles.indices), units)
        self.join_state = nn.Linear(units, units, bias=False)
        residuals = (Residual(units) for _ in range(2 if architecture.networks == "authors" else 1))
        self.head = Stack(nn.ReLU(inplace=True), *residuals, nn.Linear(units, 1))

    def observation_part(self, observations: Mapping[str, Tensor]) -> Tensor:
        """(T, N, units)."""
        part: Tensor = self.join_observation(self.encoders(observations))
        return part

    def state_part(self, states: Tensor) -> Tensor:
        """States (..., n), standardised, to (..., units)."""
        return linear(self.join_state, self.state_encoder(self.angles.features(states)))

    def log_likelihood(self, observation_part: Tensor, state_part: Tensor) -> Tensor:
        """Two broadcastable parts (..., units) to (...)."""
        value: Tensor = self.head(observation_part + state_part)
        return value.squeeze(-1)


class ParticleFilter(Filter):
    """Sampling importance resampling, resampled at every step. Subclasses have the likelihoods and their fusion."""

    @abstractmethod
    def log_likelihood(self, evidence: Evidence, states: Tensor) -> Tensor:
        """Of each modality, for particles (N, M, n) at one step: (N, K, M), unnormalised."""

    def start(self, belief: Gaussian, particles: int, generator: torch.Generator) -> Particles:
        factor = torch.linalg.cholesky(belief.covariance)
        shape = (len(belief.mean), particles, self.n)
        unit = common_random_numbers.normal(shape, generator)
        states = belief.mean.unsqueeze(1) + unit @ factor.transpose(-1, -2)
        return Particles(states, torch.full(shape[:2], -math.log(particles), device=states.device))

    def propagate(self, states: Tensor, evidence: Evidence, generator: torch.Generator) -> Tensor:
        """States (N, M, n) of the next step, with process noise."""
        control = evidence.control.unsqueeze(1)
        moved = in_chunks(lambda states: self.dynamics(states, control), states)
        noise = common_random_numbers.normal(moved.shape, generator) * self.process_noise(moved - states)
        return self.angles.wrapped(moved + noise)

    def resample(self, particles: Particles, generator: torch.Generator) -> tuple[Particles, Tensor]:
        """Resampled particles and their ancestors (N, M)."""
        rule, share = self.architecture.resampling, self.architecture.soft_share
        ancestors, log_weights = resample(particles.log_weights, rule, share, generator)
        states = particles.states.gather(1, ancestors.unsqueeze(-1).expand_as(particles.states))
        return Particles(states, log_weights), ancestors


class MixtureParticleFilter(ParticleFilter):
    """Learned likelihoods, ``w_i = sum_k beta_k p_k(z | x_i) / s_k``.

    The scale s_k is each model's evidence, or 1 (``architecture.likelihoods``).
    """

    def __init__(self, architecture: Architecture) -> None:
        super().__init__(architecture)
        self.dynamics = Dynamics(self.n, self.task.control_size, architecture.units, self.angles)
        self.measurement_models = nn.ModuleDict({m: MeasurementModel(self.task, m, architecture) for m in self.names})
        if architecture.fusion == "crossmodal":
            self.weight_model = WeightModel(self.task, architecture, 1)

    def measurement_model(self, name: str) -> MeasurementModel:
        """The model of one modality."""
        model = self.measurement_models[name]
        assert isinstance(model, MeasurementModel)
        return model

    def encode(self, batch: Batch) -> Evidence:
        observations = self.observations(batch)
        parts = [self.measurement_model(m).observation_part(observations) for m in self.names]
        evidence = Evidence(
            control=self.dynamics.control_part(self.statistics.standardise("control", batch.controls)),
            observation=torch.stack(parts, dim=2),
            noise=None,
            log_weights=self.log_weights(observations),
        )
        return self.with_readings(evidence, batch)

    def log_likelihood(self, evidence: Evidence, states: Tensor) -> Tensor:
        def model_likelihood(k: int, states: Tensor) -> Tensor:
            model = self.measurement_model(self.names[k])
            return model.log_likelihood(evidence.observation[:, k, None], model.state_part(states))

        return torch.stack([in_chunks(partial(model_likelihood, k), states) for k in range(len(self.names))], dim=1)

    def scale(self, log_weights: Tensor, log_likelihood: Tensor) -> Tensor:
        """(N, K, 1) log scale subtracted from each model's log-likelihoods (N, K, M) before the fusion.

        Normalised: the evidence ``log sum_i w_i p_k(z | x_i)`` with the particles' prior log-weights (N, M). Raw: zero.
        """
        if self.architecture.likelihoods == "raw":
            return torch.zeros_like(log_likelihood[..., :1])
        return torch.logsumexp(log_weights.unsqueeze(1) + log_likelihood, dim=-1, keepdim=True)

    def step(self, belief: Belief, evidence: Evidence, generator: torch.Generator) -> tuple[Belief, StepTrace]:
        assert isinstance(belief, Particles)
        predicted = Particles(self.propagate(belief.states, evidence, generator), belief.log_weights)
        log_likelihood = self.log_likelihood(evidence, predicted.states)
        if evidence.present is not None:  # the update of an absent model is the prediction
            log_likelihood = log_likelihood.masked_fill(~evidence.present.unsqueeze(-1), 0.0)
        scaled = log_likelihood - self.scale(predicted.log_weights, log_likelihood)
        if evidence.present is not None:
            scaled = only_present(scaled, evidence.present)
        log_weights = predicted.log_weights + mixture(scaled, evidence.log_weights)
        posterior = Particles(predicted.states, torch.log_softmax(log_weights, dim=-1))
        resampled, ancestors = self.resample(posterior, generator)
        return resampled, StepTrace(
            predicted=predicted,
            posterior=posterior,
            estimate=posterior.moments(self.angles),
            log_likelihood=log_likelihood,
            ancestors=ancestors,
        )
