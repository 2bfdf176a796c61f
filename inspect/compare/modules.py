"""Differences between two versions of a filter by module: weights and outputs."""

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
from beliefscope.filters.finetuning.module_selection import digest, module_change, within
from beliefscope.filters.rollout import first_belief

PARTICLES = 30
"""Number of particles when recording module outputs."""


@dataclass(frozen=True)
class ModuleChange:
    """A module before and after; it exists in both filters with tensors of equal shapes.

    Attributes:
        name: dotted name.
        kind: class name.
        parameters: number of trainable parameters.
        weights: norm of the parameter change relative to the norm before; NaN if that is zero.
        drift: root mean square change of the output relative to the output before, for equal observations and equal
            true states; NaN for a module that is not called as a whole.
        gradient: norm of the loss gradient, root mean square over the fine-tuning steps between the versions; NaN if
            the module was not trained.
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
    def unchanged(self) -> bool:
        """Whether parameters and buffers are bit-identical."""
        return self.hashes[0] == self.hashes[1]


@torch.no_grad()
def module_changes(
    before: Filter, after: Filter, batch: Batch, parameter_changes: Mapping[str, Sequence[float]] | None = None
) -> tuple[ModuleChange, ...]:
    """Compare all modules with tensors that both filters have, in the filter's order, without the filter itself.

    Args:
        batch: steps for comparing outputs, T = 1.
        parameter_changes: of the fine-tuning between the versions, see ``module_change``.
    """
    others = dict(after.named_modules())
    outputs = [module_outputs(filter_, batch) for filter_ in (before, after)]
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
                gradient=module_change(name, parameter_changes)["gradient"]
                if parameter_changes and any(within(key, name) for key in parameter_changes)
                else math.nan,
                hashes=(digest(module, states[0]), digest(others[name], states[1])),
            )
        )
    return tuple(changes)


def module_outputs(filter_: Filter, batch: Batch) -> dict[str, list[Tensor]]:
    """Module -> flattened outputs by call, over one step (T = 1) from the true state of N trajectories."""
    generator = torch.Generator().manual_seed(0)
    with torch.enable_grad(), _output_hooks(filter_) as outputs:  # without gradients, layers are not called as modules
        evidence, start = filter_.encode(batch), first_belief(filter_, batch)
        filter_.step(filter_.start(start, PARTICLES, generator), evidence[0], generator)
        if hasattr(filter_, "dynamics"):  # Kalman filters call its Jacobian, not the module
            filter_.dynamics(start.mean, evidence.control[0])
    return outputs


@contextmanager
def _output_hooks(filter_: nn.Module) -> Iterator[dict[str, list[Tensor]]]:
    """Record the outputs of all modules with parameters; removes the hooks on exit."""
    outputs: dict[str, list[Tensor]] = {}

    def keep(name: str, output: Any) -> None:
        for value in output if isinstance(output, tuple) else (output,):
            if isinstance(value, Tensor):
                # Copy: later layers may work in place.
                outputs.setdefault(name, []).append(value.detach().flatten().clone())

    hooks = [
        module.register_forward_hook(lambda _, __, output, name=name: keep(name, output))
        for name, module in filter_.named_modules()
        if name and next(module.parameters(), None) is not None
    ]
    try:
        yield outputs
    finally:
        for hook in hooks:
            hook.remove()


def _shapes(state: dict[str, Tensor]) -> dict[str, tuple[int, ...]]:
    return {key: tuple(value.shape) for key, value in state.items()}


def _relative(before: list[Tensor], after: list[Tensor]) -> float:
    """Norm of the difference relative to ``before``; NaN if there are no tensors or their shapes differ."""
    if not before or [t.shape for t in before] != [t.shape for t in after]:
        return float("nan")
    a, b = torch.cat(before).double(), torch.cat(after).double()
    if torch.equal(a, b):
        return 0.0
    norm = float(a.norm())
    return float((b - a).norm()) / norm if norm else float("nan")
