"""Conventions of an external filter: its adapter, unit conversion, and validation of its output.

Values are in SI units and in the task's order of components, unless an ``Adapter`` defines others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.task import Task
from beliefscope.filters.belief import Gaussian, moments

SHAPES = {
    "estimate_mean": "n",
    "estimate_covariance": "nn",
    "modality_mean": "Kn",
    "modality_covariance": "Knn",
    "weights": "KW",
    "effective_weights": "KW",
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
"""Values that a filter can return for a step, by the names of ``Trace``; their shapes after N (docs/conventions.md)."""

PAIRS = (("modality_mean", "modality_covariance"), ("particles", "log_weights"))
"""Values that require each other."""

Values = dict[str, Tensor]


def unchanged(observations: dict[str, Tensor], controls: Tensor) -> tuple[Any, Any]:
    """The default ``Adapter.inputs``: the task's observations and controls."""
    return observations, controls


@dataclass(frozen=True)
class Adapter:
    """Conventions of a module that differ from the task's: units, names and order.

    Attributes:
        module: follows the contract, in its own units.
        components: names of its state's components in its own order; by default the task's.
        mean, std: (n,) m and rad, in its order: its states are ``(state - mean) / std``.
        inputs: observations by key and controls, SI units -> arguments of the module.
        modalities: names of its K measurement models, in order.
        task: its task, by name, ``path/to/file.py:NAME`` or definition; needed by a server if not given elsewhere.
    """

    module: nn.Module
    components: Sequence[str] = ()
    mean: Sequence[float] = ()
    std: Sequence[float] = ()
    inputs: Callable[[dict[str, Tensor], Tensor], tuple[Any, Any]] = unchanged
    modalities: Sequence[str] = ()
    task: str | Task = ""


class Units:
    """Conversion between the task's SI units and order of components and a module's own."""

    def __init__(self, task: Task, adapter: Adapter) -> None:
        names = [component.name for component in task.components]
        components = tuple(adapter.components) or tuple(names)
        if sorted(components) != sorted(names):
            unknown = next((name for name in components if name not in names), None)
            if unknown is not None:
                raise unknown_name(f"component of task {task.name!r}", unknown, names)
            raise BadInput(
                f"Adapter's components are {', '.join(components)}; task {task.name!r} has {', '.join(names)}"
            )
        for name, numbers in (("mean", adapter.mean), ("std", adapter.std)):
            if len(numbers) not in (0, len(names)):
                raise BadInput(f"Adapter's {name} has {len(numbers)} numbers, expected {len(names)}: one per component")
        if not all(std > 0 for std in adapter.std):
            raise BadInput(f"Adapter's std is {tuple(adapter.std)}, expected numbers above 0")
        self.order = [components.index(name) for name in names]
        self.inverse = [names.index(name) for name in components]
        self.mean = torch.tensor(adapter.mean or [0.0] * len(names), dtype=torch.float64)[self.order]
        self.std = torch.tensor(adapter.std or [1.0] * len(names), dtype=torch.float64)[self.order]

    def from_si(self, belief: Gaussian, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Mean (N, n) and covariance (N, n, n) of a belief in SI units, in the module's units."""
        mean = (belief.mean.double() - self.mean) / self.std
        covariance = belief.covariance.double() / self.std / self.std[:, None]
        return mean[:, self.inverse].to(dtype), covariance[:, self.inverse][:, :, self.inverse].contiguous().to(dtype)

    def to_si(self, values: Values) -> Values:
        """The module's units -> SI; all but indices as float32."""
        return {name: self._convert(name, value) for name, value in values.items()}

    def _convert(self, name: str, value: Tensor) -> Tensor:
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


def named_values(output: Any, source: str) -> Values:
    """A module's return value, by name."""
    if isinstance(output, Tensor):
        output = {"estimate_mean": output}
    elif isinstance(output, tuple) and len(output) == 2:
        output = dict(zip(("estimate_mean", "estimate_covariance"), output, strict=True))
    if not isinstance(output, Mapping):
        raise BadInput(
            f"{source} returns a {type(output).__name__}, expected a mean, a pair of mean and covariance, or a dict"
        )
    for name, value in output.items():
        if name not in SHAPES:
            raise unknown_name("value of a filter", str(name), SHAPES)
        if not isinstance(value, Tensor):
            raise BadInput(f"{source} returns {name} as a {type(value).__name__}, expected a Tensor")
    if "estimate_mean" not in output:
        raise BadInput(f"{source} returns {', '.join(output) or 'nothing'}, but not estimate_mean")
    for pair in PAIRS:
        present = [name for name in pair if name in output]
        if len(present) == 1:
            raise BadInput(f"{source} returns only {present[0]}, expected both {pair[0]} and {pair[1]}, or neither")
    return {name: value.detach().cpu().clone() for name, value in output.items()}


def check_values(values: Values, leading: Sequence[int], sizes: dict[str, int], source: str) -> Values:
    """Returns the values. Raises BadInput for inconsistent shapes and numbers that are not finite.

    Args:
        leading: expected sizes of the axes before those in ``SHAPES``. sizes: of the axes' letters; extended by those
            that occur for the first time.
    """
    for name, value in values.items():
        shape, letters = tuple(value.shape), SHAPES[name]
        expected = (*leading, *(sizes.get(letter, letter) for letter in letters))
        fits = len(shape) == len(expected) and all(
            isinstance(e, str) or e == f for f, e in zip(shape, expected, strict=True)
        )
        if not fits or ("W" in letters and shape[-1] not in (1, sizes["n"])):
            text = ", ".join(str(size) for size in expected)
            raise BadInput(f"{source} returns {name} of shape {shape}, expected ({text})")
        sizes |= dict(zip(letters, shape[len(leading) :], strict=True))
        if value.isnan().any() or (not name.startswith(("log_", "prior_")) and not torch.isfinite(value).all()):
            raise BadInput(f"{source} returns {name} with a number that is not finite")
    return values


def derived(values: Values) -> Values:
    """Adds derived values: moments of the particles, and each measurement model's own posterior."""
    particles = values.get("particles")
    if particles is None:
        return values
    for name in ("log_weights", "prior_log_weights"):
        if name in values:
            values[name] = torch.log_softmax(values[name], dim=-1)
    if "estimate_covariance" not in values:
        values["estimate_covariance"] = moments(particles, values["log_weights"]).covariance
    if {"log_likelihood", "prior_log_weights"} <= values.keys() and "modality_mean" not in values:
        log_weights = torch.log_softmax(values["prior_log_weights"].unsqueeze(-2) + values["log_likelihood"], dim=-1)
        posterior = moments(particles.unsqueeze(-3), log_weights)
        values["modality_mean"], values["modality_covariance"] = posterior.mean, posterior.covariance
    return values
