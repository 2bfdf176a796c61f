"""The optimisation loop of a fine-tuning run: its steps, its validations, and its state for resuming."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.evaluate import metrics
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.batch_mix import Mix, evenly_spaced
from beliefscope.filters.finetuning.module_selection import matching
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.finetuning.slices import CLEAN
from beliefscope.filters.models.networks import ImageEncoder
from beliefscope.filters.rollout import first_belief, rollout
from beliefscope.filters.training import losses

MAX_LENGTH, MAX_WINDOWS, PARTICLES = 100, 32, 100
"""Of a validation: steps in a window, windows of each slice, and particles."""

CLEAN_LIMIT = 4 / 3
"""Error on clean data relative to the base checkpoint above which weights are never kept, however good elsewhere."""

NOISE_RATE, ENCODER_RATE = 10.0, 1 / 3
"""Relative learning rates, as in training: of the logarithmic process noise, which scales all else, and of encoders."""

PROGRESS = ("done", "best_step", "failures", "loss", "gradients")
"""Attributes of the loop that its saved state contains."""


@dataclass(frozen=True)
class Validation:
    """Metrics on episodes that are not trained on.

    Attributes:
        step: steps done. loss: mean training loss since the previous validation; None for the first.
        slices: slice -> ``Metrics.to_dict`` over the slice's steps, and ``error``: root mean square error in
            standardised units over all components. score: over all slices (``score``).
    """

    step: int
    loss: float | None
    slices: dict[str, dict[str, Any]]
    score: float = 1.0


@torch.no_grad()
def validate(filter_: Filter, mix: Mix, step: int, loss: float | None, settings: FineTune) -> Validation:
    """Metrics over windows spaced evenly over each slice's episodes, without the task's warm-up (a third if short)."""
    length = min(MAX_LENGTH, int(mix.steps.length.min()))
    warmup = min(filter_.task.warmup, length // 3)
    windows = mix.windows(evenly_spaced(mix.starts(length, warmup), MAX_WINDOWS), length, warmup)
    batch = windows.batch
    generator = torch.Generator(batch.states.device).manual_seed(settings.seed)
    evidence = windows.select_evidence(filter_.encode(batch))
    estimate = rollout(filter_, evidence, first_belief(filter_, batch), generator, PARTICLES).estimate
    error = filter_.statistics.state_to_si(estimate.mean) - batch.states
    covariance = filter_.statistics.covariance_to_si(estimate.covariance)
    standardised = losses.errors(filter_, estimate.mean, batch).square().sum(-1)
    slices = {}
    for name, columns in windows.parts.items():
        mask = windows.weight[:, columns] > 0
        values = metrics(filter_.task, error[:, columns][mask].cpu(), covariance[:, columns][mask].cpu())
        slices[name] = values.to_dict() | {"error": float(standardised[:, columns][mask].mean().sqrt())}
    return Validation(step, loss, slices)


def score(current: Validation, base: Validation, shares: Mapping[str, float], likelihood_weight: float) -> float:
    """The criterion of the best weights: each slice's error relative to the base, plus its increase in NLL.

    ``sum_s share_s (error_s / error_s' + likelihood_weight (nll_s - nll_s'))``, where ' is the base checkpoint's.
    """
    total = 0.0
    for name, share in shares.items():
        after, before = current.slices[name], base.slices[name]
        total += share * after["error"] / max(before["error"], 1e-9)
        if after["nll"] is not None and before["nll"] is not None:
            total += share * likelihood_weight * (after["nll"] - before["nll"])
    return total


class FineTuneLoop:
    """Trains some of a module's parameters on a mix of slices; subclasses have the loss and the metrics.

    Every step draws from generators seeded with its number, so that an interrupted run resumes with identical results.

    Attributes:
        done: number of steps. validations: so far, the base checkpoint's first. best_step: step of the best weights.
        failures: validations since the best one.
    """

    def __init__(self, module: nn.Module, trained: Mapping[str, nn.Parameter], settings: FineTune) -> None:
        self.module, self.trained, self.settings = module, dict(trained), settings
        self.base = {name: p.detach().clone() for name, p in trained.items()}
        self.best = dict(self.base)
        self.gradients = dict.fromkeys(trained, 0.0)
        self.validations: list[Validation] = []
        self.done = self.best_step = self.failures = 0
        self.loss = 0.0
        self.rates = self._rates()
        groups = [
            {"params": [p for name, p in trained.items() if self.rates[name] == rate], "rate": rate}
            for rate in dict.fromkeys(self.rates.values())
        ]
        self.optimiser = torch.optim.Adam(groups, lr=settings.rate)

    def _rates(self) -> dict[str, float]:
        rate = self.settings.rate
        encoders = {id(p) for m in self.module.modules() if isinstance(m, ImageEncoder) for p in m.parameters()}
        rates = {name: rate * ENCODER_RATE if id(p) in encoders else rate for name, p in self.trained.items()}
        if "dynamics.log_noise" in rates:
            rates["dynamics.log_noise"] = rate * NOISE_RATE
        for pattern, other in self.settings.rates:
            names = matching(rates, pattern)
            if not names:
                raise BadInput(f"rate {pattern}={other:g} matches no trained parameter: {', '.join(rates)}")
            rates |= dict.fromkeys(names, other)
        return rates

    @property
    def finished(self) -> bool:
        return self.done >= self.settings.steps or self.failures >= self.settings.patience

    @property
    def validation_due(self) -> bool:
        """Whether a validation follows the last step."""
        return self.done % self.settings.check == 0 or self.done == self.settings.steps

    def step(self) -> float:
        """One step of Adam followed by one of L2-SP, towards the base checkpoint's weights; returns the loss.

        The latter is the proximal step of ``l2_sp / 2 |p - p'|^2`` (Li et al., "Explicit Inductive Bias for Transfer
        Learning with Convolutional Networks", 2018): ``p' + (p - p') / (1 + rate l2_sp)``.
        """
        settings, decay = self.settings, 1.0 - 0.95 * self.done / self.settings.steps
        loss = self.step_loss(self.done)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        sizes = {n: float(p.grad.square().sum()) for n, p in self.trained.items() if p.grad is not None}
        norm = nn.utils.clip_grad_norm_(self.trained.values(), 5.0)
        if torch.isfinite(norm):  # else a gradient overflowed: skip the step
            for group in self.optimiser.param_groups:
                group["lr"] = group["rate"] * decay
            for name, size in sizes.items():
                self.gradients[name] += size
            self.optimiser.step()
            with torch.no_grad():
                for name, parameter in self.trained.items():
                    shrinkage = 1.0 / (1.0 + self.rates[name] * decay * settings.l2_sp)
                    parameter.lerp_(self.base[name], 1.0 - shrinkage)
        self.done += 1
        value = float(loss.detach())
        self.loss += value
        return value

    def step_loss(self, step: int) -> Tensor:
        """The loss of the windows drawn for this step."""
        raise NotImplementedError

    def measure(self, step: int, loss: float | None) -> Validation:
        """Metrics of the current weights on the validation episodes."""
        raise NotImplementedError

    def validate(self) -> Validation:
        """Validates the current weights, and stores them if they are the best so far."""
        settings = self.settings
        if not self.validations:
            validation = self.measure(0, None)
        else:
            loss = self.loss / (self.done - self.validations[-1].step)
            validation = self.measure(self.done, loss)
            shares = {slice_.name: share for slice_, share in settings.shares().items()}
            total = score(validation, self.validations[0], shares, settings.likelihood_weight)
            validation = replace(validation, score=total)
            self.loss, self.failures = 0.0, self.failures + 1
            if self._keeps_clean(validation) and validation.score < min(
                earlier.score for earlier in self.validations if self._keeps_clean(earlier)
            ):
                self.best = {name: p.detach().clone() for name, p in self.trained.items()}
                self.best_step, self.failures = self.done, 0
        self.validations.append(validation)
        return validation

    def _keeps_clean(self, validation: Validation) -> bool:
        """Whether the error on clean data, if they are part of the loss, is within ``CLEAN_LIMIT``."""
        errors = [v.slices[CLEAN.name]["error"] for v in (self.validations[0], validation) if CLEAN.name in v.slices]
        return not errors or bool(errors[1] <= CLEAN_LIMIT * errors[0])

    @torch.no_grad()
    def restore_best(self) -> None:
        for name, parameter in self.trained.items():
            parameter.copy_(self.best[name])

    def parameter_changes(self) -> dict[str, list[float]]:
        """Parameter -> root mean square gradient norm over the steps, norm of its change, norm of the base weights."""
        return {
            name: [
                math.sqrt(self.gradients[name] / max(self.done, 1)),
                float((parameter.detach() - self.base[name]).norm()),
                float(self.base[name].norm()),
            ]
            for name, parameter in self.trained.items()
        }

    def state(self, seconds: float) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """The state that ``restore`` needs to resume with identical results, as tensors and as JSON."""
        tensors: dict[str, Tensor] = {f"now.{name}": p for name, p in self.trained.items()}
        tensors |= {f"best.{name}": p for name, p in self.best.items()}
        for name, parameter in self.trained.items():
            tensors |= {f"{key}.{name}": value for key, value in self.optimiser.state[parameter].items()}
        progress = {name: getattr(self, name) for name in PROGRESS}
        return tensors, progress | {"validations": [asdict(v) for v in self.validations], "seconds": seconds}

    def restore(self, tensors: Mapping[str, Tensor], progress: Mapping[str, Any]) -> float:
        """Restores a ``state``; returns the seconds spent until then."""
        for name in PROGRESS:
            setattr(self, name, progress[name])
        self.validations = [Validation(**values) for values in progress["validations"]]
        with torch.no_grad():
            for name, parameter in self.trained.items():
                parameter.copy_(tensors[f"now.{name}"])
                self.best[name] = tensors[f"best.{name}"].to(parameter.device)
                if f"step.{name}" in tensors:
                    moments = {key: tensors[f"{key}.{name}"] for key in ("step", "exp_avg", "exp_avg_sq")}
                    self.optimiser.state[parameter] = {
                        key: value if key == "step" else value.to(parameter.device) for key, value in moments.items()
                    }
        return float(progress["seconds"])


class FilterLoop(FineTuneLoop):
    """The optimisation of a built-in filter on the loss of its training."""

    def __init__(
        self, filter_: Filter, trained: Mapping[str, nn.Parameter], settings: FineTune, train: Mix, val: Mix
    ) -> None:
        """Raises BadInput if a slice has no window of this length in the training episodes."""
        super().__init__(filter_, trained, settings)
        self.filter, self.train, self.val = filter_, train, val
        self.starts = train.starts(settings.length)

    def step_loss(self, step: int) -> Tensor:
        settings, device = self.settings, self.train.steps.states.device
        seed = int.from_bytes(hashlib.sha256(f"{settings.seed} {step}".encode()).digest()[:7], "big")
        generator = torch.Generator().manual_seed(seed)
        noise = torch.Generator(device).manual_seed(seed)
        windows = self.train.windows(
            self.train.sample_starts(self.starts, settings.windows, generator), settings.length
        )
        evidence = windows.select_evidence(self.filter.encode(windows.batch))
        return losses.through_filter(
            self.filter,
            evidence,
            windows.batch,
            noise,
            settings.particles,
            settings.likelihood_weight,
            windows.weight,
        )

    def measure(self, step: int, loss: float | None) -> Validation:
        return validate(self.filter, self.val, step, loss, self.settings)
