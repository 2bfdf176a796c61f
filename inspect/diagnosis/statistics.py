"""All statistics of episodes that a healthy profile has: of diagnostics, sensors and modules."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnosis.label_checks import label_statistics
from beliefscope.inspect.diagnosis.model_checks import model_statistics
from beliefscope.inspect.diagnosis.sensor_checks import sensor_statistics
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.statistics.reference_images import Reference
from beliefscope.inspect.trace import Trace

SCATTER = {"module bias": "module scatter"}
"""Kind of statistic -> kind of its distance from the other episodes: whether a bias is the same in all of them."""


def episode_statistics(trace: Trace, checkpoint: Checkpoint, reference: Reference | None) -> dict[str, float]:
    """``KIND/SUBJECT/PHASE`` -> value, of all diagnostics that apply to the trace, of sensors, labels and modules.

    reference: healthy images of the profile that the statistics are compared with, or None.
    """
    values: dict[str, float] = {}
    for entry in DIAGNOSTICS.values():
        if entry.statistics is not None and entry.refusal(trace, None) is None:
            values |= entry.statistics(trace)
    values |= sensor_statistics(trace.episode, reference) | label_statistics(trace)
    return values | model_statistics(trace, checkpoint)


def with_scatter(
    profile: HealthyProfile, rows: Sequence[Mapping[str, float]]
) -> tuple[HealthyProfile, list[dict[str, float]]]:
    """The profile and the episodes' statistics with the distances of ``SCATTER`` from the mean of their own group."""
    columns, result = dict(profile.statistics), [dict(row) for row in rows]
    for name, healthy in profile.statistics.items():
        kind, _, rest = name.partition("/")
        values = np.array([row.get(name, np.nan) for row in rows])
        if kind not in SCATTER or np.isfinite(values).sum() < 2:
            continue
        name = f"{SCATTER[kind]}/{rest}"
        columns[name] = np.abs(healthy - np.nanmean(healthy))
        for row, value in zip(result, np.abs(values - np.nanmean(values)).tolist(), strict=True):
            row[name] = value
    return replace(profile, statistics=columns), result
