"""The stages of training, in the paper's order: dynamics, measurement models, each modality, weights, everything."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from beliefscope.filters.batch import Batch, Steps, black_out
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.ekf import ExtendedKalmanFilter, VirtualSensor
from beliefscope.filters.filter import Filter
from beliefscope.filters.networks import ImageEncoder
from beliefscope.filters.pf import MeasurementModel
from beliefscope.filters.rollout import START_VARIANCE, rollout, start_at_truth

if TYPE_CHECKING:
    from beliefscope.filters.train import Plan

Report = Callable[[str, int, int, float], None]
"""Called with the stage's name, steps done, steps in all, and the loss."""

BLACKOUTS = (0.0, 0.4, 0.8)
"""Chances of a black picture: one is drawn for each training window, and all are evaluated."""


class Trainer:
    """The stages, in the paper's order. All randomness comes from one generator."""

    def __init__(
        self,
        filter_: Filter,
        steps: Steps,
        plan: Plan,
        generator: torch.Generator,
        report: Report | None,
    ) -> None:
        self.filter = filter_
        self.steps = steps
        self.plan = plan
        self.generator = generator
        self.report = report
        self.device = next(filter_.parameters()).device
        # Particles are drawn where they live.
        self.noise = torch.Generator(self.device).manual_seed(generator.initial_seed())

    def run(self) -> None:
        self.pretrain_dynamics()
        for name in self.filter.names:
            self.pretrain_measurement(name)
        crossmodal = self.filter.architecture.fusion == "crossmodal"
        if crossmodal:
            everything_else = [p for n, p in self.filter.named_parameters() if not n.startswith("weight_model.")]
            for k, name in enumerate(self.filter.names):
                self.end_to_end(f"{name} alone", everything_else, self.plan.alone, self.plan.lengths[-1], only=k)
            weights = self.filter.get_submodule("weight_model").parameters()
            self.end_to_end("weights", list(weights), self.plan.weights, self.plan.lengths[-1], rate=self.plan.rate)
        parameters = list(self.filter.parameters())
        for length, count in zip(self.plan.lengths, self.plan.together, strict=True):
            self.end_to_end(f"together, {length} steps", parameters, count, length)

    def sample(self, length: int, count: int | None = None) -> Batch:
        """Windows, in each of which pictures are black with one of the chances of ``BLACKOUTS``."""
        batch = self.steps.sample(count or self.plan.batch, length, self.generator)
        n = batch.states.shape[1]
        chance = torch.tensor(BLACKOUTS)[torch.randint(len(BLACKOUTS), (n,), generator=self.generator)]
        return black_out(batch, chance, self.generator)

    def pretrain_dynamics(self) -> None:
        """Squared error of 1, 4, 8, 16 steps ahead from the truth."""
        dynamics, standardise = self.filter.dynamics, self.filter.statistics.standardise

        def loss(length: int) -> Tensor:
            batch = self.steps.sample(4 * self.plan.batch, length, self.generator)
            control = dynamics.control_part(standardise("control", batch.controls))
            target = standardise("state", batch.states)
            state = standardise("state", batch.previous)
            total = state.new_zeros(())
            for t in range(length):
                state = dynamics(state, control[t])
                total = total + (state - target[t]).square().mean()
            return total / length

        for length in (1, 4, 8, 16):
            self.optimise(
                f"dynamics, {length} steps",
                list(dynamics.parameters()),
                self.plan.dynamics,
                self.plan.rate,
                lambda length=length: loss(length),  # type: ignore[misc]
            )

    def pretrain_measurement(self, name: str) -> None:
        """EKF: regression of the state by the virtual sensor. PF: of the likelihood, or by contrast without pictures.

        A likelihood's picture encoders first learn to tell the state through a linear readout, which is thrown away:
        that is far faster than from likelihoods, whose layers then learn on stored features.
        """
        module = self.measurement_module(name)
        if isinstance(module, VirtualSensor):
            self.pretrain_regression(f"{name} model", list(module.parameters()), lambda o: module(o)[0])
        elif any(isinstance(encoder, ImageEncoder) for encoder in module.encoders.by_modality.values()):
            encoders = module.encoders
            readout = nn.Linear(encoders.size, self.filter.n)
            nn.init.normal_(readout.weight, std=encoders.size**-0.5, generator=self.generator)
            nn.init.zeros_(readout.bias)
            readout.to(self.device)
            parameters = [*encoders.parameters(), *readout.parameters()]
            self.pretrain_regression(f"{name} model", parameters, lambda o: readout(encoders(o)))
            self.pretrain_likelihood(name, module)
        else:
            self.pretrain_contrast(name, module)

    def pretrain_regression(
        self, stage: str, parameters: Sequence[nn.Parameter], regress: Callable[[Mapping[str, Tensor]], Tensor]
    ) -> None:
        """Squared error of the state, standardised."""
        standardise = self.filter.statistics.standardise

        def loss() -> Tensor:
            batch = self.steps.sample(4 * self.plan.batch, 1, self.generator)
            return (regress(self.filter.observations(batch)) - standardise("state", batch.states)).square().mean()

        self.optimise(stage, parameters, self.plan.measurement, self.plan.rate, loss)

    def pretrain_likelihood(self, name: str, model: MeasurementModel) -> None:
        """Regression of the Gaussian log density around the truth, on stored features: encoders stay as they are."""
        bright, dark = self.features(model, 0.0), self.features(model, 1.0)
        truth = self.filter.statistics.standardise("state", self.steps.states)
        parameters = [p for n, p in model.named_parameters() if not n.startswith("encoders.")]

        def loss() -> Tensor:
            index = torch.randint(len(truth), (8 * self.plan.batch,), generator=self.generator).to(self.device)
            chance = torch.rand(len(index), 1, generator=self.generator).to(self.device)
            features = torch.where(chance < sum(BLACKOUTS) / len(BLACKOUTS), dark[index], bright[index])
            states, target = self.likelihood_target(truth[index])
            part = model.join_observation(features).unsqueeze(1)
            return nn.functional.smooth_l1_loss(model.log_likelihood(part, model.state_part(states)), target)

        self.optimise(f"{name} likelihood", parameters, self.plan.likelihood, 2 * self.plan.rate, loss)

    def pretrain_contrast(self, name: str, model: MeasurementModel) -> None:
        """Which of the batch's states belongs to an observation? The best answer is log p(z | x) / p(z) + c(z).

        A regression of the expected log density, which serves pictures well, is no likelihood where an observation says
        little: it bulges where the training states end. This is flat there. The second term pins c(z) at 0.
        """
        filter_ = self.filter

        def loss() -> Tensor:
            batch = self.steps.sample(4 * self.plan.batch, 1, self.generator)
            states = filter_.statistics.standardise("state", batch.states)
            part = model.observation_part(filter_.observations(batch))[0]
            value = model.log_likelihood(part.unsqueeze(1), model.state_part(states))
            evidence = torch.logsumexp(value, dim=1) - math.log(len(value))
            return (evidence - value.diagonal()).mean() + 0.01 * evidence.square().mean()

        # Few different states in many observations: without decay it learns the training trajectories by heart.
        self.optimise(
            f"{name} likelihood", list(model.parameters()), self.plan.likelihood, 2 * self.plan.rate, loss, decay=0.01
        )

    @torch.no_grad()
    def features(self, model: MeasurementModel, blackout: float) -> Tensor:
        """(S, d) encoded observations of all training steps."""
        parts = []
        for starts in torch.arange(len(self.steps.states), device=self.device).split(1024):
            batch = black_out(self.steps.windows(starts, 1), torch.tensor(blackout), self.generator)
            parts.append(model.encoders(self.filter.observations(batch))[0])
        return torch.cat(parts)

    def likelihood_target(self, truth: Tensor) -> tuple[Tensor, Tensor]:
        """States (B, 20, n) around the truth (B, n) and their Gaussian log density with covariance 0.1 I.

        Half of the states come from that Gaussian, as in the paper's training; half from a unit one, so that the
        likelihood is also right far from the truth, where maps show it. The constant is left out; values end at -10.
        """
        scale = torch.ones(20, 1, device=truth.device)
        scale[:10] = START_VARIANCE**0.5
        unit = torch.randn((len(truth), 20, truth.shape[-1]), generator=self.noise, device=truth.device)
        offset = unit * scale
        target = -0.5 * offset.square().sum(-1) / START_VARIANCE
        return truth.unsqueeze(1) + offset, target.clamp_min(-10.0)

    def measurement_module(self, name: str) -> VirtualSensor | MeasurementModel:
        bank = "virtual_sensors" if isinstance(self.filter, ExtendedKalmanFilter) else "measurement_models"
        module = self.filter.get_submodule(f"{bank}.{name}")
        assert isinstance(module, VirtualSensor | MeasurementModel)
        return module

    def end_to_end(
        self,
        stage: str,
        parameters: Sequence[nn.Parameter],
        count: int,
        length: int,
        only: int | None = None,
        rate: float | None = None,
    ) -> None:
        """Backpropagation through ``length`` steps of the filter."""

        def loss() -> Tensor:
            batch = self.sample(length)
            evidence = self.filter.encode(batch)
            if only is not None:
                evidence = evidence.only(only)
            start = self.perturbed(start_at_truth(self.filter, batch))
            estimate = rollout(self.filter, evidence, start, self.noise, self.plan.particles).estimate
            error = estimate.mean - self.filter.statistics.standardise("state", batch.states)
            likelihood = negative_log_likelihood(error, estimate.covariance)
            return error.square().sum(-1).mean() + self.plan.likelihood_weight * likelihood

        self.optimise(stage, parameters, count, rate or self.plan.fine_rate, loss)

    def perturbed(self, start: Gaussian) -> Gaussian:
        """A first belief whose mean is off by as much as its covariance says: the filter must learn to come back."""
        unit = torch.randn(start.mean.shape, generator=self.noise, device=self.device)
        return replace(start, mean=start.mean + START_VARIANCE**0.5 * unit)

    def optimise(
        self,
        stage: str,
        parameters: Iterable[nn.Parameter],
        count: int,
        rate: float,
        loss: Callable[[], Tensor],
        decay: float = 0.0,
    ) -> None:
        """``count`` steps of Adam on these parameters, with weight decay; all others stay as they are."""
        chosen = list(parameters)
        self.filter.requires_grad_(False)
        for parameter in chosen:
            parameter.requires_grad_(True)
        optimiser = torch.optim.AdamW(chosen, lr=rate, weight_decay=decay)
        schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.1, total_iters=max(count, 1))
        for done in range(count):
            optimiser.zero_grad(set_to_none=True)
            value = loss()
            value.backward()
            norm = nn.utils.clip_grad_norm_(chosen, 5.0)
            # One step whose gradient overflowed must not spoil the weights.
            if torch.isfinite(norm):
                optimiser.step()
            schedule.step()
            if self.report is not None:
                self.report(stage, done + 1, count, float(value.detach()))


def negative_log_likelihood(error: Tensor, covariance: Tensor) -> Tensor:
    """Mean of ``0.5 (e^T S^-1 e + log det S)``, standardised units, without the constant.

    A floor of 1e-4 on the diagonal keeps a collapsed particle set from a gradient without bound.
    """
    covariance = covariance + 1e-4 * torch.eye(error.shape[-1], device=error.device)
    factor = torch.linalg.cholesky(covariance)
    white = torch.linalg.solve_triangular(factor, error.unsqueeze(-1), upper=False).squeeze(-1)
    log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return (0.5 * white.square().sum(-1) + log_det).mean()
