"""Measures of a trace shared by all diagnostics: errors, NEES and its consistency bounds, and phases."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import is_image, lost_images
from beliefscope.datasets.task import Task, display_name, with_unit
from beliefscope.filters.covariance_floor import with_floor
from beliefscope.inspect.statistics.signals import wrapped as modulo_turn
from beliefscope.inspect.traces.data import Trace

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_STEPS = 10
"""Minimum number of steps of a phase for a verdict."""


def layers(trace: Trace) -> tuple[str, ...]:
    """Names of the L estimates: the K modalities, for their updates, then ``fused``."""
    return (*trace.modalities, "fused")


UPDATES_NOTE = "Updates start from the fused prior; the diagnostic Standalone modalities measures each by itself."
"""Part of every verdict that compares modalities by their updates from a common prior."""


def updates_note(trace: Trace) -> str:
    """``UPDATES_NOTE``; that of a bank without feedback, whose filters have their own priors, is empty."""
    prior = trace.predicted_mean
    is_common = prior is None or np.allclose(prior, prior[:, :1], equal_nan=True)
    return UPDATES_NOTE if is_common or trace.kind == "external" else ""


UNKNOWN_TRUTH = "the true state is unknown"
"""Reason why a diagnostic does not apply."""


def layer_label(layer: str) -> str:
    """Display name of an estimate: that of a modality is an update of the fused filter's prior, not standalone."""
    if layer in ("fused", "truth"):
        return layer
    name = display_name(layer)
    return f"{name} update" if "+" in layer else f"{name}-only update"


def wrapped(task: Task, difference: NDArray[Any]) -> Array:
    """Sums of differences of states (..., n), angles wrapped to -pi..pi; for states, see ``Task.difference``."""
    return wrap_angles(difference, task.angles)


def wrap_angles(difference: NDArray[Any], angles: Sequence[int]) -> Array:
    """Differences (..., n) with the components of these indices wrapped to -pi..pi."""
    difference = np.array(difference, dtype=np.float64)
    where = list(angles)
    difference[..., where] = modulo_turn(difference[..., where])
    return difference


def means(trace: Trace) -> Array:
    """(T, L, n) m, rad: each layer's estimate."""
    return np.concatenate([trace.modality_mean, trace.estimate_mean[:, None]], axis=1).astype(np.float64)


def deviations(covariance: NDArray[Any]) -> NDArray[Any]:
    """(..., n, n) -> (..., n): standard deviations."""
    return np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0))


def root(squared: Array) -> Array:
    """Square roots; NaN for negative values, of covariances that are not positive definite."""
    return np.sqrt(np.where(squared >= 0.0, squared, np.nan))


def covariances(trace: Trace) -> Array:
    """(T, L, n, n): each layer's covariance, invertible (``with_floor``); NaN where it is unknown.

    Zeros are unknown, except those of particles, which may collapse.
    """
    both = reported_covariances(trace)
    if trace.particles is None:
        both = np.where((both == 0.0).all((-2, -1), keepdims=True), np.nan, both)
    return with_floor(both)


def reported_covariances(trace: Trace) -> NDArray[Any]:
    """(T, L, n, n): each layer's covariance as the filter reports it."""
    return np.concatenate([trace.modality_covariance, trace.estimate_covariance[:, None]], axis=1)


def no_covariance(trace: Trace) -> str | None:
    """Reason why the filter's covariances have no NEES at any step, or None."""
    if not trace.has_covariance:
        return "has no covariance"
    return "reports a variance of zero at every step" if _has_zero(trace)[:, -1].all() else None


def _has_zero(trace: Trace) -> Mask:
    """(T, L): whether a known component has a variance of zero, which is unknown except that of particles."""
    reported = of_components(reported_covariances(trace), known_components(trace))
    return np.asarray((np.diagonal(reported, axis1=-2, axis2=-1) == 0.0).any(-1) & (trace.particles is None))


def errors(trace: Trace) -> Array:
    """(T, L, n) m, rad: ``Task.difference`` of estimate and true state."""
    return trace.task.difference(means(trace), trace.episode.states[:, None])


def starts_at_truth(trace: Trace) -> bool:
    """Whether the mean of the first belief is the true state of step 0, to float32 precision."""
    difference = np.abs(trace.task.difference(trace.start_mean, trace.episode.states[0]))
    size = np.abs(trace.episode.states).max(axis=0, initial=0.0) + np.abs(trace.start_mean)
    return bool((difference <= 1e-5 * size).all())


def main_error(trace: Trace) -> Array:
    """(T, L) SI: the error that runs are summarised by (``Task.main_error``), such as the distance of the position."""
    return np.asarray(trace.task.main_error.norm(errors(trace)), dtype=np.float64)


def with_main(task: Task, error: NDArray[Any]) -> Array:
    """(..., 1 + n): length of the main error, followed by the errors (..., n) of the components."""
    return np.concatenate([task.main_error.norm(error)[..., None], error], axis=-1)


def quantities(task: Task) -> list[tuple[int, str, float]]:
    """Column of ``with_main``, title with unit, and factor for display, of the main error and the other errors."""
    main = task.main_error
    others = [(1 + i, c) for i, c in enumerate(task.components) if (i,) != main.indices]
    return [
        (0, main.label, main.factor),
        *((k, with_unit(c.label, c.conversion[0]), c.conversion[1]) for k, c in others),
    ]


def known_components(trace: Trace) -> list[int]:
    """Indices of the components whose true value is known at any step."""
    return np.flatnonzero(np.isfinite(trace.episode.states).any(0)).tolist()


def of_components(covariance: NDArray[Any], components: Sequence[int]) -> NDArray[Any]:
    """The covariance (..., k, k) of some components."""
    if len(components) == covariance.shape[-1]:
        return covariance
    return covariance[..., components, :][..., components]


def nees(trace: Trace) -> Array:
    """(T, L): ``e^T S^-1 e / n`` of the n known components; mean 1 if consistent, above 1 if overconfident.

    NaN without a covariance or a true state, or with a variance of zero.
    """
    error, known = errors(trace), known_components(trace)
    if not trace.has_covariance or not known:
        return np.full(error.shape[:2], np.nan)
    error = error[..., known]
    white = np.linalg.solve(of_components(covariances(trace), known), error[..., None])[..., 0]
    return np.where(_has_zero(trace), np.nan, np.einsum("tln,tln->tl", error, white) / len(known))


def nll(trace: Trace) -> Array:
    """(T, L) nats: ``-ln N(x; m, S)`` of the known components x, in m and rad; NaN without a covariance."""
    ratio, known = nees(trace), known_components(trace)
    if not trace.has_covariance:
        return ratio
    n = len(known)
    with np.errstate(invalid="ignore"):  # covariances of updates that are not reported are NaN
        volume = np.linalg.slogdet(of_components(covariances(trace), known)).logabsdet
    return np.asarray(0.5 * (n * ratio + volume + n * math.log(2.0 * math.pi)))


def known_mean(values: Array) -> float:
    """Mean of the finite values; NaN without any."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else math.nan


def contours(covariance: NDArray[Any]) -> tuple[Array, Array]:
    """1 sigma ellipses of covariances (..., 2, 2): half axes (..., 2), shorter first, and orientation (...) in rad."""
    values, vectors = np.linalg.eigh(covariance.astype(np.float64))
    # An eigenvalue of a degenerate covariance may be slightly negative due to rounding.
    return np.sqrt(np.maximum(values, 0.0)), np.arctan2(vectors[..., 1, 0], vectors[..., 0, 0])


def particle_log_weights(trace: Trace) -> Array:
    """(T, L, M): normalised particle weights of each unimodal update (prior x likelihood) and of the posterior."""
    assert trace.prior_log_weights is not None
    assert trace.log_likelihood is not None
    assert trace.log_weights is not None
    unimodal = trace.prior_log_weights[:, None].astype(np.float64) + trace.log_likelihood
    unimodal -= np.logaddexp.reduce(unimodal, axis=-1, keepdims=True)
    return np.concatenate([unimodal, trace.log_weights[:, None]], axis=1)


def blackout(trace: Trace) -> Mask:
    """(T,): whether an image is blacked out: all its pixels are equal."""
    black = np.zeros(len(trace), dtype=bool)
    for readings in trace.episode.observations.values():
        if is_image(readings):
            black |= lost_images(readings)
    return black


def faulty(trace: Trace) -> Mask:
    """(T,): steps within the span of an injected fault."""
    at = np.arange(len(trace))
    mask = np.zeros(len(trace), bool)
    for fault in trace.faults:
        mask |= (at >= fault.from_) & (at < (len(trace) if fault.to is None else fault.to))
    return mask


def counted(trace: Trace) -> Mask:
    """(T,): steps used by metrics: all but those of the task's warm-up and gaps in the true states.

    Components that no step knows are no gaps.
    """
    known = np.isfinite(trace.episode.states)
    after_warmup = np.arange(len(trace)) >= trace.task.first_counted(len(trace))
    return np.asarray(after_warmup & known[:, known.any(0)].all(1))


def absent(trace: Trace, modality: str) -> Mask:
    """(T,): steps without a reading of any sensor of a modality, or of ``image+haptics``; none without sensors."""
    keys = [key for part in modality.split("+") for key in trace.task.modalities.get(part, ())]
    present = [trace.episode.present(key) for key in keys]
    return ~np.logical_or.reduce(present) if present else np.zeros(len(trace), dtype=bool)


def absent_modalities(trace: Trace) -> Mask:
    """(T, K): ``absent`` for each modality of the trace."""
    steps = [absent(trace, modality) for modality in trace.modalities]
    return np.stack(steps, axis=-1) if steps else np.zeros((len(trace), 0), dtype=bool)


def phases(trace: Trace) -> dict[str, Mask]:
    """Phase -> mask (T,) without warm-up steps: ``all``, groups of the task's covariates, and ``blackout``.

    The default covariate has the groups ``contact`` and ``free motion``.
    """
    keep = counted(trace)
    groups = {
        group: keep & mask
        for name, covariate in trace.task.covariates.items()
        for group, mask in covariate.masks(name, trace.episode.group_values(name))
    }
    return {"all": keep, **groups, "blackout": keep & blackout(trace)}


def shaded_groups(trace: Trace) -> dict[str, Mask]:
    """Group -> mask (T,) of each group of the task's covariates, without those of false values.

    Of the mask of a sensor (``Task.masks``), its outages.
    """
    groups: dict[str, Mask] = {}
    for name, covariate in trace.task.covariates.items():
        masks = list(covariate.masks(name, trace.episode.group_values(name)))
        groups |= dict(masks[1:] if name in trace.task.masks.values() else masks[: covariate.shaded])
    return groups


GROUPS = {"all": (0, 1, 2, 3), "contact": (2, 3), "free motion": (0, 1), "blackout": (1, 3)}
"""Phase -> its disjoint groups of steps: free motion and contact, each without and with image blackout."""


def group_index(trace: Trace) -> NDArray[np.int64]:
    """(T,): group of each step, see ``GROUPS``."""
    return 2 * trace.episode.contact.astype(np.int64) + blackout(trace)


def group_masks(trace: Trace) -> Mask:
    """(4, T): counted steps of each group."""
    return (group_index(trace) == np.arange(4)[:, None]) & counted(trace)


def _informative_phases(traces: Sequence[Trace]) -> list[dict[str, Mask]]:
    """``phases`` of each trace, without the groups of sensors that have no outage in any of them."""
    result, task = [phases(trace) for trace in traces], traces[0].task
    for name in task.masks.values():
        outage, reading = task.covariates[name].group_names(name)
        if not any(masks[outage].any() for masks in result):
            for masks in result:
                del masks[outage], masks[reading]
    return result


def long_phases(trace: Trace) -> dict[str, Mask]:
    """``phases`` of at least ``MIN_STEPS`` steps, with names for statistics ``KIND/SUBJECT/PHASE``.

    These contain no slash: a group ``speed below 0.5 m/s`` has a division slash instead.
    """
    return {
        phase.replace("/", "\N{DIVISION SLASH}"): mask
        for phase, mask in _informative_phases([trace])[0].items()
        if mask.sum() >= MIN_STEPS
    }


def pooled_phases(traces: Sequence[Trace]) -> dict[str, Mask]:
    """``phases`` of concatenated traces: phase -> mask (sum of T,)."""
    masks = _informative_phases(traces)
    return {phase: np.concatenate([mask[phase] for mask in masks]) for phase in masks[0]}


def phase_sums(traces: Sequence[Trace], values: Sequence[Array]) -> dict[str, tuple[Array, Array]]:
    """Sums of values (T, ...) over the steps of a phase.

    Returns: phase -> numbers of steps (M,) and sums (M, ...) of the M trajectories that have steps in it. Phases in no
    trajectory are absent.
    """
    masks = _informative_phases(traces)
    result = {}
    for phase in masks[0]:
        steps = np.array([mask[phase].sum() for mask in masks], dtype=np.float64)
        sums = np.stack([value[mask[phase]].sum(0) for value, mask in zip(values, masks, strict=True)])
        if steps.any():
            result[phase] = (steps[steps > 0], sums[steps > 0])
    return result


def trace_indices(traces: Sequence[Trace]) -> NDArray[np.int64]:
    """(sum of T,): index of the trace that each step of the concatenated traces belongs to."""
    return np.repeat(np.arange(len(traces)), [len(trace) for trace in traces])


def intervals(mask: Mask) -> NDArray[np.int64]:
    """(R, 2): first step of each interval of True in a mask (T,), and the first step after it."""
    edges = np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8))
    return np.flatnonzero(edges).reshape(-1, 2)


def display_units(task: Task) -> tuple[tuple[str, ...], Array]:
    """Display units (``cm``, ``deg``) of the n components, and the conversion factors (n,) from SI."""
    pairs = [component.conversion for component in task.components]
    return tuple(unit for unit, _ in pairs), np.array([factor for _, factor in pairs])


def by_component(task: Task, quantities: Mapping[str, Array]) -> dict[str, float]:
    """Component with unit, and quantity -> value in the unit, from quantity -> values (n,) in SI units."""
    return {
        f"{with_unit(c.label, c.conversion[0])}: {name}": c.conversion[1] * values[i]
        for i, c in enumerate(task.components)
        for name, values in quantities.items()
    }


def error_names(task: Task) -> list[str]:
    """Names of the main error and of the components that are not part of it."""
    return [task.main_error.name, *(task.components[i].label for i in _others(task))]


def squared_errors(trace: Trace, estimates: NDArray[Any] | None = None) -> Array:
    """(..., Q) SI: sums over the counted steps of the squared errors of ``error_names``.

    estimates: (T, ..., n) other estimates than those of the trace.
    """
    if estimates is None:
        error = errors(trace)[:, -1]
    else:
        shape = (len(trace), *(1,) * (estimates.ndim - 2), estimates.shape[-1])
        error = wrapped(trace.task, estimates - trace.episode.states.reshape(shape))
    columns = [0, *(1 + i for i in _others(trace.task))]
    return np.asarray(np.square(with_main(trace.task, error[counted(trace)])[..., columns]).sum(0))


def _others(task: Task) -> list[int]:
    """Indices of the components that are not part of the main error."""
    return [i for i in range(len(task.components)) if i not in task.main_error.indices]


def removed_share(sums: Array) -> Array:
    """Share of the root of the first of two sums (..., 2) that is missing in that of the second."""
    return np.asarray(1.0 - np.sqrt(sums[..., 1] / np.maximum(sums[..., 0], 1e-12)))
