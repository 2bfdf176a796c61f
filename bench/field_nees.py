"""Calibrate the pretrained filters of a field task on held-out episodes and print their NEES on others.

    beliefscope collect push-field --episodes 960 --steps 200 --seed 31 --split test -o first.h5
    beliefscope collect push-field --episodes 240 --steps 200 --seed 32 --split test -o second.h5
    python bench/field_nees.py push-field first.h5 second.h5

The episodes of all files are divided into sets of 60. The factor on the covariance for a set is the mean NEES over all
other sets (docs/calibration.md), either one for all steps, or one for each combination of contact and outage, which a
robot can measure. For each phase the table has the mean NEES over all episodes, with its 95 % interval over
trajectories, and the number of sets whose own interval contains 1.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from field_tasks import Array, mean_of_steps, nees_by_step, phase_mean, phases

from beliefscope.datasets.store import open_dataset
from beliefscope.filters.checkpoint import load_checkpoint
from beliefscope.filters.names import pretrained_path

RULES = ("crossmodal", "unimodal", "feature", "image", "haptics")
FILTERS = ("information-ekf", "crossmodal-pf", *(f"{rule}-ekf" for rule in RULES))
EPISODES = 60
"""Episodes of a set."""


def calibrated(values: Array, cells: Array) -> Array:
    """NEES (T, R) of all sets, each divided by the mean over the other sets of the steps in the same cell (T, R)."""
    result = values.copy()
    for first in range(0, values.shape[1], EPISODES):
        inside = np.zeros(values.shape[1], bool)
        inside[first : first + EPISODES] = True
        for cell in np.unique(cells):
            others = values[:, ~inside][cells[:, ~inside] == cell].mean()
            result[:, inside] /= np.where(cells[:, inside] == cell, others, 1.0)
    return result


def row(values: Array, masks: dict[str, Array]) -> str:
    """Mean NEES of each phase over all episodes, and the number of sets whose interval contains 1."""
    parts = []
    for mask in masks.values():
        sets = [slice(first, first + EPISODES) for first in range(0, values.shape[1], EPISODES)]
        intervals = [phase_mean(values[:, part], mask[:, part]) for part in sets]
        consistent = sum(bool(low <= 1.0 <= high) for _, low, high in intervals)
        parts.append(f"{mean_of_steps(values, mask)}, {consistent} of {len(sets)}")
    return " | ".join(parts)


def main(task: str, paths: Sequence[Path]) -> None:
    torch.set_num_threads(1)
    episodes = []
    for path in paths:
        with open_dataset(path) as data:
            episodes += list(data)
    masks = phases(episodes)
    by_phase = masks["contact"] + 2 * masks["outage"]
    print(f"| filter | factors | {' | '.join(masks)} |")
    for name in FILTERS:
        filter_ = load_checkpoint(pretrained_path(task, name)).filter
        starts = range(0, len(episodes), EPISODES)
        values = np.concatenate([nees_by_step(filter_, episodes[i : i + EPISODES]) for i in starts], 1)
        print(f"| {name} | none | {row(values, masks)} |")
        print(f"| | one | {row(calibrated(values, np.zeros_like(by_phase)), masks)} |")
        print(f"| | by phase | {row(calibrated(values, by_phase), masks)} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], [Path(path) for path in sys.argv[2:]])
