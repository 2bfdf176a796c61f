"""Causes planted in a copy of a filter: in its weights, or where no weight can hold them, in its equations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from beliefbench import equations
from beliefscope.datasets.episode import Episode
from beliefscope.filters.batch import Steps
from beliefscope.filters.filter import Architecture, Filter
from beliefscope.filters.models.information import InformationFilter
from beliefscope.filters.models.weight_model import MAX_LOGIT


@dataclass(frozen=True)
class ModelCause:
    """A cause planted in a filter.

    Attributes:
        magnitudes: four levels, from mild to severe; fewer are repeated.
        kinds: kinds of filters that can have it. weighted: whether it needs a weight model.
        equations: subclass that replaces the filter's class; its weights are unchanged.
        feedback: whether the fused belief must be the next prior.
        bank: whether the posteriors of a bank must be fused, which an information filter does not have.
    """

    magnitudes: tuple[float, ...]
    kinds: tuple[str, ...] = ("ekf", "ukf", "pf")
    weighted: bool = False
    equations: type[Filter] | None = None
    feedback: bool = False
    bank: bool = False

    def applies(self, architecture: Architecture) -> bool:
        feedback = architecture.kind == "pf" or architecture.feedback
        weighted = architecture.fusion in ("crossmodal", "information")
        bank = architecture.fusion != "information"
        return (
            architecture.kind in self.kinds
            and self.weighted <= weighted
            and self.feedback <= feedback
            and self.bank <= bank
        )


KALMAN, PARTICLE = ("ekf", "ukf"), ("pf",)

MODEL_CAUSES: dict[str, ModelCause] = {
    "model.image.bias": ModelCause((0.1, 0.15, 0.5, 0.7)),  # standard deviations of the state
    "model.image.overconfident": ModelCause((0.6, 0.5, 0.2, 0.25)),  # scale of standard deviations
    "model.image.underconfident": ModelCause((2.0, 2.5, 5.0, 6.0)),
    "model.image.broken": ModelCause((0.1, 0.15, 1.0, 0.8)),  # share of random weights
    "dynamics.bias": ModelCause((0.01, 0.015, 0.05, 0.07)),  # standard deviations of the state per step
    "dynamics.frozen": ModelCause((0.7, 0.6, 0.0, 0.1)),  # remaining share of the predicted change
    "dynamics.broken": ModelCause((0.1, 0.15, 1.0, 0.8)),
    "process_noise.small": ModelCause((0.5, 0.4, 0.1, 0.15)),  # scale of standard deviations
    "process_noise.large": ModelCause((2.0, 2.5, 8.0, 6.0)),
    "covariance.small": ModelCause((0.6, 0.55, 0.2, 0.15), equations=equations.ReportedCovariance),
    "covariance.large": ModelCause((1.6, 1.8, 5.0, 6.0), equations=equations.ReportedCovariance),
    "weights.constant": ModelCause((0.6, 0.4, 0.5, 0.3), weighted=True),  # weight of the image
    "weights.inverted": ModelCause((0.6, 0.7, 1.0, 1.5), weighted=True),  # scale of the logits, negated
    "weights.ignores_image": ModelCause((2.0, 2.5, 8.0, 6.0), weighted=True),  # difference of the logits
    "weights.ignores_haptics": ModelCause((2.0, 2.5, 8.0, 6.0), weighted=True),
    "particles.few": ModelCause((100, 60, 10, 15), PARTICLE),  # number of particles
    "particles.deprived": ModelCause((30, 20, 2, 3), PARTICLE, equations=equations.FewAncestors),
    "resampling.off": ModelCause((1.0,), PARTICLE, equations=equations.NoResampling),
    "resampling.biased": ModelCause((0.7, 0.6, 0.0, 0.2), PARTICLE, equations=equations.BiasedResampling),
    "fusion.shared_prior": ModelCause((1.0,), KALMAN, equations=equations.SharedPrior, bank=True),
    "fusion.miscalibrated": ModelCause(
        (0.6, 0.5, 0.2, 0.15), equations=equations.MiscalibratedFusion, feedback=True, bank=True
    ),
}
MODEL_CAUSES |= {
    name.replace("image", "haptics"): cause for name, cause in MODEL_CAUSES.items() if name.startswith("model.image")
}


def plant(filter_: Filter, cause: str, magnitude: float, episodes: Sequence[Episode], rng: np.random.Generator) -> None:
    """Change a filter in place; ``equations`` and the number of particles belong to the case (``cases.py``)."""
    if MODEL_CAUSES[cause].equations is not None or cause == "particles.few":
        return
    part, _, mechanism = cause.rpartition(".")
    with torch.no_grad():
        if part == "dynamics":
            _plant_dynamics(filter_, mechanism, magnitude, episodes, rng)
        elif part == "process_noise":
            filter_.dynamics.log_noise += math.log(magnitude)
            if isinstance(filter_, InformationFilter):
                filter_.log_motion += math.log(magnitude)
        elif part == "weights":
            _plant_weights(filter_, mechanism, magnitude)
        else:
            _plant_measurement(filter_, part.removeprefix("model."), mechanism, magnitude, rng)


def _plant_measurement(filter_: Filter, name: str, mechanism: str, magnitude: float, rng: np.random.Generator) -> None:
    """EKF: z and R. PF: a bias b gives log p(z | x - b); confidence scales log p."""
    particle = filter_.architecture.kind == "pf"
    model = filter_.get_submodule(f"{'measurement_models' if particle else 'virtual_sensors'}.{name}")
    if mechanism == "broken":
        _mix_with_noise(model, magnitude, rng)
    elif mechanism == "bias":
        bias = magnitude * _signs(filter_.n, rng)
        if particle:
            first = model.get_submodule("state_encoder.0")
            first.bias -= first.weight @ bias
        else:
            _last_linear(model.get_submodule("state")).bias += bias
    elif particle:
        last = _last_linear(model.get_submodule("head"))
        last.weight /= magnitude**2
        last.bias /= magnitude**2
    else:
        _last_linear(model.get_submodule("log_noise")).bias += math.log(magnitude)


def _plant_dynamics(
    filter_: Filter, mechanism: str, magnitude: float, episodes: Sequence[Episode], rng: np.random.Generator
) -> None:
    """x' = x + f1 sigmoid(f2): a bias is added to f1, divided by the mean of the gate over the episodes."""
    dynamics, n = filter_.dynamics, filter_.n
    if mechanism == "broken":
        _mix_with_noise(dynamics, magnitude, rng)
    elif mechanism == "frozen":
        dynamics.output.weight[:n] *= magnitude
        dynamics.output.bias[:n] *= magnitude
    else:
        steps = Steps.from_episodes(filter_.task, episodes)
        states = filter_.statistics.standardise("state", steps.states)
        control = dynamics.control_part(filter_.statistics.standardise("control", steps.controls))
        hidden = dynamics.shared(dynamics.join_state(dynamics.state_encoder(states)) + control)
        gate = torch.sigmoid(dynamics.output(hidden)[:, n]).mean()
        dynamics.output.bias[:n] += magnitude * _signs(n, rng) / gate


def _plant_weights(filter_: Filter, mechanism: str, magnitude: float) -> None:
    """Logits are bounded by ``MAX_LOGIT tanh(logit / MAX_LOGIT)``; those of two modalities differ by twice as much."""
    output = filter_.get_submodule("weight_model.output")
    if mechanism == "inverted":
        output.weight *= -magnitude
        output.bias *= -magnitude
        return
    bias = output.bias.view(len(filter_.names), -1)
    image = filter_.index("image")
    sign = torch.full((len(filter_.names), 1), -1.0)
    sign[image] = 1.0
    if mechanism == "constant":
        output.weight.zero_()
        logit = math.log(magnitude / (1.0 - magnitude)) / 2.0
        bias.copy_((sign * MAX_LOGIT * math.atanh(logit / MAX_LOGIT)).expand_as(bias))
    else:
        bias += sign * magnitude / 2.0 * (-1.0 if mechanism == "ignores_image" else 1.0)


def _mix_with_noise(module: nn.Module, share: float, rng: np.random.Generator) -> None:
    """Weight matrices ``sqrt(1 - share^2) W + share std(W) N(0, 1)``: their size is kept."""
    for parameter in module.parameters():
        if parameter.ndim > 1:
            noise = torch.from_numpy(rng.standard_normal(parameter.shape).astype(np.float32))
            parameter.copy_(math.sqrt(1.0 - share**2) * parameter + share * parameter.std() * noise)


def _signs(n: int, rng: np.random.Generator) -> Tensor:
    return torch.from_numpy(rng.choice([-1.0, 1.0], n).astype(np.float32))


def _last_linear(module: nn.Module) -> nn.Linear:
    return [m for m in module.modules() if isinstance(m, nn.Linear)][-1]


def with_equations(filter_: Filter, cause: str, magnitude: float) -> None:
    """Give the filter the equations of a cause, in place."""
    mixin = MODEL_CAUSES[cause].equations
    if mixin is not None:
        filter_.__class__ = type(mixin.__name__, (mixin, type(filter_)), {"magnitude": magnitude})
