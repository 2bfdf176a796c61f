"""Stubs with the public interface of torchfilter."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

N_STATE = 3
Q = 0.05


class Walk(nn.Module):
    """Random walk dynamics."""

    def forward(self, *, initial_states: Tensor, controls: Tensor) -> tuple[Tensor, Tensor]:
        return initial_states, Q * torch.eye(N_STATE).expand(len(initial_states), -1, -1)


class Sensor(nn.Module):
    """Virtual sensor: a function of one observation and a Cholesky factor."""

    def __init__(self, key: str, size: int, noise: float, seed: int) -> None:
        super().__init__()
        self.key, self.noise = key, noise
        weight = torch.randn(N_STATE, size, generator=torch.Generator().manual_seed(seed))
        self.weight = nn.Parameter(0.3 * weight)

    def forward(self, *, observations: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        values = observations[self.key]
        return torch.tanh(values @ self.weight.T), self.noise * torch.eye(N_STATE).expand(len(values), -1, -1)


class VirtualSensorKalman(nn.Module):
    """Like ``torchfilter.filters.VirtualSensorExtendedKalmanFilter``."""

    def __init__(self, sensor: nn.Module) -> None:
        super().__init__()
        self.dynamics_model, self.virtual_sensor_model = Walk(), sensor

    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        self.belief_mean, self.belief_covariance = mean, covariance

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> Tensor:
        self.belief_mean, factor = self.dynamics_model(initial_states=self.belief_mean, controls=controls)
        self.belief_covariance = self.belief_covariance + factor @ factor.mT
        z, factor = self.virtual_sensor_model(observations=observations)
        gain = self.belief_covariance @ torch.linalg.inv(self.belief_covariance + factor @ factor.mT)
        self.belief_mean = self.belief_mean + (gain @ (z - self.belief_mean).unsqueeze(-1)).squeeze(-1)
        self.belief_covariance = self.belief_covariance - gain @ self.belief_covariance
        return self.belief_mean


class WeightsOfFilters(nn.Module):
    """Weights (K, N, n) by component."""

    def forward(self, *, observations: dict[str, Tensor]) -> Tensor:
        force = observations["force"].abs()
        return torch.stack([0.2 + force, 0.7 + 0.0 * force])


class CrossmodalKalman(nn.Module):
    """Weighted average of several Kalman filters."""

    def __init__(self, *filters: nn.Module) -> None:
        super().__init__()
        self.filter_models, self.crossmodal_weight_model = nn.ModuleList(filters), WeightsOfFilters()
        self.state_covariance_estimate: Tensor | None = None

    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        for filter_ in self.filter_models:
            filter_.initialize_beliefs(mean=mean, covariance=covariance)

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> Tensor:
        means = torch.stack([f(observations=observations, controls=controls) for f in self.filter_models])
        covariances = torch.stack([f.belief_covariance for f in self.filter_models])
        weights = self.crossmodal_weight_model(observations=observations)
        share = (weights / weights.sum(0)).unsqueeze(-1)
        self.state_covariance_estimate = (share * share.mT * covariances).sum(0)
        return (share.squeeze(-1) * means).sum(0)


class Likelihood(nn.Module):
    """Measurement model of particles: a Gaussian around the sensor output."""

    def __init__(self, sensor: nn.Module) -> None:
        super().__init__()
        self.sensor = sensor

    def forward(self, *, states: Tensor, observations: dict[str, Tensor]) -> Tensor:
        z, factor = self.sensor(observations=observations)
        return -0.5 * ((states - z.unsqueeze(1)) / factor[0, 0, 0]).square().sum(-1)


class WeightsOfLikelihoods(nn.Module):
    """Log weights (N, K), not normalised."""

    def forward(self, *, observations: dict[str, Tensor]) -> Tensor:
        return torch.cat([observations["contact"], 0.5 - observations["contact"]], dim=1)


class CrossmodalLikelihood(nn.Module):
    """Mixture of several measurement models."""

    def __init__(self, *models: nn.Module) -> None:
        super().__init__()
        self.measurement_models, self.crossmodal_weight_model = nn.ModuleList(models), WeightsOfLikelihoods()

    def forward(self, *, states: Tensor, observations: dict[str, Tensor]) -> Tensor:
        terms = torch.stack([model(states=states, observations=observations) for model in self.measurement_models], 2)
        return torch.logsumexp(self.crossmodal_weight_model(observations=observations).unsqueeze(1) + terms, dim=2)


class Particles(nn.Module):
    """Like ``torchfilter.filters.ParticleFilter``: resamples within the step, after the estimate."""

    def __init__(self, model: nn.Module, count: int = 80) -> None:
        super().__init__()
        self.dynamics_model, self.measurement_model, self.num_particles = Walk(), model, count
        self.at_end: Callable[[], None] = lambda: None

    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        samples = torch.distributions.MultivariateNormal(mean, covariance).sample((self.num_particles,))
        self.particle_states = samples.transpose(0, 1)
        self.particle_log_weights = torch.full(self.particle_states.shape[:2], -math.log(self.num_particles))

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> Tensor:
        count, particles, n = self.particle_states.shape
        flat = self.particle_states.reshape(-1, n)
        mean, factor = self.dynamics_model(initial_states=flat, controls=controls.repeat_interleave(particles, 0))
        noise = torch.distributions.MultivariateNormal(mean, scale_tril=factor)
        self.particle_states = noise.rsample().view(count, particles, n)
        fused = self.measurement_model(states=self.particle_states, observations=observations)
        self.particle_log_weights = torch.log_softmax(self.particle_log_weights + fused, dim=1)
        estimate = (self.particle_log_weights.exp().unsqueeze(-1) * self.particle_states).sum(1)
        index = torch.distributions.Categorical(logits=self.particle_log_weights).sample((particles,)).T
        self.particle_states = self.particle_states.gather(1, index.unsqueeze(-1).expand(-1, -1, n))
        self.particle_log_weights = torch.full_like(self.particle_log_weights, -math.log(particles))
        self.at_end()
        return estimate
