"""Training a filter: how long each stage takes, and the record of how it went."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from beliefscope import __version__
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import build
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.filter import Architecture, Filter
from beliefscope.filters.training.resume import Partial, Parts, key_of
from beliefscope.filters.training.stages import BLACKOUTS, Report, Trainer


@dataclass(frozen=True)
class Plan:
    """How long and how each stage trains. Counts are optimiser steps, and the most there are: see ``patience``.

    Attributes:
        dynamics: for each of the lengths 1, 4, 8, 16. pictures: for the picture encoders. models: for each virtual
            sensor or likelihood. alone: for each modality through the filter. weights: weight model alone.
        together: for each of the lengths. fine: for everything, picture encoders included.
        lengths: of the subsequences of the stages together. window: where a modality or the weight model trains alone.
        batch: subsequences of 16 steps that are averaged; more of shorter ones. particles: in training.
        rate, fine_rate: Adam's learning rate, the fine one where whole filters train end to end.
        likelihood_weight: of the negative log-likelihood beside the squared error of the mean, end to end: the squared
            error alone, as in the authors' code, leaves covariances without a meaning.
        check: steps between two looks at the validation loss. patience: looks without a better one that end a stage.
    """

    dynamics: int = 150
    pictures: int = 500
    models: int = 1500
    alone: int = 300
    weights: int = 300
    together: tuple[int, ...] = (100, 150, 250)
    fine: int = 60
    lengths: tuple[int, ...] = (4, 16, 32)
    window: int = 32
    batch: int = 32
    particles: int = 30
    rate: float = 1e-3
    fine_rate: float = 3e-4
    likelihood_weight: float = 0.05
    check: int = 50
    patience: int = 6


PLANS = {
    "cpu": Plan(),
    "full": Plan(
        dynamics=2000,
        pictures=8000,
        models=20_000,
        alone=1500,
        weights=1500,
        together=(1500, 1500, 4000),
        fine=2000,
        batch=64,
        check=250,
    ),
    "smoke": Plan(
        dynamics=2, pictures=2, models=2, alone=1, weights=1, together=(1,), fine=1, lengths=(4,), window=4, batch=4
    ),
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
    blackouts: Sequence[float] = BLACKOUTS,
    command: str = "",
    report: Report | None = None,
    validated: Report | None = None,
    resumed: Callable[[str], None] | None = None,
    device: str | None = None,
    partial: Path | None = None,
    parts: Path | None = None,
) -> Trained:
    """Trains a filter on the ``train`` episodes and measures it on ``test`` ones (``val`` where there are none).

    Every stage keeps the weights that do best on ``val``. CUDA is used where there is one. The same seed on the same
    machine with as many threads gives the same weights, killed and resumed or not.

    Args:
        blackouts: chances of a black picture, one of which is drawn for each training window.
        validated: called like ``report`` at each look at the validation loss.
        resumed: called with the name of the last finished stage, where the training goes on from one.
        partial: file of the finished stages, from which a training that was killed goes on; removed at the end.
        parts: folder of what other filters of the same task can use: dynamics, picture encoders.

    Raises:
        BadInput: no training episode, or one whose arrays do not fit the task.
    """
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    by_split = {s: [e for e in episodes if e.split == s] for s in ("train", "val", "test")}
    training, validation = by_split["train"], by_split["val"]
    if not training:
        raise BadInput("the data set has no episode of split 'train'")
    began = time.monotonic()
    filter_ = build(architecture, seed).to(device)
    steps = Steps.of(filter_.task, [*training, *validation], device)
    fitted = steps.part(0, len(training))
    filter_.statistics.fit(fitted)
    name = torch.cuda.get_device_name() if device == "cuda" else "cpu"
    # The number of episodes stands for copies with broken sensors, which the data's hash does not know.
    common = {
        "task": architecture.task,
        "data": data_hash,
        "steps": len(steps.states),
        "plan": asdict(plan),
        "seed": seed,
        "versions": versions(),
        "device": name,
    }
    trainer = Trainer(
        filter_,
        fitted,
        plan,
        seed,
        steps.part(len(training), len(steps.length)) if validation else None,
        report,
        blackouts,
        None if parts is None else Parts(parts),
        key_of(**common),
    )
    trainer.validated = validated or trainer.validated
    kept = (
        Partial(
            partial, key_of(architecture=architecture.to_json(), blackouts=list(blackouts), command=command, **common)
        )
        if partial
        else None
    )
    done: list[str] = []
    spent = 0.0
    if kept is not None and (found := kept.load()) is not None:
        tensors, progress = found
        done, spent = list(progress["done"]), float(progress["seconds"])
        filter_.load_state_dict(tensors)
        if resumed is not None:
            resumed(done[-1])

    def finished(stage: str) -> None:
        done.append(stage)
        if kept is not None:
            kept.save(filter_.state_dict(), {"done": done, "seconds": spent + time.monotonic() - began})

    trainer.run(tuple(done), finished)
    filter_.eval().requires_grad_(False)
    seconds = spent + time.monotonic() - began
    held_out = by_split["test"] or by_split["val"]
    record = {
        "command": command,
        "seed": seed,
        "plan": asdict(plan),
        "blackouts": list(blackouts),
        "data_hash": data_hash,
        "episodes": {split: len(members) for split, members in by_split.items()},
        "seconds": round(seconds, 1),
        "versions": versions(),
        "device": name,
        "threads": torch.get_num_threads(),
        "metrics": measure(filter_, held_out) if held_out else {},
    }
    if kept is not None:
        kept.drop()
    return Trained(filter_.cpu(), record)


def versions() -> dict[str, str]:
    """Of what the same seed depends on for the same weights."""
    return {"beliefscope": __version__, "torch": torch.__version__, "python": sys.version.split()[0]}


def measure(filter_: Filter, episodes: Sequence[Episode]) -> dict[str, Any]:
    """Metrics by blackout (``"0"``, ``"0.4"``, ``"0.8"``), fused and with each modality alone."""
    names: list[str | None] = [None]
    if filter_.architecture.fusion == "crossmodal":
        names += filter_.names
    return {
        f"{blackout:g}": {
            name or "fused": evaluate(
                filter_, episodes, faults=Faults.parse(f"blackout={blackout}"), only=name
            ).to_dict()
            for name in names
        }
        for blackout in BLACKOUTS
    }
