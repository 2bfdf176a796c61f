"""Statistics of the innovations that an external filter reports in the spaces of its measurements."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from beliefscope.inspect.diagnosis.checks.vectors import angle_channels
from beliefscope.inspect.statistics.innovations import (
    are_extreme,
    channel_names,
    innovations,
    prediction,
    squared_innovations,
)
from beliefscope.inspect.statistics.measures import Array, Mask, absent, counted, deviations
from beliefscope.inspect.statistics.signals import NEAR_TURN, TURN
from beliefscope.inspect.trace import Trace

MIN_STEPS = 10
"""Minimum number of steps of a statistic."""

REJECTABLE = 0.05
"""Largest probability of innovations, in a consistent filter, that a correct gate rejects."""

SAME = 1e-5
"""Largest change of a belief by no update, relative to its size: beliefs have single precision."""

LARGEST_LOGARITHM = 30.0
"""Largest absolute logarithm of a standard deviation; larger ones are those of a covariance without full rank."""


def innovation_statistics(trace: Trace) -> dict[str, float]:
    """``KIND/MODALITY/all`` -> value, of innovations nu with covariance S.

    ``innovation bias``, by channel: mean of nu, in standard deviations. ``innovation std``: geometric mean of the
    standard deviations S. ``innovation turns``: share of steps with a nu close to a full turn in a channel
    of angles. ``updates``: share of steps with an accepted innovation that changes the belief, or with one that a
    correct gate may reject (``REJECTABLE``), such as that of a filter that has lost the state. ``absent updates``:
    share of the steps without a reading of the modality that have an accepted one. ``measurement noise``: geometric
    mean of the standard deviations R (``measurement_noise``). ``innovation share``: innovation std relative to that of
    all modalities, which shows whose measurement noise is wrong where only the mean of all is known.

    Modalities of the task that are not among those of the filter have no updates.
    """
    if trace.innovation is None or (pair := innovations(trace)) is None:
        return {}
    keep = counted(trace)
    nu, variance = pair[0][keep], np.diagonal(pair[1][keep], axis1=-2, axis2=-1)
    used = np.isfinite(nu) & (variance > 0.0)
    deviation = np.sqrt(np.where(used, variance, np.nan))
    accepted = used_channels(trace, np.isfinite(nu), keep)
    squared = None if trace.accepted is None else squared_innovations(trace)
    rejectable = np.zeros(used.shape[:2], bool) if squared is None else are_extreme(*squared, REJECTABLE)[keep]
    own, all_names = set(trace.modalities), set(trace.task.modalities)
    values = {f"updates/{name}/all": 0.0 for name in sorted(all_names - own) if own < all_names}
    names = channel_names(trace, pair[0])
    for k, modality in enumerate(trace.modalities):
        updated = np.asarray(accepted[:, k].any(-1))
        values[f"updates/{modality}/all"] = float((updated | rejectable[:, k]).mean())
        if (without := absent(trace, modality)[keep]).any():
            values[f"absent updates/{modality}/all"] = float(updated[without].mean())
        channels = np.flatnonzero(used[:, k].sum(0) >= MIN_STEPS)
        if not len(channels):
            continue
        for i in channels:
            at = used[:, k, i]
            values[f"innovation bias/{modality} {names[k][i]}/all"] = float((nu[at, k, i] / deviation[at, k, i]).mean())
        values[f"innovation std/{modality}/all"] = float(np.exp(np.nanmean(np.log(deviation[:, k, channels]))))
        angles = [i for i in angle_columns(trace, modality) if i in channels]
        turns = np.any(np.abs(np.abs(nu[:, k, angles]) - TURN) < NEAR_TURN, axis=-1)
        values[f"innovation turns/{modality}/all"] = float(turns[used[:, k].any(-1)].mean())
    noise = measurement_noise(trace, *pair)
    if "measurement noise//all" in noise:
        sizes = {m: values[name] for m in trace.modalities if (name := f"innovation std/{m}/all") in values}
        mean = math.exp(np.mean(np.log([*sizes.values()])))
        values |= {f"innovation share/{m}/all": size / mean for m, size in sizes.items()}
    return values | noise


def angle_columns(trace: Trace, modality: str) -> list[int]:
    """Channels of a modality, that of all its sensors, which are angles and wrap around in the episode."""
    angles, count = [], 0
    for key in trace.task.modalities.get(modality, ()):
        angles += [count + i for i in angle_channels(trace.episode, key)]
        count += math.prod(trace.episode.observations[key].shape[1:])
    return angles


def measurement_noise(trace: Trace, nu: Array, s: Array) -> dict[str, float]:
    """``measurement noise/MODALITY/all``: geometric mean of the standard deviations R of each modality's channels.

    An update has ``det P / det P+ = det S / det R``, whatever the measurement function, and several updates in turn
    have the product of these ratios: the logarithms of the steps are linear equations for those of the modalities. For
    modalities that are always used together, they only give the mean of all, ``measurement noise//all``, at the steps
    at which all are used: it would change with the share of rejected measurements. Known ones do not replace it, since
    a measurement that only a faulty filter rejects is known there, and not in its record. Several updates at once lack
    the covariances between the measurements in ``det S``: where the filter also reports the single-modality updates
    from the common prediction, each has an equation of its own.

    Only of filters that report their prediction and whose beliefs have a covariance of full rank.

    Args:
        nu: (T, K, m) innovations. s: (T, K, m, m) their covariance.
    """
    predicted = prediction(trace)
    if predicted is None or predicted.covariance is None or not trace.has_covariance:
        return {}
    used = used_channels(trace, np.isfinite(nu))
    s = np.where(used[..., :, None] & used[..., None, :], s, np.eye(nu.shape[-1]))
    before, after = predicted.covariance, trace.estimate_covariance.astype(np.float64)
    (sign_s, of_s), (sign, of_before), (sign_after, of_after) = map(np.linalg.slogdet, (s, before, after))
    channels = used.sum(-1)  # (T, K)
    if (own := _updates_of_one_prediction(trace)) is not None:
        sign_own, of_own = np.linalg.slogdet(own)
        each = 0.5 * (of_s - of_before[:, None] + of_own) / np.maximum(channels, 1)
        valid = (counted(trace) & (sign > 0))[:, None] & (sign_s > 0) & (sign_own > 0) & (channels > 0)
        known = {m: each[at, k] for k, (m, at) in enumerate(zip(trace.modalities, valid.T, strict=True))}
        return _deviations({m: float(v.mean()) for m, v in known.items() if len(v) >= MIN_STEPS})
    keep = counted(trace) & (sign_s > 0).all(-1) & (sign > 0) & (sign_after > 0) & (channels.sum(-1) > 0)
    with np.errstate(invalid="ignore"):  # a belief may have no volume
        total = 0.5 * (of_s.sum(-1) - of_before + of_after)  # sum of the channels' log standard deviations
    if keep.sum() < MIN_STEPS:
        return {}
    values = _by_modality(trace.modalities, channels[keep].astype(np.float64), total[keep])
    complete = keep & (channels == np.isfinite(nu).sum(-1).max(0)).all(-1) & (channels > 0).all(-1)
    if complete.sum() >= MIN_STEPS:
        values[""] = float(np.mean(total[complete] / channels.sum(-1)[complete]))
    return _deviations(values)


def _updates_of_one_prediction(trace: Trace) -> Array | None:
    """(T, K, n, n) covariances of the single-modality updates of one prediction; None for updates in turn."""
    before, after = trace.predicted_covariance, trace.modality_covariance
    if before is None or len(trace.modalities_with_posterior) < 2:
        return None
    if not np.allclose(before, before[:, :1], rtol=1e-4):
        return None
    return after.astype(np.float64)


def _deviations(logarithms: Mapping[str, float]) -> dict[str, float]:
    """``measurement noise/MODALITY/all`` from the mean logarithms of the standard deviations."""
    return {f"measurement noise/{m}/all": math.exp(v) for m, v in logarithms.items() if abs(v) < LARGEST_LOGARITHM}


def used_channels(trace: Trace, known: Mask, keep: Mask | slice = slice(None)) -> Mask:
    """The known channels (T, K, m) without those of measurements that are rejected or do not change the belief."""
    used = known if trace.accepted is None else known & (trace.accepted[keep] != 0.0)[..., None]
    return used & ~_without_effect(trace)[keep, :, None]


def _without_effect(trace: Trace) -> Mask:
    """(T, K) whether the belief after the update with a modality is that before it; False where it is unknown.

    Of updates in turn, those in the order of the modalities have their own effects; of others, it is that of all.
    """
    means, covariances = trace.predicted_mean, trace.predicted_covariance
    if means is None or covariances is None or not trace.has_covariance:
        return np.zeros((len(trace), 1), dtype=bool)
    after, after_covariance = trace.estimate_mean[:, None], trace.estimate_covariance[:, None]
    if not np.allclose(covariances, covariances[:, :1], rtol=1e-4, equal_nan=True):
        after = np.concatenate([means[:, 1:], after], axis=1)
        after_covariance = np.concatenate([covariances[:, 1:], after_covariance], axis=1)
    moved = np.abs(trace.task.difference(after.astype(np.float64), means))
    is_there = (moved <= SAME * deviations(covariances)).all(-1)
    largest = np.abs(covariances).max((-2, -1), keepdims=True)
    return np.asarray(is_there & (np.abs(after_covariance - covariances) <= SAME * largest).all((-2, -1)))


def _by_modality(modalities: tuple[str, ...], channels: Array, total: Array) -> dict[str, float]:
    """Modality -> mean logarithm of its standard deviations, if the equations determine it."""
    gram = channels.T @ channels
    eigenvalues, vectors = np.linalg.eigh(gram)
    free = vectors[:, eigenvalues < 1e-6 * max(float(eigenvalues[-1]), 1e-12)]
    solution = np.linalg.lstsq(channels, total, rcond=1e-6)[0]
    determined = np.abs(free).max(1, initial=0.0) < 1e-3
    measured = channels.sum(0) > 0
    return {m: float(v) for m, v, yes in zip(modalities, solution, determined & measured, strict=True) if yes}
