"""Statistics of the sample sets as JSON: the original 140 episodes of each task, and the numbers of all.

``python bench/samples.py PATH`` prints the statistics of each split of another data set.
"""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path

import numpy as np

from beliefscope.datasets.dataset_statistics import statistics
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset, sample_path

FIRST = 140
"""Episodes of seed 0, which the documentation describes; those behind them are further test episodes."""


ROOT = Path(__file__).resolve().parent.parent
TESTS = {
    "door": runpy.run_path(str(ROOT / "tests" / "datasets" / "test_samples.py")),
    "push": runpy.run_path(str(ROOT / "tests" / "datasets" / "simulation" / "test_push.py")),
}
"""The regressions from hand to object are those of the tests."""


def door_regression(episodes: list[Episode]) -> dict[str, object]:
    """RMSE, cm: of the hinge in free motion, for pushes; across and along the panel in a grasp."""

    def error(policy: str, contact: bool) -> np.ndarray:
        chosen = [e for e in episodes if e.provenance["policy"] == policy]
        splits = ([e for e in chosen if (e.split == "train") == train] for train in (True, False))
        return np.asarray(100 * TESTS["door"]["hinge_error"](*splits, contact))

    half_range = 100 * TESTS["door"]["HINGE_HALF_RANGE"]
    return {
        "free_cm": float(np.sqrt((error("push", False) ** 2).mean())),
        "mean_cm": half_range / 3**0.5,
        "grasp_cm": error("pull", True).tolist(),
    }


def push_regression(episodes: list[Episode]) -> dict[str, object]:
    """RMSE, cm, of the puck's x and y from hand and force, and of their mean."""
    splits = [[e for e in episodes if (e.split == "train") == train] for train in (True, False)]
    result = {}
    for name, contact in (("contact", True), ("free", False)):
        error, mean = TESTS["push"]["puck_error"](*splits, contact)
        result[name] = {"cm": (100 * error).tolist(), "mean_cm": (100 * mean).tolist()}
    return result


REGRESSIONS = {"door": door_regression, "push": push_regression}


def summary(name: str) -> dict[str, object]:
    with open_dataset(sample_path(name)) as data:
        episodes, task = list(data), data.task
    splits, first = [episode.split for episode in episodes], episodes[:FIRST]
    force = np.concatenate([episode.observations["force"] for episode in first]).astype(np.float64)
    states = np.concatenate([episode.states for episode in first]).astype(np.float64)
    contact = np.concatenate([episode.contact for episode in first]).astype(bool)
    policies: dict[str, list[Episode]] = {}
    for episode in first:
        policies.setdefault(str(episode.provenance.get("policy", "")), []).append(episode)
    squared = (force**2).sum(axis=1)
    return {
        "megabytes": Path(sample_path(name)).stat().st_size / 1e6,
        "episodes": len(splits),
        "splits": {split: splits.count(split) for split in ("train", "val", "test")},
        "statistics": statistics(task, first),
        "contact_by_policy": {policy: float(np.mean([e.contact for e in group])) for policy, group in policies.items()},
        "force_rms_N": {"all": float(squared.mean() ** 0.5), "contact": float(squared[contact].mean() ** 0.5)},
        "regression": REGRESSIONS[name](episodes),
        "state_mean": states.mean(axis=0).tolist(),
        "state_std": states.std(axis=0).tolist(),
        "state_max": states.max(axis=0).tolist(),
    }


if __name__ == "__main__":
    if len(sys.argv) > 1:
        with open_dataset(Path(sys.argv[1])) as data:
            parts = {split: [e for e in data if e.split == split] for split in ("train", "val", "test")}
            print(json.dumps({split: statistics(data.task, part) for split, part in parts.items() if part}, indent=1))
    else:
        print(json.dumps({name: summary(name) for name in ("door", "push")}, indent=1))
