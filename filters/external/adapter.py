"""Conventions of an external filter: its adapter, unit conversion, and validation of its output.

Values are in SI units and in the task's order of components, unless an ``Adapter`` defines others. Innovations are in
the units of their sensors.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from beliefscope.datasets.errors import BadInput, type_name, unknown_name
from beliefscope.datasets.task import Task
from beliefscope.filters.belief import Gaussian

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
    "innovation": "Km",
    "innovation_covariance": "Kmm",
    "accepted": "K",
}
"""Values that a filter can return for a step, by the names of ``Trace``; their shapes after N (docs/conventions.md)."""

MEASUREMENTS = ("innovation", "innovation_covariance", "accepted")
"""Values in the spaces of the K measurements: NaN after the last channel, and where there is no measurement."""

EXTRA = "extra/"
"""Start of the names of the filter's own scalars."""

PAIRS = (
    ("modality_mean", "modality_covariance"),
    ("particles", "log_weights"),
    ("innovation", "innovation_covariance"),
)
"""Values that require each other."""

Values = dict[str, Tensor]


MIN_STEPS = 5
"""Smallest number of steps after which a filter that fails is restarted."""


class FailedStep(BadInput):
    """A filter fails at a step, or returns a number that is not finite."""

    def __init__(self, message: str, step: int = 0) -> None:  # the default is for pickle, which then sets it
        super().__init__(message)
        self.step = step


def unchanged(observations: dict[str, Any], controls: Any) -> tuple[Any, Any]:
    """The default ``Adapter.inputs``: the task's observations and controls."""
    return observations, controls


@dataclass(frozen=True)
class Adapter:
    """Conventions of a filter that differ from the task's: units, names and order.

    Attributes:
        module: follows the contract, in its own units. A ``torch.nn.Module`` takes tensors on the device of its
            parameters, any other object NumPy arrays.
        components: names of its state's components in its own order; by default the task's.
        mean, std: (n,) m and rad, in its order: its states are ``(state - mean) / std``.
        initial_std: (n,) standard deviations of the first belief, in its units and order; by default the root of 0.1.
        inputs: observations by key and controls, SI units -> arguments of the module.
        modalities: names of its K measurement models, in order.
        task: its task, by name, ``FILE.py:NAME`` or definition; needed by a server if not given elsewhere.
        batched: whether it filters N episodes at once. Otherwise it runs once per episode, without the axis N.
        log_likelihood: states (C, n) in its units and the inputs of one step, with N = 1 -> (K, C) log-likelihoods of
            its measurement models, or (K + 1, C) with the fused one last; enables likelihood maps.
        absent: reading of a sensor that an ablation removes: ``mean`` over the episode, or ``nan`` for a filter that
            skips such readings (an image is black).
    """

    module: Any
    components: Sequence[str] = ()
    mean: Sequence[float] = ()
    std: Sequence[float] = ()
    inputs: Callable[[dict[str, Tensor], Tensor], tuple[Any, Any]] = unchanged
    modalities: Sequence[str] = ()
    task: str | Task = ""
    batched: bool = True
    absent: Literal["mean", "nan"] = "mean"
    log_likelihood: Callable[[Any, Any], Any] | None = None
    initial_std: Sequence[float] = ()


@cache
def letters_of(name: str) -> str:
    """Letters of the axes of a value after N. Raises BadInput for an unknown name."""
    if name.startswith(EXTRA):
        if not re.fullmatch(r"[\w-]{1,80}", name.removeprefix(EXTRA)):
            raise BadInput(f"extra value {name.removeprefix(EXTRA)!r}: a name has up to 80 letters, digits, - and _")
        return ""
    if name not in SHAPES:
        raise unknown_name("filter output", name, [*SHAPES, "extra"])
    return SHAPES[name]


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
        for name, numbers in (("mean", adapter.mean), ("std", adapter.std), ("initial_std", adapter.initial_std)):
            if len(numbers) not in (0, len(names)):
                raise BadInput(f"Adapter's {name} has {len(numbers)} numbers, expected {len(names)}: one per component")
        for name, deviations in (("std", adapter.std), ("initial_std", adapter.initial_std)):
            if not all(std > 0 for std in deviations):
                raise BadInput(f"Adapter's {name} is {tuple(deviations)}, expected numbers above 0")
        self.order = [components.index(name) for name in names]
        self.inverse = [names.index(name) for name in components]
        self.mean = torch.tensor(adapter.mean or [0.0] * len(names), dtype=torch.float64)[self.order]
        self.std = torch.tensor(adapter.std or [1.0] * len(names), dtype=torch.float64)[self.order]
        self.initial_std = None
        if adapter.initial_std:
            self.initial_std = torch.tensor(adapter.initial_std, dtype=torch.float64)[self.order] * self.std
        self._same = not adapter.mean and not adapter.std and components == tuple(names)

    def from_si(self, belief: Gaussian, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Mean (N, n) and covariance (N, n, n) of a belief in SI units, in the module's units."""
        mean = (belief.mean.double() - self.mean) / self.std
        covariance = belief.covariance.double() / self.std / self.std[:, None]
        return mean[:, self.inverse].to(dtype), covariance[:, self.inverse][:, :, self.inverse].contiguous().to(dtype)

    def states_from_si(self, states: Tensor, dtype: torch.dtype) -> Tensor:
        """States (C, n) in SI units, in the module's units."""
        return ((states.double() - self.mean) / self.std)[:, self.inverse].to(dtype)

    def to_si(self, values: Values) -> Values:
        """The module's units -> SI; all but indices as float32."""
        return {name: self._convert(name, value) for name, value in values.items()}

    def _convert(self, name: str, value: Tensor) -> Tensor:
        if name == "ancestors":
            return value.int()
        if self._same:
            return value.float()
        value, letters = value.double(), letters_of(name)
        if letters.endswith("nn"):
            value = value[..., self.order, :][..., self.order] * self.std * self.std[:, None]
        elif letters.endswith("n"):
            value = value[..., self.order] * self.std + self.mean
        elif letters == "KW" and value.shape[-1] == len(self.order):
            value = value[..., self.order]
        return value.float()


def named_values(output: Any, source: str, task: Task) -> Values:
    """A filter's return value for a step or all steps, by name, as tensors on the CPU that may share its memory.

    Means and particles may have quaternions (``Task.states``). Raises BadInput for unknown names, incomplete pairs and
    values that are no arrays.
    """
    if isinstance(output, Tensor | np.ndarray):
        output = {"estimate_mean": output}
    elif isinstance(output, tuple) and len(output) == 2:
        output = dict(zip(("estimate_mean", "estimate_covariance"), output, strict=True))
    if not isinstance(output, Mapping):
        raise BadInput(
            f"{source} returns {type_name(output)}, expected a mean, a pair of mean and covariance, or a dict"
        )
    named = {name: value for name, value in output.items() if name != "extra"}
    named |= {f"{EXTRA}{name}": value for name, value in output.get("extra", {}).items()}
    letters = {name: letters_of(str(name)) for name in named}
    if "estimate_mean" not in named:
        raise BadInput(f"{source} returns {', '.join(named) or 'nothing'}, but not estimate_mean")
    values: Values = {}
    for name, value in named.items():
        if isinstance(value, list | tuple) and name in MEASUREMENTS:
            parts = [None if part is None else _tensor(part, name, source) for part in value]
            leading = np.shape(named["estimate_mean"])[:-1]
            _check_parts(parts, len(letters[name]) - 1, leading, f"{source} returns {name}")
            values[name] = _padded(parts, len(letters[name]) - 1, leading)
        else:
            values[name] = _tensor(value, name, source)
    for pair in PAIRS:
        present = [name for name in pair if name in values]
        if len(present) == 1:
            raise BadInput(f"{source} returns only {present[0]}, expected both {pair[0]} and {pair[1]}, or neither")
    if task.rotations:
        for name, axes in letters.items():
            if axes.endswith("n") and not axes.endswith("nn"):
                values[name] = torch.from_numpy(task.states(values[name].numpy()))
    return values


def _tensor(value: Any, name: str, source: str) -> Tensor:
    """A tensor on the CPU."""
    if isinstance(value, Tensor):
        return value.detach().cpu() if value.requires_grad or not value.is_cpu else value
    is_scalar = name.startswith(EXTRA) or name == "accepted"
    if isinstance(value, np.ndarray | np.generic) or (is_scalar and isinstance(value, bool | int | float)):
        array = np.array(value)  # torch refuses some layouts of arrays, such as read-only ones and negative strides
        if array.dtype.kind in "biuf":
            return torch.from_numpy(array)
    raise BadInput(f"{source} returns {name} as {type_name(value)}, expected an array or a Tensor")


def copied(values: Values) -> Values:
    """Copies, since a filter may modify its own values in place."""
    return {name: value.clone() for name, value in values.items()}


def _check_parts(parts: Sequence[Tensor | None], axes: int, leading: Sequence[int], returns: str) -> None:
    """Raises BadInput for values of another shape than (..., m) or (..., m, m), with the arguments of ``_padded``."""
    for k, part in enumerate(parts):
        shape = () if part is None else tuple(part.shape)
        if part is not None and shape != (*leading, *shape[-1:] * axes):
            expected = ", ".join(map(str, [*leading, *("m",) * axes]))
            raise BadInput(f"{returns} of measurement {k + 1} of shape {shape}, expected ({expected})")


def _padded(parts: Sequence[Tensor | None], axes: int, leading: Sequence[int]) -> Tensor:
    """K values (..., m_k) or (..., m_k, m_k) as (..., K, m, m), m the largest m_k; NaN elsewhere and for None.

    Args:
        axes: number of axes of size m_k, 0 to 2. leading: sizes of the axes before.
    """
    m = max((part.shape[-1] for part in parts if part is not None), default=0) if axes else 0
    values = np.full((*leading, len(parts), *(m,) * axes), np.nan)  # NumPy is faster for values of a step
    for k, part in enumerate(parts):
        if part is not None:
            size = slice(part.shape[-1] if axes else None)
            values[(..., k, *(size,) * axes)] = part.double().numpy()
    return torch.from_numpy(values)


def check_values(values: Values, leading: Sequence[int], sizes: dict[str, int], source: str, step: int = 0) -> Values:
    """Returns the values. Raises BadInput for inconsistent shapes, and FailedStep for numbers that are not finite.

    Args:
        leading: expected sizes of the axes before those in ``SHAPES``: (T, N) or (N). sizes: of the axes' letters; new
            ones are added.
        step: of the values, if they have no axis T.
    """
    for name, value in values.items():
        shape, letters = tuple(value.shape), letters_of(name)
        expected = (*leading, *(sizes.get(letter, letter) for letter in letters))
        fits = len(shape) == len(expected) and all(
            isinstance(e, str) or e == f for f, e in zip(shape, expected, strict=True)
        )
        if not fits or ("W" in letters and shape[-1] not in (1, sizes["n"])):
            text = ", ".join(str(size) for size in expected)
            raise BadInput(f"{source} returns {name} of shape {shape}, expected ({text})")
        sizes |= dict(zip(letters, shape[len(leading) :], strict=True))
        may_be_infinite, may_be_nan = name.startswith(("log_", "prior_")), name in MEASUREMENTS
        if _is_finite(value):
            continue
        if (not may_be_nan and value.isnan().any()) or (not may_be_infinite and value.isinf().any()):
            if len(leading) > 1:
                step = int((~value.isfinite()).flatten(1).any(1).int().argmax())
            raise FailedStep(f"{source} returns {name} with a number that is not finite", step)
    if "effective_weights" in values and values["effective_weights"].shape[-2] > 1:
        _check_sum(values["effective_weights"].sum(-2), source)
    sizes.pop("m", None)  # the number of channels may change between steps
    return values


SUM_TOLERANCE = 0.01
"""Largest difference of the sum of effective weights from one."""


def _check_sum(sums: Tensor, source: str) -> None:
    """Raise BadInput unless sums of effective weights over the models are one, or 0 for a step without an update."""
    wrong = sums[((sums - 1).abs() > SUM_TOLERANCE) & (sums != 0)]
    if wrong.numel():
        text = f"{float(wrong.flatten()[0]):.3g}"
        raise BadInput(f"{source} returns effective_weights with the sum {text} over the K models, expected 1")


def _is_finite(value: Tensor) -> bool:
    """Whether all numbers are certainly finite: their sum is, which is cheap to compute."""
    return not value.is_floating_point() or bool(value.sum().isfinite())


def model_names(
    values: Values, axis: int, names: Sequence[str], task: Task, models: Sequence[int] = (), source: str = "the filter"
) -> tuple[str, ...]:
    """Names of the measurement models: as given, or the task's modalities if there are as many, or numbered.

    A single model of a task with several modalities is never named after one that it may not read.

    Args:
        axis: of the values that indexes the models. models: indices of the participating models, if not all.

    Raises BadInput if the number of given names does not match.
    """
    counts = [values[name].shape[axis] for name, shape in SHAPES.items() if shape[0] == "K" and name in values]
    count, modalities = max(counts, default=0), tuple(task.modalities)
    candidates = tuple(names) or modalities
    if count and len(candidates) > count == len(models):
        return tuple(candidates[k] for k in models)
    if count and len(candidates) == count:
        return candidates
    if names and count:
        raise BadInput(f"{source} names {len(names)} modalities, {', '.join(names)}, but has {count}")
    return tuple(f"model-{k + 1}" for k in range(count))
