"""Undoing a cause in sensors or controls: readings shifted, scaled or advanced by the size of the deviation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.inspect.diagnosis.setting import Deviations, Setting, Undo
from beliefscope.inspect.diagnosis.vector_checks import CHANGE


def _with_readings(setting: Setting, key: str, change: Callable[[NDArray[Any], float], NDArray[Any]]) -> Setting | None:
    """Changed readings (T, ...) of a sensor, or controls, in the affected episodes; ``change`` also takes dt."""
    episodes = dict(setting.episodes)
    for index in setting.affected:
        episode = episodes[index]
        if key == "control":
            controls = change(episode.controls, episode.dt).astype(np.float32)
            episodes[index] = replace(episode, controls=controls)
            continue
        if key not in episode.observations:
            return None
        readings = episode.observations[key]
        changed = change(readings.astype(np.float64), episode.dt)
        if readings.dtype == np.uint8:
            changed = np.rint(changed).clip(0, 255)
        observations = {**episode.observations, key: changed.astype(readings.dtype)}
        episodes[index] = replace(episode, observations=observations)
    return replace(setting, episodes=episodes)


def advance(key: str, setting: Setting, deviations: Deviations) -> Setting | None:
    """A delayed image, the delayed haptics, or controls, advanced by their delay."""
    lag = deviations.get("lag/control/all" if key == "control" else "lag/image/all")
    steps = 0 if lag is None else round(abs(lag.value - lag.healthy))
    keys = setting.checkpoint.task.modalities.get(key, (key,))
    result: Setting | None = setting
    for name in keys:
        if result is not None:
            result = _with_readings(
                result, name, lambda values, dt: values[np.minimum(np.arange(len(values)) + steps, len(values) - 1)]
            )
    return result if steps else None


def realign_image(setting: Setting, deviations: Deviations) -> Setting | None:
    """Images shifted back; their borders are repeated."""
    x, y = (_shift(deviations, axis) for axis in "xy")
    if x is None or y is None:
        return None

    def back(images: NDArray[Any], dt: float) -> NDArray[Any]:
        rows, columns = (np.arange(size) + round(n) for size, n in zip(images.shape[1:], (y, x), strict=True))
        height, width = images.shape[1:]
        return images[:, rows.clip(0, height - 1)][:, :, columns.clip(0, width - 1)]

    return _with_readings(setting, "image", back)


def _shift(deviations: Deviations, axis: str) -> float | None:
    """Pixels: mean of the shifts of the scene and of the hand, weighted by the precision of healthy episodes."""
    names = [f"{kind}/image {axis}/all" for kind in ("shift", "hand offset")]
    known = [deviations[name] for name in names if name in deviations]
    if not known:
        return None
    weights = [max(d.high - d.low, 1e-6) ** -2 for d in known]
    return float(np.average([d.value - d.healthy for d in known], weights=weights))


def expose_image(setting: Setting, deviations: Deviations) -> Setting | None:
    """Images of healthy brightness."""
    ratio = _ratio(deviations, "brightness/image/all")
    return None if not ratio else _with_readings(setting, "image", lambda images, dt: images / ratio)


def tare_force(setting: Setting, deviations: Deviations) -> Setting | None:
    """Force without its excess level in free motion."""
    bias = [_excess(deviations, f"level/force {axis}/free motion") for axis in "xyz"]
    if None in bias:
        return None
    return _with_readings(setting, "force", lambda force, dt: force - np.array(bias)[: force.shape[1]])


def detrend_force(setting: Setting, deviations: Deviations) -> Setting | None:
    """Force without its excess slope in free motion."""
    slope = [_excess(deviations, f"drift/force {axis}/free motion") for axis in "xyz"]
    if None in slope:
        return None
    return _with_readings(
        setting, "force", lambda f, dt: f - np.array(slope)[: f.shape[1]] * dt * np.arange(len(f))[:, None]
    )


def scale_force(setting: Setting, deviations: Deviations) -> Setting | None:
    """Force of healthy size."""
    gain = _ratio(deviations, "size/force/contact")
    return None if not gain else _with_readings(setting, "force", lambda force, dt: force / gain)


def negate_force(setting: Setting, deviations: Deviations) -> Setting | None:
    """Force with the opposite sign."""
    return _with_readings(setting, "force", lambda force, dt: -force)


def scale_control(setting: Setting, deviations: Deviations) -> Setting | None:
    """Controls whose change of the hand position has the healthy scale."""
    scale = _ratio(deviations, "scale/control/all")
    channels = CHANGE if setting.checkpoint.task.control_size >= CHANGE.stop else slice(None)

    def rescaled(controls: NDArray[Any], dt: float) -> NDArray[Any]:
        controls = controls.copy()
        controls[:, channels] /= scale
        return controls

    return None if not scale else _with_readings(setting, "control", rescaled)


def _excess(deviations: Deviations, name: str) -> float | None:
    return deviations[name].value - deviations[name].healthy if name in deviations else None


def _ratio(deviations: Deviations, name: str) -> float | None:
    deviation = deviations.get(name)
    return deviation.value / deviation.healthy if deviation is not None and deviation.healthy else None


READINGS: Mapping[str, Undo] = {
    "realign image": realign_image,
    "expose image": expose_image,
    "tare force": tare_force,
    "detrend force": detrend_force,
    "scale force": scale_force,
    "negate force": negate_force,
    "scale control": scale_control,
}
"""Intervention -> function."""
