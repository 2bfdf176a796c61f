"""Registry of the filters, for any task. To add one, add a line here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Literal

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

KINDS: dict[Kind, type[Filter]] = {
    "ekf": ExtendedKalmanFilter,
    "ukf": UnscentedKalmanFilter,
    "pf": MixtureParticleFilter,
    "lstm": Lstm,
    "transformer": Transformer,
}

INFORMATION: dict[Kind, type[Filter]] = {"ekf": InformationFilter, "pf": InformationParticleFilter}
"""Filters with fusion ``information``."""

FILTERS: dict[str, tuple[Literal["each", "all", "one"], Callable[..., Architecture]]] = {
    "crossmodal-ekf": ("each", partial(Architecture, kind="ekf", fusion="crossmodal", feedback=True)),
    "crossmodal-pf": ("each", partial(Architecture, kind="pf", fusion="crossmodal")),
    "crossmodal-ukf": ("each", partial(Architecture, kind="ukf", fusion="crossmodal", feedback=True)),
    "information-ekf": ("each", partial(Architecture, kind="ekf", fusion="information", feedback=True)),
    "information-pf": ("each", partial(Architecture, kind="pf", fusion="information")),
    "unimodal-ekf": ("each", partial(Architecture, kind="ekf", fusion="unimodal")),
    "unimodal-pf": ("each", partial(Architecture, kind="pf", fusion="unimodal", likelihoods="raw")),
    "feature-ekf": ("all", partial(Architecture, kind="ekf", fusion="none")),
    "feature-pf": ("all", partial(Architecture, kind="pf", fusion="none")),
    "{modality}-ekf": ("one", partial(Architecture, kind="ekf", fusion="none")),
    "{modality}-pf": ("one", partial(Architecture, kind="pf", fusion="none")),
    "lstm": ("all", partial(Architecture, kind="lstm", fusion="none")),
    "transformer": ("all", partial(Architecture, kind="transformer", fusion="none")),
}
"""Name -> measurement models and architecture. ``each``: one model per modality. ``all``: one model of all modalities.
``one``: a filter per modality, with that modality only (``image-pf``, ``haptics-pf``). The task is added by
``filters_of``."""


def filters_of(task: Task) -> dict[str, Architecture]:
    """All filters of a task by name, with measurement models named after its modalities."""
    each = tuple(task.modalities)
    models: dict[str, list[tuple[str, ...]]] = {
        "each": [each],
        "all": [("+".join(each),)],
        "one": [(modality,) for modality in each],
    }
    return {
        name.format(modality=names[0]): template(task=task, models=names)
        for name, (inputs, template) in FILTERS.items()
        for names in models[inputs]
    }


NETWORKS: dict[str, dict[str, Any]] = {"default": {}, "authors": {"networks": "authors", "image_stride": 1}}
"""Name of a set of networks -> fields of the architecture. ``authors``: layers, parameters and image resolution of the
paper's published networks for the door task."""


def architecture(task: str | Task, name: str, networks: str = "default") -> Architecture:
    """The named filter's architecture for a task. Raises BadInput for an unknown name."""
    filters = filters_of(find_task(task))
    check_name("filter", name, filters)
    check_name("set of networks", networks, NETWORKS)
    return replace(filters[name], **NETWORKS[networks])


def build(architecture: Architecture, seed: int = 0) -> Filter:
    """A filter with initial weights that depend only on the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)  # torch.manual_seed also prepares those of all GPUs: 2 ms
        classes = INFORMATION if architecture.fusion == "information" else KINDS
        return classes[architecture.kind](architecture)
