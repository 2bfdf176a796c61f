"""Share of planted data slices that the search finds, its false discovery rate and its time, as JSON.

    python bench/slices.py FIELD [FIRST_SEED]

FIELD/push and FIELD/door have ``outages.h5`` of bench/field_tasks.py; errors are those of the pretrained filters on
these 60 episodes of 200 steps, and on the 64 held-out episodes of door and push.

Each data set pairs the covariates of every episode with the errors of a random episode, rotated by a random number of
steps. So real errors, with their dependence, have no relation to real covariates; then the errors of one random slice
are multiplied by a factor (1: null data set). A slice is a range, a category, or in a quarter of the cases both, and
has 5 to 50 % of the steps and at least 8 episodes; thresholds are at any value. Settings of the search were chosen
with seeds below 2000; FIRST_SEED is 2000.

found: share of data sets in which a reported slice has steps in common with the planted one, at least half of those of
either (Jaccard index). false discovery rate: mean share of reported slices that are false, 0 if none is reported. A
reported slice is false unless planted steps are at least twice as frequent inside as outside. Brackets: 95 % intervals,
Clopper-Pearson for shares of data sets.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import betaincinv, stdtrit

from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.slices.covariates import StepCovariate, covariates_of
from beliefscope.inspect.slices.search import Candidate, Index, find_candidates, random_pairings
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.measures import Array, Mask
from beliefscope.inspect.traces.batch import trace_all

FILTERS = {"push-field": "information-ekf", "door-field": "information-ekf", "door": "crossmodal-ekf"}
FILTERS |= {"push": "crossmodal-ekf"}
FACTORS = {1.5: 67, 2.0: 67, 3.0: 66}
"""Factor of the planted error -> number of data sets."""
NULL = 200
PAIRS = 0.25
SIZE, MIN_EPISODES = (0.05, 0.5), 8


@dataclass(frozen=True)
class Table:
    """Position errors (S,) in m, episode of each step, and covariates."""

    error: Array
    episode: Index
    covariates: list[StepCovariate]


def table_of(task: str, field: Path) -> Table:
    checkpoint = load_checkpoint(pretrained_path(task, FILTERS[task]))
    path = field / task.removesuffix("-field") / "outages.h5" if task.endswith("-field") else sample_path(task)
    with open_dataset(path) as data:
        traces = list(trace_all(checkpoint, data, data.held_out()))
    error = np.concatenate([measures.main_error(t)[measures.counted(t), -1] for t in traces])
    number = np.repeat(np.arange(len(traces)), [measures.counted(t).sum() for t in traces])
    return Table(error, number, covariates_of(traces))


def random_slice(table: Table, rng: np.random.Generator) -> tuple[Mask, bool]:
    """Steps of a random slice, and whether one of its covariates varies within episodes."""
    categories = [covariate for covariate in table.covariates if covariate.categories]
    while True:
        parts = [table.covariates[rng.integers(len(table.covariates))]]
        if rng.random() < PAIRS:
            parts.append(categories[rng.integers(len(categories))])
        steps = np.logical_and.reduce([random_range(part, rng) for part in parts])
        if SIZE[0] <= steps.mean() <= SIZE[1] and len(np.unique(table.episode[steps])) >= MIN_EPISODES:
            return steps, any(varies(part, table.episode) for part in parts)


def random_range(covariate: StepCovariate, rng: np.random.Generator) -> Mask:
    """A random category; or 10 to 60 % of the values, above a threshold, below one or between two."""
    if covariate.categories:
        return covariate.values == rng.integers(len(covariate.categories))
    values = np.sort(covariate.values[np.isfinite(covariate.values)])
    share = rng.uniform(0.1, 0.6)
    begin = rng.choice([0.0, 1.0 - share, rng.uniform(0.0, 1.0 - share)])
    low = -np.inf if begin == 0.0 else values[int(begin * len(values))]
    high = values[min(int((begin + share) * len(values)), len(values) - 1)]
    return (covariate.values > low) & (covariate.values <= high)


def varies(covariate: StepCovariate, episode: Index) -> bool:
    same = np.diff(episode) == 0
    return bool((np.diff(np.nan_to_num(covariate.values)) != 0)[same].any())


@dataclass(frozen=True)
class Trial:
    """A search: factor, whether the slice varies within episodes, result, and CPU seconds."""

    factor: float
    within: bool
    jaccard: float
    reported: int
    false: int
    seconds: float


def trial(table: Table, factor: float, seed: int) -> Trial:
    rng = np.random.default_rng(seed)
    error = table.error[random_pairings(table.episode, 1, rng)[:, 0]]
    planted, within = random_slice(table, rng)
    began = time.process_time()
    result = find_candidates(np.where(planted, factor * error, error), table.episode, table.covariates, seed=seed)
    seconds = time.process_time() - began
    overlap = [(r.steps & planted).sum() / (r.steps | planted).sum() for r in result]
    false = len(result) if factor == 1.0 else sum(is_false(r, planted) for r in result)
    return Trial(factor, within, max(overlap, default=0.0), len(result), false, seconds)


def is_false(result: Candidate, planted: Mask) -> bool:
    return bool(planted[result.steps].mean() < 2.0 * planted[~result.steps].mean())


def share(hits: Sequence[bool]) -> str:
    """``0.83 [0.77, 0.88], 166 of 200``"""
    k, n = int(np.sum(hits)), len(hits)
    low = betaincinv(k, n - k + 1, 0.025) if k else 0.0
    high = betaincinv(k + 1, n - k, 0.975) if k < n else 1.0
    return f"{k / n:.3f} [{low:.3f}, {high:.3f}], {k} of {n}"


def mean(values: Sequence[float]) -> str:
    value, n = float(np.mean(values)), len(values)
    half = float(stdtrit(n - 1, 0.975) * np.std(values, ddof=1) / np.sqrt(n))
    return f"{value:.3f} [{max(value - half, 0.0):.3f}, {value + half:.3f}]"


def summary(trials: Sequence[Trial]) -> dict[str, Any]:
    return {
        "found": share([t.jaccard >= 0.5 for t in trials]),
        "false discovery rate": mean([t.false / max(t.reported, 1) for t in trials]),
        "slices reported": round(float(np.mean([t.reported for t in trials])), 2),
    }


def main(field: Path, first_seed: int) -> None:
    tables = [table_of(task, field) for task in FILTERS]
    factors = [*np.repeat(list(FACTORS), list(FACTORS.values())), *[1.0] * NULL]
    trials = [trial(tables[i % len(tables)], float(f), first_seed + i) for i, f in enumerate(factors)]
    planted, null = [t for t in trials if t.factor > 1.0], [t for t in trials if t.factor == 1.0]
    document = {"planted": summary(planted)}
    document |= {f"factor {factor:g}": summary([t for t in planted if t.factor == factor]) for factor in FACTORS}
    document |= {
        "varies within episodes": summary([t for t in planted if t.within]),
        "constant in each episode": summary([t for t in planted if not t.within]),
        "null": {"any slice reported": share([t.reported > 0 for t in null])},
        "CPU s": {"mean": np.mean([t.seconds for t in trials]), "largest": max(t.seconds for t in trials)},
    }
    print(json.dumps(document, indent=1, default=lambda value: round(float(value), 2)))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 2000)
