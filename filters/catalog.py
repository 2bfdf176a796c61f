"""The filters by name, for any task. A new one is one line here."""

from __future__ import annotations

from typing import Literal

import torch

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import one_of
from beliefscope.datasets.task import Task
from beliefscope.filters.ekf import ExtendedKalmanFilter
from beliefscope.filters.filter import Architecture, Filter, Fusion, Kind
from beliefscope.filters.lstm import Lstm
from beliefscope.filters.pf import ParticleFilter
from beliefscope.filters.ukf import UnscentedKalmanFilter

KINDS: dict[Kind, type[Filter]] = {
    "ekf": ExtendedKalmanFilter,
    "ukf": UnscentedKalmanFilter,
    "pf": ParticleFilter,
    "lstm": Lstm,
}

FILTERS: dict[str, tuple[Kind, Fusion, Literal["each", "all", "one"]]] = {
    "crossmodal-ekf": ("ekf", "crossmodal", "each"),
    "crossmodal-pf": ("pf", "crossmodal", "each"),
    "crossmodal-ukf": ("ukf", "crossmodal", "each"),
    "unimodal-ekf": ("ekf", "unimodal", "each"),
    "unimodal-pf": ("pf", "unimodal", "each"),
    "feature-ekf": ("ekf", "none", "all"),
    "feature-pf": ("pf", "none", "all"),
    "{modality}-ekf": ("ekf", "none", "one"),
    "{modality}-pf": ("pf", "none", "one"),
    "lstm": ("lstm", "none", "all"),
}
"""Name -> equations, fusion, and what the measurement models see: ``each`` modality has one, ``all`` share one, or
there is only ``one`` modality, and such a filter for each of them (``image-pf``, ``haptics-pf``)."""


def filters_of(task: Task) -> dict[str, Architecture]:
    """All filters of a task by name, with measurement models after its modalities."""
    each = tuple(task.modalities)
    models: dict[str, list[tuple[str, ...]]] = {
        "each": [each],
        "all": [("+".join(each),)],
        "one": [(modality,) for modality in each],
    }
    return {
        name.format(modality=chosen[0]): Architecture(task.name, kind, fusion, chosen)
        for name, (kind, fusion, sees) in FILTERS.items()
        for chosen in models[sees]
    }


def architecture(task: str, name: str) -> Architecture:
    """The named filter's architecture for a task. Raises BadInput for an unknown name."""
    filters = filters_of(find_task(task))
    if name not in filters:
        raise one_of("filter", name, filters)
    return filters[name]


def build(architecture: Architecture, seed: int = 0) -> Filter:
    """A filter with fresh weights; the same for the same seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return KINDS[architecture.kind](architecture)
