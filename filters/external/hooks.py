"""Reads what a filter with torchfilter's interface knows while it steps, by hooks that are gone afterwards.

Read are public names of torchfilter, and of the crossmodal filters that the paper's authors built upon it; what is
called the same elsewhere is read the same:

* particle filters: ``particle_states``, ``particle_log_weights``, ``measurement_model``; where that one fuses several,
  its ``measurement_models``.
* Kalman filters: ``belief_mean``, ``belief_covariance``, ``virtual_sensor_model`` or ``measurement_model``; where the
  virtual sensor fuses several, its own ``virtual_sensor_model``.
* several Kalman filters that are fused: ``filter_models``; the fused covariance as ``belief_covariance`` or
  ``state_covariance_estimate``.
* ``crossmodal_weight_model``, wherever it sits: gives (N, K) log-weights, or (K, N, n) weights of each component.

Such a particle filter resamples within its step, and equal weights are what is left. Its measurement model is called
before that, with the predicted particles and while the filter still has their prior weights: hence the posterior.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class Call:
    """A call of a part of a filter. before: what the filter believed meanwhile: what it predicted."""

    inputs: Mapping[str, Any]
    output: Any
    before: tuple[Tensor, ...]


class Capture:
    """Listens to a filter while it is entered; ``step`` says what the last step knew.

    Attributes:
        models: indices of the measurement models that took part in the last step; empty where none is recognised.
    """

    def __init__(self, filter_: nn.Module) -> None:
        self.models: tuple[int, ...] = ()
        self._filter: Any = filter_
        self._calls: dict[nn.Module, Call] = {}
        self._hooks = ExitStack()
        named = filter_.named_modules()
        self._weigher = next((part for name, part in named if name.endswith("crossmodal_weight_model")), None)
        self._of_particles = hasattr(filter_, "particle_states") and hasattr(filter_, "particle_log_weights")

    def __enter__(self) -> Capture:
        with ExitStack() as hooks:
            for part, believer in dict(self._parts()).items():
                hooks.callback(part.register_forward_hook(self._keep(believer), with_kwargs=True).remove)
            self._hooks = hooks.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._hooks.close()
        self._calls.clear()

    def step(self, mean: Tensor) -> dict[str, Tensor]:
        """What the step that estimated ``mean`` (N, n) knew, by the names of ``Trace``; forgets it.

        Shapes are a trace's, with N in place of T. What could not be read is not there.
        """
        found = self._particles() if self._of_particles else self._gaussians()
        weights = self._weights(len(mean))
        shares = self._shares(found, weights, mean)
        found |= {name: value for name, value in (("weights", weights), ("acting", shares)) if value is not None}
        self._calls.clear()
        return found

    def _parts(self) -> Iterator[tuple[nn.Module, Callable[[], tuple[Tensor, ...]]]]:
        """(part to listen to, what its filter believes)."""
        if self._weigher is not None:
            yield self._weigher, tuple
        if self._of_particles:
            model = getattr(self._filter, "measurement_model", None)
            for part in (model, *_several(model, "measurement_models")):
                if isinstance(part, nn.Module):
                    yield part, lambda: (_copied(self._filter.particle_log_weights),)
            return
        for filter_ in self._kalman():
            if filter_ is not self._filter:
                yield filter_, tuple
            for sensor in _sensors(filter_):
                yield sensor, lambda filter_=filter_: _belief(filter_)  # type: ignore[misc]

    def _keep(self, believer: Callable[[], tuple[Tensor, ...]]) -> Callable[..., None]:
        def keep(part: nn.Module, args: tuple[Any, ...], kwargs: dict[str, Any], output: Any) -> None:
            # The first call of a step counts: an extended Kalman filter calls its model again for the Jacobian.
            if part not in self._calls:
                inputs = {"states": args[0], **kwargs} if args else kwargs
                self._calls[part] = Call(inputs, _copied(output), believer())

        return keep

    def _kalman(self) -> list[nn.Module]:
        """The Kalman filters: those that are fused, or the filter itself; none where it is something else."""
        several = _several(self._filter, "filter_models")
        return several or ([self._filter] if hasattr(self._filter, "belief_mean") else [])

    def _particles(self) -> dict[str, Tensor]:
        model = self._filter.measurement_model
        call = self._calls.get(model)
        if call is None:
            return {}
        states, fused, (prior,) = _copied(call.inputs.get("states")), call.output, call.before
        if not isinstance(states, Tensor) or states.ndim != 3 or not fused.shape == prior.shape == states.shape[:2]:
            return {}  # asked piece by piece, or of something else than the particles
        found = {
            "particles": states,
            "prior_log_weights": torch.log_softmax(prior, dim=-1),
            "log_weights": torch.log_softmax(prior + fused, dim=-1),
        }
        models = _several(model, "measurement_models") or [model]
        each = {k: self._calls[part].output for k, part in enumerate(models) if part in self._calls}
        self.models = tuple(each)
        if each and all(one.shape == fused.shape for one in each.values()):
            found["log_likelihood"] = torch.stack(list(each.values()), dim=1)
        after = _copied(self._filter.particle_states)
        if after.shape == states.shape:
            same = (after.unsqueeze(2) == states.unsqueeze(1)).all(-1)  # (N, M after, M before)
            if same.any(-1).all():
                found["ancestors"] = same.int().argmax(-1)
        return found

    def _gaussians(self) -> dict[str, Tensor]:
        filters = self._kalman()
        if not filters:
            return {}
        found: dict[str, Tensor] = {}
        whole = _covariance(self._filter)
        if whole is not None:
            found["estimate_covariance"] = whole
        if filters[0] is self._filter:
            sensors = {k: sensor for k, sensor in enumerate(_sensors(self._filter)) if sensor in self._calls}
            believed = [_belief(self._filter)] if len(sensors) == 1 else []
        else:
            acted = {k: filter_ for k, filter_ in enumerate(filters) if filter_ in self._calls}
            sensors = {k: _sensors(filter_)[0] for k, filter_ in acted.items() if len(_sensors(filter_)) == 1}
            covariances = [_covariance(filter_) for filter_ in acted.values()]
            means = [self._calls[filter_].output for filter_ in acted.values()]
            believed = [(m, c) for m, c in zip(means, covariances, strict=True) if c is not None]
            if len(believed) < len(acted) or len(sensors) < len(acted):
                return found
        self.models = tuple(sensors)
        calls = [self._calls[sensor] for sensor in sensors.values() if sensor in self._calls]
        _stack(found, "modality", believed)
        if len(calls) == len(sensors):
            _stack(found, "predicted", [call.before for call in calls])
            if all(hasattr(filter_, "virtual_sensor_model") for filter_ in filters):
                _stack(found, "observation", [_of_factor(call.output) for call in calls])
        return found

    def _weights(self, count: int) -> Tensor | None:
        """(N, K, W) of the measurement models that took part."""
        if self._weigher is None or self._weigher not in self._calls:
            return None
        output = self._calls[self._weigher].output
        output = output[0] if isinstance(output, tuple) else output
        if isinstance(output, Tensor) and output.ndim == 2 and len(output) == count:
            weights = output.exp().unsqueeze(-1)
        elif isinstance(output, Tensor) and output.ndim == 3 and output.shape[1] == count:
            weights = output.transpose(0, 1)
        else:
            return None
        return weights[:, list(self.models)] if 0 < len(self.models) < weights.shape[1] else weights

    def _shares(self, found: Mapping[str, Tensor], weights: Tensor | None, mean: Tensor) -> Tensor | None:
        """(N, K, W) share of each model in what was fused, where that followed the rule that ours follow; else None."""
        each = found.get("log_likelihood")
        if each is not None and each.shape[1] > 1:
            each = each if weights is None else each + weights.log()
            if _alike(torch.logsumexp(each, dim=1), self._calls[self._filter.measurement_model].output):
                return torch.logsumexp(found["prior_log_weights"].unsqueeze(1) + each, dim=-1, keepdim=True).softmax(1)
        modality = found.get("modality_mean")
        if modality is not None and weights is not None and modality.shape[1] == weights.shape[1] > 1:
            share = weights / weights.sum(1, keepdim=True)
            if _alike((share * modality).sum(1), mean):
                return share
        return None


def _alike(one: Tensor, other: Tensor) -> bool:
    """Whether a rule of fusion gives what the filter has: as near as float32 is after some hundred sums."""
    return one.shape == other.shape and torch.allclose(one, other, rtol=1e-3, atol=1e-4)


def _several(owner: Any, name: str) -> list[nn.Module]:
    """The modules of a list of them that goes by a name; none where there is no such list."""
    found = getattr(owner, name, None)
    return list(found) if isinstance(found, nn.ModuleList) else []


def _sensors(filter_: Any) -> list[nn.Module]:
    """A Kalman filter's virtual sensors, or its measurement model."""
    virtual = getattr(filter_, "virtual_sensor_model", None)
    sensor = virtual if virtual is not None else getattr(filter_, "measurement_model", None)
    return _several(virtual, "virtual_sensor_model") or ([sensor] if isinstance(sensor, nn.Module) else [])


def _covariance(filter_: Any) -> Tensor | None:
    found = (getattr(filter_, name, None) for name in ("belief_covariance", "state_covariance_estimate"))
    return next((_copied(one) for one in found if isinstance(one, Tensor)), None)


def _belief(filter_: Any) -> tuple[Tensor, ...]:
    """Mean and covariance as they are; nothing where the filter does not show both."""
    mean, covariance = getattr(filter_, "belief_mean", None), _covariance(filter_)
    return (_copied(mean), covariance) if isinstance(mean, Tensor) and covariance is not None else ()


def _of_factor(output: Any) -> tuple[Tensor, ...]:
    """Mean and covariance of a virtual sensor's answer: a mean and a Cholesky factor."""
    if not isinstance(output, tuple) or len(output) != 2:
        return ()
    mean, factor = output
    return mean, factor @ factor.transpose(-1, -2)


def _stack(found: dict[str, Tensor], name: str, beliefs: list[tuple[Tensor, ...]]) -> None:
    """Adds means (N, K, n) and covariances (N, K, n, n), where all K are whole."""
    if beliefs and all(len(one) == 2 for one in beliefs):
        found[f"{name}_mean"], found[f"{name}_covariance"] = (
            torch.stack(one, dim=1) for one in zip(*beliefs, strict=True)
        )


def _copied(value: Any) -> Any:
    """Tensors detached and copied, since a filter may go on to write into its own; within tuples as well."""
    if isinstance(value, tuple):
        return tuple(_copied(one) for one in value)
    return value.detach().clone() if isinstance(value, Tensor) else value
