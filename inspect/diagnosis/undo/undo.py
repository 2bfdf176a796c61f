"""Undoing a cause: changes of the episodes, the filter or the number of particles that remove a fault.

Sizes come from the deviations: a bias is subtracted, a factor divided out, a delay advanced.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Evidence
from beliefscope.filters.catalog import build
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.filter import Filter
from beliefscope.filters.models.ekf import ExtendedKalmanFilter
from beliefscope.filters.models.information import InformationFilter
from beliefscope.filters.models.pf import MixtureParticleFilter
from beliefscope.filters.models.weight_model import MAX_LOGIT
from beliefscope.inspect.diagnosis.undo import arrays
from beliefscope.inspect.diagnosis.undo.expected_readings import detrend, rearrange, scale, tare
from beliefscope.inspect.diagnosis.undo.readings import READINGS, advance
from beliefscope.inspect.diagnosis.undo.run_inputs import Deviations, RunInputs, Undo, without_sensor
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation

MIN_SLOPE = 0.2
"""Smallest slope of a dynamics model that can be rescaled."""


def undo(name: str, inputs: RunInputs, deviations: Deviations, base: Checkpoint | None = None) -> RunInputs | None:
    """The inputs of the run without a fault.

    Args:
        name: key of ``UNDO``, or one of its keys that end in a sensor or modality.
        base: checkpoint of the same architecture, whose modules replace faulty ones where it is given.
    """
    action, _, subject = name.partition(" ")
    if base is not None and name in MODULES:
        return _with_modules(inputs, base, MODULES[name])
    function = UNDO.get(name) or partial(BY_SUBJECT[action], subject)
    return function(inputs, deviations)


def brings_back(name: str, base: Checkpoint | None = None) -> bool:
    """Whether an intervention brings back healthy readings, modules or equations; others only remove a sensor."""
    function = UNDO.get(name) or BY_SUBJECT[name.partition(" ")[0]]
    return function not in (drop, skip_lost_images) or (base is not None and name in MODULES)


def _with_modules(inputs: RunInputs, base: Checkpoint, prefixes: Sequence[str]) -> RunInputs | None:
    """The modules whose names start with one of the prefixes, from another checkpoint."""
    if base.filter.architecture != inputs.checkpoint.filter.architecture:
        return None
    filter_ = _copy(inputs.checkpoint)
    taken = {k: v for k, v in base.filter.state_dict().items() if k.startswith(tuple(prefixes))}
    filter_.load_state_dict(filter_.state_dict() | taken)
    return _with_filter(inputs, filter_)


def _copy(checkpoint: Checkpoint) -> Filter:
    return copy.deepcopy(checkpoint.filter)


def _with_filter(inputs: RunInputs, filter_: Filter) -> RunInputs:
    return replace(inputs, checkpoint=inputs.checkpoint.with_filter(filter_))


def _with_evidence(inputs: RunInputs, change: Callable[[Evidence], Evidence]) -> RunInputs:
    """A filter whose evidence is changed."""
    return _with_encoder(inputs, lambda evidence, batch: change(evidence))


def _with_encoder(inputs: RunInputs, change: Callable[[Evidence, Batch], Evidence]) -> RunInputs:
    """A filter whose evidence is changed, depending on the readings."""
    filter_ = _copy(inputs.checkpoint)
    encode = filter_.encode

    def encode_and_change(batch: Batch) -> Evidence:
        return change(encode(batch), batch)

    object.__setattr__(filter_, "encode", encode_and_change)
    return _with_filter(inputs, filter_)


def drop(modality: str, inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Without all models that use a modality in the affected steps; None if no other model remains.

    An external filter sees the modality's sensors without information (``filters/external/ablation.py``).
    """
    if isinstance(inputs.checkpoint, ExternalFilter):
        return without_sensor(inputs, inputs.checkpoint, modality)
    keep = torch.tensor([modality not in model.split("+") for model in inputs.checkpoint.filter.names])
    if keep.all() or not keep.any():
        return None

    def select(evidence: Evidence) -> Evidence:
        present = torch.ones(evidence.observation.shape[:3], dtype=torch.bool)
        present[slice(*(inputs.steps or (None,)))] = keep
        return evidence.select_models(present)

    return _with_evidence(inputs, select)


def skip_lost_images(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Without the models that use images at the steps with a lost image; an external filter without all its images."""
    checkpoint = inputs.checkpoint
    if isinstance(checkpoint, ExternalFilter):
        return without_sensor(inputs, checkpoint, "image")
    keys = [key for key in checkpoint.task.modalities.get("image", ()) if len(checkpoint.task.observations[key]) >= 2]
    seeing = torch.tensor(["image" in model.split("+") for model in checkpoint.filter.names])

    def select(evidence: Evidence, batch: Batch) -> Evidence:
        images = [batch.observations[key] for key in keys]
        lost = torch.stack([(i == i[:, :, :1, :1]).flatten(2).all(-1) for i in images]).all(0)  # (T, N)
        return evidence.select_models(~(lost[..., None] & seeing))

    return _with_encoder(inputs, select) if keys and seeing.any() else None


def rescale(modality: str, inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Healthy standard deviations of a measurement model."""
    filter_ = inputs.checkpoint.filter
    ratio = _by_component(deviations, "module std", modality, filter_, lambda d: d.value / d.healthy)
    if ratio is None or modality not in filter_.names:
        return None
    k = filter_.names.index(modality)
    if isinstance(filter_, ExtendedKalmanFilter):
        return _with_evidence(inputs, lambda e: replace(e, noise=_at(_noise(e), k, _noise(e)[:, :, k] / ratio)))
    power = float(ratio.log().mean().exp().square())
    return _with_likelihood(inputs, k, lambda likelihood, evidence, states: power * likelihood(evidence, states))


def shift(modality: str, inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """A measurement model without its excess bias."""
    filter_ = inputs.checkpoint.filter
    bias = _by_component(deviations, "module bias", modality, filter_, lambda d: d.value - d.healthy)
    if bias is None or modality not in filter_.names:
        return None
    k, bias = filter_.names.index(modality), bias / filter_.statistics.mean_std("state")[1]
    if isinstance(filter_, ExtendedKalmanFilter):
        return _with_evidence(
            inputs, lambda e: replace(e, observation=_at(e.observation, k, e.observation[:, :, k] - bias))
        )
    return _with_likelihood(inputs, k, lambda likelihood, evidence, states: likelihood(evidence, states + bias))


def _with_likelihood(inputs: RunInputs, k: int, change: Callable[..., Tensor]) -> RunInputs | None:
    """A particle filter with another likelihood of model k."""
    if not isinstance(inputs.checkpoint.filter, MixtureParticleFilter):
        return None
    filter_ = _copy(inputs.checkpoint)
    assert isinstance(filter_, MixtureParticleFilter)
    likelihood = filter_.log_likelihood

    def changed(evidence: Evidence, states: Tensor) -> Tensor:
        return _at(likelihood(evidence, states), k, change(likelihood, evidence, states)[:, k], axis=1)

    object.__setattr__(filter_, "log_likelihood", changed)
    return _with_filter(inputs, filter_)


def _with_dynamics(inputs: RunInputs, change: Callable[[Tensor, Tensor], Tensor]) -> RunInputs:
    """Another prediction, a function of the states and the predicted states; its Jacobian is unchanged."""
    filter_ = _copy(inputs.checkpoint)
    forward, with_jacobian = filter_.dynamics.forward, filter_.dynamics.with_jacobian

    def predict(states: Tensor, control: Tensor) -> Tensor:
        return change(states, forward(states, control))

    def predict_with_jacobian(states: Tensor, control: Tensor) -> tuple[Tensor, Tensor]:
        predicted, jacobian = with_jacobian(states, control)
        return change(states, predicted), jacobian

    object.__setattr__(filter_.dynamics, "forward", predict)
    object.__setattr__(filter_.dynamics, "with_jacobian", predict_with_jacobian)
    return _with_filter(inputs, filter_)


def shift_dynamics(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Predictions without their excess bias."""
    filter_ = inputs.checkpoint.filter
    bias = _by_component(deviations, "dynamics bias", "", filter_, lambda d: d.value - d.healthy)
    if bias is None:
        return None
    bias = bias / filter_.statistics.mean_std("state")[1]
    return _with_dynamics(inputs, lambda states, predicted: predicted - bias)


def scale_dynamics(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Predicted changes with the healthy slope; None for a slope below ``MIN_SLOPE``."""
    slopes = [d.value / d.healthy for name, d in deviations.items() if name.startswith("dynamics slope/") and d.healthy]
    if not slopes or np.mean(slopes) < MIN_SLOPE:
        return None
    factor = 1.0 / float(np.mean(slopes))
    return _with_dynamics(inputs, lambda states, predicted: states + factor * (predicted - states))


def rescale_process_noise(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """The healthy process noise."""
    filter_ = _copy(inputs.checkpoint)
    ratio = _by_component(deviations, "process noise", "", filter_, lambda d: d.value / d.healthy)
    if ratio is None:
        return None
    filter_.dynamics.log_noise.sub_(ratio.log())
    if isinstance(filter_, InformationFilter):
        filter_.log_motion.sub_(ratio.log())
    return _with_filter(inputs, filter_)


def change_beta(inputs: RunInputs, change: Callable[[Tensor], Tensor]) -> RunInputs | None:
    """Other log-odds (..., W) of the first of two models, before their bound."""
    if len(inputs.checkpoint.filter.names) != 2:
        return None

    def changed(evidence: Evidence) -> Evidence:
        assert evidence.log_weights is not None
        odds = evidence.log_weights[..., 0, :] - evidence.log_weights[..., 1, :]
        logit = 2.0 * MAX_LOGIT * torch.atanh((odds / (2.0 * MAX_LOGIT)).clamp(-0.9999, 0.9999))
        odds = 2.0 * MAX_LOGIT * torch.tanh(change(logit) / (2.0 * MAX_LOGIT))
        log_weights = torch.stack([torch.nn.functional.logsigmoid(odds), torch.nn.functional.logsigmoid(-odds)], -2)
        return evidence.with_log_weights(log_weights)

    return _with_evidence(inputs, changed)


def healthy_beta(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Fusion weights whose mean log-odds are healthy."""
    shifts = [d.healthy - d.value for name, d in deviations.items() if name.startswith("beta logit/")]
    return change_beta(inputs, lambda logit: logit + torch.tensor(shifts, dtype=logit.dtype)) if shifts else None


def invert_beta(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Fusion weights with exchanged modalities."""
    return change_beta(inputs, lambda logit: -logit)


def healthy_particles(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """As many particles as in the healthy record; None if there are more already, or the filter has its own number."""
    if isinstance(inputs.checkpoint, ExternalFilter):
        return None
    deviation = deviations.get("particles//all")
    healthy = 0 if deviation is None else round(deviation.healthy)
    return replace(inputs, particles=healthy) if healthy > inputs.particles else None


def restore_equations(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """The filter with its weights and the equations of this version."""
    filter_ = build(inputs.checkpoint.filter.architecture)
    filter_.load_state_dict(inputs.checkpoint.filter.state_dict())
    return _with_filter(inputs, filter_.eval().requires_grad_(False))


def _by_component(
    deviations: Deviations, kind: str, model: str, filter_: Filter, value: Callable[[Deviation], float]
) -> Tensor | None:
    """(n,) values of a kind of statistic of a model; None if one is missing."""
    names = [f"{kind}/{f'{model} {c.name}'.strip()}/all" for c in filter_.task.components]
    if not all(name in deviations for name in names):
        return None
    return torch.tensor([value(deviations[name]) for name in names], dtype=torch.float32)


def _noise(evidence: Evidence) -> Tensor:
    assert evidence.noise is not None
    return evidence.noise


def _at(values: Tensor, k: int, row: Tensor, axis: int = 2) -> Tensor:
    """A copy of the values with index k of an axis replaced."""
    return values.index_copy(axis, torch.tensor([k]), row.unsqueeze(axis))


BY_SUBJECT: dict[str, Callable[[str, RunInputs, Deviations], RunInputs | None]] = {
    "drop": drop,
    "restore": drop,  # unless there is a base checkpoint
    "rescale": rescale,
    "shift": shift,
    "advance": advance,
    "rearrange": rearrange,
    "scale": scale,
    "tare": tare,
    "detrend": detrend,
    "level": arrays.level,
    "divide": arrays.divide,
    "negate": arrays.negate,
    "reorder": arrays.reorder,
}
"""Interventions that are followed by a modality or sensor."""

UNDO: dict[str, Undo] = {
    "shift dynamics": shift_dynamics,
    "scale dynamics": scale_dynamics,
    "rescale process noise": rescale_process_noise,
    "healthy beta": healthy_beta,
    "invert beta": invert_beta,
    "healthy particles": healthy_particles,
    "restore equations": restore_equations,
    "skip lost images": skip_lost_images,
    **READINGS,
}
"""The other interventions."""

MODULES: dict[str, tuple[str, ...]] = {
    "shift dynamics": ("dynamics.",),
    "scale dynamics": ("dynamics.",),
    "restore dynamics": ("dynamics.",),
    "rescale process noise": ("dynamics.log_noise", "log_motion"),
    "healthy beta": ("weight_model.",),
    "invert beta": ("weight_model.",),
}
for modality in ("image", "haptics"):
    for action in ("shift", "rescale", "restore"):
        MODULES[f"{action} {modality}"] = (f"virtual_sensors.{modality}.", f"measurement_models.{modality}.")
"""Intervention -> prefixes of the modules that a base checkpoint replaces instead."""
