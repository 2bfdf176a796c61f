"""What diagnostics measure a trace by: errors, NEES, and the kinds of steps it has. Shared by all of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.task import Task
from beliefscope.filters.evaluate import LEFT_OUT, UNITS
from beliefscope.inspect.trace import Trace

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FLOOR = 1e-8
"""m^2 or rad^2 on the diagonal of a covariance before it is inverted: a particle set may have collapsed."""


def task_of(trace: Trace) -> Task:
    """The task of a trace's episode."""
    return find_task(trace.episode.task)


def layers(trace: Trace) -> tuple[str, ...]:
    """Whose estimates there are: the K modalities, then ``fused``. L of them."""
    return (*trace.modalities, "fused")


def wrapped(task: Task, difference: NDArray[Any]) -> Array:
    """Differences of states (..., n), angles brought to -pi..pi."""
    difference = np.array(difference, dtype=np.float64)
    for i, component in enumerate(task.components):
        if component.unit == "rad":
            difference[..., i] = (difference[..., i] + np.pi) % (2.0 * np.pi) - np.pi
    return difference


def means(trace: Trace) -> Array:
    """(T, L, n) m, rad: each layer's estimate."""
    return np.concatenate([trace.modality_mean, trace.estimate_mean[:, None]], axis=1).astype(np.float64)


def covariances(trace: Trace) -> Array:
    """(T, L, n, n): each layer's covariance with ``FLOOR`` on its diagonal; NaN where a filter has none."""
    both = np.concatenate([trace.modality_covariance, trace.estimate_covariance[:, None]], axis=1)
    return both.astype(np.float64) + FLOOR * np.eye(both.shape[-1])


def errors(trace: Trace) -> Array:
    """(T, L, n) m, rad: estimate minus truth, angles wrapped."""
    return wrapped(task_of(trace), means(trace) - trace.episode.states[:, None])


def position_error(trace: Trace) -> Array:
    """(T, L) m: distance from the truth on the map."""
    where = list(task_of(trace).map_indices)
    return np.linalg.norm(errors(trace)[..., where], axis=-1)


def nees(trace: Trace) -> Array:
    """(T, L): ``e^T S^-1 e / n``: mean 1 where consistent, more where over-confident. NaN without a covariance."""
    error = errors(trace)
    if not trace.has_covariance:
        return np.full(error.shape[:2], np.nan)
    white = np.linalg.solve(covariances(trace), error[..., None])[..., 0]
    return np.einsum("tln,tln->tl", error, white) / error.shape[-1]


def contours(covariance: NDArray[Any]) -> tuple[Array, Array]:
    """Ellipses at 1 sigma of covariances (..., 2, 2): half axes (..., 2), the shorter first, and its turn (...) rad."""
    values, vectors = np.linalg.eigh(covariance.astype(np.float64))
    # Rounding may leave a flat covariance with an eigenvalue just below zero.
    return np.sqrt(np.maximum(values, 0.0)), np.arctan2(vectors[..., 1, 0], vectors[..., 0, 0])


def particle_log_weights(trace: Trace) -> Array:
    """(T, L, M): predicted particles as each layer weighs them, normalised: prior x its likelihood, the posterior."""
    assert trace.prior_log_weights is not None
    assert trace.log_likelihood is not None
    assert trace.log_weights is not None
    alone = trace.prior_log_weights[:, None].astype(np.float64) + trace.log_likelihood
    alone -= np.logaddexp.reduce(alone, axis=-1, keepdims=True)
    return np.concatenate([alone, trace.log_weights[:, None]], axis=1)


def blackout(trace: Trace) -> Mask:
    """(T,): whether a picture is black, every pixel zero."""
    black = np.zeros(len(trace), dtype=bool)
    for array in trace.episode.observations.values():
        if array.ndim == 3 and array.dtype == np.uint8:
            black |= ~array.any(axis=(1, 2))
    return black


def counted(trace: Trace) -> Mask:
    """(T,): the steps that metrics count: not the first ``LEFT_OUT``, where the start at the truth still helps."""
    return np.arange(len(trace)) >= min(LEFT_OUT, len(trace) - 1)


def splits(trace: Trace) -> dict[str, Mask]:
    """Kind of step -> its mask (T,), first steps left out: ``all``, ``contact``, ``no contact``, ``blackout``."""
    contact, keep = trace.episode.contact.astype(bool), counted(trace)
    return {"all": keep, "contact": keep & contact, "no contact": keep & ~contact, "blackout": keep & blackout(trace)}


def pooled_splits(traces: Sequence[Trace]) -> dict[str, Mask]:
    """``splits`` of all traces, end to end: kind of step -> mask (sum of T,)."""
    masks = [splits(trace) for trace in traces]
    return {split: np.concatenate([mask[split] for mask in masks]) for split in masks[0]}


def owners(traces: Sequence[Trace]) -> NDArray[np.int64]:
    """(sum of T,): which of the traces each step is of, where all are laid end to end."""
    return np.repeat(np.arange(len(traces)), [len(trace) for trace in traces])


def stretches(mask: Mask) -> NDArray[np.int64]:
    """(R, 2): first step of each stretch of True in a mask (T,), and the first step after it."""
    edges = np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8))
    return np.flatnonzero(edges).reshape(-1, 2)


def shown_units(task: Task) -> tuple[tuple[str, ...], Array]:
    """Units as shown (``cm``, ``deg``) of the n components, and the factors (n,) to them."""
    pairs = [UNITS[component.unit] for component in task.components]
    return tuple(unit for unit, _ in pairs), np.array([factor for _, factor in pairs])
