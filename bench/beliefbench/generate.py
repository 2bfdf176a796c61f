"""Writing cases: fresh episodes, planted faults, and whether they change the estimates."""

from __future__ import annotations

import copy
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from beliefbench import shifts
from beliefbench.cases import PARTICLES, Planted, Spec, healthy_profile, write_truth
from beliefbench.model_faults import MODEL_CAUSES, plant, with_equations
from beliefbench.sensor_faults import LABEL_CAUSES, SENSOR_CAUSES, inject, mislabel
from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import write_dataset
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path, save_checkpoint
from beliefscope.inspect.statistics.measures import counted, errors, nees
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all

MIN_RMSE, MIN_NEES = 1.2, 2.0
"""A fault is visible if the RMSE of positions or of angles grows by this factor, or NEES changes by this factor."""


def write_case(spec: Spec, directory: Path) -> Path:
    """Write the folder of a case. The truth is written last: a folder without it is incomplete."""
    folder = directory / spec.name
    folder.mkdir(parents=True, exist_ok=True)
    original = load_checkpoint(pretrained_path(spec.task, spec.filter))
    clean = clean_episodes(spec)
    episodes, filter_, details, particles = clean, copy.deepcopy(original.filter), [], PARTICLES
    rng = spec.rng
    for item in spec.planted:
        if item.cause in MODEL_CAUSES:
            plant(filter_, item.cause, float(item.magnitude), clean, rng)
            particles = int(item.magnitude) if item.cause == "particles.few" else particles
            details.append(item)
        else:
            episodes, item = _change_data(spec, item, episodes, rng)
            details.append(item)
    write_dataset(folder / "episodes.h5", find_task(spec.task), episodes)
    path = folder / "checkpoint.safetensors"
    save_checkpoint(filter_, spec.filter, original.record, path, healthy_profile(spec.task, spec.filter))
    settings = {"task": spec.task, "filter": spec.filter, "particles": particles, "seed": spec.seed}
    (folder / "settings.json").write_text(json.dumps(settings) + "\n")
    faulty = load_checkpoint(path)
    for item in details:
        if item.cause in MODEL_CAUSES:
            with_equations(faulty.filter, item.cause, float(item.magnitude))
    effect = effect_of(run(original, clean, PARTICLES, spec.seed), run(faulty, episodes, particles, spec.seed))
    write_truth(folder, replace(spec, planted=tuple(details)), effect)
    return folder


def clean_episodes(spec: Spec) -> list[Episode]:
    """Fresh episodes: no other case and no training set has their seed."""
    simulate = find_task(spec.task).simulate
    return [replace(simulate(spec.seed, i, spec.steps), split="test") for i in range(spec.episodes)]


def _change_data(
    spec: Spec, item: Planted, episodes: list[Episode], rng: np.random.Generator
) -> tuple[list[Episode], Planted]:
    everything = tuple(range(len(episodes)))
    if item.cause in SENSOR_CAUSES:
        changed, text, affected = inject(item.cause, item.magnitude, episodes, spec.seed, rng)
        return changed, replace(item, faults=text, episodes=tuple(affected))
    assert not isinstance(item.magnitude, str)
    if item.cause in LABEL_CAUSES:
        changed = mislabel(item.cause, item.magnitude, episodes, rng)
    else:
        shifted = (shifts.shifted_episode(spec.task, spec.seed, i, spec.steps, item.magnitude) for i in everything)
        changed = [replace(episode, split="test") for episode in shifted]
    return changed, replace(item, episodes=everything)


def run(checkpoint: Checkpoint, episodes: Sequence[Episode], particles: int, seed: int) -> list[Trace]:
    return list(trace_all(checkpoint, episodes, range(len(episodes)), seed, particles))


def effect_of(clean: Sequence[Trace], faulty: Sequence[Trace]) -> dict[str, Any]:
    """``visible``, and the ratios it follows from: RMSE by unit, and NEES, both of the fused estimate."""
    (before, nees_before), (after, nees_after) = _scores(clean), _scores(faulty)
    rmse_ratio = {unit: after[unit] / max(before[unit], 1e-9) for unit in before}
    nees_ratio = nees_after / max(nees_before, 1e-9)
    visible = max(rmse_ratio.values()) > MIN_RMSE or not 1.0 / MIN_NEES <= nees_ratio <= MIN_NEES
    return {"visible": visible, "rmse": after, "rmse_ratio": rmse_ratio, "nees": nees_after, "nees_ratio": nees_ratio}


def _scores(traces: Sequence[Trace]) -> tuple[dict[str, float], float]:
    components = traces[0].task.components
    squares = np.concatenate([errors(t)[counted(t), -1] ** 2 for t in traces])  # (S, n)
    units = [component.unit for component in components]
    rmse = {unit: float(np.sqrt(squares[:, [u == unit for u in units]].sum(1).mean())) for unit in dict.fromkeys(units)}
    return rmse, float(np.concatenate([nees(t)[counted(t), -1] for t in traces]).mean())
