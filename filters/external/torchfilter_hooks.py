"""Reads intermediate results of filters with torchfilter's interface through temporary hooks.

It uses public attributes of torchfilter, and of the paper authors' crossmodal filters built on it; other filters with
the same attributes work as well:

* particle filters: ``particle_states``, ``particle_log_weights``, ``measurement_model``; if that fuses several, its
  ``measurement_models``.
* Kalman filters: ``belief_mean``, ``belief_covariance``, ``virtual_sensor_model`` or ``measurement_model``; if the
  virtual sensor fuses several, its own ``virtual_sensor_model``.
* fused Kalman filters: ``filter_models``; the fused covariance as ``belief_covariance`` or
  ``state_covariance_estimate``.
* ``crossmodal_weight_model``, anywhere in the module: returns (N, K) log-weights, or (K, N, n) weights per
  component.

Such a particle filter resamples at the end of its step, after which all weights are equal. The posterior is derived
from the call of its measurement model, which takes the predicted particles while the filter has the prior weights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

RESAMPLED = "resampled"
"""Name of the particles (N, M, n) after a step, among the values of ``Capture.step``."""


@dataclass(frozen=True)
class Call:
    """A call of a submodule. before: the filter's belief at the time of the call, the prediction."""

    inputs: Mapping[str, Any]
    output: Any
    before: tuple[Tensor, ...]


class Capture:
    """Context manager that records a filter's submodule calls; ``step`` returns the values of the last step.

    Attributes:
        models: indices of the measurement models that took part in the last step; empty if none is recognised or the
            filter has only one, whose sensors are unknown.
    """

    def __init__(self, filter_: nn.Module | None) -> None:
        """filter_: None for a filter without submodules to record."""
        self.models: tuple[int, ...] = ()
        self._filter: Any = filter_
        self._calls: dict[nn.Module, Call] = {}
        self._hooks = ExitStack()
        named = filter_.named_modules() if filter_ is not None else ()
        self._weight_model = next((part for name, part in named if name.endswith("crossmodal_weight_model")), None)
        self._has_particles = hasattr(filter_, "particle_states") and hasattr(filter_, "particle_log_weights")
        self._has_values = self._has_particles or self._weight_model is not None or bool(self._kalman())

    def __enter__(self) -> Capture:
        with ExitStack() as hooks:
            for part, belief in dict(self._parts()).items():
                hooks.callback(part.register_forward_hook(self._recorder(belief), with_kwargs=True).remove)
            self._hooks = hooks.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._hooks.close()
        self._calls.clear()

    def step(self, mean: Tensor) -> dict[str, Tensor]:
        """The values of the step that estimated ``mean`` (N, n), by the names of ``Trace``; clears the recorded calls.

        Shapes are those of a trace, with N in place of T. Values that could not be read are missing; others may share
        the filter's memory.
        """
        if not self._has_values:
            return {}
        values = self._particles() if self._has_particles else self._gaussians()
        weights = self._weights(len(mean))
        effective = self._effective_weights(values, weights, mean)
        optional = {"weights": weights, "effective_weights": effective}
        self._calls.clear()
        return values | {name: value for name, value in optional.items() if value is not None}

    def _parts(self) -> Iterator[tuple[nn.Module, Callable[[], tuple[Tensor, ...]]]]:
        """(submodule to record, function that returns its filter's belief)."""
        if self._weight_model is not None:
            yield self._weight_model, tuple
        if self._has_particles:
            model = getattr(self._filter, "measurement_model", None)
            for part in (model, *_modules(model, "measurement_models")):
                if isinstance(part, nn.Module):
                    yield part, lambda: (_copy(self._filter.particle_log_weights),)
            return
        for filter_ in self._kalman():
            if filter_ is not self._filter:
                yield filter_, tuple
            for sensor in _sensors(filter_):
                yield sensor, lambda filter_=filter_: _belief(filter_)  # type: ignore[misc]

    def _recorder(self, belief: Callable[[], tuple[Tensor, ...]]) -> Callable[..., None]:
        def record(part: nn.Module, args: tuple[Any, ...], kwargs: dict[str, Any], output: Any) -> None:
            # Record the first call of a step only: an extended Kalman filter calls its model again for the Jacobian.
            if part not in self._calls:
                inputs = {"states": args[0], **kwargs} if args else kwargs
                self._calls[part] = Call(inputs, _copy(output), belief())

        return record

    def _kalman(self) -> list[nn.Module]:
        """The fused Kalman filters, or the filter itself if it is one."""
        fused = _modules(self._filter, "filter_models")
        return fused or ([self._filter] if hasattr(self._filter, "belief_mean") else [])

    def _particles(self) -> dict[str, Tensor]:
        model = self._filter.measurement_model
        call = self._calls.get(model)
        if call is None:
            return {}
        states, fused, (prior,) = _read(call.inputs.get("states")), call.output, call.before
        if not isinstance(states, Tensor) or states.ndim != 3 or not fused.shape == prior.shape == states.shape[:2]:
            return {}  # called in chunks, or with other states than the particles
        values = {
            "particles": states,
            "prior_log_weights": prior,  # ``adapter.derived`` normalises both
            "log_weights": prior + fused,
        }
        models = _modules(model, "measurement_models") or [model]
        outputs = {k: self._calls[part].output for k, part in enumerate(models) if part in self._calls}
        self.models = tuple(outputs) if len(models) > 1 else ()
        if outputs and all(output.shape == fused.shape for output in outputs.values()):
            first, *others = outputs.values()
            values["log_likelihood"] = torch.stack([first, *others], dim=1) if others else first.unsqueeze(1)
        after = _read(self._filter.particle_states)
        if after.shape == states.shape:
            values[RESAMPLED] = after
        return values

    def _gaussians(self) -> dict[str, Tensor]:
        filters = self._kalman()
        if not filters:
            return {}
        values: dict[str, Tensor] = {}
        covariance = _covariance(self._filter)
        if covariance is not None:
            values["estimate_covariance"] = covariance
        count = len(filters)
        if filters[0] is self._filter:
            count = len(_sensors(self._filter))
            sensors = {k: sensor for k, sensor in enumerate(_sensors(self._filter)) if sensor in self._calls}
            beliefs = [_belief(self._filter)] if len(sensors) == 1 else []
        else:
            called = {k: filter_ for k, filter_ in enumerate(filters) if filter_ in self._calls}
            sensors = {k: _sensors(filter_)[0] for k, filter_ in called.items() if len(_sensors(filter_)) == 1}
            covariances = [_covariance(filter_) for filter_ in called.values()]
            means = [self._calls[filter_].output for filter_ in called.values()]
            beliefs = [(m, c) for m, c in zip(means, covariances, strict=True) if c is not None]
            if len(beliefs) < len(called) or len(sensors) < len(called):
                return values
        self.models = tuple(sensors) if count > 1 else ()
        calls = [self._calls[sensor] for sensor in sensors.values() if sensor in self._calls]
        _stack(values, "modality", beliefs)
        if len(calls) == len(sensors):
            _stack(values, "predicted", [call.before for call in calls])
            if all(hasattr(filter_, "virtual_sensor_model") for filter_ in filters):
                _stack(values, "observation", [_mean_and_covariance(call.output) for call in calls])
        return values

    def _weights(self, count: int) -> Tensor | None:
        """(N, K, W) of the measurement models that took part."""
        if self._weight_model is None or self._weight_model not in self._calls:
            return None
        output = self._calls[self._weight_model].output
        output = output[0] if isinstance(output, tuple) else output
        if isinstance(output, Tensor) and output.ndim == 2 and len(output) == count:
            weights = output.exp().unsqueeze(-1)
        elif isinstance(output, Tensor) and output.ndim == 3 and output.shape[1] == count:
            weights = output.transpose(0, 1)
        else:
            return None
        return weights[:, list(self.models)] if 0 < len(self.models) < weights.shape[1] else weights

    def _effective_weights(self, values: Mapping[str, Tensor], weights: Tensor | None, mean: Tensor) -> Tensor | None:
        """(N, K, W) share of each model in the posterior if the fusion follows this package's rule; else None."""
        scores = values.get("log_likelihood")
        if scores is not None and scores.shape[1] > 1:
            scores = scores if weights is None else scores + weights.log()
            if _close(torch.logsumexp(scores, dim=1), self._calls[self._filter.measurement_model].output):
                return torch.logsumexp(values["prior_log_weights"].unsqueeze(1) + scores, dim=-1, keepdim=True).softmax(
                    1
                )
        modality = values.get("modality_mean")
        if modality is not None and weights is not None and modality.shape[1] == weights.shape[1] > 1:
            share = weights / weights.sum(1, keepdim=True)
            if _close((share * modality).sum(1), mean):
                return share
        return None


def _close(a: Tensor, b: Tensor) -> bool:
    """Whether two results agree to the precision of some hundred float32 sums."""
    return a.shape == b.shape and torch.allclose(a, b, rtol=1e-3, atol=1e-4)


def _modules(owner: Any, name: str) -> list[nn.Module]:
    """The modules of the attribute of this name if it is a ModuleList, else none."""
    modules = getattr(owner, name, None)
    return list(modules) if isinstance(modules, nn.ModuleList) else []


def _sensors(filter_: Any) -> list[nn.Module]:
    """A Kalman filter's virtual sensors, or its measurement model."""
    virtual = getattr(filter_, "virtual_sensor_model", None)
    sensor = virtual if virtual is not None else getattr(filter_, "measurement_model", None)
    return _modules(virtual, "virtual_sensor_model") or ([sensor] if isinstance(sensor, nn.Module) else [])


def _covariance(filter_: Any) -> Tensor | None:
    values = (getattr(filter_, name, None) for name in ("belief_covariance", "state_covariance_estimate"))
    return next((_copy(value) for value in values if isinstance(value, Tensor)), None)


def _belief(filter_: Any) -> tuple[Tensor, ...]:
    """Mean and covariance; empty if the filter lacks one."""
    mean, covariance = getattr(filter_, "belief_mean", None), _covariance(filter_)
    return (_copy(mean), covariance) if isinstance(mean, Tensor) and covariance is not None else ()


def _mean_and_covariance(output: Any) -> tuple[Tensor, ...]:
    """Mean and covariance of a virtual sensor's output, a mean and a Cholesky factor."""
    if not isinstance(output, tuple) or len(output) != 2:
        return ()
    mean, factor = output
    return mean, factor @ factor.transpose(-1, -2)


def _stack(values: dict[str, Tensor], name: str, beliefs: list[tuple[Tensor, ...]]) -> None:
    """Adds means (N, K, n) and covariances (N, K, n, n) if all K are complete."""
    if beliefs and all(len(belief) == 2 for belief in beliefs):
        values[f"{name}_mean"], values[f"{name}_covariance"] = (
            torch.stack(parts, dim=1) for parts in zip(*beliefs, strict=True)
        )


def _read(value: Any) -> Any:
    """A detached tensor on the CPU, which may share the filter's memory."""
    return value.detach().cpu() if isinstance(value, Tensor) else value


def _copy(value: Any) -> Any:
    """A detached copy of a tensor or tuple of tensors on the CPU, since the filter may modify its own in place."""
    if isinstance(value, tuple):
        return tuple(_copy(item) for item in value)
    return value.detach().cpu().clone() if isinstance(value, Tensor) else value
