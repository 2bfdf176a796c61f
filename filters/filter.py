"""Base class of all filters: networks that encode evidence, and a pure step over beliefs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, Literal, get_args, get_origin, get_type_hints

import torch
from torch import Tensor, nn

from beliefscope.datasets.catalog import stored_task
from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.task import Task
from beliefscope.filters.batch import Batch, Statistics
from beliefscope.filters.belief import Belief, Evidence, Gaussian, StepTrace
from beliefscope.filters.models.dynamics import Dynamics
from beliefscope.filters.models.fusion import CovarianceRule
from beliefscope.filters.models.networks import Encoders, Networks, Pooling
from beliefscope.filters.models.resampling import Resampling
from beliefscope.filters.names import no_built_in

Kind = Literal["ekf", "ukf", "pf", "lstm", "transformer"]
Fusion = Literal["crossmodal", "unimodal", "information", "none"]

WEIGHTED: tuple[Fusion, ...] = ("crossmodal", "information")
"""Fusion rules with a weight model."""

_type_hints = cache(get_type_hints)  # evaluated from text: most of the time of listing a task's filters

MAX_SIZE = 4096
"""Upper limit of layer widths and other integers of an architecture."""


@dataclass(frozen=True)
class Architecture:
    """Everything that determines a filter's modules and equations; stored as JSON in the checkpoint.

    Attributes:
        task: of the filter.
        kind: ``ekf``, ``ukf``, ``pf``, ``lstm`` or ``transformer``.
        fusion: rule that fuses the measurement models' results: ``crossmodal`` (learned weights beta), ``unimodal``
            (product of experts for an EKF, sum of likelihoods for a PF), ``information`` (one prior; precisions add, or
            particles are weighted by a product of likelihoods, each to a power given by beta), or ``none`` (one model).
        models: for each measurement model its modalities, joined by ``+``.
        units: width of all fully connected layers. image_stride: of the first convolution.
        networks: ``default``, or ``authors``: the layers of the paper's published code, see docs/filters.md.
        pooling: between the last convolution and the first fully connected layer.
        covariance: EKF, UKF: rule of the fused covariance. feedback: EKF, UKF: whether every unimodal
            filter continues from the fused belief (independent in the paper's text).
        likelihoods: PF: ``normalised`` over the particles of each model before the fusion, so that beta is a model's
            share of the particle weights; or ``raw``: a model with higher likelihoods overall dominates.
        resampling: PF: rule for sampling ancestors. soft_share: ``soft``: share of the weights in the proposal, the
            rest is uniform; in (0, 1].
    """

    task: Task
    kind: Kind
    fusion: Fusion = "crossmodal"
    models: tuple[str, ...] = ("image", "haptics")
    units: int = 64
    image_stride: int = 2
    networks: Networks = "default"
    pooling: Pooling = "flatten"
    covariance: CovarianceRule = "paper"
    feedback: bool = False
    likelihoods: Literal["normalised", "raw"] = "normalised"
    resampling: Resampling = "systematic"
    soft_share: float = 0.5

    def __post_init__(self) -> None:
        """Raises BadInput for an invalid value."""
        for name, kind in _type_hints(Architecture).items():
            value = getattr(self, name)
            if get_origin(kind) is Literal and value not in get_args(kind):
                raise unknown_name(f"filter {name}", value, get_args(kind))
            if kind is str and not isinstance(value, str):
                raise BadInput(f"{name} of a filter is {value!r:.200}, not a name")
            if kind is int and not (type(value) is int and 1 <= value <= MAX_SIZE):
                raise BadInput(f"{name} of a filter is {value!r}, not a whole number from 1 to {MAX_SIZE}")
        if not self.models or not all(isinstance(model, str) for model in self.models):
            raise BadInput(f"models of a filter are {self.models!r}, not names of modalities")
        if self.fusion == "information" and (
            self.kind not in ("ekf", "pf") or any("+" in model for model in self.models)
        ):
            raise BadInput(f"fusion 'information' needs kind ekf or pf and one modality per model, not {self.kind!r}")
        if not 0.0 < self.soft_share <= 1.0:
            raise BadInput(f"soft_share must be above 0 and at most 1, not {self.soft_share}")

    def to_json(self) -> dict[str, Any]:
        """JSON values; only the name of the task."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return values | {"task": self.task.name, "models": list(self.models)}

    @classmethod
    def from_json(cls, values: Mapping[str, Any], task: Task | None = None) -> Architecture:
        """Inverse of ``to_json``. Missing values take their default.

        Args:
            task: definition; by default the built-in task with the name in the values.

        Raises BadInput for unknown keys, and without task, kind or models.
        """
        try:
            task = stored_task(values["task"]) if task is None else task
            return cls(**{**values, "task": task, "models": tuple(values["models"])})
        except (KeyError, TypeError) as error:
            raise BadInput(f"not an architecture of this version: {error}") from None


class Filter(nn.Module, ABC):
    """A differentiable filter: ``encode`` once, then ``step`` through time. Standardised units throughout.

    Attributes:
        has_covariance: whether its estimates have a covariance; else it is NaN.
        history: number of past steps that the encoding of a step uses.
        dynamics: the dynamics model; sequence models have none.
        angles: components of the state that wrap.
    """

    has_covariance = True
    history = 0
    dynamics: Dynamics

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        task = architecture.task
        if reason := no_built_in(task):
            raise BadInput(reason)
        self.architecture = architecture
        self.task = task
        self.n = len(task.components)
        self.statistics = Statistics(task)
        self.angles = self.statistics.angles

    @property
    def names(self) -> tuple[str, ...]:
        """The measurement models' names, in the order of every K axis: ``image``, ``haptics``."""
        return self.architecture.models

    def index(self, name: str) -> int:
        """Position of a measurement model. Raises BadInput for an unknown name."""
        if name not in self.names:
            raise BadInput(f"Modality {name!r} is not in this filter. Available: {', '.join(self.names)}.")
        return self.names.index(name)

    def log_weights(self, observations: Mapping[str, Tensor]) -> Tensor | None:
        """(T, N, K, W) log beta from standardised observations, or None without a weight model."""
        if self.architecture.fusion not in WEIGHTED:
            return None
        return self.get_submodule("weight_model")(observations)

    def observations(self, batch: Batch) -> dict[str, Tensor]:
        """Observations by modality, standardised, float32."""
        return self.statistics.standardise_observations(batch.observations)

    def with_readings(self, evidence: Evidence, batch: Batch) -> Evidence:
        """Evidence of the last steps of a batch without models none of whose sensors has a reading there.

        See ``Evidence.select_models``.
        """
        if batch.present is None:
            return evidence
        present = [self.has_reading(batch, name.split("+"))[-len(evidence) :] for name in self.names]
        return evidence.select_models(torch.stack(present, dim=-1))

    def has_reading(self, batch: Batch, modalities: Iterable[str]) -> Tensor:
        """(T, N) bool: steps at which any sensor of these modalities has a reading (``Batch.present``)."""
        if batch.present is None:
            return torch.ones_like(batch.contact)
        order = list(self.task.modalities)
        return batch.present[..., [order.index(modality) for modality in modalities]].any(-1)

    def process_noise(self, change: Tensor) -> Tensor:
        """Root of Q's diagonal (n,) or (..., n), which may depend on the predicted change (..., n)."""
        return self.dynamics.noise

    @abstractmethod
    def encode(self, batch: Batch) -> Evidence:
        """Everything that does not depend on the belief, for all T x N at once."""

    def encode_after(self, batch: Batch, lead: int) -> Evidence:
        """The evidence of all steps but the first ``lead``, which are only seen as earlier ones (``history``)."""
        return self.encode(batch)[lead:]

    @abstractmethod
    def start(self, belief: Gaussian, particles: int, generator: torch.Generator) -> Belief:
        """The first belief from a Gaussian (N, n), (N, n, n)."""

    @abstractmethod
    def step(self, belief: Belief, evidence: Evidence, generator: torch.Generator) -> tuple[Belief, StepTrace]:
        """One prediction and update. ``evidence`` is of one step: leading axis N. Uses no other random numbers."""

    def steps(
        self, belief: Belief, evidence: Evidence, generator: torch.Generator
    ) -> Iterator[tuple[Belief, StepTrace]]:
        """Belief and trace of all T steps of ``evidence``, each from the belief of the previous one."""
        for step_evidence in evidence:
            belief, trace = self.step(belief, step_evidence, generator)
            yield belief, trace


def encoders(
    task: Task, modalities: Iterable[str], architecture: Architecture, steps: int = 1, extra: int = 0
) -> Encoders:
    """New encoders of these modalities. Raises BadInput for one that the task does not have.

    Args:
        steps: number of steps whose vectors are joined. extra: number of further entries of each vector.
    """
    shapes: dict[str, tuple[int, ...]] = {}
    for modality in modalities:
        if modality not in task.modalities:
            raise BadInput(
                f"Modality {modality!r} is not in task {task.name!r}. Available: {', '.join(task.modalities)}."
            )
        shape = modality_shape(task, modality)
        shapes[modality] = shape if len(shape) == 2 else (steps * shape[0] + extra,)
    a = architecture
    vectors = [m for m, shape in shapes.items() if len(shape) == 1 and a.networks == "authors"]
    groups = {modality: vector_groups(task, modality, steps) for modality in vectors}
    return Encoders(shapes, a.units, a.image_stride, a.pooling, a.networks, groups)


def vector_groups(task: Task, modality: str, steps: int = 1) -> list[list[int]]:
    """Entries of a modality's joined vectors that are positions, and the others, without empty groups."""
    groups: dict[bool, list[int]] = {True: [], False: []}
    start = 0
    for key in task.modalities[modality]:
        size = task.observations[key][0]
        groups[key in task.positions] += range(start, start + size)
        start += size
    return [[step * start + i for step in range(steps) for i in group] for group in groups.values() if group]


def modality_shape(task: Task, modality: str) -> tuple[int, ...]:
    """(H, W) of an image, or (d,) of concatenated vectors. Raises BadInput for other sensors."""
    keys = task.modalities[modality]
    shapes = [task.observations[key] for key in keys]
    is_image = len(keys) == 1 and len(shapes[0]) == 2 and keys[0] not in task.arrays
    if not is_image and any(len(shape) > 1 for shape in shapes):
        sensors = ", ".join(f"{key} {shape}" for key, shape in zip(keys, shapes, strict=True))
        raise BadInput(
            f"modality {modality!r} of task {task.name!r} has {sensors}; the built-in filters take one gray image or "
            f"only vectors. Use a filter of your own."
        )
    return shapes[0] if is_image else (sum(shape[0] for shape in shapes),)
