"""Calibrate the shipped filters of a field task on held-out episodes and print their NEES before and after.

    beliefscope collect push-field --episodes 240 --steps 200 --seed 23 --split test -o fit.h5
    beliefscope collect push-field --episodes 60 --steps 200 --seed 22 --split test -o test.h5
    python bench/field_nees.py push-field fit.h5 test.h5

The factor on the covariance is the mean NEES over the first file (docs/calibration.md), either one for all steps, or
one for each combination of contact and outage, which a robot can measure. Brackets: 95 % intervals over trajectories.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from field_tasks import Array, mean_of_steps, nees_by_step, phases

from beliefscope.datasets.store import open_dataset
from beliefscope.filters.checkpoint import load_checkpoint
from beliefscope.filters.names import shipped

RULES = ("crossmodal", "unimodal", "feature", "image", "haptics")
FILTERS = ("information-ekf", "crossmodal-pf", *(f"{rule}-ekf" for rule in RULES))


def cells(masks: dict[str, Array]) -> Array:
    """(T, R) number of the combination of contact and outage."""
    return masks["contact"] + 2 * masks["outage"]


def row(values: Array, masks: dict[str, Array]) -> str:
    return " | ".join(mean_of_steps(values, mask) for mask in masks.values())


def main(task: str, fit: Path, test: Path) -> None:
    torch.set_num_threads(1)
    with open_dataset(fit) as first, open_dataset(test) as second:
        fitted, tested = list(first), list(second)
    fit_masks, test_masks = phases(fitted), phases(tested)
    print(f"| filter | factors | {' | '.join(test_masks)} |")
    for name in FILTERS:
        filter_ = load_checkpoint(shipped(task, name)).filter
        before, values = nees_by_step(filter_, fitted), nees_by_step(filter_, tested)
        factors = np.array([before[cells(fit_masks) == cell].mean() for cell in range(4)])
        print(f"| {name} | none | {row(values, test_masks)} |")
        print(f"| | one, {before.mean():.2f} | {row(values / before.mean(), test_masks)} |")
        labels = ", ".join(f"{factor:.2f}" for factor in factors)
        print(f"| | by phase, {labels} | {row(values / factors[cells(test_masks)], test_masks)} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
