"""Undoing a cause in sensors, controls or labels: values shifted, scaled or advanced by the size of the deviation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import derived_controls
from beliefscope.datasets.task import axis_name
from beliefscope.inspect.diagnosis.checks.readings import delayed_errors
from beliefscope.inspect.diagnosis.checks.sensors import biased_steps
from beliefscope.inspect.diagnosis.checks.vectors import (
    CHANGE,
    FORCE,
    TORQUE,
    commands_hand,
    free_motion,
    in_contact,
    lever,
)
from beliefscope.inspect.diagnosis.undo.run_inputs import Deviations, RunInputs, Undo
from beliefscope.inspect.statistics.image_landmarks import LandmarkFilter
from beliefscope.inspect.statistics.reading_model import CONTROL, ReadingModel
from beliefscope.inspect.statistics.reference_images import CONTACT, HAND
from beliefscope.inspect.statistics.signals import MIN_STEPS, Array, wrapped

CLEARLY = 2.0
"""Ratio of the force in contact to its 90 % quantile without contact."""

SMALLEST_GAIN = 0.01
"""Smallest slope of readings on the expected ones by which they are divided."""

NUDGE = 1e-3
"""m: step of the difference quotient of the camera's map."""


def _with_readings(
    inputs: RunInputs, key: str, change: Callable[[NDArray[Any], Episode], NDArray[Any]]
) -> RunInputs | None:
    """Changed readings (T, ...) of a sensor, or controls, in the affected episodes; ``change`` also takes the episode.

    Controls that derive from the readings are recomputed, as when faults are injected.
    """
    episodes = dict(inputs.episodes)
    for index in inputs.affected:
        episode = episodes[index]
        if key == "control":
            controls = change(episode.controls, episode).astype(np.float32)
            episodes[index] = replace(episode, controls=controls)
            continue
        if key not in episode.observations:
            return None
        readings = episode.observations[key]
        changed = change(readings.astype(np.float64), episode)
        if readings.dtype == np.uint8:
            changed = np.rint(changed).clip(0, 255)
        observations = {**episode.observations, key: changed.astype(readings.dtype)}
        episodes[index] = replace(episode, observations=observations, controls=derived_controls(episode, observations))
    return replace(inputs, episodes=episodes)


def _with_labels(inputs: RunInputs, change: Callable[[NDArray[Any]], NDArray[Any]]) -> RunInputs:
    """Changed true states (T, n) in the affected episodes."""
    episodes = {
        index: replace(episode, states=change(episode.states).astype(np.float32))
        if index in inputs.affected
        else episode
        for index, episode in inputs.episodes.items()
    }
    return replace(inputs, episodes=episodes)


def advance(key: str, inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """A delayed image, the delayed haptics, controls or labels, advanced by their delay.

    Of a sensor with a delay behind the labelled contact or the labels: each such sensor by its own delay.
    """
    kinds = ("contact lag", "reading lag")
    lags = {
        name: [deviations[statistic] for kind in kinds if (statistic := f"{kind}/{name}/all") in deviations]
        for name in (*inputs.checkpoint.task.observations, CONTROL)
    }
    largest = {name: max(behind_by, key=lambda d: d.t) for name, behind_by in lags.items() if behind_by}
    behind = {name: round(d.value - d.healthy) for name, d in largest.items()}
    if behind.get(key, 0) > 0:
        steps_of = {name: steps for name, steps in behind.items() if steps > 0}
    else:
        names = [f"lag/{key if key in ('control', 'labels') else 'image'}/all", f"lag/labels {key}/all"]
        names += ["lag/dynamics/all"] if key == CONTROL else []
        lag = next((deviations[name] for name in names if name in deviations), None)
        steps = 0 if lag is None else round(abs(lag.value - lag.healthy))
        if not steps:
            return None
        if key == "labels":
            return _with_labels(inputs, lambda values: _ahead(values, steps))
        steps_of = dict.fromkeys(inputs.checkpoint.task.modalities.get(key, (key,)), steps)
    result: RunInputs | None = inputs
    for name, count in steps_of.items():
        if result is not None:
            result = _with_readings(result, name, lambda values, episode, count=count: _ahead(values, count))  # type: ignore[misc]
    return result


def _ahead(values: NDArray[Any], steps: int) -> NDArray[Any]:
    """Values (T, ...) that many steps earlier; the last ones are repeated."""
    return values[np.minimum(np.arange(len(values)) + steps, len(values) - 1)]


def realign_image(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Images shifted back; their borders are repeated."""
    x, y = (_shift(deviations, axis) for axis in "xy")
    if x is None or y is None:
        return None

    def back(images: NDArray[Any], episode: Episode) -> NDArray[Any]:
        rows, columns = (np.arange(size) + round(n) for size, n in zip(images.shape[1:], (y, x), strict=True))
        height, width = images.shape[1:]
        return images[:, rows.clip(0, height - 1)][:, :, columns.clip(0, width - 1)]

    return _with_readings(inputs, "image", back)


def _shift(deviations: Deviations, axis: str) -> float | None:
    """Pixels: mean of the shifts of the scene and of the hand, weighted by the precision of healthy episodes.

    Without a measured hand, that of the object from its label.
    """
    names = [f"{kind}/image {axis}/all" for kind in ("shift", "hand offset", "object offset")]
    shifts = [deviations[name] for name in names if name in deviations]
    shifts = [d for d in shifts if not d.statistic.startswith("object")] or shifts
    if not shifts:
        return None
    weights = [max(d.high - d.low, 1e-6) ** -2 for d in shifts]
    return float(np.average([d.value - d.healthy for d in shifts], weights=weights))


def expose_image(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Images of healthy brightness."""
    ratio = _ratio(deviations, "brightness/image/all")
    return None if not ratio else _with_readings(inputs, "image", lambda images, episode: images / ratio)


def tare(key: str, inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Force or torque without its excess level in free motion; that of some steps only is removed from these.

    Other sensors without their mean error from the expected readings.
    """
    levels = [deviations.get(f"level/{key} {axis}/free motion") for axis in "xyz"]
    if None in levels:
        return _as_expected(key, inputs, lambda readings, expected: np.ones(readings.shape[1]))

    def unbiased(readings: NDArray[Any], episode: Episode) -> NDArray[Any]:
        free = free_motion(episode) & episode.present(key)
        for axis, level in enumerate(levels[: readings.shape[1]]):
            assert level is not None
            steps = biased_steps(episode, key, axis)
            if steps is None:
                readings[:, axis] -= level.value - level.healthy
            else:
                part = np.s_[steps[0] : steps[1] + 1]
                readings[part, axis] -= np.median(readings[part, axis][free[part]]) - level.healthy
        return readings

    return _with_readings(inputs, key, unbiased)


def detrend(key: str, inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Readings without the line over time that fits their errors from the expected ones in all affected episodes."""
    if (model := _reading_model(key, inputs)) is None:
        return None
    compared = [model.compare(inputs.episodes[index]) for index in inputs.affected]
    steps = np.concatenate([one.steps() for one in compared])
    errors = np.concatenate([np.subtract(*one.pairs()) for one in compared])
    if len(steps) < MIN_STEPS:
        return None
    (slope, offset), channels = np.polyfit(steps, errors, 1), list(model.channels)

    def restored(values: NDArray[Any], episode: Episode) -> NDArray[Any]:
        result = values.copy()
        own = values[:, channels] - offset - slope * np.arange(len(values))[:, None]
        result[:, channels] = np.where(model.is_angle, wrapped(own), own)
        return result

    return _with_readings(inputs, key, restored)


def scale(key: str, inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Readings without their mean error from the expected ones, and divided by their slope on these."""

    def slope(readings: Array, expected: Array) -> Array:
        around = expected - expected.mean(0)
        return np.asarray((around * readings).sum(0) / np.maximum(np.square(around).sum(0), 1e-24))

    return _as_expected(key, inputs, slope)


def _as_expected(key: str, inputs: RunInputs, gain_of: Callable[[Array, Array], Array]) -> RunInputs | None:
    """Readings (z - c) / g, which agree with the expected ones in the mean of the affected episodes.

    None without a model of the sensor, and for a gain of about 0.

    Args:
        gain_of: g (A,) from readings and expected readings (S, A).
    """
    if (model := _reading_model(key, inputs)) is None:
        return None
    pairs = (model.compare(inputs.episodes[index]).pairs() for index in inputs.affected)
    readings, expected = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    gain = gain_of(readings, expected) if len(readings) >= MIN_STEPS else np.zeros(1)
    if (np.abs(gain) < SMALLEST_GAIN).any():
        return None
    offset, channels = readings.mean(0) - gain * expected.mean(0), list(model.channels)

    def restored(values: NDArray[Any], episode: Episode) -> NDArray[Any]:
        result = values.copy()
        own = (values[:, channels] - offset) / gain
        result[:, channels] = np.where(model.is_angle, wrapped(own), own)
        return result

    return _with_readings(inputs, key, restored)


def _reading_model(key: str, inputs: RunInputs) -> ReadingModel | None:
    """The healthy record's model of a sensor; None if the labels explain none of its channels."""
    readings = () if inputs.healthy is None else inputs.healthy.readings
    return next((model for model in readings if model.key == key and model.channels), None)


def detrend_force(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Force without its excess slope in free motion."""
    slope = [_excess(deviations, f"drift/force {axis}/free motion") for axis in "xyz"]
    if None in slope:
        return None
    return _with_readings(
        inputs, "force", lambda f, episode: f - np.array(slope)[: f.shape[1]] * episode.dt * np.arange(len(f))[:, None]
    )


def scale_force(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Force of healthy size: from how much the hand yields to it or, where this is unknown, from its size."""
    ratios = [ratio for axis in "xyz" if (ratio := _ratio(deviations, f"compliance/force {axis}/all"))]
    gain = 1.0 / float(np.median(ratios)) if ratios else _ratio(deviations, "size/force/contact")
    return None if not gain else _with_readings(inputs, "force", lambda force, episode: force / gain)


def negate_force(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Force with the opposite sign."""
    return _with_readings(inputs, "force", lambda force, episode: -force)


def permute_force(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Force with the order of axes that best agrees with the torque in contact; None if that is the order it has."""
    orders = list(permutations(range(3)))
    left = np.zeros(len(orders))
    for index in inputs.affected:
        observations, at = inputs.episodes[index].observations, in_contact(inputs.episodes[index])
        if {FORCE, TORQUE} <= observations.keys() and at.sum() >= MIN_STEPS:
            force, torque = (observations[key].astype(np.float64)[at] for key in (FORCE, TORQUE))
            left += [lever(force[:, order], torque)[1] for order in orders]
    order = orders[int(left.argmin())]
    return None if order == (0, 1, 2) else _with_readings(inputs, FORCE, lambda force, episode: force[:, order])


def rearrange(key: str, inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Readings with the order and the signs of channels that best agree with the labels; None if they have them."""
    if (model := _reading_model(key, inputs)) is None:
        return None
    from scipy.optimize import linear_sum_assignment  # takes most of a second

    affected = (inputs.episodes[index] for index in inputs.affected)
    total = np.sum([delayed_errors(model.compare(episode), episode.dt)[1] for episode in affected], axis=0)
    if not np.isfinite(total).all():
        return None
    sources, channels = linear_sum_assignment(total.min(0))  # reading i is of channel j
    signs = np.where(total.argmin(0)[sources, channels], -1.0, 1.0)
    if (sources == channels).all() and (signs > 0.0).all():
        return None
    order = np.array(model.channels)

    def arranged(values: NDArray[Any], episode: Episode) -> NDArray[Any]:
        result = values.copy()
        result[:, order[channels]] = signs * values[:, order[sources]]
        return result

    return _with_readings(inputs, key, arranged)


def restore_contact(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """A contact flag computed from the force: set where it exceeds its healthy size without the flag (``CLEARLY``)."""
    names = [f"unflagged force/{CONTACT}/all", *(f"level/{FORCE} {axis}/free motion" for axis in "xyz")]
    if inputs.healthy is None or not all(name in inputs.healthy.statistics for name in names):
        return None
    unflagged, *zero = (float(np.nanmean(inputs.healthy.statistics[name])) for name in names)

    def restored(flag: NDArray[Any], episode: Episode) -> NDArray[Any]:
        size = np.linalg.norm(episode.observations[FORCE].astype(np.float64) - zero, axis=1)
        return (size > CLEARLY * unflagged)[:, None]

    return _with_readings(inputs, CONTACT, restored)


def shift_hand(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Hand positions without their offset: from commanded positions or, if these derive from the measured ones, from
    the offset of the hand in the image, which determines x and y."""
    offset = [_excess(deviations, f"offset/control {axis}/all") for axis in "xyz"]
    pixels = [_excess(deviations, f"hand offset/image {axis}/all") for axis in "xy"]
    derived = any(
        not np.array_equal(derived_controls(e, {**e.observations, HAND: e.observations[HAND] + 1.0}), e.controls)
        for e in inputs.episodes.values()
        if HAND in e.observations
    )
    if not derived and None not in offset:
        shift = -np.array(offset, dtype=np.float64)
    elif None not in pixels and (camera := _hand_camera(inputs)) is not None:
        centre = camera.scale[0]
        nudged = camera.pixels(centre + NUDGE * np.eye(len(centre))[:2]) - camera.pixels(centre[None])
        shift = np.zeros(len(centre))
        shift[:2] = -np.linalg.lstsq(nudged.T / NUDGE, np.array(pixels, dtype=np.float64), rcond=None)[0]
    else:
        return None
    return _with_readings(inputs, HAND, lambda position, episode: position - shift[: position.shape[1]])


def _hand_camera(inputs: RunInputs) -> LandmarkFilter | None:
    """Where the hand is seen in healthy images."""
    reference = None if inputs.healthy is None else inputs.healthy.reference
    return None if reference is None else reference.hand


def shift_labels(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Labels without an offset: the excess bias of all measurement models, weighted by their precision."""
    task = inputs.checkpoint.task
    shift = np.zeros(len(task.components))
    for i, component in enumerate(task.components):
        biases = [
            d
            for name, d in deviations.items()
            if name.startswith("module bias/") and name.endswith(f" {component.name}/all")
        ]
        if not biases:
            return None
        weights = [max(d.high - d.low, 1e-6) ** -2 for d in biases]
        shift[i] = np.average([d.value - d.healthy for d in biases], weights=weights)
    return _with_labels(inputs, lambda states: states + shift)


def scale_control(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Controls with the healthy scale of the change of the hand or, of others, the healthy scale of each channel."""
    size = inputs.checkpoint.task.control_size
    factors = np.array([_scale(deviations, channel, size) for channel in range(size)])
    if commands_hand(inputs.checkpoint.task):
        factors[CHANGE] = _ratio(deviations, "scale/control/all") or 1.0
    return None if (factors == 1.0).all() else _with_readings(inputs, "control", lambda values, _: values / factors)


def _scale(deviations: Deviations, channel: int, size: int) -> float:
    """Actual over healthy gain of a channel of the controls, or over its healthy size."""
    axis = axis_name("control", channel, size)
    for name in (f"reading gain/{axis}/all", f"size/{axis}/all"):
        if name in deviations and deviations[name].alarm:
            return _ratio(deviations, name) or 1.0
    return 1.0


def negate_control(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Controls with the opposite sign of the channels that fit the dynamics better with it."""
    size = inputs.checkpoint.task.control_size
    opposed = (deviations.get(f"opposed/{axis_name('control', channel, size)}/all") for channel in range(size))
    signs = np.array([-1.0 if deviation is not None and deviation.alarm else 1.0 for deviation in opposed])
    return None if (signs == 1.0).all() else _with_readings(inputs, "control", lambda values, _: values * signs)


def _excess(deviations: Deviations, name: str) -> float | None:
    return deviations[name].value - deviations[name].healthy if name in deviations else None


def _ratio(deviations: Deviations, name: str) -> float | None:
    deviation = deviations.get(name)
    return deviation.value / deviation.healthy if deviation is not None and deviation.healthy else None


READINGS: Mapping[str, Undo] = {
    "realign image": realign_image,
    "expose image": expose_image,
    "tare force": partial(tare, FORCE),
    "tare torque": partial(tare, TORQUE),
    "permute force": permute_force,
    "restore contact": restore_contact,
    "shift hand": shift_hand,
    "shift labels": shift_labels,
    "detrend force": detrend_force,
    "scale force": scale_force,
    "negate force": negate_force,
    "scale control": scale_control,
    "negate control": negate_control,
}
"""Intervention -> function."""
