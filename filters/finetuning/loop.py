"""The loop of a fine-tuning: its steps, its looks at episodes it does not learn from, and where it stands."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from beliefscope.filters.evaluate import LEFT_OUT, metrics
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.batch_mix import Mix, spread
from beliefscope.filters.finetuning.module_selection import matching
from beliefscope.filters.models.networks import ImageEncoder
from beliefscope.filters.rollout import rollout, start_at_truth
from beliefscope.filters.training import losses

if TYPE_CHECKING:
    from beliefscope.filters.finetuning.finetune import FineTune

LONGEST, WINDOWS, PARTICLES = 100, 32, 100
"""Of a look: steps of a window and windows of each slice, at most; particles."""

NOISE, PICTURES = 10.0, 1 / 3
"""Times the rate, as in training: process noise, which is logarithmic and scales all else, and picture encoders."""


@dataclass(frozen=True)
class Look:
    """How the filter does on episodes that it does not learn from.

    Attributes:
        step: steps done. loss: mean of the training loss since the look before; NaN in the first.
        slices: slice -> ``Metrics.to_dict`` over the steps that count, and ``error``: root mean square of the error in
            standardised units, all components together. score: of all slices (``score``).
    """

    step: int
    loss: float | None
    slices: dict[str, dict[str, Any]]
    score: float = 1.0


@torch.no_grad()
def look(filter_: Filter, mix: Mix, step: int, loss: float | None, settings: FineTune) -> Look:
    """Over windows spread evenly over each slice's episodes, the first 30 steps (a third of short ones) left out."""
    length = min(LONGEST, int(mix.steps.length.min()))
    unheeded = min(LEFT_OUT, length // 3)
    windows = mix.windows(spread(mix.starts(length, unheeded), WINDOWS), length, unheeded)
    batch = windows.batch
    generator = torch.Generator(batch.states.device).manual_seed(settings.seed)
    evidence = windows.heard(filter_.encode(batch))
    estimate = rollout(filter_, evidence, start_at_truth(filter_, batch), generator, PARTICLES).estimate
    error = filter_.statistics.state_to_si(estimate.mean) - batch.states
    covariance = filter_.statistics.covariance_to_si(estimate.covariance)
    standardised = (estimate.mean - losses.state(filter_, batch)).square().sum(-1)
    slices = {}
    for name, columns in windows.parts.items():
        counts = windows.weight[:, columns] > 0
        found = metrics(filter_.task, error[:, columns][counts].cpu(), covariance[:, columns][counts].cpu())
        slices[name] = found.to_dict() | {"error": float(standardised[:, columns][counts].mean().sqrt())}
    return Look(step, loss, slices)


def score(found: Look, parent: Look, shares: Mapping[str, float], likelihood_weight: float) -> float:
    """What is to fall: each slice's error as a multiple of the parent's, plus how much its likelihood has got worse.

    ``sum_s share_s (error_s / error_s' + likelihood_weight (nll_s - nll_s'))``, where ' is the parent's.
    """
    total = 0.0
    for name, share in shares.items():
        now, before = found.slices[name], parent.slices[name]
        total += share * now["error"] / max(before["error"], 1e-9)
        if now["nll"] is not None and before["nll"] is not None:
            total += share * likelihood_weight * (now["nll"] - before["nll"])
    return total


class Tuning:
    """A filter, some of whose parameters learn from a mix of slices.

    Every step draws from generators seeded with its number, so that a run does the same wherever it was cut.

    Attributes:
        done: steps. looks: so far, the parent's first. best_step: after which the weights did best.
    """

    def __init__(
        self, filter_: Filter, trained: Mapping[str, nn.Parameter], settings: FineTune, train: Mix, val: Mix
    ) -> None:
        """Raises BadInput where a slice has no window of this length in the training episodes."""
        self.filter, self.trained, self.settings = filter_, dict(trained), settings
        self.train, self.val = train, val
        self.starts = train.starts(settings.length)
        self.parent = {name: p.detach().clone() for name, p in trained.items()}
        self.best = dict(self.parent)
        self.gradients = dict.fromkeys(trained, 0.0)
        self.looks: list[Look] = []
        self.done = self.best_step = self.since = 0
        self.loss = 0.0
        self.rates = self._rates()
        groups = [
            {"params": [p for name, p in trained.items() if self.rates[name] == rate], "rate": rate}
            for rate in dict.fromkeys(self.rates.values())
        ]
        self.optimiser = torch.optim.Adam(groups, lr=settings.rate)

    def _rates(self) -> dict[str, float]:
        rate = self.settings.rate
        seeing = {id(p) for m in self.filter.modules() if isinstance(m, ImageEncoder) for p in m.parameters()}
        rates = {name: rate * PICTURES if id(p) in seeing else rate for name, p in self.trained.items()}
        if "dynamics.log_noise" in rates:
            rates["dynamics.log_noise"] = rate * NOISE
        for pattern, other in self.settings.rates:
            rates |= dict.fromkeys(matching(rates, pattern), other)
        return rates

    @property
    def finished(self) -> bool:
        return self.done >= self.settings.steps or self.since >= self.settings.patience

    @property
    def due(self) -> bool:
        """Whether the step just done is followed by a look."""
        return self.done % self.settings.check == 0 or self.done == self.settings.steps

    def begin(self) -> Look:
        """The look before the first step."""
        self.looks = [look(self.filter, self.val, 0, None, self.settings)]
        return self.looks[0]

    def step(self) -> float:
        """One step of Adam, and then one back towards the parent; returns the loss.

        The way back is the proximal step of ``pull / 2 |p - p'|^2`` ("L2-SP", Li et al., "Explicit Inductive Bias for
        Transfer Learning", 2018): ``p' + (p - p') / (1 + rate pull)``.
        """
        settings, faded = self.settings, 1.0 - 0.95 * self.done / self.settings.steps
        loss = self.loss_of(self.done)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        sizes = {n: float(p.grad.square().sum()) for n, p in self.trained.items() if p.grad is not None}
        norm = nn.utils.clip_grad_norm_(self.trained.values(), 5.0)
        # One step whose gradient overflowed must not spoil the weights.
        if torch.isfinite(norm):
            for group in self.optimiser.param_groups:
                group["lr"] = group["rate"] * faded
            for name, size in sizes.items():
                self.gradients[name] += size
            self.optimiser.step()
            with torch.no_grad():
                for name, parameter in self.trained.items():
                    back = 1.0 / (1.0 + self.rates[name] * faded * settings.pull)
                    parameter.lerp_(self.parent[name], 1.0 - back)
        self.done += 1
        value = float(loss.detach())
        self.loss += value
        return value

    def loss_of(self, step: int) -> Tensor:
        """The loss of the windows that this step draws."""
        settings, device = self.settings, self.train.steps.states.device
        seed = int.from_bytes(hashlib.sha256(f"{settings.seed} {step}".encode()).digest()[:7], "big")
        generator = torch.Generator().manual_seed(seed)
        noise = torch.Generator(device).manual_seed(seed)
        starts = self.train.drawn(self.starts, settings.windows, generator)
        windows = self.train.windows(starts, settings.length)
        evidence = windows.heard(self.filter.encode(windows.batch))
        return losses.through_filter(
            self.filter,
            evidence,
            windows.batch,
            noise,
            settings.particles,
            settings.likelihood_weight,
            windows.weight,
        )

    def look(self) -> Look:
        """After a step that is ``due``: looks, and keeps the weights where they do better than all before."""
        settings, last = self.settings, self.looks[-1].step
        found = look(self.filter, self.val, self.done, self.loss / (self.done - last), settings)
        shares = {one.name: share for one, share in settings.shares().items()}
        found = replace(found, score=score(found, self.looks[0], shares, settings.likelihood_weight))
        self.loss, self.since = 0.0, self.since + 1
        if found.score < min(one.score for one in self.looks):
            self.best = {name: p.detach().clone() for name, p in self.trained.items()}
            self.best_step, self.since = self.done, 0
        self.looks.append(found)
        return found

    @torch.no_grad()
    def take_best(self) -> None:
        for name, parameter in self.trained.items():
            parameter.copy_(self.best[name])

    def parts(self) -> dict[str, list[float]]:
        """Parameter -> root mean square of its gradient's norm over the steps, norm of its change, of the parent's."""
        return {
            name: [
                math.sqrt(self.gradients[name] / max(self.done, 1)),
                float((parameter - self.parent[name]).norm()),
                float(self.parent[name].norm()),
            ]
            for name, parameter in self.trained.items()
        }

    def state(self, seconds: float) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """All that ``restore`` needs to go on as if nothing had been, as tensors and as JSON."""
        tensors: dict[str, Tensor] = {f"now.{name}": p for name, p in self.trained.items()}
        tensors |= {f"best.{name}": p for name, p in self.best.items()}
        for name, parameter in self.trained.items():
            tensors |= {f"{key}.{name}": value for key, value in self.optimiser.state[parameter].items()}
        names = ("done", "best_step", "since", "loss", "gradients")
        progress = {name: getattr(self, name) for name in names}
        return tensors, progress | {"looks": [asdict(one) for one in self.looks], "seconds": seconds}

    def restore(self, tensors: Mapping[str, Tensor], progress: Mapping[str, Any]) -> float:
        """Where ``state`` left off; returns the seconds spent until then."""
        for name in ("done", "best_step", "since", "loss", "gradients"):
            setattr(self, name, progress[name])
        self.looks = [Look(**one) for one in progress["looks"]]
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
