"""Calibrate the shipped filters of a field task on held-out episodes and print their NEES before and after.

    beliefscope collect push-field --episodes 240 --steps 200 --seed 23 --split test -o fit.h5
    beliefscope collect push-field --episodes 60 --steps 200 --seed 22 --split test -o test.h5
    python bench/field_nees.py push-field fit.h5 test.h5

The factor on the covariance is the mean NEES over the first file (docs/calibration.md), either one for all steps, or
one for each combination of contact and outage, which a robot can measure. Brackets: 95 % intervals over trajectories.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from field_tasks import Array, phases, triple

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.batch import Steps
from beliefscope.filters.checkpoint import load_checkpoint
from beliefscope.filters.evaluate import run
from beliefscope.filters.filter import Filter
from beliefscope.filters.names import shipped
from beliefscope.inspect.statistics.intervals import jackknife

FILTERS = ("information-ekf", "crossmodal-pf", *(f"{rule}-ekf" for rule in ("crossmodal", "unimodal", "feature")))
SINGLE = ("image-ekf", "haptics-ekf")


def nees(filter_: Filter, episodes: Sequence[Episode]) -> Array:
    """(T, R) NEES / n."""
    steps = Steps.from_episodes(filter_.task, episodes)
    error, covariance = run(filter_, steps.windows(steps.first, len(episodes[0])), None, particles=300, seed=0)
    white = torch.linalg.solve(covariance.double(), error.double().unsqueeze(-1)).squeeze(-1)
    values: Array = (error.double() * white).mean(-1).numpy()
    return values


def cells(masks: dict[str, Array]) -> Array:
    """(T, R) number of the combination of contact and outage."""
    return masks["contact"] + 2 * masks["outage"]


def row(values: Array, masks: dict[str, Array]) -> str:
    means = (
        triple(jackknife(np.stack([mask.sum(0), (mask * values).sum(0)], 1), lambda s: s[..., 1] / s[..., 0]))
        for mask in masks.values()
    )
    return " | ".join(means)


def main(task: str, fit: Path, test: Path) -> None:
    torch.set_num_threads(1)
    with open_dataset(fit) as first, open_dataset(test) as second:
        fitted, tested = list(first), list(second)
    fit_masks, test_masks = phases(fitted), phases(tested)
    print(f"| filter | factors | {' | '.join(test_masks)} |")
    for name in (*FILTERS, *SINGLE):
        filter_ = load_checkpoint(shipped(task, name)).filter
        before, values = nees(filter_, fitted), nees(filter_, tested)
        factors = np.array([before[cells(fit_masks) == cell].mean() for cell in range(4)])
        print(f"| {name} | none | {row(values, test_masks)} |")
        print(f"| | one, {before.mean():.2f} | {row(values / before.mean(), test_masks)} |")
        labels = ", ".join(f"{factor:.2f}" for factor in factors)
        print(f"| | by phase, {labels} | {row(values / factors[cells(test_masks)], test_masks)} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
