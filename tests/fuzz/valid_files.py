"""Small valid files of every data format."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import h5py
import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.readers.mit_push import KEYS
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset


@cache
def episodes(task: str = "door", steps: int = 6) -> tuple[Episode, ...]:
    """First steps of three sample episodes, one of each split."""
    with open_dataset(sample_path(task)) as data:
        first = {summary.split: summary.index for summary in reversed(data.summaries)}
        return tuple(_first(data[index], steps) for _, index in sorted(first.items()))


def _first(episode: Episode, steps: int) -> Episode:
    arrays = {name: getattr(episode, name)[:steps] for name in ("states", "controls", "contact", "qpos")}
    return replace(episode, **arrays, observations={k: v[:steps] for k, v in episode.observations.items()})


def write_episodes(path: Path) -> None:
    write_dataset(path, DOOR, episodes())


PAPER_LAYOUTS: dict[str, dict[str, tuple[int, ...]]] = {
    "door": {
        "object-state": (5,),
        "eef_pos": (3,),
        "ee-force-obs": (3,),
        "ee-torque-obs": (3,),
        "contact-obs": (),
        "image": (64, 64),
    },
    "push": {"Cylinder0_pos": (3,), "eef_pos": (3,), "force": (6,), "contact": (), "image": (32, 32)},
    "real": {"pos": (3,), "tip": (3,), "force": (3,), "contact": (), "image": (32, 32, 3)},
}
"""Layout of the paper's files -> key -> shape per step."""


def write_paper_file(path: Path, keys: dict[str, tuple[int, ...]]) -> None:
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for index in range(2):
            group = file.create_group(f"trajectory{index}")
            for key, shape in keys.items():
                group[key] = rng.random((5, *shape), np.float32)


def write_push(path: Path) -> None:
    clock = np.arange(40) / 100
    still = np.zeros(len(clock))
    rows = {
        "object_pose": np.column_stack([clock, 0.3 + clock / 10, still, still]),
        "tip_pose": np.column_stack([clock, 0.2 + clock / 10, still, still]),
        "ft_wrench": np.column_stack([clock, still, still, still]),
    }
    if path.suffix == ".json":
        path.write_text(json.dumps({key: rows[key].tolist() for key in KEYS}))
    else:
        with h5py.File(path, "w") as file:
            file.update(rows)
