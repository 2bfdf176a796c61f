"""Channels of a user's sensors and controls against the values that the labels lead to expect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Task, axis_name
from beliefscope.inspect.diagnosis.checks.reading_noise import delayed, noise_around_expected
from beliefscope.inspect.diagnosis.checks.vectors import FORCE, TORQUE, commands_hand
from beliefscope.inspect.diagnostics.statistic_kinds import AROUND_EXPECTED, EXPECTED
from beliefscope.inspect.statistics.array_channels import array_keys
from beliefscope.inspect.statistics.reading_features import CONTROL, FIRST_CHANGES
from beliefscope.inspect.statistics.reading_model import (
    ComparedReadings,
    ReadingModel,
    readings_of,
)
from beliefscope.inspect.statistics.reference_images import CONTACT, HAND
from beliefscope.inspect.statistics.signals import (
    MIN_STEPS,
    Array,
    deviating_interval,
    drifting_lag,
    fitted_lag,
    largest_lag,
    nearer_slope,
)

MAX_CHANNELS = 24
"""Largest number of channels of a sensor whose channels are compared with each other."""

SIMPLER = 2.0
"""Largest error with another sign and order, relative to that with a delay or biases, at which the former is preferred.
"""

SURELY = 4.0
"""Smallest number of standard errors of a slope."""

LEAST_GAIN = 0.1
"""Smallest gain by which the noise is divided."""

BLOCKS = 10
"""Number of parts of an episode that are taken as independent of each other."""

EDGES = 151
"""Number of steps, evenly spaced, at which a bias may begin or end."""

AS_GOOD = 0.9
"""Ratio of the squares that a drift leaves to those of a gain from which the latter is as good."""

ALIKE = (0.1, 1.5)
"""Likelihood ratios of a ramp to an interval between which either may be the case."""

ONSETS = 20
"""Number of times, evenly spaced, at which a drift may begin."""

CLEARLY = 0.5
"""Largest ratio of the squares that a bias in an interval leaves to those of a drift or a gain."""

EXPLAINED = {"level": "reading bias", "drift": "reading bias", "size": "reading gain", "roughness": "reading bias"}
"""Kinds of statistics that another healthy motion changes: the level of readings, and their standard deviation; and the
kinds that take their place. It also changes the noise of all readings, but not that around the expected ones."""

UNCERTAIN = 1.0
"""Largest standard error of a short delay, steps; it is larger where the expected readings hardly vary."""

FITS = 9.0
"""Largest mean square error of readings that fit, relative to the square of the noise."""


def modelled_sensors(task: Task) -> list[str]:
    """Observation keys of the vector sensors of unknown physics, except lidars, and of arrays and point clouds.

    A measured hand shows the physics of force and torque.
    """
    known = {CONTACT, *task.scans, *((HAND, FORCE, TORQUE) if HAND in task.observations else ())}
    sizes = {key: shape[0] for key, shape in task.observations.items() if len(shape) == 1 and key not in known}
    return [*(key for key, size in sizes.items() if size <= MAX_CHANNELS), *array_keys(task), *task.clouds]


def modelled_keys(task: Task) -> list[str]:
    """Keys of the reading models of a task: sensors, and controls that do not command a measured hand."""
    has_controls = 0 < task.control_size <= MAX_CHANNELS and not commands_hand(task)
    return [*modelled_sensors(task), *([CONTROL] if has_controls else [])]


def reading_statistics(episode: Episode, models: Sequence[ReadingModel]) -> dict[str, float]:
    """Of each channel that the labels explain, against its expected readings.

    ``reading lag``: steps by which new readings of a sensor follow the expected ones; of a short delay, also fractions.
    The others are those at this lag. ``reading bias``: mean error relative to the noise. ``reading drift``: change of
    the error over the episode, likewise. ``reading gain``: slope of the readings on the expected ones. ``reading
    noise``: standard deviation from this line, relative to the noise. ``reading ratio``: gain without a bias, if it
    explains the errors as well as a bias, and else nearly 1; not of angles. ``reading outliers``: share of isolated
    readings, which the others leave out; of sensors with such readings in the record.
    ``inverted``: half the log-ratio of the mean square error to that with the opposite sign, 0 unless the readings then
    fit (``FITS``), hardly worse than with biases (``SIMPLER``). ``exchanged``: likewise, of the errors of two channels
    to those with these channels exchanged, whatever their signs, for the best other channel; or of one channel to those
    of a channel without a model.

    Of channels of sensors that the labels explain in part only, bias and drift.
    """
    values: dict[str, float] = {}
    for model in (model.of_weak() for model in models if model.key != CONTROL):
        if not is_expected(model, episode):
            continue
        compared, count = model.compare(episode), readings_of(episode, model.key).shape[1]
        line = _line(*compared.pairs(), compared.steps() / len(episode), model.gain_spreads)
        for i, channel in enumerate(model.channels):
            axis = axis_name(model.key, channel, count)
            for kind in ("bias", "drift"):
                values[f"reading {kind}/{axis}/all"] = float(line[kind][i] / model.noise[i])
    for model in (model for model in models if is_expected(model, episode)):
        compared = model.compare(episode)
        delay, errors = delayed_errors(compared, episode.dt)
        is_short = delay == 0.0 and _is_own_arrangement(errors)
        values[f"reading lag/{model.key}/all"] = _short_delay(compared) if is_short else delay
        if model.outliers:
            read = compared.present | compared.outliers
            values[f"reading outliers/{model.key}/all"] = float(compared.outliers.sum() / max(read.sum(), 1))
        whole = 0 if np.isnan(delay) else int(delay)
        line = _line(*_pairs(compared, whole), compared.steps(whole) / len(episode), model.gain_spreads)
        least, biased = errors.min(0), compared.errors_with_biases(whole)
        own = np.diagonal(least)
        exchanged = _evidence(own[:, None] + own, least + least.T, 2.0 * FITS, biased[:, None] + biased)
        inverted = _evidence(np.diagonal(errors[0]), np.diagonal(errors[1]), FITS, biased)
        all_readings = readings_of(episode, model.key)
        others = np.delete(all_readings, model.channels, axis=1)
        replaced = _evidence(own, compared.errors(whole, others).min((0, 1), initial=np.inf), FITS, biased)
        count = all_readings.shape[1]
        values |= noise_around_expected(compared, whole, count) if model.key != CONTROL else {}
        for i, channel in enumerate(model.channels):
            axis = axis_name(model.key, channel, count)
            values[f"reading bias/{axis}/all"] = float(line["bias"][i] / model.noise[i])
            values[f"reading drift/{axis}/all"] = float(line["drift"][i] / model.noise[i])
            values[f"reading gain/{axis}/all"] = float(line["gain"][i])
            values[f"reading noise/{axis}/all"] = float(line["noise"][i] / model.noise[i])
            if not model.is_angle[i]:
                values[f"reading ratio/{axis}/all"] = float(line["ratio"][i])
            values[f"inverted/{axis}/all"] = float(inverted[i])
            if count > 1:
                pairs = np.delete(exchanged[i], i)
                values[f"exchanged/{axis}/all"] = float(max(replaced[i], pairs.max(initial=0.0)))
    return values


def is_expected(model: ReadingModel, episode: Episode) -> bool:
    """Whether the labels explain channels of the model's sensor, and an episode has both."""
    has_sensor = model.key in (*episode.observations, CONTROL)
    return has_sensor and len(model.channels) > 0 and bool(np.isfinite(episode.states).all())


def without_outliers(episode: Episode, models: Sequence[ReadingModel]) -> Episode:
    """The episode with interpolated readings instead of isolated ones, of sensors with such ones in the record."""
    changed = {}
    for model in (m for m in models if m.outliers and is_expected(m, episode) and m.key != CONTROL):
        outliers = model.compare(episode).outliers
        others, steps = np.flatnonzero(episode.present(model.key) & ~outliers), np.flatnonzero(outliers)
        if len(others) and len(steps):
            readings = episode.observations[model.key].astype(np.float64)
            readings[steps] = np.stack([np.interp(steps, others, x[others]) for x in readings.T], axis=1)
            changed[model.key] = readings
    return replace(episode, observations={**episode.observations, **changed}) if changed else episode


def with_errors(episode: Episode, models: Sequence[ReadingModel]) -> Episode:
    """The episode with errors in place of the readings that models expect, interpolated at other steps."""
    changed = {}
    for model in (m for m in models if is_expected(m, episode) and m.key != CONTROL):
        compared = model.compare(episode)
        delay, _ = delayed_errors(compared, episode.dt)
        errors, known = delayed(compared, 0 if np.isnan(delay) else int(delay))
        if known.any():
            readings, steps = episode.observations[model.key].astype(np.float64), np.flatnonzero(known)
            filled = [np.interp(np.arange(len(episode)), steps, error[steps]) for error in errors.T]
            readings[:, model.channels] = np.stack(filled, axis=1)
            changed[model.key] = readings
    return replace(episode, observations={**episode.observations, **changed}) if changed else episode


def without_explained(row: Mapping[str, float]) -> dict[str, float]:
    """Statistics without those of channels that the labels explain (``EXPLAINED``): their errors count instead."""
    return {name: value for name, value in row.items() if not _is_explained(name, row)}


def _is_explained(statistic: str, row: Mapping[str, float]) -> bool:
    kind, subject, phase = statistic.split("/")
    if kind == "noise":
        return phase not in AROUND_EXPECTED and f"noise/{subject}/{EXPECTED}" in row
    return kind in EXPLAINED and f"{EXPLAINED[kind]}/{subject}/all" in row


def biased_interval(subject: str, episode: Episode, models: Sequence[ReadingModel]) -> tuple[int, int] | None:
    """First and last step of the interval in which a channel has most of its error against the expected readings.

    None if the other steps have it as well, if the interval is short, or if no model expects readings of the channel.
    """
    for model in (model.with_weak_channels() for model in models):
        count = 0 if model.key not in (*episode.observations, CONTROL) else readings_of(episode, model.key).shape[1]
        axes = [axis_name(model.key, channel, count) for channel in model.channels]
        if subject not in axes:
            continue
        compared, i = model.compare(episode), axes.index(subject)
        steps = compared.steps()
        error = (compared.readings - compared.expected)[steps, i]
        if len(error) < MIN_STEPS:
            return None
        error *= np.sign(error.mean())
        first, last = deviating_interval(error)
        inside, others = error[first : last + 1], np.delete(error, np.s_[first : last + 1])
        if len(inside) >= MIN_STEPS and len(others) and others.mean() < CLEARLY * inside.mean():
            return int(steps[first]), int(steps[last])
    return None


def _pairs(compared: ComparedReadings, delay: int) -> tuple[Array, Array]:
    """``ComparedReadings.pairs``; those of controls with a slope that the size of the motion does not change.

    Process noise in the labels flattens the slope of the controls on the expected ones, noise of measured controls the
    opposite one: see ``nearer_slope``.
    """
    readings, expected = compared.pairs(delay)
    if compared.model.key != CONTROL or not len(readings):
        return readings, expected
    x, y = expected - expected.mean(0), readings - readings.mean(0)
    product = (x * y).sum(0)
    slope = product / np.maximum(np.square(x).sum(0), 1e-24)
    other = compared.model.explained * np.square(y).sum(0) / np.where(product > 0.0, product, np.nan)
    return readings + (nearer_slope(slope, other, 1.0) - slope) * x, expected


def _short_delay(compared: ComparedReadings) -> float:
    """Steps, with fractions: regression of the errors on the changes of the expected readings by step.

    The mean error of the episode is a random effect: it shows the delay of a steady motion, unless biases of this size
    are healthy, or a bias, of the episode or in an interval, leaves clearly less (``CLEARLY``) than the delay.
    """
    noise, biases = compared.model.noise, compared.model.biases
    error, change = compared.readings - compared.expected, np.gradient(compared.expected, axis=0)
    chosen = compared.fresh & np.isfinite(change).all(1)
    error, change = (x[chosen] / noise for x in (error, change))
    unbiased = error - error.mean(0)
    unbiased -= _interval_means(unbiased)
    known = 1.0 - 1.0 / np.sqrt(1.0 + len(error) * np.square(biases / noise))
    error, change = (x - known * x.mean(0) for x in (error, change))
    delay = _delay(error, change)
    is_bias = np.square(unbiased).sum() < CLEARLY * np.square(error + delay * change).sum()
    return _delay(unbiased, change) if is_bias else delay


def _delay(error: Array, change: Array) -> float:
    """Steps by which readings follow expected ones, from their errors and the changes of the latter (S, A).

    Both in standard deviations of the noise; NaN if its standard error is above ``UNCERTAIN``.
    """
    power = float(np.square(change).sum())
    return -float((error * change).sum()) / power if power * UNCERTAIN**2 > 1.0 else np.nan


def _line(readings: Array, expected: Array, times: Array, spread: Array) -> dict[str, Array]:
    """``bias``, ``drift``, ``gain``, ``noise`` and ``ratio`` (A,) of readings (S, A) at times (S,), from 0 to 1.

    They are those of a line through the expected readings, and, if there is a drift, the times; NaN for too few steps.
    Noise changes slopes as well: gains are shrunk towards 1 if their standard errors exceed the spread (A,) of healthy
    ones, but little if they differ from 1 by far more than ``SURELY`` of them (positive-part James-Stein estimator).
    The noise is that before the gain, unless this is tiny (``LEAST_GAIN``): such readings do not follow. The ratio is a
    gain without a bias, which is known even if the expected readings hardly vary. It is shrunk towards 1 by the
    likelihood ratio of a bias, and of the drift, to it.
    """
    if len(readings) < MIN_STEPS:
        return dict.fromkeys(("bias", "drift", "gain", "noise", "ratio"), np.full(readings.shape[1], np.nan))
    x, y = expected - expected.mean(0), readings - readings.mean(0)
    drift, drifted = _drift(x, y - x, times - times.mean())
    y = y - drifted
    power = np.maximum(np.square(x).sum(0), 1e-24)
    slope = (x * y).sum(0) / power
    rest = np.sqrt(np.square(y - slope * x).mean(0))
    error = np.maximum(np.maximum(rest / np.sqrt(power), _clustered(x * (y - slope * x)) / power), 1e-12)
    sure = 1.0 - np.square(SURELY * error / np.maximum(np.abs(slope - 1.0), 1e-12))
    share = np.maximum(np.minimum(np.square(spread / error), 1.0), sure)
    is_gain = (sure > 0.0) & (np.abs(slope) > LEAST_GAIN)
    before = np.where(is_gain, np.abs(slope), np.maximum(slope, 1.0))
    errors, gain = readings - expected, 1.0 + share * (slope - 1.0)
    ratio = (expected * errors).sum(0) / np.maximum(np.square(expected).sum(0), 1e-24)
    others = errors - drifted
    by_bias, by_ratio = (np.square(e).mean(0) + 1e-24 for e in (others - others.mean(0), errors - ratio * expected))
    ratio = 1.0 + np.minimum(by_bias / by_ratio, 1.0) ** (len(errors) / 2.0) * ratio
    return {"bias": errors.mean(0), "drift": drift, "gain": gain, "noise": rest / before, "ratio": ratio}


def _drift(expected: Array, errors: Array, times: Array) -> tuple[Array, Array]:
    """(A,) slope of errors (S, A) with a mean of 0 by the times (S,), and the part (S, A) that is a drift or a bias.

    A gain and a bias in an interval also change errors over time. The slope is shrunk by the likelihood ratio of the
    better of these to a ramp from some step on, for ``BLOCKS`` pairs of independent errors. The part is that of the
    ramp, if it leaves less than a gain, which has fewer parameters (``AS_GOOD``), or of the interval, which has more
    than both, if it leaves clearly less (``CLEARLY``). The slope is NaN if a ramp and an interval both explain most of
    the errors, and about as well (``ALIKE``): a few late readings do not show which of them it is.
    """
    time = times[:, None]
    power = np.square(errors).sum(0)
    slope = (time * errors).sum(0) / np.square(time).sum()
    interval = _interval_means(errors)
    gain = expected * ((expected * errors).sum(0) / np.maximum(np.square(expected).sum(0), 1e-24))
    ramp = _ramp(errors, times)
    left = [np.maximum(np.square(errors - fit).sum(0), 1e-9 * power + 1e-24) for fit in (ramp, interval, gain)]
    by_ramp, by_interval, by_gain = left[0], left[1], AS_GOOD * left[2]
    is_interval = by_interval < CLEARLY * np.minimum(by_ramp, by_gain)
    part = np.where(is_interval, interval, np.where(by_ramp < by_gain, ramp, 0.0))
    ratio = (by_interval / by_ramp) ** BLOCKS
    is_either = (np.maximum(by_ramp, by_interval) < CLEARLY * power) & (ratio > ALIKE[0]) & (ratio < ALIKE[1])
    shrunk = slope * np.minimum(np.minimum(by_interval, by_gain) / by_ramp, 1.0) ** BLOCKS
    return np.where(is_either, np.nan, shrunk), part


def _ramp(errors: Array, times: Array) -> Array:
    """(S, A) ramps from one of ``ONSETS`` times on that explain most of errors (S, A) at times (S,), without a mean."""
    onsets = np.linspace(times[0], times[-1], ONSETS + 1)[:-1]
    ramps = np.maximum(times[:, None] - onsets, 0.0)  # (S, O)
    ramps -= ramps.mean(0)
    powers = np.square(ramps).sum(0)[:, None]
    products = ramps.T @ errors  # (O, A)
    best = (np.square(products) / powers).argmax(0)
    channels = np.arange(errors.shape[1])
    return np.asarray(ramps[:, best] * (products[best, channels] / powers[best, 0]))


def _interval_means(errors: Array) -> Array:
    """(S, A) means inside and outside of the interval that explain most of errors (S, A) with a mean of 0."""
    count = len(errors)
    edges = np.unique(np.linspace(0, count, EDGES).astype(int))
    sums = np.concatenate([np.zeros((1, errors.shape[1])), errors.cumsum(0)])[edges]
    first, last = np.triu_indices(len(edges), 1)
    inside = edges[last] - edges[first]
    outside = np.maximum(count - inside, 1)  # the sum of all is 0
    total = sums[last] - sums[first]
    best = (np.square(total) / (inside * outside)[:, None]).argmax(0)
    steps, total = np.arange(count)[:, None], np.take_along_axis(total, best[None], 0)
    is_inside = (steps >= edges[first[best]]) & (steps < edges[last[best]])
    return np.where(is_inside, total / inside[best], -total / outside[best])


def _clustered(terms: Array) -> Array:
    """(A,) standard errors of sums of terms (S, A) with a mean of 0, which depend on each other within ``BLOCKS``."""
    starts = np.linspace(0, len(terms), BLOCKS, endpoint=False).astype(int)
    return np.asarray(np.sqrt(np.square(np.add.reduceat(terms, starts, axis=0)).sum(0)))


def _evidence(error: Array, other: Array, limit: float, biased: Array) -> Array:
    """Half the log-ratio of errors to others; 0 if these are not smaller, above a limit, or worse than with biases."""
    ratio = error / np.maximum(other, 1e-12)
    fits = other < np.minimum(limit, SIMPLER * biased)
    return np.asarray(0.5 * np.log(np.where(fits, np.maximum(ratio, 1.0), 1.0)))


def _is_own_arrangement(errors: Array) -> bool:
    """Whether neither the opposite sign of a channel nor the exchange of two has smaller errors (2, A, A).

    A channel alone may have a smaller error as another one with more noise, to which it is relative.
    """
    own, least = np.diagonal(errors[0]), errors.min(0)
    return bool((own <= np.diagonal(errors[1])).all() and (own[:, None] + own <= least + least.T).all())


def delayed_errors(compared: ComparedReadings, dt: float) -> tuple[float, Array]:
    """Delay of the readings in steps, NaN if they do not follow the expected ones, and ``errors`` at this delay.

    Periodic readings with the opposite sign look delayed: without a delay, channels may have another sign and order.
    The delay of a clock that drifts far is its mean over the episode.

    Args:
        dt: s per step.
    """
    known = (np.arange(len(compared.present)) >= FIRST_CHANGES) & compared.present.any() & compared.known
    signals = compared.readings, compared.expected, compared.fresh, known
    delay, errors = fitted_lag(*signals, largest_lag(dt)), compared.errors()
    if np.isnan(delay):
        drifting = np.round(drifting_lag(*signals))
        is_late = _is_own_arrangement(errors) and not np.isnan(drifting)
        return (drifting, compared.errors(int(drifting))) if is_late else (delay, errors)
    if delay == 0.0:
        return delay, errors
    delayed = compared.errors(int(delay))
    is_arranged = _least_of_orders(errors.min(0)) < SIMPLER * np.diagonal(delayed[0]).sum()
    return (0.0, errors) if is_arranged else (delay, delayed)


def _least_of_orders(errors: Array) -> float:
    """Least sum of errors (A, A) of readings as those of the channels, each of another one; NaN if some are unknown."""
    if not np.isfinite(errors).all():
        return np.nan
    from scipy.optimize import linear_sum_assignment  # takes most of a second

    return float(errors[linear_sum_assignment(errors)].sum())
