"""Controls against the measured hand that they command, and the laws between sensors and controls."""

from __future__ import annotations

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import axis_name
from beliefscope.inspect.diagnosis.checks.vectors import (
    AXES,
    CHANGE,
    FORCE,
    POSITION,
    commands_hand,
    labelled_contact_statistics,
    vector_keys,
    wrench_statistics,
)
from beliefscope.inspect.statistics.reference_images import HAND
from beliefscope.inspect.statistics.signals import MIN_STEPS, Array, lag, robust_fit

SAME_POSITION = 1e-6
"""m: largest variation of the distance of set points from measured positions that are the same but for rounding."""

LAWFUL = 0.005
"""m: largest median error of the law of an impedance controller; twice that of most healthy episodes."""


def law_statistics(episode: Episode) -> dict[str, float]:
    """Statistics of an episode about laws between sensors and controls: of contact, and of the controller."""
    values = wrench_statistics(episode) | control_statistics(episode) | impedance_statistics(episode)
    for key in vector_keys(episode):
        values |= labelled_contact_statistics(episode, key)
    return values


def control_statistics(episode: Episode) -> dict[str, float]:
    """Delay and scale of controls that command a hand position, against the measured position.

    ``step scale``: slope of the commanded changes on the differences of the commanded positions. It is one whatever
    the hand does, unless only the changes are scaled.

    Of other controls, the standard deviation of each channel: only a filter's dynamics say what they do.
    """
    if not commands_hand(episode.task):
        controls = episode.controls.astype(np.float64)
        names = [axis_name("control", i, controls.shape[1]) for i in range(controls.shape[1])]
        return {f"size/{name}/all": float(size) for name, size in zip(names, controls.std(0), strict=True)}
    if HAND not in episode.observations:
        return {}
    hand, controls = episode.observations[HAND].astype(np.float64), episode.controls.astype(np.float64)
    moved, change = np.diff(hand, axis=0, prepend=hand[:1]), controls[:, CHANGE]
    delay = lag(change, moved)[0]
    shift = 0 if np.isnan(delay) else int(delay)
    steps = np.arange(len(hand))
    valid = (steps - shift >= 1) & (steps - shift < len(hand))
    a, b = change[valid], moved[steps[valid] - shift]
    return {
        "lag/control/all": delay,
        "scale/control/all": _slope(a, b),
        "step scale/control/all": _slope(change[:-1], np.diff(controls[:, POSITION], axis=0)),
    }


def _slope(a: Array, b: Array) -> float:
    """Slope of a on b, (T, 3) each; NaN if b does not vary."""
    power = np.square(b).sum()
    return float((a * b).sum() / power) if power > 1e-12 else np.nan


def impedance_statistics(episode: Episode) -> dict[str, float]:
    """How the hand p follows its set point s under the force F, on each axis: ``s - p = offset - c F + k v``.

    The law of an impedance controller with compliance c (m/N) and damping, here a delay of k steps with the velocity v
    (m per step). The offset (m) is that of the measured position, which neither contact nor motion hides. A gain g of
    the force divides c by g. A robust fit; c and k are NaN if the set point is the measured position. The offset and c
    are NaN where the law does not hold (``LAWFUL``), such as for a jammed arm.

    ``drift`` of the force, N/s: slope of the force over time beyond what the law explains, also in episodes without
    free motion.
    """
    if not commands_hand(episode.task) or HAND not in episode.observations:
        return {}
    hand, controls = episode.observations[HAND].astype(np.float64), episode.controls.astype(np.float64)
    present = episode.present(HAND)[:-1]
    force = np.zeros_like(hand)
    if FORCE in episode.observations and episode.observations[FORCE].shape[1] == 3:
        force, present = episode.observations[FORCE].astype(np.float64), present & episode.present(FORCE)[:-1]
    distance = (controls[1:, POSITION] - hand[:-1])[present].T
    columns = np.stack([np.ones_like(hand), -force, np.gradient(hand, axis=0)], axis=-1)[:-1][present].swapaxes(0, 1)
    if distance.shape[1] < MIN_STEPS:
        return {}
    fit = robust_fit(columns, distance)
    time = np.broadcast_to(episode.dt * np.flatnonzero(present), distance.shape)
    terms = np.stack([np.ones_like(distance), time, distance, columns[..., 2]], axis=-1)
    readings = -columns[..., 1]
    trend = robust_fit(terms, readings)
    left = np.median(np.abs(readings - (terms @ trend[..., None])[..., 0]), axis=1)
    drift = np.where(left < LAWFUL * np.abs(trend[:, 2]), trend[:, 1], np.nan)
    if np.ptp(distance) < SAME_POSITION:
        fit[:, 1:] = drift[:] = np.nan
    else:
        error = np.median(np.abs(distance - (columns @ fit[..., None])[..., 0]), axis=1)
        fit[error > LAWFUL, :2] = np.nan
    names = ("offset/control", f"compliance/{FORCE}", "following/control")
    values = {f"{name} {AXES[i]}/all": float(fit[i, k]) for k, name in enumerate(names) for i in range(3)}
    return values | {f"drift/{FORCE} {AXES[i]}/all": float(drift[i]) for i in range(3)}
