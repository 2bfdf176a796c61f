"""Statistics of modules, adjusted for the readings of the episode.

What a healthy module computes depends on its inputs: a measurement model that sees little of an object has another
bias and is less certain. A regression on the statistics of the sensors, fitted to the healthy record, predicts the
statistics of modules. What it cannot predict varies less between healthy episodes, so smaller faults show.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from beliefscope.inspect.diagnostics.healthy_comparison import MIN_HEALTHY, scaled_values
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.diagnostics.statistic_kinds import ADJUSTED, KINDS
from beliefscope.inspect.statistics.measures import Array

MODULES = ("module ", "dynamics ")
"""How the names of adjusted statistics begin."""

RIDGE = 0.3
"""Penalty of squared coefficients, relative to the variance of a reading, which is one."""

LIMIT = 3.0
"""Largest deviation of a reading from its healthy mean that predicts anything, in standard deviations."""

PREDICTED = 0.9
"""Largest standard deviation of an adjusted statistic, relative to that of the statistic itself."""

Rows = Sequence[Mapping[str, float]]


def with_adjusted(profile: HealthyProfile, rows: Rows, sensors: Rows) -> tuple[HealthyProfile, list[dict[str, float]]]:
    """The profile and the episodes' statistics with those of modules adjusted for the readings.

    ``KIND/SUBJECT/adjusted``: the statistic without what the readings predict, if they predict it. Values of the record
    are predicted from its other episodes (leave-one-out), so values of new healthy episodes have the same distribution.
    A reading far from healthy ones predicts nothing, so a faulty sensor does not change the adjusted statistics of
    healthy modules.
    """
    finite = {name: np.isfinite(values) for name, values in profile.statistics.items()}
    readings = [n for n, at in finite.items() if at.sum() >= MIN_HEALTHY and any(n in row for row in sensors)]
    names = [n for n, at in finite.items() if at.all() and n.startswith(MODULES) and any(n in row for row in rows)]
    if not readings or not names:
        return profile, [dict(row) for row in rows]
    count = profile.episodes
    values, _ = _scaled(profile, rows, names)
    mean = values[:count].mean(0)
    influence = _influence(*_scaled(profile, rows, readings), count)
    residual = values - mean - influence @ (values[:count] - mean)
    residual[:count] /= 1.0 - 1.0 / count - np.diagonal(influence)[:, None]
    predicted = residual[:count].std(0) < PREDICTED * values[:count].std(0)
    names = [name for name, kept in zip(names, predicted, strict=True) if kept]
    adjusted = (mean + residual)[:, predicted]
    adjusted = _rounded(np.where([KINDS[name.split("/")[0]][1] for name in names], np.exp(adjusted), adjusted))
    columns = [f"{name.rpartition('/')[0]}/{ADJUSTED}" for name in names]
    added = [dict(zip(columns, row, strict=True)) for row in adjusted[count:].tolist()]
    statistics = {**profile.statistics, **dict(zip(columns, adjusted[:count].T, strict=True))}
    return replace(profile, statistics=statistics), [{**row, **more} for row, more in zip(rows, added, strict=True)]


def _rounded(values: Array) -> Array:
    """Nine significant digits: the last ones depend on the number of threads of the linear algebra."""
    scale = 10.0 ** (8.0 - np.floor(np.log10(np.maximum(np.abs(values), 1e-300))))
    return np.asarray(np.round(values * scale) / scale)


def _scaled(profile: HealthyProfile, rows: Rows, names: Sequence[str]) -> tuple[Array, Array]:
    """Values (E, S) on the scale of their kind, first those of the record, and smallest standard deviations (S,)."""
    healthy = np.stack([profile.statistics[name] for name in names], axis=1)
    tested = [[row.get(name, np.nan) for name in names] for row in rows]
    values, floor, _ = scaled_values(names, np.concatenate([healthy, tested]))
    return values, floor


def _influence(readings: Array, floor: Array, count: int) -> Array:
    """(E, N): by how much a value of each of the N healthy episodes changes the prediction for each episode.

    Ridge regression on the readings (E, S); the first N episodes are healthy.
    """
    healthy = readings[:count]
    deviation = np.maximum(np.nanstd(healthy, axis=0), floor)
    standardised = (readings - np.nanmean(healthy, axis=0)) / deviation
    standardised[~(np.abs(standardised) <= LIMIT)] = 0.0
    kernel = standardised @ standardised[:count].T / count
    return np.asarray(np.linalg.solve(kernel[:count] + RIDGE * np.eye(count), kernel.T).T)
