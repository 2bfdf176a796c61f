"""Train filters on a field task and compare fusion with the better single modality, as JSON.

    beliefscope collect push-field --episodes 250 --steps 200 --seed 0 -o DIR/train.h5
    beliefscope collect push-field --episodes 60 --steps 200 --seed 1 --split test -o DIR/outages.h5
    beliefscope collect push-field --episodes 60 --steps 200 --seed 1 --split test --without outages \\
        -o DIR/no_outages.h5
    python bench/field_tasks.py DIR information-ekf information-ekf:image information-ekf:haptics crossmodal-ekf

``NAME:MODALITY`` is the same filter with one modality, trained by itself. Checkpoints are kept as DIR/NAME.safetensors;
existing ones are not trained again. Errors are position RMSE in cm, from step 0. Brackets: 95 % intervals over
trajectories (inspect/statistics/intervals.py). The plan is a fifth of the preset ``cpu``, on one thread.
"""

from __future__ import annotations

import json
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
from beliefscope.filters.evaluate import Metrics, evaluate
from beliefscope.filters.filter import Filter
from beliefscope.filters.models.ekf import ExtendedKalmanFilter
from beliefscope.filters.models.information import InformationFilter
from beliefscope.filters.models.information_pf import with_particles
from beliefscope.filters.training.plan import Plan
from beliefscope.filters.training.train import train
from beliefscope.inspect.statistics.intervals import jackknife

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
KEY = "position_cm"
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
    path = folder / f"{name.replace(':', '-')}.safetensors"
    if not path.exists():
        with open_dataset(folder / "train.h5") as data:
            episodes = [episode for episode in data if episode.split != "test"]
            fused, _, modality = name.partition(":")
            settings = architecture(data.task.name, fused)
            result = train(
                replace(settings, models=(modality,)) if modality else settings,
                episodes,
                data_hash=data.hash,
                plan=PLAN,
                blackouts=(0.0,),  # the images have outages
                command=f"python bench/field_tasks.py DIR {name}",
                partial=path.with_suffix(".partial"),
                shared=folder / "shared",
                report=lambda stage, step, steps, loss: (
                    print(stage, step, loss, file=sys.stderr) if step % 50 == 0 else None
                ),
            )
        save_checkpoint(result.filter, name, result.record, path)
    return load_checkpoint(path).filter


def triple(values: tuple[Array, Array, Array]) -> str:
    """``0.55 [0.49, 0.62]``"""
    value, low, high = (float(v) for v in values)
    return f"{value:.2f} [{low:.2f}, {high:.2f}]"


def squares(result: Metrics) -> Array:
    """(R, 2): number of steps, and sum of squared position errors, of each trajectory."""
    return result.squares[:, [0, 1 + list(result.rmse).index(KEY)]]


def error(result: Metrics) -> str:
    return triple(jackknife(squares(result), lambda s: np.sqrt(s[..., 1] / s[..., 0])))


def ratio(fused: Metrics, alone: Sequence[Metrics]) -> str:
    """Error of the fused filter over that of the best other one."""
    sums = np.stack([squares(result)[:, 1] for result in (fused, *alone)], axis=1)
    return triple(jackknife(sums, lambda s: np.sqrt(s[..., 0] / s[..., 1:].min(-1))))


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


def dropped_haptics(filter_: Filter, episodes: Sequence[Episode]) -> str:
    """Error over the 2 s from the first contact with haptics dropped there, over that of clean haptics."""
    clean, faulty = [], []
    for episode in episodes:
        first = int(episode.contact.argmax())
        if not 0 < first <= len(episode) - DROPPED:
            continue
        part = shortened(episode, first + DROPPED)
        clean.append(evaluate(filter_, [part]))
        faulty.append(evaluate(filter_, [part], faults=Faults.parse(f"drop=haptics:from={first}")))
    sums = np.array([[m.rmse_after_contact[KEY] ** 2 for m in pair] for pair in zip(faulty, clean, strict=True)])
    return triple(jackknife(sums, lambda s: np.sqrt(s[..., 0] / s[..., 1])))


def shortened(episode: Episode, steps: int) -> Episode:
    """The first steps of an episode."""
    arrays = {key: getattr(episode, key)[:steps] for key in ("states", "controls", "contact", "qpos")}
    return replace(episode, observations={key: v[:steps] for key, v in episode.observations.items()}, **arrays)


def report(filters: dict[str, Filter], episodes: Sequence[Episode]) -> dict[str, Any]:
    """Errors of all filters on a test set, and the gain of each fused one."""
    results = {name: evaluate(f, episodes, baselines=True, modalities=len(f.names) > 1) for name, f in filters.items()}
    document: dict[str, Any] = {}
    for name, result in results.items():
        entry: dict[str, Any] = {
            "error": error(result),
            "before, after first contact": [result.rmse_before_contact[KEY], result.rmse_after_contact[KEY]],
            "nees": result.nees,
        }
        entry |= {baseline: error(other) for baseline, other in result.baselines.items() if other is not None}
        entry |= {f"{modality} standalone": error(other) for modality, other in result.standalone.items()}
        if result.standalone:
            entry["fused / better own standalone"] = ratio(result, list(result.standalone.values()))
            alone = [other for label, other in results.items() if len(filters[label].names) == 1]
            if alone:
                entry["fused / best separately trained"] = ratio(result, alone)
                entry["fused / best standalone"] = ratio(result, [*alone, *result.standalone.values()])
            entry["haptics dropped for 2 s from first contact"] = dropped_haptics(filters[name], episodes)
            filter_ = filters[name]
            assert isinstance(filter_, ExtendedKalmanFilter)
            entry["haptics share"] = haptics_share(filter_, episodes)
        document[name] = entry
    return document


def main(folder: Path, names: Sequence[str]) -> None:
    torch.set_num_threads(1)
    filters = {name: trained(folder, name) for name in names}
    document = {}
    for test in TESTS:
        with open_dataset(folder / f"{test}.h5") as data:
            document[test] = {"episodes": len(data), **report(filters, list(data))}
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:] or DEFAULT)
