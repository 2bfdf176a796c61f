"""Undoing a cause in sensors, controls or labels: values shifted, scaled or advanced by the size of the deviation."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import derived_controls
from beliefscope.datasets.task import axis_name
from beliefscope.inspect.diagnosis.checks.vectors import (
    CHANGE,
    FORCE,
    TORQUE,
    commands_hand,
    in_contact,
    lever,
)
from beliefscope.inspect.diagnosis.undo.expected_readings import tare
from beliefscope.inspect.diagnosis.undo.run_inputs import Deviations, RunInputs, Undo, with_labels, with_readings
from beliefscope.inspect.statistics.image_landmarks import LandmarkFilter
from beliefscope.inspect.statistics.reading_features import CONTROL
from beliefscope.inspect.statistics.reference_images import CONTACT, HAND
from beliefscope.inspect.statistics.signals import MIN_STEPS

CLEARLY = 2.0
"""Ratio of the force in contact to its 90 % quantile without contact."""

NUDGE = 1e-3
"""m: step of the difference quotient of the camera's map."""


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
            return with_labels(inputs, lambda values: _ahead(values, steps))
        steps_of = dict.fromkeys(inputs.checkpoint.task.modalities.get(key, (key,)), steps)
    result: RunInputs | None = inputs
    for name, count in steps_of.items():
        if result is not None:
            result = with_readings(result, name, lambda values, episode, count=count: _ahead(values, count))  # type: ignore[misc]
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

    return with_readings(inputs, "image", back)


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
    return None if not ratio else with_readings(inputs, "image", lambda images, episode: images / ratio)


def detrend_force(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Force without its excess slope in free motion or, without that, of what the law of the controller leaves."""
    names = ("drift/force {}/free motion", "drift/force {}/all")
    slopes = ([_excess(deviations, name.format(axis)) for axis in "xyz"] for name in names)
    slope = next((values for values in slopes if None not in values), None)
    if slope is None:
        return None
    return with_readings(
        inputs, "force", lambda f, episode: f - np.array(slope)[: f.shape[1]] * episode.dt * np.arange(len(f))[:, None]
    )


def scale_force(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Force of healthy size: from how much the hand yields to it or, where this is unknown, from its size."""
    ratios = [ratio for axis in "xyz" if (ratio := _ratio(deviations, f"compliance/force {axis}/all"))]
    gain = 1.0 / float(np.median(ratios)) if ratios else _ratio(deviations, "size/force/contact")
    return None if not gain else with_readings(inputs, "force", lambda force, episode: force / gain)


def negate_force(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Force with the opposite sign."""
    return with_readings(inputs, "force", lambda force, episode: -force)


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
    return None if order == (0, 1, 2) else with_readings(inputs, FORCE, lambda force, episode: force[:, order])


def restore_contact(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """A contact flag computed from the force: set where it exceeds its healthy size without the flag (``CLEARLY``)."""
    names = [f"unflagged force/{CONTACT}/all", *(f"level/{FORCE} {axis}/free motion" for axis in "xyz")]
    if inputs.healthy is None or not all(name in inputs.healthy.statistics for name in names):
        return None
    unflagged, *zero = (float(np.nanmean(inputs.healthy.statistics[name])) for name in names)

    def restored(flag: NDArray[Any], episode: Episode) -> NDArray[Any]:
        size = np.linalg.norm(episode.observations[FORCE].astype(np.float64) - zero, axis=1)
        return (size > CLEARLY * unflagged)[:, None]

    return with_readings(inputs, CONTACT, restored)


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
    return with_readings(inputs, HAND, lambda position, episode: position - shift[: position.shape[1]])


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
    return with_labels(inputs, lambda states: states + shift)


def scale_control(inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Controls with the healthy scale of the change of the hand or, of others, the healthy scale of each channel."""
    size = inputs.checkpoint.task.control_size
    factors = np.array([_scale(deviations, channel, size) for channel in range(size)])
    if commands_hand(inputs.checkpoint.task):
        names = ("step scale/control/all", "scale/control/all")
        factors[CHANGE] = next(filter(None, (_ratio(deviations, name) for name in names)), 1.0)
    return None if (factors == 1.0).all() else with_readings(inputs, "control", lambda values, _: values / factors)


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
    return None if (signs == 1.0).all() else with_readings(inputs, "control", lambda values, _: values * signs)


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
