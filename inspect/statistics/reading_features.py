"""Features of the labels from which the readings of a sensor are expected."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Task
from beliefscope.inspect.statistics.signals import Array

Indices = NDArray[np.intp]

CONTROL = "control"
"""Key of the controls in the place of a sensor's."""

FIRST_CHANGES = 2
"""First step with all features, which need two earlier ones."""

GRID = 15
"""Number of places along each axis among which a landmark is searched."""

ZOOMS, ZOOM = 7, 0.35
"""Number of searches, and size of each relative to the one before; the first is twice as large as the positions."""

DEGREES = (2, 3)
"""Degrees of polynomials in the state and the controls."""

MAX_FLAGS = 3
"""Largest number of boolean covariates whose steps have features of their own."""

MAX_TERMS = 200
"""Largest number of terms of a polynomial."""

SEARCHED = 400
"""Largest number of positions that the search compares."""


def features(episode: Episode, with_controls: bool) -> tuple[Array, list[Indices]]:
    """(T, F): the state, its first and second changes by step, all in the body frame, and all of them with each flag.

    Flags are contact and other boolean covariates, such as a firm grip, but not those of absent readings.

    Angles that wrap have their cosine and sine as well, rotations are their matrices. Angles among the controls, such
    as a measured heading, also turn vectors into the body frame. Changes are zero where they are unknown, at the first
    two steps. Also returns the groups of features among which the model of a channel chooses, as their indices.
    """
    task, states = episode.task, episode.states.astype(np.float64)
    change, second = np.zeros((2, *states.shape))
    change[1:] = task.difference(states[1:], states[:-1])
    second[2:] = change[2:] - change[1:-1]
    others, frames = _values(episode, with_controls)
    vectors = np.concatenate([others, change, second], axis=1)
    in_frames = (frames[:, :, None] * vectors[:, None]).reshape(len(states), -1)
    all_ = np.concatenate([others, frames, change, second, in_frames], axis=1)
    flags = [np.nan_to_num(episode.covariate(name).astype(np.float64))[:, None] for name in _flags(task)]
    all_ = np.concatenate([all_, *(part for flag in flags for part in (flag, flag * all_))], axis=1)
    index, state = np.arange(all_.shape[1]), others.shape[1] + frames.shape[1]
    return all_, [index[:state], index[: state + 2 * states.shape[1]], index]


def _flags(task: Task) -> list[str]:
    """Names of boolean covariates, at most ``MAX_FLAGS``, without the masks of sensors."""
    flags = (name for name, covariate in task.covariates.items() if covariate.kind == "boolean")
    return [name for name in flags if name not in task.masks.values()][:MAX_FLAGS]


def monomials(episode: Episode, with_controls: bool, degree: int) -> Array:
    """(T, F): the state at each step, the controls, and all products of up to ``degree`` of them; (T, 0) of too many.

    Angles that wrap are their cosine and sine, rotations their matrices.
    """
    task = episode.task
    others, frames = _values(episode, with_controls)
    turned = {i for at in task.rotations for i in range(at.start, at.stop)}
    wraps = np.array([c.wraps for i, c in enumerate(task.components) if i not in turned], dtype=bool)
    plain = [i for i in range(task.control_size) if with_controls and not task.channel(CONTROL, i).wraps]
    controls = episode.controls[:, plain].astype(np.float64)
    values = np.concatenate([others[:, ~wraps], frames, controls], axis=1)
    if math.comb(values.shape[1] + degree, degree) > MAX_TERMS:
        return values[:, :0]
    return products(values, degree)


def products(values: Array, degree: int) -> Array:
    """(T, F): all products of up to ``degree`` of V values (T, V), which are the first columns."""
    count = values.shape[1]
    terms = [values]
    last = np.arange(count)  # of each product, its last factor: the next one is not before it
    for _ in range(degree - 1):
        before, factor = np.nonzero(last[:, None] <= np.arange(count))
        terms.append(terms[-1][:, before] * values[:, factor])
        last = factor
    return np.concatenate(terms, axis=1)


def positions(task: Task, states: Array) -> Array:
    """(T, p): the two components of the map, and a third one in their unit; (T, 0) without two positions."""
    turning = {*task.angles, *(i for at in task.rotations for i in range(at.start, at.stop))}
    chosen = [i for i in task.map_indices if i not in turning]
    units = {task.components[i].unit for i in chosen}
    chosen += [i for i, c in enumerate(task.components) if c.unit in units and i not in (*chosen, *turning)][:1]
    return states[:, chosen if len(units) == 1 and len(chosen) > 1 else []]


def landmark_features(places: Array, landmark: Array) -> Array:
    """(..., T, 3) distance of positions (T, p) to landmarks (..., p), and cosine and sine of their direction."""
    relative = landmark[..., None, :] - places
    squares = np.square(relative)
    distance, plane = (np.sqrt(part.sum(-1, keepdims=True)) for part in (squares, squares[..., :2]))
    return np.concatenate([distance, relative[..., :2] / np.maximum(plane, 1e-12)], axis=-1)


def find_landmark(places: Array, targets: Array) -> Array:
    """(p,) the place whose distance from the positions (S, p), or whose direction, predicts the targets best.

    A search on a grid, and on finer ones around the best place.

    Args:
        targets: (S, 1) readings, or (S, 2) cosine and sine of an angle.
    """
    chosen = np.s_[:: 1 + len(places) // SEARCHED]
    places, targets = places[chosen], targets[chosen]
    middle, size = places.mean(0), 2.0 * np.ptp(places, axis=0)
    for _ in range(ZOOMS):
        axes = [m + s * np.linspace(-0.5, 0.5, GRID) for m, s in zip(middle, size, strict=True)]
        agreement = _agreement([axis[:, None] - x for axis, x in zip(axes, places.T, strict=True)], targets)
        best = np.unravel_index(agreement.argmax(), agreement.shape)
        middle = np.array([axis[i] for axis, i in zip(axes, best, strict=True)])
        size = ZOOM * size
    return middle


def _agreement(offsets: Sequence[Array], targets: Array) -> Array:
    """Squared correlation of readings with distances, or of angles with directions, for each place of a grid.

    Args:
        offsets: p arrays (G, S) of the places along each axis from the positions.

    Returns: (G, ..., G) with p axes; the third one has the size 1 for directions, which do not depend on it.
    """
    if targets.shape[1] > 1:  # directions may have the opposite sign
        direction = offsets[0][:, None] + 1j * offsets[1]
        direction /= np.maximum(np.abs(direction), 1e-12)
        angle = (targets[:, 0] + 1j * targets[:, 1]) / len(targets)
        plane = np.maximum(np.abs(direction @ angle), np.abs(direction @ angle.conj()))
        return np.asarray(plane.reshape(*plane.shape, *(1,) * (len(offsets) - 2)))
    squared, y = np.square(offsets[0]), targets[:, 0] - targets.mean()
    for offset in offsets[1:]:
        squared = squared[..., None, :] + np.square(offset)
    distance = np.sqrt(squared)
    distance -= distance.mean(-1, keepdims=True)
    power = np.einsum("...s,...s->...", distance, distance) * np.square(y).sum()
    return np.asarray(np.square(distance @ y) / np.maximum(power, 1e-24))


def _values(episode: Episode, with_controls: bool) -> tuple[Array, Array]:
    """State components (T, V) that do not jump, and those (T, R) that turn vectors of the world into the body frame.

    Angles that wrap around are among both, unwrapped; those of controls are among the latter only.
    """
    task, states = episode.task, episode.states.astype(np.float64)
    turning = {i for i, c in enumerate(task.components) if c.wraps}
    rotated = {i for at in task.rotations for i in range(at.start, at.stop)}
    others = [np.unwrap(x, axis=0) if i in turning else x for i, x in enumerate(states.T) if i not in rotated]
    functions: tuple[Callable[[Array], Array], ...] = (np.cos, np.sin)
    angles = [states[:, i] for i in turning]
    if with_controls:
        controls = episode.controls.T.astype(np.float64)
        angles += [x for i, x in enumerate(controls) if task.channel(CONTROL, i).wraps]
    frames = [f(x) for x in angles for f in functions]
    if task.rotations:
        from scipy.spatial.transform import Rotation  # takes most of a second

        frames += [x for at in task.rotations for x in Rotation.from_rotvec(states[:, at]).as_matrix().reshape(-1, 9).T]
    return np.array(others).T.reshape(len(states), -1), np.array(frames).T.reshape(len(states), -1)
