"""Calls of an external filter: types and devices of its arguments, its random numbers and its state."""

from __future__ import annotations

import copy
import inspect
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task
from beliefscope.filters.batch import check_shapes
from beliefscope.filters.external.adapter import MIN_STEPS, Adapter, FailedStep

CPU = torch.device("cpu")

UNBOUND = 256
"""Steps whose views of the inputs exist at the same time."""

DT = "dt"
"""Key under which a filter receives the durations of irregular steps."""


IN_TRAINING = (nn.modules.dropout._DropoutNd, nn.modules.batchnorm._BatchNorm)
"""Modules that do something else in training mode."""

PRESENT = ".present"
"""End of the keys under which a filter receives the masks of sensors."""


def is_stepwise(filter_: Any) -> bool:
    """Whether the filter is called for one step at a time."""
    return hasattr(filter_, "initialize_beliefs")


def has_own_start(filter_: Any) -> bool:
    """Whether the filter supplies its initial belief: ``initialize_beliefs`` has no parameters."""
    return is_stepwise(filter_) and _parameters(filter_.initialize_beliefs) == []


def takes_file(build: Any) -> bool:
    """Whether a build function has a parameter without a default: it receives the path of the weights."""
    parameters = _parameters(build) or []
    return any(p.default is p.empty and p.kind is p.POSITIONAL_OR_KEYWORD for p in parameters)


def _parameters(function: Any) -> list[inspect.Parameter] | None:
    """The parameters of a function; None if it has no signature, as some built-in functions."""
    try:
        return [*inspect.signature(function).parameters.values()]
    except (TypeError, ValueError):
        return None


def takes_start(filter_: Any) -> bool:
    """Whether the filter is called step by step from a belief that it is given."""
    return is_stepwise(filter_) and not has_own_start(filter_)


def evaluation_mode(module: nn.Module, name: str) -> None:
    """Set a module to evaluation mode. Warns if its training mode has other results."""
    if module.training and any(isinstance(part, IN_TRAINING) for part in module.modules()):
        warnings.warn(
            f"{name} is in training mode; it runs in evaluation mode: without dropout, and with the stored statistics "
            "of batch normalisation",
            stacklevel=3,
        )
    module.eval()


@contextmanager
def with_advice(filter_: Any, episodes: Sequence[Episode]) -> Iterator[None]:
    """Adds to a ``FailedStep`` which readings are removed, or how to examine the filter if ``diagnose`` restarts it."""
    try:
        yield
    except FailedStep as error:
        removed = [key for key, values in episodes[0].observations.items() if np.isnan(values).any()]
        if removed:
            text = f"{error}; the removed readings of {', '.join(removed)} are NaN, by Adapter(absent='nan')"
            raise FailedStep(text, error.step) from error
        is_known = all(np.isfinite(episode.states).all() for episode in episodes)
        if error.step >= MIN_STEPS and takes_start(filter_) and is_known:
            error.advice = "`beliefscope diagnose` restarts it at the true state and names the cause"
        raise


def device_of(filter_: Any) -> torch.device:
    """The device of a module's parameters and buffers."""
    return next((tensor.device for tensor in _tensors(filter_)), CPU)


def dtype_of(filter_: Any) -> torch.dtype:
    """The floating-point type of a module's parameters and buffers; that of any other filter is float64."""
    if not isinstance(filter_, nn.Module):
        return torch.float64
    types = (tensor.dtype for tensor in _tensors(filter_) if tensor.is_floating_point())
    return next(types, torch.float32)


def described(error: Exception, where: str, adapter: Adapter, task: Task) -> str:
    """An exception of a filter in one line, with its location, such as ``step 0``."""
    message = (str(error).strip().splitlines() or ["no message"])[0]
    text = f"fails at {where}: {type(error).__name__}: {message}"
    if isinstance(adapter.module, nn.Module) and re.search("scalar type|dtype|[Ii]nput type", message):
        types = [str(dtype).removeprefix("torch.") for dtype in (dtype_of(adapter.module), torch.get_default_dtype())]
        text += f"; its inputs are {types[0]} as its parameters, images uint8; "
        text += f"tensors that it creates without a dtype are {types[1]}"
    elif (
        where == "step 0" and adapter.batched and isinstance(error, IndexError | TypeError | ValueError | RuntimeError)
    ):
        text += "; the first axis of its inputs is that of N episodes; Adapter(filter, batched=False) has none"
    if isinstance(error, KeyError) and message.strip("'") not in task.observations:
        text += f"; the observations are {', '.join(task.observations)}"
    return text


def call(adapter: Adapter, observations: Mapping[str, Tensor], controls: Tensor, device: torch.device) -> Any:
    """The filter's output for inputs on the CPU, (N, ...) or (T, N, ...), in the types that it takes.

    device: of the filter (``device_of``).
    """
    inputs = _inputs(adapter, observations, controls, device)
    return _function(adapter.module)(observations=inputs[0], controls=inputs[1])


def model_arguments(
    adapter: Adapter, observations: Mapping[str, Tensor], controls: Tensor, states: Tensor
) -> tuple[Any, Any]:
    """States (C, n) in the filter's units, and its observations, in the types that its measurement models take."""
    device = device_of(adapter.module)
    inputs = _inputs(adapter, observations, controls, device)
    return _argument(adapter.module, states, device), inputs[0]


def _inputs(
    adapter: Adapter, observations: Mapping[str, Tensor], controls: Tensor, device: torch.device
) -> tuple[Any, Any]:
    filter_ = adapter.module
    if device.type == "cpu" and isinstance(filter_, nn.Module):
        return adapter.inputs(dict(observations), controls)
    converted = {key: _argument(filter_, value, device) for key, value in observations.items()}
    return adapter.inputs(converted, _argument(filter_, controls, device))


def initialize(filter_: Any, *belief: Tensor) -> Any:
    """Starts the filter at a belief (N, n), (N, n, n), or without one at its own; its result."""
    device = device_of(filter_)
    arguments = zip(("mean", "covariance"), belief, strict=False)
    return filter_.initialize_beliefs(**{name: _argument(filter_, value, device) for name, value in arguments})


def inputs_of(task: Task, episodes: Sequence[Episode], dtype: torch.dtype) -> tuple[dict[str, Tensor], Tensor]:
    """Observations (T, N, ...) by key, images as uint8; controls (T, N, c).

    Of episodes with their own times, observations also have ``dt`` (T, N): s since the previous step. Of sensors with
    absent readings (``Task.masks``), they have ``KEY.present`` (T, N): 1 at steps with a reading, else 0.
    """
    for number, episode in enumerate(episodes):
        check_shapes(task, episode, f"episode {number}")
    observations = {
        key: torch.from_numpy(np.stack([episode.observations[key] for episode in episodes], axis=1))
        for key in task.observations
    }
    if any(episode.time is not None for episode in episodes):
        observations[DT] = torch.from_numpy(np.stack([episode.durations for episode in episodes], axis=1))
    for key in task.masks:
        present = np.stack([episode.present(key) for episode in episodes], axis=1)
        observations[key + PRESENT] = torch.from_numpy(present)
    controls = torch.from_numpy(np.stack([episode.controls for episode in episodes], axis=1)).to(dtype)
    return {k: v if v.dtype == torch.uint8 else v.to(dtype) for k, v in observations.items()}, controls


def steps_of(observations: Mapping[str, Tensor], controls: Tensor) -> Iterator[tuple[dict[str, Tensor], Tensor]]:
    """Observations and controls (T, ...) of each step. They are unbound in blocks, which is faster than indexing."""
    for start in range(0, len(controls), UNBOUND):
        block = slice(start, start + UNBOUND)
        for control, *row in zip(*(v[block].unbind() for v in (controls, *observations.values())), strict=True):
            yield dict(zip(observations, row, strict=True)), control


def _function(filter_: Any) -> Any:
    """A module is called, so that its hooks run; another object's ``forward``, or else itself."""
    return filter_ if isinstance(filter_, nn.Module) else getattr(filter_, "forward", filter_)


def _argument(filter_: Any, value: Tensor, device: torch.device) -> Any:
    return value.to(device) if isinstance(filter_, nn.Module) else value.numpy()


def _tensors(filter_: Any) -> Iterator[Tensor]:
    if isinstance(filter_, nn.Module):
        yield from filter_.parameters()
        yield from filter_.buffers()


@contextmanager
def seeded(seed: int, filter_: Any) -> Iterator[None]:
    """Seeds the global generators of torch and NumPy; restores them afterwards."""
    with kept_generators(filter_) as seed_generators:
        seed_generators(seed)
        yield


@contextmanager
def kept_generators(filter_: Any) -> Iterator[Callable[[int], None]]:
    """Restores the global generators of torch and NumPy afterwards. Gives a function that seeds them."""
    device = device_of(filter_)
    state = np.random.get_state()  # noqa: NPY002 - filters of other projects use the global generator
    generators = [torch.default_generator]
    if device.type == "cuda":
        generators.append(
            torch.cuda.default_generators[torch.cuda.current_device() if device.index is None else device.index]
        )
    states = [generator.get_state() for generator in generators]

    def seed_generators(seed: int) -> None:
        for generator in generators:
            generator.manual_seed(seed)
        np.random.seed(seed % 2**32)  # noqa: NPY002

    try:
        yield seed_generators
    finally:
        for generator, own in zip(generators, states, strict=True):
            generator.set_state(own)
        np.random.set_state(state)  # noqa: NPY002


def snapshot(filter_: Any, source: str) -> Any:
    """Everything that a step may change: the result of ``get_state``, or a copy of all attributes but parameters.

    Raises BadInput if the attributes cannot be copied.
    """
    if hasattr(filter_, "get_state"):
        return copy.deepcopy(filter_.get_state())
    try:
        return copy.deepcopy([_state(part) for part in _parts(filter_)], _shared(filter_))
    except Exception as error:
        raise BadInput(
            f"{source} cannot be copied ({type(error).__name__}: {error}): give it get_state and set_state"
        ) from error


def restore(filter_: Any, state: Any) -> None:
    """Returns the filter to a state of ``snapshot``, which stays valid."""
    if hasattr(filter_, "get_state"):
        filter_.set_state(copy.deepcopy(state))
        return
    copied = copy.deepcopy(state, _shared(filter_))
    for part, (attributes, buffers) in zip(_parts(filter_), copied, strict=True):
        for name in [name for name in _attributes(part) if name not in attributes]:
            delattr(part, name)
        vars(part).update(attributes)
        if isinstance(part, nn.Module):
            part._buffers.update(buffers)


def _parts(filter_: Any) -> list[Any]:
    """The filter and, of a module, all submodules; their identity is kept, since hooks refer to it."""
    if isinstance(filter_, nn.Module):
        return list(filter_.modules())
    return [filter_] if hasattr(filter_, "__dict__") else []


def _state(part: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Attributes and buffers."""
    return _attributes(part), dict(part._buffers) if isinstance(part, nn.Module) else {}


def _attributes(part: Any) -> dict[str, Any]:
    internal = vars(nn.Module()).keys() if isinstance(part, nn.Module) else ()
    return {name: value for name, value in vars(part).items() if name not in internal}


def _shared(filter_: Any) -> dict[int, Any]:
    """Memo of ``copy.deepcopy`` for objects that are not copied: the filter, its modules and parameters."""
    owned = [filter_] if isinstance(filter_, nn.Module) else [v for v in _values(filter_) if isinstance(v, nn.Module)]
    shared: list[Any] = [filter_, *(parameter for module in owned for parameter in module.parameters())]
    if isinstance(filter_, nn.Module):
        shared += filter_.modules()
    return {id(item): item for item in shared}


def _values(filter_: Any) -> list[Any]:
    return list(vars(filter_).values()) if hasattr(filter_, "__dict__") else []


def step_inputs(
    task: Task, adapter: Adapter, episode: Episode, step: int, dtype: torch.dtype
) -> tuple[dict[str, Tensor], Tensor]:
    """Observations (1, ...) by key and controls (1, c) of a step; without the axis N if the filter takes none."""
    index = slice(step, step + 1) if adapter.batched else step
    observations = {key: torch.as_tensor(episode.observations[key][index]) for key in task.observations}
    if episode.time is not None:
        observations[DT] = torch.as_tensor(episode.durations[index])
    for key in task.masks:
        observations[key + PRESENT] = torch.as_tensor(episode.present(key)[index])
    typed = {key: v if v.dtype == torch.uint8 else v.to(dtype) for key, v in observations.items()}
    return typed, torch.as_tensor(episode.controls[index]).to(dtype)
