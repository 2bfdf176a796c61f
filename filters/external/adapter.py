"""What a filter from outside says at a step, and in which units: its adapter, and the checks of what it gives.

All is in SI units and in the task's order of components, unless an ``Adapter`` says otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.datasets.task import Task
from beliefscope.filters.belief import Gaussian, moments

SHAPES = {
    "estimate_mean": "n",
    "estimate_covariance": "nn",
    "modality_mean": "Kn",
    "modality_covariance": "Knn",
    "weights": "KW",
    "acting": "KW",
    "predicted_mean": "Kn",
    "predicted_covariance": "Knn",
    "observation_mean": "Kn",
    "observation_covariance": "Knn",
    "particles": "Mn",
    "prior_log_weights": "M",
    "log_weights": "M",
    "log_likelihood": "KM",
    "ancestors": "M",
}
"""What a filter may say of a step, by the names of ``Trace``; its shape after N, in the letters of the conventions."""

PAIRS = (("modality_mean", "modality_covariance"), ("particles", "log_weights"))
"""What comes together or not at all."""

Values = dict[str, Tensor]


def unchanged(observations: dict[str, Tensor], controls: Tensor) -> tuple[Any, Any]:
    """What a module is called with, where it takes the task's own."""
    return observations, controls


@dataclass(frozen=True)
class Adapter:
    """How a module is spoken to that does not speak SI units, or names things in its own way.

    Attributes:
        module: that follows the contract, in its own units.
        components: names of its state's components in its own order; without them, the task's.
        mean, std: (n,) m and rad, in its order: its states are ``(state - mean) / std``.
        inputs: observations by key and controls, SI units -> those that the module is called with.
        modalities: names of its K measurement models, in order.
        task: name of the task that it is for. Only a server needs it, which is not told otherwise.
    """

    module: nn.Module
    components: Sequence[str] = ()
    mean: Sequence[float] = ()
    std: Sequence[float] = ()
    inputs: Callable[[dict[str, Tensor], Tensor], tuple[Any, Any]] = unchanged
    modalities: Sequence[str] = ()
    task: str = ""


class Units:
    """From the task's SI units and order of components to a module's own, and back."""

    def __init__(self, task: Task, adapter: Adapter) -> None:
        names = [component.name for component in task.components]
        components = tuple(adapter.components) or tuple(names)
        if sorted(components) != sorted(names):
            wrong = next((name for name in components if name not in names), None)
            if wrong is not None:
                raise one_of(f"component of task {task.name!r}", wrong, names)
            raise BadInput(
                f"Adapter's components are {', '.join(components)}; task {task.name!r} has {', '.join(names)}"
            )
        for name, numbers in (("mean", adapter.mean), ("std", adapter.std)):
            if len(numbers) not in (0, len(names)):
                raise BadInput(f"Adapter's {name} has {len(numbers)} numbers, expected {len(names)}: one a component")
        if not all(std > 0 for std in adapter.std):
            raise BadInput(f"Adapter's std is {tuple(adapter.std)}, expected numbers above 0")
        self.order = [components.index(name) for name in names]
        self.back = [names.index(name) for name in components]
        self.mean = torch.tensor(adapter.mean or [0.0] * len(names), dtype=torch.float64)[self.order]
        self.std = torch.tensor(adapter.std or [1.0] * len(names), dtype=torch.float64)[self.order]

    def of_start(self, belief: Gaussian, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """SI units -> the module's, mean (N, n) and covariance (N, n, n)."""
        mean = (belief.mean.double() - self.mean) / self.std
        covariance = belief.covariance.double() / self.std / self.std[:, None]
        return mean[:, self.back].to(dtype), covariance[:, self.back][:, :, self.back].contiguous().to(dtype)

    def to_si(self, values: Values) -> Values:
        """The module's units -> SI; all but indices as float32."""
        return {name: self._one(name, value) for name, value in values.items()}

    def _one(self, name: str, value: Tensor) -> Tensor:
        if name == "ancestors":
            return value.int()
        value = value.double()
        if name.endswith("covariance"):
            value = value[..., self.order, :][..., self.order] * self.std * self.std[:, None]
        elif SHAPES[name].endswith("n"):
            value = value[..., self.order] * self.std + self.mean
        elif SHAPES[name] == "KW" and value.shape[-1] == len(self.order):
            value = value[..., self.order]
        return value.float()


def named(said: Any, source: str) -> Values:
    """What a module returned, by name."""
    if isinstance(said, Tensor):
        said = {"estimate_mean": said}
    elif isinstance(said, tuple) and len(said) == 2:
        said = dict(zip(("estimate_mean", "estimate_covariance"), said, strict=True))
    if not isinstance(said, Mapping):
        raise BadInput(
            f"{source} returns a {type(said).__name__}, expected a mean, a pair of mean and covariance, or a dict"
        )
    for name, value in said.items():
        if name not in SHAPES:
            raise one_of("value of a filter", str(name), SHAPES)
        if not isinstance(value, Tensor):
            raise BadInput(f"{source} returns {name} as a {type(value).__name__}, expected a Tensor")
    if "estimate_mean" not in said:
        raise BadInput(f"{source} returns {', '.join(said) or 'nothing'}, but not estimate_mean")
    for pair in PAIRS:
        there = [name for name in pair if name in said]
        if len(there) == 1:
            raise BadInput(f"{source} returns {there[0]} alone, expected both {pair[0]} and {pair[1]}, or neither")
    return {name: value.detach().cpu().clone() for name, value in said.items()}


def checked(values: Values, leading: Sequence[int], sizes: dict[str, int], who: str) -> Values:
    """The values, if shapes agree with each other and with those before, and no number is missing.

    Args:
        leading: expected sizes of the axes before those in ``SHAPES``. sizes: of the letters that are known; those that
            are new are added.
    """
    for name, value in values.items():
        found, letters = tuple(value.shape), SHAPES[name]
        expected = (*leading, *(sizes.get(letter, letter) for letter in letters))
        fits = len(found) == len(expected) and all(
            isinstance(e, str) or e == f for f, e in zip(found, expected, strict=True)
        )
        if not fits or ("W" in letters and found[-1] not in (1, sizes["n"])):
            shown = ", ".join(str(size) for size in expected)
            raise BadInput(f"{who} gives {name} of shape {found}, expected ({shown})")
        sizes |= dict(zip(letters, found[len(leading) :], strict=True))
        if value.isnan().any() or (not name.startswith(("log_", "prior_")) and not torch.isfinite(value).all()):
            raise BadInput(f"{who} gives {name} with a number that is not finite")
    return values


def derived(values: Values) -> Values:
    """Adds what follows: moments of particles, and what each measurement model alone makes of them."""
    particles = values.get("particles")
    if particles is None:
        return values
    for name in ("log_weights", "prior_log_weights"):
        if name in values:
            values[name] = torch.log_softmax(values[name], dim=-1)
    if "estimate_covariance" not in values:
        values["estimate_covariance"] = moments(particles, values["log_weights"]).covariance
    if {"log_likelihood", "prior_log_weights"} <= values.keys() and "modality_mean" not in values:
        alone = torch.log_softmax(values["prior_log_weights"].unsqueeze(-2) + values["log_likelihood"], dim=-1)
        each = moments(particles.unsqueeze(-3), alone)
        values["modality_mean"], values["modality_covariance"] = each.mean, each.covariance
    return values
