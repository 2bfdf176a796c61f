"""All statistics of episodes that a healthy profile has: of diagnostics, sensors and modules."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnosis.checks.labels import common_part, label_statistics
from beliefscope.inspect.diagnosis.checks.modules import model_statistics
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.statistics.measures import Array
from beliefscope.inspect.statistics.reading_model import ReadingModel
from beliefscope.inspect.statistics.signals import nearer_slope
from beliefscope.inspect.trace import Trace

SCATTER = {
    "module bias": "module scatter",
    "contact distance": "contact distance scatter",
    "reading bias": "reading scatter",
    "reading lag": "reading lag scatter",
    "dynamics offset": "dynamics scatter",
}
"""Kind of statistic -> kind of its distance from the other episodes: whether a bias is the same in all of them."""


COMMON = frozenset({"contact distance"})
"""Kinds of statistics that count by their part common to all episodes: an object of another size changes all of them
alike, an offset each in its own direction."""

MIN_COMMON = 3
"""Minimum number of episodes with a common part."""


def episode_statistics(
    trace: Trace, checkpoint: Checkpoint, sensors: Mapping[str, float], readings: Sequence[ReadingModel] = ()
) -> dict[str, float]:
    """``KIND/SUBJECT/PHASE`` -> value, of all diagnostics that apply to the trace, of sensors, labels and modules.

    Args:
        sensors: statistics of the episode's sensors, which do not depend on the filter (``sensor_statistics``).
        readings: models of the healthy record.
    """
    values: dict[str, float] = {}
    for entry in DIAGNOSTICS.values():
        if entry.statistics is not None and entry.refusal(trace, None) is None:
            values |= entry.statistics(trace)
    return {**values, **sensors, **label_statistics(trace), **model_statistics(trace, checkpoint, readings)}


def _distance(values: Array, kind: str) -> Array:
    """Distances of values (E,) from their mean; of delays, from the range between none and twice the mean.

    An estimated delay is less exact if it is large. A bias is a delay or its opposite, by the direction of the motion.
    """
    mean = float(np.nanmean(values))
    return np.maximum(np.abs(values - mean) - (abs(mean) if kind == "reading lag" else 0.0), 0.0)


def with_slopes(
    profile: HealthyProfile, rows: Sequence[Mapping[str, float]]
) -> tuple[HealthyProfile, list[dict[str, float]]]:
    """The profile and the episodes' statistics with slopes that neither noise nor the size of the motion changes.

    Process noise in the true changes decreases ``dynamics response``, noise in the controls the inverse of
    ``dynamics slope``: the slope is the ``nearer_slope`` of the two to the healthy one, the responses being relative to
    their healthy median. They are left out.
    """
    columns, result = dict(profile.statistics), [dict(row) for row in rows]
    for name in [name for name in columns if name.startswith("dynamics response/")]:
        slope = name.replace("response", "slope", 1)
        if slope in columns and (np.isfinite(columns[slope]) & np.isfinite(columns[name])).any():
            middle, of_response = (float(np.nanmedian(columns[n])) for n in (slope, name))
            ratio = middle / of_response if of_response else np.nan
            columns[slope] = nearer_slope(columns[slope], columns[name] * ratio, middle)
            for row in result:
                row[slope] = float(nearer_slope(row.get(slope, np.nan), row.get(name, np.nan) * ratio, middle))
        del columns[name]
        for row in result:
            row.pop(name, None)
    return replace(profile, statistics=columns), result


def with_scatter(
    profile: HealthyProfile, rows: Sequence[Mapping[str, float]]
) -> tuple[HealthyProfile, list[dict[str, float]]]:
    """The profile and the episodes' statistics with the distances of ``SCATTER`` from the mean of their own group.

    Statistics of ``COMMON`` are replaced by the part common to the episodes; NaN for too few of them.
    """
    columns, result = dict(profile.statistics), [dict(row) for row in rows]
    for name, healthy in profile.statistics.items():
        kind, _, rest = name.partition("/")
        values = np.array([row.get(name, np.nan) for row in rows])
        if kind not in SCATTER or np.isfinite(values).sum() < 2:
            continue
        name = f"{SCATTER[kind]}/{rest}"
        columns[name] = _distance(healthy, kind)
        for row, value in zip(result, _distance(values, kind).tolist(), strict=True):
            row[name] = value
    for name in (name for name in profile.statistics if name.partition("/")[0] in COMMON):
        finite = np.array([row[name] for row in rows if np.isfinite(row.get(name, np.nan))])
        common = float(common_part(finite[:, None])[0]) if len(finite) >= MIN_COMMON else np.nan
        for row in result:
            row[name] = common
    return replace(profile, statistics=columns), result
