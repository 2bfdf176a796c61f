"""The filters by name. A new one is one line here."""

from __future__ import annotations

from dataclasses import replace

import torch

from beliefscope.datasets.errors import one_of
from beliefscope.filters.ekf import ExtendedKalmanFilter
from beliefscope.filters.filter import Architecture, Filter
from beliefscope.filters.pf import ParticleFilter

KINDS: dict[str, type[Filter]] = {"ekf": ExtendedKalmanFilter, "pf": ParticleFilter}

FILTERS: dict[str, Architecture] = {
    "crossmodal-ekf": Architecture(task="door", kind="ekf"),
    "crossmodal-pf": Architecture(task="door", kind="pf"),
}


def architecture(task: str, name: str) -> Architecture:
    """The named filter's architecture for a task. Raises BadInput for an unknown name."""
    if name not in FILTERS:
        raise one_of("filter", name, FILTERS)
    return replace(FILTERS[name], task=task)


def build(architecture: Architecture, seed: int = 0) -> Filter:
    """A filter with fresh weights; the same for the same seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return KINDS[architecture.kind](architecture)
