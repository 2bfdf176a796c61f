"""Extended Kalman filters with learned virtual sensors, one per measurement model, and their fusion."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from dataclasses import replace

import torch
from torch import Tensor, nn

from beliefscope.datasets.task import Task
from beliefscope.filters.angles import Angles
from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Belief, Evidence, Gaussian, StepTrace
from beliefscope.filters.filter import WEIGHTED, Architecture, Filter, encoders
from beliefscope.filters.models.dynamics import Dynamics
from beliefscope.filters.models.ekf_numpy import SingleTrajectory, is_usual
from beliefscope.filters.models.fusion import in_one_turn, product_of_experts, symmetric, weighted_average
from beliefscope.filters.models.networks import Residual, Stack
from beliefscope.filters.models.weight_model import WeightModel


def predict(belief: Gaussian, mean: Tensor, jacobian: Tensor, noise: Tensor) -> Gaussian:
    """Prediction: ``m' = f(m, u)``, ``S' = A S A^T + Q`` (Lee et al., eq. 5, 6).

    Args:
        mean: (..., n) f at the old mean. jacobian: (..., n, n) A. noise: (n,) square root of Q's diagonal.
    """
    covariance = jacobian @ belief.covariance @ jacobian.transpose(-1, -2) + torch.diag_embed(noise**2)
    return Gaussian(mean, symmetric(covariance))


def update(belief: Gaussian, observation: Tensor, noise: Tensor) -> Gaussian:
    """Update with an observation of the whole state, H = I: ``K = S (S + R)^-1`` (Lee et al., eq. 7-9).

    The covariance ``(I - K) S`` is computed as ``K R``, which is equal and has no difference that would lose precision.

    Args:
        observation: (..., n) z. noise: (..., n) square root of R's diagonal.
    """
    r = noise.square()
    # K^T = (S + R)^-1 S, since S and R are symmetric.
    gain = torch.linalg.solve(belief.covariance + torch.diag_embed(r), belief.covariance).mT
    mean = belief.mean + (gain @ (observation - belief.mean).unsqueeze(-1)).squeeze(-1)
    return Gaussian(mean, symmetric(gain * r.unsqueeze(-2)))


def shared(belief: Gaussian) -> Gaussian:
    """A belief (N, n) as one that all filters of a bank have in common, (N, 1, n)."""
    return Gaussian(belief.mean.unsqueeze(1), belief.covariance.unsqueeze(1))


class VirtualSensor(nn.Module):
    """Virtual observation of the state with its standard deviations, from the observations of one measurement model.

    With ``authors`` networks, each output has its own half of the trunk's features and a first layer of n units.
    """

    def __init__(self, task: Task, model: str, architecture: Architecture, steps: int = 1, extra: int = 0) -> None:
        """steps: number of steps whose vectors are joined. extra: number of further inputs."""
        super().__init__()
        self.angles, n, units = Angles.from_task(task), len(task.components), architecture.units
        read = n + len(self.angles.indices)  # sines and cosines
        self.encoders = encoders(task, model.split("+"), architecture, steps, extra)
        self.state: nn.Module
        self.log_noise: nn.Sequential
        self.halves = architecture.networks == "authors"
        if self.halves:
            width = 2 * units
            first = (nn.Linear(self.encoders.size, width), nn.ReLU(inplace=True))
            self.trunk = Stack(*first, Residual(width), Residual(width))
            self.state, self.log_noise = (
                Stack(nn.Linear(units, d), nn.ReLU(inplace=True), Residual(d), nn.Linear(d, d)) for d in (read, n)
            )
        else:
            self.trunk = Stack(nn.Linear(self.encoders.size, units), nn.ReLU(inplace=True), Residual(units))
            self.state = nn.Linear(units, read)
            self.log_noise = nn.Sequential(nn.Linear(units, units), nn.ReLU(), nn.Linear(units, n))

    def forward(self, observations: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """z (T, N, n) and the square root of R's diagonal (T, N, n)."""
        features = self.trunk(self.encoders(observations))
        first, second = features.chunk(2, dim=-1) if self.halves else (features, features)
        return self.angles.states(self.state(first)), self.log_noise(second).clamp(-5.0, 3.0).exp()


class ExtendedKalmanFilter(Filter):
    """A bank of K unimodal EKFs that share the dynamics model, fused after every step.

    The belief passed between steps is the bank, Gaussian (N, K, n): the unimodal filters stay independent, as in
    the paper's text, unless ``architecture.feedback`` replaces each belief by the fused one. A belief that all filters
    have in common is (N, 1, n), and predicted once.

    Attributes:
        single: only in the copy that executes ``steps`` of one trajectory.
    """

    single: SingleTrajectory | None = None

    def __init__(self, architecture: Architecture) -> None:
        super().__init__(architecture)
        self.dynamics = Dynamics(self.n, self.task.control_size, architecture.units, self.angles)
        self.virtual_sensors = nn.ModuleDict({m: VirtualSensor(self.task, m, architecture) for m in self.names})
        if architecture.fusion in WEIGHTED:
            self.weight_model = WeightModel(self.task, architecture, self.n)

    def sense(self, name: str, observations: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """z and the square root of R's diagonal of one virtual sensor, (T, N, n), standardised.

        Args:
            observations: standardised, of consecutive steps.
        """
        z, noise = self.virtual_sensors[name](observations)
        return z, noise

    def sees_past(self, name: str) -> bool:
        """Whether a virtual sensor also sees earlier steps."""
        return False

    def encode(self, batch: Batch) -> Evidence:
        return self.encode_after(batch, 0)

    def encode_after(self, batch: Batch, lead: int) -> Evidence:
        observations, count = self.observations(batch), len(batch) - lead
        recent = {name: values[lead:] for name, values in observations.items()}
        sensed = (self.sense(name, observations if self.sees_past(name) else recent) for name in self.names)
        z, noise = zip(*sensed, strict=True)
        evidence = Evidence(
            control=self.dynamics.control_part(self.statistics.standardise("control", batch.controls[lead:])),
            observation=torch.stack([values[-count:] for values in z], dim=2),
            noise=torch.stack([values[-count:] for values in noise], dim=2),
            log_weights=self.log_weights(recent),
        )
        return self.with_readings(evidence, batch)

    def start(self, belief: Gaussian, particles: int, generator: torch.Generator) -> Belief:
        return shared(belief)

    def steps(
        self, belief: Belief, evidence: Evidence, generator: torch.Generator
    ) -> Iterator[tuple[Belief, StepTrace]]:
        filter_ = copy.copy(self)  # shares the weights, which are looked up once
        object.__setattr__(filter_, "single", self.single_trajectory(evidence.control))
        return super(ExtendedKalmanFilter, filter_).steps(belief, evidence, generator)

    def single_trajectory(self, control: Tensor) -> SingleTrajectory | None:
        """None unless N is 1 on a CPU without gradients, and for other equations.

        control: (..., N, u), its part of the dynamics model.
        """
        if control.shape[-2] > 1 or not control.is_cpu or torch.is_grad_enabled():
            return None
        usual = type(self).predict is ExtendedKalmanFilter.predict and is_usual(self.dynamics)
        return SingleTrajectory(self.dynamics) if usual else None

    def step(self, belief: Belief, evidence: Evidence, generator: torch.Generator) -> tuple[Belief, StepTrace]:
        predicted, bank = self.predict_and_update(belief, evidence)
        fused = self.wrapped(self.fuse(bank, evidence.log_weights, evidence.present))
        trace = StepTrace(predicted=predicted, posterior=fused, estimate=fused, modality=bank)
        return (shared(fused) if self.architecture.feedback else bank), trace

    def predict_and_update(self, belief: Belief, evidence: Evidence) -> tuple[Gaussian, Gaussian]:
        """The predicted bank, and the bank after the update of each filter with its own observation, (N, K, n)."""
        assert isinstance(belief, Gaussian)
        assert evidence.noise is not None
        if belief.mean.shape[1] == 1 and (single := self.single or self.single_trajectory(evidence.control)):
            return single.predict_and_update(belief, evidence)
        predicted = self.predict(belief, evidence.control.unsqueeze(1))
        bank = update(predicted, self.angles.near(evidence.observation, predicted.mean), evidence.noise)
        predicted, bank = self.wrapped(predicted), self.wrapped(bank)
        predicted = Gaussian(predicted.mean.expand_as(bank.mean), predicted.covariance.expand_as(bank.covariance))
        if evidence.present is not None:
            present = evidence.present.unsqueeze(-1)
            mean = torch.where(present, bank.mean, predicted.mean)
            bank = Gaussian(mean, torch.where(present.unsqueeze(-1), bank.covariance, predicted.covariance))
        return predicted, bank

    def wrapped(self, belief: Gaussian) -> Gaussian:
        """The belief with the angles of its mean from -pi to pi."""
        return replace(belief, mean=self.angles.wrapped(belief.mean)) if self.angles.indices else belief

    def bank_of(self, belief: Gaussian) -> Gaussian:
        """K copies (N, K, n) of a belief (N, n)."""
        k = len(self.names)
        mean = belief.mean.unsqueeze(1).expand(-1, k, -1)
        return Gaussian(mean, belief.covariance.unsqueeze(1).expand(-1, k, -1, -1))

    def virtual_observations(self, evidence: Evidence) -> Gaussian:
        """z and R of all virtual sensors, (T, N, K, n)."""
        assert evidence.noise is not None
        return Gaussian(evidence.observation, torch.diag_embed(evidence.noise**2))

    def shares(self, evidence: Evidence) -> Tensor:
        """Effective weights of a filter with beta, (T, N, K, n)."""
        assert evidence.log_weights is not None
        return torch.softmax(evidence.log_weights, dim=-2)

    def predict(self, belief: Gaussian, control_part: Tensor) -> Gaussian:
        """The predicted bank (N, K, n), or (N, 1, n) from a common belief; ``control_part`` (N, 1, u)."""
        mean, jacobian = self.dynamics.with_jacobian(belief.mean, control_part)
        return predict(belief, mean, jacobian, self.dynamics.noise)

    def fuse(self, bank: Gaussian, log_weights: Tensor | None, present: Tensor | None = None) -> Gaussian:
        """The fused belief (N, n) of a bank (N, K, n). present: (N, K) bool, as in ``Evidence``."""
        bank = in_one_turn(bank, self.angles)
        if log_weights is not None:
            return weighted_average(bank, log_weights, self.architecture.covariance)
        if len(self.names) == 1:
            return Gaussian(bank.mean[:, 0], bank.covariance[:, 0])
        return product_of_experts(bank, present)
