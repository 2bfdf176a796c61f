"""The filters by name, for any task. A new one is one line here."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import one_of
from beliefscope.datasets.task import Task
from beliefscope.filters.filter import Architecture, Filter, Kind
from beliefscope.filters.models.ekf import ExtendedKalmanFilter
from beliefscope.filters.models.lstm import Lstm
from beliefscope.filters.models.pf import ParticleFilter
from beliefscope.filters.models.ukf import UnscentedKalmanFilter

KINDS: dict[Kind, type[Filter]] = {
    "ekf": ExtendedKalmanFilter,
    "ukf": UnscentedKalmanFilter,
    "pf": ParticleFilter,
    "lstm": Lstm,
}

ANY = ""
"""Stands for the task, and for the models after its modalities, in what ``FILTERS`` holds."""

FILTERS: dict[str, tuple[Literal["each", "all", "one"], Architecture]] = {
    "crossmodal-ekf": ("each", Architecture(ANY, "ekf", "crossmodal", feedback=True)),
    "crossmodal-pf": ("each", Architecture(ANY, "pf", "crossmodal")),
    "crossmodal-ukf": ("each", Architecture(ANY, "ukf", "crossmodal", feedback=True)),
    "unimodal-ekf": ("each", Architecture(ANY, "ekf", "unimodal")),
    "unimodal-pf": ("each", Architecture(ANY, "pf", "unimodal", likelihoods="raw")),
    "feature-ekf": ("all", Architecture(ANY, "ekf", "none")),
    "feature-pf": ("all", Architecture(ANY, "pf", "none")),
    "{modality}-ekf": ("one", Architecture(ANY, "ekf", "none")),
    "{modality}-pf": ("one", Architecture(ANY, "pf", "none")),
    "lstm": ("all", Architecture(ANY, "lstm", "none")),
}
"""Name -> what the measurement models see, and the filter for any task. ``each`` modality has a model, ``all`` share
one, or there is only ``one`` modality, and such a filter for each of them (``image-pf``, ``haptics-pf``)."""


def filters_of(task: Task) -> dict[str, Architecture]:
    """All filters of a task by name, with measurement models after its modalities."""
    each = tuple(task.modalities)
    models: dict[str, list[tuple[str, ...]]] = {
        "each": [each],
        "all": [("+".join(each),)],
        "one": [(modality,) for modality in each],
    }
    return {
        name.format(modality=chosen[0]): replace(of_any_task, task=task.name, models=chosen)
        for name, (sees, of_any_task) in FILTERS.items()
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
