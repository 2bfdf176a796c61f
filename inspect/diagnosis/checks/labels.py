"""Lag and offset of the labels (true states) against what the modalities of a filter measure."""

from __future__ import annotations

import numpy as np

from beliefscope.datasets.task import Task
from beliefscope.inspect.statistics.measures import counted
from beliefscope.inspect.statistics.reference_images import HAND
from beliefscope.inspect.statistics.signals import MIN_STEPS, Array, Mask, fitted_lag, lag, largest_lag
from beliefscope.inspect.trace import Trace

SMALLEST_MOTION = 1e-2
"""m or rad: range of a component that moves."""

SMALLEST_SHARE = 0.1
"""As ``SMALLEST_MOTION``, of components on the map, relative to its half width, if that is smaller."""

BASELINE = 4
"""Steps over which changes are compared: longer ones have less noise, shorter ones a sharper correlation."""


def label_statistics(trace: Trace) -> dict[str, float]:
    """Lag and offset of the labels against each modality, and shared by all of them, over the counted steps.

    A delay of one sensor changes the lag of its own modality, one of the labels that of all modalities; likewise for
    offsets. Modalities are virtual sensors (Kalman filters) or single-modality updates.

    ``lag/labels MODALITY/all``: steps by which the labels follow the modality. ``lag/labels/all`` and
    ``offset/labels COMPONENT/all`` (median of label minus modality, m or rad): the smallest in size over the
    modalities, zero if the signs differ. NaN if no component moves.
    """
    measured = trace.observation_mean if trace.observation_mean is not None else trace.modality_mean
    labels, task = trace.episode.states.astype(np.float64), trace.task
    keep = counted(trace)
    if not trace.modalities or keep.sum() < MIN_STEPS or not np.isfinite(labels).all():
        return {}
    difference = task.difference(labels[:, None], measured)  # (T, K, n)
    offset = np.median(difference[keep], axis=0)  # (K, n)
    lags = np.array([_lag(task, labels, labels - difference[:, k], keep) for k in range(len(trace.modalities))])
    values = {f"lag/labels {name}/all": float(steps) for name, steps in zip(trace.modalities, lags, strict=True)}
    values["lag/labels/all"] = (
        float(common_part(lags[np.isfinite(lags), None])[0]) if np.isfinite(lags).any() else np.nan
    )
    for component, common in zip(task.components, common_part(offset), strict=True):
        values[f"offset/labels {component.name}/all"] = float(common)
    return values


def _lag(task: Task, labels: Array, measured: Array, keep: Mask) -> float:
    """Steps by which changes of the labels follow those of measured values (T, n), from the components that move.

    Without a measured hand, the labels themselves, which is more exact where a modality measures the state well.
    """
    if HAND not in task.observations:
        unwrapped, angles = labels.copy(), list(task.angles)
        unwrapped[:, angles] = np.unwrap(labels[:, angles], axis=0)
        return fitted_lag(unwrapped, unwrapped + measured - labels, keep, keep, largest_lag(task.dt))
    on_map = [component.name in task.map_components for component in task.components]
    smallest = np.where(on_map, min(SMALLEST_MOTION, SMALLEST_SHARE * task.map_half_width), SMALLEST_MOTION)
    moving = np.ptp(labels[keep], axis=0) > smallest
    if not moving.any():
        return np.nan
    scale = labels[keep][:, moving].std(0)
    changes = (task.difference(x[BASELINE:], x[:-BASELINE]) for x in (labels, measured))
    late, early = (change[:, moving] / scale for change in changes)
    return lag(late, early, keep[BASELINE:])[0]


def common_part(values: Array) -> Array:
    """(n,): what values (K, n) have in common, the smallest in size; zero where their signs differ."""
    smallest = np.abs(values).min(0)
    return np.where((values > 0).all(0), smallest, np.where((values < 0).all(0), -smallest, 0.0))
