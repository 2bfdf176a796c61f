"""Training a filter: how long each stage takes, and the record of how it went."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from beliefscope import __version__
from beliefscope.datasets.corrupt import Recipe
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import build
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.filter import Architecture, Filter
from beliefscope.filters.trainer import BLACKOUTS, Report, Trainer


@dataclass(frozen=True)
class Plan:
    """How long and how each stage trains. Counts are optimiser steps.

    Attributes:
        dynamics: for each of the lengths 1, 4, 8, 16. measurement: for each virtual sensor, and for a likelihood's
            picture encoders. likelihood: PF: for the layers after these, and for a likelihood without pictures.
            alone: for each modality through the filter. weights: weight model alone.
            together: for each of the lengths.
        batch: windows a step. lengths: of the subsequences of the last stage. particles: in training.
        rate, fine_rate: Adam's learning rate, the fine one where whole filters train end to end.
        likelihood_weight: of the negative log-likelihood beside the squared error of the mean, end to end: the squared
            error alone, as in the authors' code, leaves covariances without a meaning.
    """

    dynamics: int = 100
    measurement: int = 300
    likelihood: int = 1500
    alone: int = 80
    weights: int = 120
    together: tuple[int, ...] = (80, 100, 300)
    lengths: tuple[int, ...] = (4, 8, 16)
    batch: int = 32
    particles: int = 30
    rate: float = 1e-3
    fine_rate: float = 3e-4
    likelihood_weight: float = 0.02


PLANS = {
    "cpu": Plan(),
    "full": Plan(
        dynamics=2000,
        measurement=8000,
        likelihood=20_000,
        alone=1500,
        weights=1500,
        together=(1500, 1500, 4000),
        batch=64,
    ),
    "smoke": Plan(dynamics=2, measurement=2, likelihood=2, alone=1, weights=1, together=(1,), lengths=(4,), batch=4),
}


@dataclass(frozen=True)
class Trained:
    """filter: in evaluation mode. record: JSON for the checkpoint: plan, seed, data hash, metrics, seconds."""

    filter: Filter
    record: dict[str, Any]


def train(
    architecture: Architecture,
    episodes: Sequence[Episode],
    *,
    data_hash: str,
    plan: Plan = PLANS["cpu"],
    seed: int = 0,
    command: str = "",
    report: Report | None = None,
    device: str | None = None,
) -> Trained:
    """Trains a filter on the ``train`` episodes and measures it on ``test`` ones (``val`` where there are none).

    CUDA is used where there is one. The same seed on the same machine gives the same weights.

    Raises:
        BadInput: no training episode, or one whose arrays do not fit the task.
    """
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    by_split = {s: [e for e in episodes if e.split == s] for s in ("train", "val", "test")}
    if not by_split["train"]:
        raise BadInput("the data set has no episode of split 'train'")
    began = time.monotonic()
    filter_ = build(architecture, seed).to(device)
    steps = Steps.of(filter_.task, by_split["train"], device)
    filter_.statistics.fit(steps)
    trainer = Trainer(filter_, steps, plan, torch.Generator().manual_seed(seed), report)
    trainer.run()
    filter_.eval().requires_grad_(False)
    seconds = time.monotonic() - began
    held_out = by_split["test"] or by_split["val"]
    record = {
        "command": command,
        "seed": seed,
        "plan": asdict(plan),
        "data_hash": data_hash,
        "episodes": {split: len(members) for split, members in by_split.items()},
        "seconds": round(seconds, 1),
        "versions": {
            "beliefscope": __version__,
            "torch": torch.__version__,
            "python": sys.version.split()[0],
        },
        "device": torch.cuda.get_device_name() if device == "cuda" else "cpu",
        "metrics": measure(filter_, held_out) if held_out else {},
    }
    return Trained(filter_.cpu(), record)


def measure(filter_: Filter, episodes: Sequence[Episode]) -> dict[str, Any]:
    """Metrics by blackout (``"0"``, ``"0.4"``, ``"0.8"``), fused and with each modality alone."""
    names: list[str | None] = [None]
    if filter_.architecture.fusion == "crossmodal":
        names += filter_.names
    return {
        f"{blackout:g}": {
            name or "fused": evaluate(
                filter_, episodes, recipe=Recipe.parse(f"blackout={blackout}"), only=name
            ).to_dict()
            for name in names
        }
        for blackout in BLACKOUTS
    }
