"""Statistics of vector sensors and controls without ground truth: each axis, and relations between sensors."""

from __future__ import annotations

from itertools import permutations

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Task, axis_name
from beliefscope.inspect.statistics.contact_distance import contact_residual
from beliefscope.inspect.statistics.reference_images import CONTACT, HAND, Reference, displacements_in_contact
from beliefscope.inspect.statistics.signals import (
    MIN_STEPS,
    Array,
    Mask,
    is_angle,
    lag,
    noise_level,
    repeats,
    robust_line,
)

AXES = "xyz"
FORCE, TORQUE = "force", "torque"
"""Observation keys of the wrench, which ``datasets/faults`` uses as well."""

POSITION, CHANGE = slice(0, 3), slice(3, 6)
"""Channels of controls that command a hand position: the previous position and its change."""

STEADY = 0.1
"""Largest median deviation from the median distance in contact, relative to the mean distance."""

CALMER = 0.2
"""Relative variation of the force with the contact flag below which the flag is inverted."""

ROUGH = 0.5
"""Roughness above which readings are mostly noise."""

MIN_CONTACT = 3
"""Smallest number of steps in contact that show a delay."""

JUMP = 4.0
"""Smallest change to a limit, relative to the usual one of the readings, of an axis that is not saturated."""

MIN_MOTION = 1e-3
"""m per step: the hand moves."""


def axis_statistics(episode: Episode, key: str) -> dict[str, float]:
    """Level, drift, changes, noise, repeated and saturated readings of each axis of a vector sensor (T, d).

    Changes are the 90 % quantile of second differences in free motion: neither a bias nor a drift matters, wherever
    it begins, but contact without its flag does. Steps without a reading do not count.
    """
    readings, present = episode.observations[key].astype(np.float64), episode.present(key)
    if not present.any():
        return {}
    calm = free_motion(episode) & present
    level, slope = robust_line(readings, calm)
    change = np.abs(np.diff(readings, n=2, axis=0))[calm[2:] & calm[1:-1] & calm[:-2]]
    noise = noise_level(readings, present)
    values: dict[str, float] = {}
    for i in range(readings.shape[1]):
        axis = axis_name(key, i, readings.shape[1])
        values |= {
            f"level/{axis}/free motion": float(level[i]),
            f"drift/{axis}/free motion": float(slope[i] / episode.dt),
            f"change/{axis}/free motion": float(np.quantile(change[:, i], 0.9)) if len(change) else np.nan,
            f"noise/{axis}/all": float(noise[i]),
            f"stuck/{axis}/all": float(stuck(episode, key, i)[present].mean()),
            f"saturation/{axis}/all": float(saturated(readings[present, i]).mean()),
        }
    return values


def stuck(episode: Episode, key: str, axis: int) -> Mask:
    """(T,): whether an axis repeats its reading while the hand moves, other than its largest one (``saturated``)."""
    present = episode.present(key)
    same, readings = np.zeros(len(episode), dtype=bool), episode.observations[key][present, axis]
    same[present] = repeats(readings, episode.task.held_steps(key)) & ~saturated(readings)
    return same & _moving(episode) if key != HAND else same


def contact_statistics(episode: Episode) -> dict[str, float]:
    """The contact flag: how often it is set and changes; compared with the force, how strongly related and how late.

    The flag and the force's distance from its median in free motion are correlated in healthy episodes with and without
    contact. A bias or the sign of the force does not matter. Free motion is without the flag or, if the force hardly
    varies with it (``CALMER``), with the flag: so an inverted flag has the opposite correlation.
    """
    if CONTACT not in episode.observations:
        return {}
    flag = episode.observations[CONTACT][:, 0] > 0.5
    changes = contact_changes(episode) / (len(flag) - 1) if len(flag) > 1 else np.nan
    values = {f"share/{CONTACT}/all": float(flag.mean()), f"toggles/{CONTACT}/all": changes}
    if FORCE not in episode.observations:
        return values
    force = episode.observations[FORCE].astype(np.float64)
    both = min(flag.sum(), (~flag).sum()) >= 3
    calm = ~flag if (~flag).any() else flag
    size = np.linalg.norm(force - np.median(force[calm], axis=0), axis=1)
    if min(flag.sum(), (~flag).sum()) >= MIN_STEPS:
        inverted = np.linalg.norm(force - np.median(force[flag], axis=0), axis=1)
        size = inverted if np.median(inverted[flag]) < CALMER * np.median(size[~flag]) else size
    both = both and size.std() > 0
    spread = np.log(size + 1e-2 * max(size.max(), 1e-9))
    related = float(np.corrcoef(flag, spread)[0, 1]) if both else np.nan
    return values | {
        f"agreement/{CONTACT}/all": related,
        f"opposition/{CONTACT}/all": max(0.0, -related),
        f"lag/{CONTACT}/all": lag(flag[:, None].astype(np.float64), spread[:, None])[0] if both else np.nan,
        f"unflagged force/{CONTACT}/all": float(np.quantile(size[~flag], 0.9)) if (~flag).any() else np.nan,
    }


def size_statistics(episode: Episode) -> dict[str, float]:
    """Standard deviation of the force in contact, and its roughness, noise relative to the standard deviation.

    The roughness separates noise from a gain, which does not change it.
    """
    force, at = _force(episode), in_contact(episode)
    if force is None:
        return {}
    size = _size(force[at])
    noise = float(np.linalg.norm(noise_level(force, at)))
    return {f"size/{FORCE}/contact": size, f"roughness/{FORCE}/contact": noise / size if size > 0.0 else np.nan}


def own_size_statistics(episode: Episode, key: str) -> dict[str, float]:
    """Standard deviation of each axis of a sensor in contact, and its roughness, as ``size_statistics`` of the force.

    Without ``contact_flag``, in the whole episode. The size of readings that are mostly noise (``ROUGH``) is unknown:
    it does not separate more noise from a gain.
    """
    at = in_contact(episode) & episode.present(key)
    if at.sum() < MIN_STEPS:
        return {}
    readings = episode.observations[key].astype(np.float64)
    size, noise = readings[at].std(0), noise_level(readings, at)
    values: dict[str, float] = {}
    for i in range(readings.shape[1]):
        axis = axis_name(key, i, readings.shape[1])
        values[f"size/{axis}/contact"] = float(size[i]) if noise[i] < ROUGH * size[i] else np.nan
        values[f"roughness/{axis}/contact"] = float(noise[i] / size[i]) if size[i] > 0.0 else np.nan
    return values


def _force(episode: Episode) -> Array | None:
    """(T, 3) measured force; None without it, or if less than ``MIN_STEPS`` steps are in contact."""
    force = episode.observations.get(FORCE)
    if force is None or force.shape[1] != 3 or in_contact(episode).sum() < MIN_STEPS:
        return None
    return force.astype(np.float64)


def _size(values: Array) -> float:
    """Root mean square distance of vectors (T, 3) from their mean."""
    return float(np.sqrt(np.square(values - values.mean(0)).sum(1).mean()))


def labelled_contact_statistics(episode: Episode, key: str) -> dict[str, float]:
    """``contact lag``: steps by which a vector sensor follows the labelled contact.

    Of a task without a contact sensor. NaN for readings that do not depend on contact.
    """
    if not has_labels_only(episode.task):
        return {}
    touched, free, present = in_contact(episode), free_motion(episode), episode.present(key)
    if touched.sum() < MIN_CONTACT or (free & present).sum() < MIN_STEPS:
        return {f"contact lag/{key}/all": np.nan}
    readings = episode.observations[key].astype(np.float64)
    size = np.linalg.norm(readings - np.median(readings[free & present], axis=0), axis=1)
    spread = np.log(size + 1e-2 * max(size.max(), 1e-9))
    return {f"contact lag/{key}/all": lag(spread[:, None], touched[:, None].astype(np.float64), present)[0]}


def wrench_statistics(episode: Episode) -> dict[str, float]:
    """Laws of a rigid contact: torque = lever x force + constant, and a force that opposes the hand's motion.

    A gain g of the force divides the lever by g; a sign inverts lever and motion; an exchange of axes breaks both laws.
    A bias of force or torque changes only the constant.
    """
    observations, at = episode.observations, in_contact(episode)
    values: dict[str, float] = {}
    if (readings := _force(episode)) is None:
        return values
    force = readings[at]
    if TORQUE in observations and observations[TORQUE].shape[1] == 3:
        torque = observations[TORQUE].astype(np.float64)[at]
        values[f"size/{TORQUE}/contact"] = _size(torque)
        residuals = {order: lever(force[:, order], torque) for order in permutations(range(3))}
        arm, rest = residuals.pop((0, 1, 2))
        values |= {f"lever/{FORCE} {axis}/contact": float(r) for axis, r in zip(AXES, arm, strict=True)}
        others = min(share for _, share in residuals.values())
        values[f"axes/{FORCE}/contact"] = float(np.log(max(others, 1e-6) / max(rest, 1e-6)))
    if HAND in observations:
        motion = np.gradient(observations[HAND].astype(np.float64), axis=0)[at]
        moves = np.linalg.norm(motion, axis=1) > MIN_MOTION
        if moves.sum() >= MIN_STEPS:
            length = np.linalg.norm(force, axis=1) * np.linalg.norm(motion, axis=1)
            cosine = (force * motion).sum(1) / np.maximum(length, 1e-12)
            values[f"direction/{FORCE}/contact"] = float(np.median(cosine[moves]))
    return values


def lever(force: Array, torque: Array) -> tuple[Array, float]:
    """(3,) m: least-squares lever r of ``torque = r x force + constant`` (T, 3), and the share of variance left."""
    f, t = force - force.mean(0), torque - torque.mean(0)
    # Normal equations of t = -[f]x r: sum([f]x' [f]x) r = sum(f x t).
    gram = np.square(f).sum() * np.eye(3) - f.T @ f
    arm = np.linalg.pinv(gram, rcond=1e-6) @ np.cross(f, t).sum(0)
    left = np.square(t - np.cross(arm, f)).sum() / max(np.square(t).sum(), 1e-12)
    return arm, float(left)


def commands_hand(task: Task) -> bool:
    """Whether the controls command the position (x, y, z) of a hand that is measured."""
    return task.observations.get(HAND) == (3,) and task.control_size >= CHANGE.stop


def contact_distance_statistics(episode: Episode, reference: Reference | None) -> dict[str, float]:
    """Distance of the measured hand from the labelled object in contact, beyond that of healthy contacts, m.

    ``contact distance``: its median, which an object of another size changes. ``contact distance error``: the median of
    its size, which labels or hand positions with an offset increase as well. Neither depends on images or networks.
    NaN for a hand that slides over the object (``STEADY``).
    """
    if reference is None or reference.contact is None or (moved := displacements_in_contact(episode)) is None:
        return {}
    if len(moved) < MIN_STEPS:
        return {}
    beyond = contact_residual(moved, reference.contact)
    middle = float(np.median(beyond))
    steady = np.median(np.abs(beyond - middle)) < STEADY * reference.contact[0]
    return {
        "contact distance/labels/contact": middle if steady else np.nan,
        "contact distance error/labels/contact": float(np.median(np.abs(beyond))) if steady else np.nan,
    }


def in_contact(episode: Episode) -> Mask:
    """(T,): steps with the contact flag or, without such a sensor, with labelled contact; all without either."""
    flag = contact_flag(episode)
    return np.ones(len(episode), dtype=bool) if flag is None else flag


def contact_flag(episode: Episode) -> Mask | None:
    """(T,): the contact flag or, without such a sensor, the labelled contact; None without either."""
    if CONTACT in episode.observations:
        return np.asarray(episode.observations[CONTACT][:, 0] > 0.5)
    return np.asarray(episode.contact, dtype=bool) if CONTACT in episode.task.covariates else None


def has_labels_only(task: Task) -> bool:
    """Whether contact is labelled, and no sensor measures it."""
    return CONTACT in task.covariates and CONTACT not in task.observations


def contact_changes(episode: Episode) -> int:
    """Number of changes of the contact flag; 0 without one."""
    return int(np.abs(np.diff(in_contact(episode).astype(int))).sum())


def free_motion(episode: Episode) -> Mask:
    """(T,): steps without ``contact_flag``, and their neighbours without it, since readings are means over a step."""
    flag = contact_flag(episode)
    touched = np.zeros(len(episode), dtype=bool) if flag is None else flag
    return np.convolve(touched, np.ones(3))[1:-1] == 0


def angle_channels(episode: Episode, key: str) -> list[int]:
    """Channels of a vector sensor that are angles in rad and wrap around in the episode; not of sensors of contact."""
    readings = episode.observations[key]
    if readings.ndim != 2 or key in (HAND, FORCE, TORQUE, CONTACT):
        return []
    present = episode.present(key)
    gaps = np.diff(np.flatnonzero(present))
    successive = gaps <= np.median(gaps) if len(gaps) else None  # an angle in bursts jumps between them
    channels = enumerate(readings[present].T)
    return [i for i, channel in channels if is_angle(channel) or is_angle(channel, successive)]


def vector_keys(episode: Episode) -> list[str]:
    """Observation keys of vectors (T, d) other than the contact flag and the hand position."""
    return [key for key, readings in episode.observations.items() if readings.ndim == 2 and key not in (CONTACT, HAND)]


def vector_statistics(episode: Episode) -> dict[str, float]:
    """Statistics of all vector sensors in an episode or a window."""
    values: dict[str, float] = {}
    for key in vector_keys(episode):
        values |= axis_statistics(episode, key)
        is_known = HAND in episode.observations and key in (FORCE, TORQUE)
        values |= {} if is_known else own_size_statistics(episode, key)
    if HAND in episode.observations:
        hand, present = episode.observations[HAND], episode.present(HAND)
        noise = noise_level(hand.astype(np.float64), present)
        values[f"position noise/{HAND}/all"] = float(np.sqrt(np.square(noise).mean()))
        if present.any():
            values[f"stuck/{HAND}/all"] = float(repeats(hand, episode.task.held_steps(HAND))[present].mean())
    return values | contact_statistics(episode) | size_statistics(episode)


def _moving(episode: Episode) -> Mask:
    """(T,): whether the measured hand or, without one, anything moves."""
    if HAND not in episode.observations:
        return np.ones(len(episode), dtype=bool)
    hand = episode.observations[HAND]
    return np.concatenate([[False], (hand[1:] != hand[:-1]).any(1)])


def saturated(values: Array) -> Mask:
    """(T,): readings at the largest magnitude, the smallest or the largest value, each if reached more than once.

    A single stretch of equal readings is a stuck axis, and so is a smallest or largest value to which they jump.
    """
    result, changes = np.zeros(len(values), dtype=bool), np.abs(np.diff(values))
    for i, series in enumerate((np.abs(values), values, -values) if len(values) else ()):
        at = series == series.max()
        if np.count_nonzero(at) < 2 or np.diff(at, prepend=False).sum() <= 2:  # most readings reach it once
            continue
        into, usual = changes[at[1:] & ~at[:-1]], np.median(changes[changes > 0.0])
        jumps = i > 0 and len(into) > 0 and float(np.median(into)) > JUMP * usual
        result |= at & (not jumps)
    return result


def axis_index(axis: str) -> int:
    """Index of an axis, from the part of its display name after the key."""
    return int(axis) if axis.isdecimal() else AXES.index(axis)
