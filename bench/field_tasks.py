"""Train filters on a field task and compare fusion with the better single modality, as JSON.

    beliefscope collect push-field --episodes 300 --steps 200 --seed 0 -o DIR/train.h5
    beliefscope collect push-field --episodes 60 --steps 200 --seed 1 --split test -o DIR/outages.h5
    beliefscope collect push-field --episodes 60 --steps 200 --seed 1 --split test --without outages \\
        -o DIR/no_outages.h5
    python bench/field_tasks.py DIR information-ekf information-ekf:image information-ekf:haptics crossmodal-ekf

The same for door-field, with 500 training episodes. ``NAME:MODALITY`` is the same filter with one modality, trained by
itself; ``NAME#SEED`` has another seed than 0. Checkpoints are kept as DIR/NAME.safetensors; existing ones are not
trained again. Errors are RMSE from step 0, in cm and degrees. Brackets: 95 % intervals over trajectories
(inspect/statistics/intervals.py). The plan is for one thread, about 5 minutes per filter.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import architecture
from beliefscope.filters.checkpoint import load_checkpoint, save_checkpoint
from beliefscope.filters.evaluate import Metrics, evaluate, run
from beliefscope.filters.filter import Filter
from beliefscope.filters.models.ekf import ExtendedKalmanFilter
from beliefscope.filters.models.information import InformationFilter
from beliefscope.filters.models.information_pf import with_particles
from beliefscope.filters.training.plan import Plan
from beliefscope.filters.training.train import train
from beliefscope.inspect.statistics.intervals import jackknife, mean_interval

Array = NDArray[np.float64]

PLAN = Plan(
    dynamics=150,
    horizons=(1, 4, 16, 64),
    images=1500,
    models=3000,
    single=80,
    weights=80,
    together=(60, 80, 60),
    fine=0,
    batch=16,
    patience=8,
)
DEFAULT = ("information-ekf", "information-ekf:image", "information-ekf:haptics")
TESTS = ("outages", "no_outages")
"""Test sets; those that do not exist are omitted."""
DROPPED = 20
"""Steps without haptics after the first contact."""


def trained(folder: Path, name: str) -> Filter:
    """The filter's checkpoint in the folder, which is trained if it does not exist.

    ``information-pf`` has the weights of ``information-ekf``.
    """
    if name.startswith("information-pf"):
        kalman = trained(folder, name.replace("-pf", "-ekf", 1))
        assert isinstance(kalman, InformationFilter)
        return with_particles(kalman)
    path = folder / f"{name.replace(':', '-').replace('#', '-seed')}.safetensors"
    if not path.exists():
        with open_dataset(folder / "train.h5") as data:
            episodes = [episode for episode in data if episode.split != "test"]
            label, _, seed = name.partition("#")
            fused, _, modality = label.partition(":")
            settings = architecture(data.task.name, fused)
            result = train(
                replace(settings, models=(modality,)) if modality else settings,
                episodes,
                data_hash=data.hash,
                plan=PLAN,
                seed=int(seed or 0),
                blackouts=(0.0,),  # the images have outages
                command=f"python bench/field_tasks.py DIR {name}",
                partial=path.with_suffix(".partial"),
                shared=folder / "shared",
                report=lambda stage, step, steps, loss: (
                    print(stage, step, loss, file=sys.stderr) if step % 50 == 0 else None
                ),
            )
        save_checkpoint(result.filter, fused, result.record, path)
    return load_checkpoint(path).filter


def triple(values: tuple[Array, Array, Array]) -> str:
    """``0.55 [0.49, 0.62]``"""
    value, low, high = (float(v) for v in values)
    return f"{value:.2f} [{low:.2f}, {high:.2f}]"


def squares(result: Metrics, key: str) -> Array:
    """(R, 2): number of steps, and sum of squared errors, of each trajectory."""
    return result.squares[:, [0, 1 + list(result.rmse).index(key)]]


def error(result: Metrics, key: str) -> str:
    return triple(jackknife(squares(result, key), lambda s: np.sqrt(s[..., 1] / s[..., 0])))


def ratio(fused: Metrics, alone: Sequence[Metrics], key: str) -> str:
    """Error of the fused filter over that of the best other one."""
    sums = np.stack([squares(result, key)[:, 1] for result in (fused, *alone)], axis=1)
    return triple(jackknife(sums, lambda s: np.sqrt(s[..., 0] / s[..., 1:].min(-1))))


def phases(episodes: Sequence[Episode]) -> dict[str, Array]:
    """Phase -> (T, R) mask of the steps of R episodes of equal length."""
    outage = np.stack([episode.observations["image"].max(axis=(1, 2)) == 0 for episode in episodes], axis=1)
    contact = np.stack([episode.contact for episode in episodes], axis=1)
    return {"all": np.ones_like(contact), "contact": contact, "free motion": ~contact, "outage": outage}


def nees_by_step(filter_: Filter, episodes: Sequence[Episode]) -> Array:
    """(T, R) NEES / n of episodes of equal length."""
    steps = Steps.from_episodes(filter_.task, episodes)
    error, covariance = run(filter_, steps.windows(steps.first, len(episodes[0])), None, particles=300, seed=0)
    white = torch.linalg.solve(covariance.double(), error.double().unsqueeze(-1)).squeeze(-1)
    values: Array = (error.double() * white).mean(-1).numpy()
    return values


def phase_mean(values: Array, mask: Array) -> tuple[Array, Array, Array]:
    """Mean NEES (T, R) of some steps, and its interval over trajectories, whose means are skewed."""
    has = mask.any(0)
    return mean_interval((mask * values).sum(0)[has], mask.sum(0)[has])


def mean_of_steps(values: Array, mask: Array) -> str:
    """The same as text."""
    return triple(phase_mean(values, mask))


def nees(filter_: Filter, episodes: Sequence[Episode]) -> dict[str, str]:
    """Mean NEES / n by phase."""
    values = nees_by_step(filter_, episodes)
    return {phase: mean_of_steps(values, mask) for phase, mask in phases(episodes).items() if mask.any()}


@torch.no_grad()
def haptics_share(filter_: ExtendedKalmanFilter, episodes: Sequence[Episode]) -> dict[str, str]:
    """Mean effective weight of haptics: in contact minus free motion, and in outages minus other steps."""
    steps, rows = Steps.from_episodes(filter_.task, episodes), []
    for number, episode in enumerate(episodes):
        share = filter_.shares(filter_.encode(steps.episode(number)))[:, 0, filter_.index("haptics")].mean(-1).numpy()
        outage = episode.observations["image"].max(axis=(1, 2)) == 0
        masks = [episode.contact, ~episode.contact, outage, ~outage]
        rows.append([[mask.sum(), share[mask].sum()] for mask in masks])
    sums = np.array(rows, np.float64).reshape(len(rows), 8)

    def difference(s: Array, first: int) -> Array:
        return s[..., first + 1] / s[..., first] - s[..., first + 3] / s[..., first + 2]

    result = {"contact - free motion": triple(jackknife(sums, lambda s: difference(s, 0)))}
    if sums[:, 4].any():
        result["outage - other steps"] = triple(jackknife(sums, lambda s: difference(s, 4)))
    return result


def dropped_haptics(filter_: Filter, episodes: Sequence[Episode]) -> str | None:
    """Error over the 2 s from the first contact with haptics dropped there, over that of clean haptics.

    None if all episodes begin in contact.
    """
    clean, faulty = [], []
    for episode in episodes:
        first = int(episode.contact.argmax())
        if not 0 < first <= len(episode) - DROPPED:
            continue
        part = shortened(episode, first + DROPPED)
        clean.append(evaluate(filter_, [part]))
        faulty.append(evaluate(filter_, [part], faults=Faults.parse(f"drop=haptics:from={first}")))
    if not clean:
        return None
    sums = np.array(
        [[m.rmse_after_contact["position_cm"] ** 2 for m in pair] for pair in zip(faulty, clean, strict=True)]
    )
    return triple(jackknife(sums, lambda s: np.sqrt(s[..., 0] / s[..., 1])))


def shortened(episode: Episode, steps: int) -> Episode:
    """The first steps of an episode."""
    arrays = {key: getattr(episode, key)[:steps] for key in ("states", "controls", "contact", "qpos")}
    return replace(episode, observations={key: v[:steps] for key, v in episode.observations.items()}, **arrays)


def report(filters: dict[str, Filter], episodes: Sequence[Episode]) -> dict[str, Any]:
    """Errors of all filters on a test set, and the gain of each fused one."""
    results = {name: evaluate(f, episodes, baselines=True, modalities=len(f.names) > 1) for name, f in filters.items()}
    alone = [result for name, result in results.items() if len(filters[name].names) == 1]
    document: dict[str, Any] = {}
    for name, result in results.items():
        filter_, entry = filters[name], {}
        document[name] = entry
        if math.isfinite(result.nees):
            entry["nees"] = nees(filter_, episodes)
        for key in ("position_cm", *(key for key in result.rmse if key.endswith("_deg"))):
            entry[key] = errors(result, alone, key)
        if result.standalone:
            entry["haptics dropped for 2 s from first contact"] = dropped_haptics(filter_, episodes)
            if isinstance(filter_, ExtendedKalmanFilter) and hasattr(filter_, "weight_model"):
                entry["haptics share"] = haptics_share(filter_, episodes)
    return document


def errors(result: Metrics, alone: Sequence[Metrics], key: str) -> dict[str, Any]:
    """Errors of a filter in one unit, and their ratios to those of single modalities."""
    others = {name: other for name, other in result.baselines.items() if other is not None}
    others |= {f"{modality} standalone": other for modality, other in result.standalone.items()}
    entry: dict[str, Any] = {
        "error": error(result, key),
        "before, after first contact": [
            metrics.get(key) for metrics in (result.rmse_before_contact, result.rmse_after_contact)
        ],
    }
    entry |= {name: error(other, key) for name, other in others.items()}
    if not result.standalone:
        return entry | {f"filter / {name}": ratio(result, [other], key) for name, other in others.items()}
    entry["fused / better own standalone"] = ratio(result, list(result.standalone.values()), key)
    if alone:
        entry["fused / best separately trained"] = ratio(result, alone, key)
        entry["fused / best standalone"] = ratio(result, [*alone, *result.standalone.values()], key)
    return entry


def main(folder: Path, names: Sequence[str]) -> None:
    torch.set_num_threads(1)
    filters = {name: trained(folder, name) for name in names}
    document = {}
    for test in (name for name in TESTS if (folder / f"{name}.h5").exists()):
        with open_dataset(folder / f"{test}.h5") as data:
            document[test] = {"episodes": len(data), **report(filters, list(data))}
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:] or DEFAULT)
