"""Training of a filter, resumable after an interruption, and the record of it."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from beliefscope import __version__
from beliefscope.datasets.dataset import no_training_episodes
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import build
from beliefscope.filters.evaluate import Metrics, evaluate
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.filter import Architecture, Filter
from beliefscope.filters.models.information import InformationFilter
from beliefscope.filters.models.information_pf import with_particles
from beliefscope.filters.out_of_distribution import summarise
from beliefscope.filters.start_offset import NO_OFFSET, StartOffset
from beliefscope.filters.training.plan import BLACKOUTS, PLANS, Plan, Report, evaluated_blackouts
from beliefscope.filters.training.resume import Partial, SharedModules, cache_key
from beliefscope.filters.training.stages import Trainer


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
    on_validation: Report = lambda *progress: None,
    on_resume: Callable[[str], None] = lambda stage: None,
    on_evaluation: Callable[[float], None] = lambda done: None,
    device: str | None = None,
    partial: Path | None = None,
    shared: Path | None = None,
) -> Trained:
    """Trains a filter on the ``train`` episodes and evaluates it on the ``test`` episodes (``val`` if there are none).

    Every stage keeps the weights that do best on ``val``. CUDA is used if available. With the same seed, machine and
    number of threads the weights are identical, whether or not the training was interrupted and resumed.

    Args:
        blackouts: probabilities of an image blackout; one is drawn for each training window.
        on_validation: called like ``report`` with each validation loss. on_evaluation: with its completed share.
        on_resume: called with the name of the last finished stage if the training resumes.
        partial: file of the finished stages, from which an interrupted training resumes, such as ``partial_path`` of
            its checkpoint.
        shared: folder of modules that other filters of the same task can use: dynamics, image encoders.

    Raises:
        BadInput: no training episode, or one whose arrays do not fit the task.
    """
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    splits = {s: [e for e in episodes if e.split == s] for s in ("train", "val", "test")}
    if not splits["train"]:
        raise no_training_episodes(architecture.task, (e.split for e in episodes))
    began = time.monotonic()
    by_particles = architecture.fusion == "information" and architecture.kind == "pf"
    # The same model as a Kalman filter has a likelihood without sampling noise.
    filter_ = build(replace(architecture, kind="ekf") if by_particles else architecture, seed).to(device)
    steps = Steps.from_episodes(filter_.task, [*splits["train"], *splits["val"]], device)
    count = len(splits["train"])
    train_steps, val_steps = steps.part(0, count), steps.part(count, len(steps.length)) if splits["val"] else None
    filter_.statistics.fit(train_steps)
    record = {
        "command": command,
        "seed": seed,
        "plan": asdict(plan),
        "blackouts": list(blackouts),
        "data_hash": data_hash,
        "versions": versions(),
        "device": torch.cuda.get_device_name() if device == "cuda" else "cpu",
    }
    # The number of steps distinguishes data sets extended by faulty copies, which their hash does not cover.
    inputs = {key: record[key] for key in ("seed", "plan", "data_hash", "versions", "device")}
    inputs |= {"task": architecture.task.name, "steps": len(steps.states), "angles": filter_.angles.indices}
    store = None if shared is None else SharedModules(shared)
    trainer = Trainer(
        filter_, train_steps, plan, seed, val_steps, report, blackouts, store, cache_key(**inputs), on_validation
    )
    state = None
    if partial is not None:
        inputs |= {"architecture": architecture.to_json(), "blackouts": list(blackouts), "command": command}
        state = Partial(partial, cache_key(**inputs))
    seconds = _run_stages(trainer, state, began, on_resume)
    if by_particles:
        assert isinstance(filter_, InformationFilter)
        filter_ = with_particles(filter_).to(device)
    filter_.eval().requires_grad_(False)
    held_out = splits["test"] or splits["val"]
    record |= {
        "episodes": {split: len(members) for split, members in splits.items()},
        "seconds": round(seconds, 1),
        "threads": torch.get_num_threads(),
        "data_summary": summarise(filter_.statistics, filter_.task, splits["train"]),
        "metrics": measure(filter_, held_out, progress=on_evaluation) if held_out else {},
    }
    return Trained(filter_.cpu(), record)


def _run_stages(trainer: Trainer, state: Partial | None, began: float, on_resume: Callable[[str], None]) -> float:
    """Runs all stages, or the remaining ones after an interruption; returns the seconds spent in total."""
    done: list[str] = []
    spent = 0.0
    if state is not None and (saved := state.load()) is not None:
        tensors, progress = saved
        done, spent = list(progress["done"]), float(progress["seconds"])
        trainer.filter.load_state_dict(tensors)
        on_resume(done[-1])

    def on_stage_end(stage: str) -> None:
        done.append(stage)
        if state is not None:
            progress = {"done": done, "seconds": spent + time.monotonic() - began}
            state.save(trainer.filter.state_dict(), progress)

    trainer.run(tuple(done), on_stage_end)
    return spent + time.monotonic() - began


def versions() -> dict[str, str]:
    """Versions of the software on which the weights depend."""
    return {"beliefscope": __version__, "torch": torch.__version__, "python": sys.version.split()[0]}


def measure(
    filter_: Filter | ExternalFilter,
    episodes: Sequence[Episode],
    start_offset: StartOffset = NO_OFFSET,
    progress: Callable[[float], None] = lambda done: None,
) -> dict[str, Any]:
    """Metrics by probability of an image blackout (``"0"``, ``"0.4"``, ``"0.8"``, ``"0.95"``); without images ``"0"``.

    ``fused``: of the filter, with its ``baselines``, which a blackout does not change, and its single-modality
    ``updates``; a modality's name: of its standalone filter.
    """
    several = len(filter_.task.modalities if isinstance(filter_, ExternalFilter) else filter_.names) > 1
    results: dict[str, Metrics] = {}
    blackouts = evaluated_blackouts(filter_.task)
    for blackout in blackouts:
        first = next(iter(results.values()), None)
        result = evaluate(
            filter_,
            episodes,
            faults=Faults.parse(f"blackout={blackout}") if blackout else NO_FAULTS,
            start_offset=start_offset,
            baselines=first is None,
            modalities=several,
            progress=lambda done: progress((len(results) + done) / len(blackouts)),
        )
        results[f"{blackout:g}"] = result if first is None else replace(result, baselines=first.baselines)
    return {
        blackout: {"fused": result.to_dict()}
        | {name: alone.to_dict() for name, alone in result.standalone.items() if alone}
        for blackout, result in results.items()
    }
