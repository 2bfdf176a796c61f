"""Registry of the filters, for any task. To add one, add a line here and in ``names``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import check_name
from beliefscope.datasets.task import Task
from beliefscope.filters.filter import Architecture, Filter, Kind
from beliefscope.filters.models.ekf import ExtendedKalmanFilter
from beliefscope.filters.models.information import InformationFilter
from beliefscope.filters.models.information_pf import InformationParticleFilter
from beliefscope.filters.models.lstm import Lstm
from beliefscope.filters.models.pf import MixtureParticleFilter
from beliefscope.filters.models.transformer import Transformer
from beliefscope.filters.models.ukf import UnscentedKalmanFilter
from beliefscope.filters.names import filter_names

KINDS: dict[Kind, type[Filter]] = {
    "ekf": ExtendedKalmanFilter,
    "ukf": UnscentedKalmanFilter,
    "pf": MixtureParticleFilter,
    "lstm": Lstm,
    "transformer": Transformer,
}

INFORMATION: dict[Kind, type[Filter]] = {"ekf": InformationFilter, "pf": InformationParticleFilter}
"""Filters with fusion ``information``."""

FILTERS: dict[str, Callable[..., Architecture]] = {
    "crossmodal-ekf": partial(Architecture, kind="ekf", fusion="crossmodal", feedback=True),
    "crossmodal-pf": partial(Architecture, kind="pf", fusion="crossmodal"),
    "crossmodal-ukf": partial(Architecture, kind="ukf", fusion="crossmodal", feedback=True),
    "information-ekf": partial(Architecture, kind="ekf", fusion="information", feedback=True),
    "information-pf": partial(Architecture, kind="pf", fusion="information"),
    "unimodal-ekf": partial(Architecture, kind="ekf", fusion="unimodal"),
    "unimodal-pf": partial(Architecture, kind="pf", fusion="unimodal", likelihoods="raw"),
    "feature-ekf": partial(Architecture, kind="ekf", fusion="none"),
    "feature-pf": partial(Architecture, kind="pf", fusion="none"),
    "{modality}-ekf": partial(Architecture, kind="ekf", fusion="none"),
    "{modality}-pf": partial(Architecture, kind="pf", fusion="none"),
    "lstm": partial(Architecture, kind="lstm", fusion="none"),
    "transformer": partial(Architecture, kind="transformer", fusion="none"),
}
"""Key of ``names.MODELS`` -> architecture; the task and the measurement models are added by ``filters_of``."""


def filters_of(task: Task) -> dict[str, Architecture]:
    """All filters of a task by name."""
    return {name: FILTERS[key](task=task, models=models) for name, (key, models) in filter_names(task).items()}


NETWORKS: dict[str, dict[str, Any]] = {"default": {}, "authors": {"networks": "authors", "image_stride": 1}}
"""Name of a set of networks -> fields of the architecture. ``authors``: layers, parameters and image resolution of the
paper's published networks for the door task."""


def architecture(task: str | Task, name: str, networks: str = "default") -> Architecture:
    """The named filter's architecture for a task. Raises BadInput for an unknown name."""
    filters = filters_of(find_task(task))
    check_name("filter", name, filters)
    check_name("network set", networks, NETWORKS)
    return replace(filters[name], **NETWORKS[networks])


def build(architecture: Architecture, seed: int = 0) -> Filter:
    """A filter with initial weights that depend only on the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)  # torch.manual_seed also prepares those of all GPUs: 2 ms
        classes = INFORMATION if architecture.fusion == "information" else KINDS
        return classes[architecture.kind](architecture)
