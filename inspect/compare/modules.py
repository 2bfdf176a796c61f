"""What two versions of a filter have in common and what not, module by module: weights, and what comes out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from beliefscope.filters.batch import Batch
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.module_selection import digest, moved, within
from beliefscope.filters.rollout import start_at_truth

PARTICLES = 30
"""Of a particle filter that is listened to."""


@dataclass(frozen=True)
class ModuleChange:
    """One module before and after; both filters have it, with tensors of the same shapes.

    Attributes:
        name: dotted. kind: its class. parameters: how many numbers it learns.
        weights: norm of the parameters' change over their norm before; NaN where that is zero.
        drift: root mean square of its output's change over that of its output before, where both filters look at the
            same observations and begin a step at the same, true state; NaN for a module that is not called as a whole.
        gradient: norm of the loss's gradient by its parameters, root mean square over the steps of the fine-tuning that
            made the one after of the one before; NaN where nothing of it was trained, or not so.
        hashes: SHA-256 of its parameters and buffers, before and after.
    """

    name: str
    kind: str
    parameters: int
    weights: float
    drift: float
    gradient: float
    hashes: tuple[str, str]

    @property
    def same(self) -> bool:
        """Whether every bit of its parameters and buffers is as it was."""
        return self.hashes[0] == self.hashes[1]


@torch.no_grad()
def module_changes(
    before: Filter, after: Filter, batch: Batch, ran: Mapping[str, Sequence[float]] | None = None
) -> tuple[ModuleChange, ...]:
    """Of every module with tensors that both have, in the filter's order; the filter itself is not among them.

    Args:
        batch: T = 1: the steps that outputs are compared at.
        ran: of the fine-tuning between them, as ``moved`` takes it.
    """
    others = dict(after.named_modules())
    outputs = [heard(filter_, batch) for filter_ in (before, after)]
    changes = []
    for name, module in before.named_modules():
        states = [module.state_dict(), others[name].state_dict() if name in others else {}]
        if not name or not states[0] or _shapes(states[0]) != _shapes(states[1]):
            continue
        parameters = [[p.flatten() for p in m.parameters()] for m in (module, others[name])]
        changes.append(
            ModuleChange(
                name=name,
                kind=type(module).__name__,
                parameters=sum(p.numel() for p in parameters[0]),
                weights=_relative(*parameters),
                drift=_relative(*(outputs[i].get(name, []) for i in (0, 1))),
                gradient=moved(name, ran)["gradient"] if ran and any(within(key, name) for key in ran) else math.nan,
                hashes=(digest(module, states[0]), digest(others[name], states[1])),
            )
        )
    return tuple(changes)


def heard(filter_: Filter, batch: Batch) -> dict[str, list[Tensor]]:
    """Module -> what came out of it, flat, call by call, in one step from the truth at each of N places; T is 1."""
    generator = torch.Generator().manual_seed(0)
    with _listening(filter_) as found:
        evidence, start = filter_.encode(batch), start_at_truth(filter_, batch)
        filter_.step(filter_.start(start, PARTICLES, generator), evidence[0], generator)
        if hasattr(filter_, "dynamics"):  # Kalman filters ask it for Jacobians, not as a module
            filter_.dynamics(start.mean, evidence.control[0])
    return found


@contextmanager
def _listening(filter_: nn.Module) -> Iterator[dict[str, list[Tensor]]]:
    """Hooks on every module with parameters, which are gone afterwards."""
    found: dict[str, list[Tensor]] = {}

    def keep(name: str, output: Any) -> None:
        for one in output if isinstance(output, tuple) else (output,):
            if isinstance(one, Tensor):
                # A copy: the layer behind may work in place.
                found.setdefault(name, []).append(one.detach().flatten().clone())

    hooks = [
        module.register_forward_hook(lambda _, __, output, name=name: keep(name, output))
        for name, module in filter_.named_modules()
        if name and next(module.parameters(), None) is not None
    ]
    try:
        yield found
    finally:
        for hook in hooks:
            hook.remove()


def _shapes(state: dict[str, Tensor]) -> dict[str, tuple[int, ...]]:
    return {key: tuple(value.shape) for key, value in state.items()}


def _relative(before: list[Tensor], after: list[Tensor]) -> float:
    """Norm of the difference over that of ``before``; NaN where there is nothing, or nothing alike."""
    if not before or [t.shape for t in before] != [t.shape for t in after]:
        return float("nan")
    a, b = torch.cat(before).double(), torch.cat(after).double()
    if torch.equal(a, b):
        return 0.0
    norm = float(a.norm())
    return float((b - a).norm()) / norm if norm else float("nan")
