"""Model of a vector sensor or of the controls: values that the labels lead to expect, from healthy episodes.

It shows what the readings of a sensor of unknown physics cannot show by themselves: channels that are inverted or
exchanged, a gain, a bias, and a delay behind the labels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Task
from beliefscope.inspect.statistics.reference_images import CONTACT
from beliefscope.inspect.statistics.signals import MAX_PAIRS, MIN_STEPS, Array, Mask, is_angle, wrapped

Indices = NDArray[np.intp]

CONTROL = "control"
"""Key of the model of the controls."""

FIRST_CHANGES = 2
"""First step with all features, which need two earlier ones."""

EXPLAINED = 0.5
"""Smallest share of the variance of a channel within episodes that its model explains in other episodes."""

SMALLEST_NOISE = 0.01
"""Smallest noise of a channel, relative to the standard deviation of its readings within episodes."""

RIDGE = 1e-3
"""Penalty of squared coefficients of standardised features, relative to the number of steps."""

MAX_STEPS = 20_000
"""Number of steps to which a model is fitted; of more, every second one and so on."""

MIN_EPISODES = 4
"""Smallest number of episodes of a model."""

DEGREES = {3: 4, 2: 12}
"""Degree of a polynomial of the state -> largest number of its components."""

DIGITS = 4
"""Significant digits of stored coefficients."""


@dataclass(frozen=True)
class ComparedReadings:
    """Readings and expected readings (T, A) of an episode, the steps (T,) that have both, and their model."""

    readings: Array
    expected: Array
    present: Mask
    model: ReadingModel

    def pairs(self, delay: int = 0) -> tuple[Array, Array]:
        """Readings (S, A) and the readings expected ``delay`` steps earlier, of at most ``MAX_PAIRS`` steps."""
        steps = np.flatnonzero(self.present)
        steps = steps[(steps - delay >= FIRST_CHANGES) & (steps - delay < len(self.present))]
        steps = steps[:: 1 + len(steps) // MAX_PAIRS]
        return self.readings[steps], self.expected[steps - delay]

    def errors(self, delay: int = 0) -> Array:
        """(2, A, A): mean square of reading i minus plus or minus expected reading j, of ``pairs``.

        Relative to the square of channel j's noise: about 1 if reading i is of channel j. NaN for too few steps.
        """
        readings, expected = self.pairs(delay)
        if len(readings) < MIN_STEPS:
            return np.full((2, readings.shape[1], readings.shape[1]), np.nan)
        signs = np.array([1.0, -1.0])[:, None, None, None]
        difference = readings[:, :, None] - signs * expected[:, None]  # (2, S, A, A)
        both = np.logical_and.outer(self.model.angles, self.model.angles)
        difference[:, :, both] = wrapped(difference[:, :, both])
        return np.asarray(np.square(difference / self.model.noise).mean(1))


@dataclass(frozen=True)
class ReadingModel:
    """Expected readings of one sensor, or expected controls.

    Attributes:
        key: observation key of the sensor, or ``CONTROL``.
        channels: indices of the A channels that the labels explain (``EXPLAINED``).
        coefficients: (F, A) in units of the readings by those of the ``features``.
        constants: (A,) in units of the readings.
        noise: (A,) standard deviations of the readings from the expected ones, in episodes to which it is not fitted.
        biases: (A,) standard deviations between these episodes of the mean of this noise, beyond those of its average.
        angles: (A,) whether a channel is an angle that wraps around, such as a heading or a bearing.
        limits: (2, n) smallest and largest true state, beyond which polynomials are constant.
    """

    key: str
    channels: tuple[int, ...]
    coefficients: Array
    constants: Array
    noise: Array
    biases: Array
    angles: tuple[bool, ...]
    limits: Array

    def to_json(self) -> dict[str, Any]:
        """JSON values."""

        def rounded(values: Array) -> list[float]:
            return [float(f"{value:.{DIGITS}g}") for value in values.tolist()]

        return {
            "key": self.key,
            "channels": list(self.channels),
            "coefficients": [rounded(row) for row in self.coefficients],
            "constants": rounded(self.constants),
            "noise": rounded(self.noise),
            "biases": rounded(self.biases),
            "angles": list(self.angles),
            "limits": [rounded(row) for row in self.limits],
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> ReadingModel:
        """Inverse of ``to_json``. Raises ValueError for arrays of different sizes."""
        channels = tuple(int(channel) for channel in value["channels"])
        names = ("coefficients", "constants", "noise", "biases", "limits")
        coefficients, constants, noise, biases, limits = (np.array(value[name], dtype=np.float64) for name in names)
        shapes = (*coefficients.shape[1:], *constants.shape, *noise.shape, *biases.shape, len(value["angles"]))
        if coefficients.ndim != 2 or shapes != (len(channels),) * 5 or limits.ndim != 2 or len(limits) != 2:
            raise ValueError(f"{len(channels)} channels, coefficients {coefficients.shape}, limits {limits.shape}")
        angles = tuple(map(bool, value["angles"]))
        return cls(str(value["key"]), channels, coefficients, constants, noise, biases, angles, limits)

    def compare(self, episode: Episode) -> ComparedReadings:
        """The readings of an episode beside the expected ones; angles are within half a turn of these.

        No step has both if the model has the features of another version.
        """
        readings, present = readings_of(episode, self.key)[:, self.channels], _steps(episode, self.key)
        inputs, _ = features(episode, self.limits)
        if inputs.shape[1] != len(self.coefficients):
            return ComparedReadings(readings, readings, np.zeros_like(present), self)
        expected = inputs @ self.coefficients + self.constants
        turning = np.array(self.angles)
        readings[:, turning] = (expected + wrapped(readings - expected))[:, turning]
        return ComparedReadings(readings, expected, present, self)


def fit_reading_models(episodes: Sequence[Episode], keys: Sequence[str]) -> tuple[ReadingModel, ...]:
    """Models of the vector sensors whose readings depend on the labels; none for too few labelled episodes.

    Each half of the episodes decides which channels the model of the other half explains.
    """
    episodes = [episode for episode in episodes if np.isfinite(episode.states).all()]
    if len(episodes) < MIN_EPISODES or not keys:
        return ()
    states = np.concatenate([episode.states for episode in episodes]).astype(np.float64)
    limits = np.stack([states.min(0), states.max(0)])
    inputs, (groups, *_) = zip(*(features(episode, limits) for episode in episodes), strict=True)
    result = []
    for key in keys:
        angles = [_centre_of(episodes, key, channel) for channel in range(readings_of(episodes[0], key).shape[1])]
        present = [np.flatnonzero(_steps(episode, key)) for episode in episodes]
        stride = 1 + sum(map(len, present)) // MAX_STEPS
        rows = [
            (x[steps[::stride]], _around(episode, readings_of(episode, key), angles)[steps[::stride]])
            for x, episode, steps in zip(inputs, episodes, present, strict=True)
            if len(steps) // stride >= MIN_STEPS
        ]
        if len(rows) < MIN_EPISODES:
            continue
        mean_x, mean_y = (np.mean([row[i].mean(0) for row in rows], axis=0) for i in (0, 1))
        rows = [(x - mean_x, y - mean_y) for x, y in rows]
        coefficients, errors = _best_of(groups, rows)
        count = np.array([len(y) for _, y in rows], dtype=np.float64)
        left, total = (np.asarray(sum(len(y) * y.var(0) for y in parts)) for parts in (errors, [y for _, y in rows]))
        channels = np.flatnonzero(left < (1.0 - EXPLAINED) * total)
        if len(channels):
            coefficients = coefficients[:, channels]
            constants = mean_y[channels] - mean_x @ coefficients
            variance = np.maximum(left, SMALLEST_NOISE**2 * total)[channels] / count.sum()
            between = np.var([error.mean(0)[channels] for error in errors], axis=0) - variance * (1.0 / count).mean()
            explained = tuple(channels.tolist())
            turning = tuple(angles[channel] is not None for channel in explained)
            noise, biases = np.sqrt(variance), np.sqrt(np.maximum(between, 0.0))
            result.append(ReadingModel(key, explained, coefficients, constants, noise, biases, turning, limits))
    return tuple(result)


def readings_of(episode: Episode, key: str) -> Array:
    """(T, d) readings of a vector sensor, or the controls."""
    return (episode.controls if key == CONTROL else episode.observations[key]).astype(np.float64)


def _best_of(groups: Sequence[Indices], rows: Sequence[tuple[Array, Array]]) -> tuple[Array, list[Array]]:
    """(F, d) coefficients of one group of features only, that which leaves the least of each channel in other episodes.

    Further features, fitted to noise, would change the expected readings from step to step. Also returns the errors
    (S, d) of each episode, in any order, from coefficients that are fitted to half of the others.
    """
    results = []
    for group in groups:
        x = [(inputs[:, group], readings) for inputs, readings in rows]
        errors = [*_errors(x[1::2], _ridge(x[::2])), *_errors(x[::2], _ridge(x[1::2]))]
        coefficients = np.zeros((rows[0][0].shape[1], rows[0][1].shape[1]))
        coefficients[group] = _ridge(x)
        results.append((sum(len(e) * e.var(0) for e in errors), coefficients, errors))
    best = np.argmin([left for left, _, _ in results], axis=0)  # (d,)
    columns = np.arange(len(best))
    chosen = np.stack([coefficients for _, coefficients, _ in results])[best, :, columns].T
    errors = [np.stack(parts)[best, :, columns].T for parts in zip(*(errors for _, _, errors in results), strict=True)]
    return chosen, errors


def _ridge(rows: Sequence[tuple[Array, Array]]) -> Array:
    """(F, d) coefficients of ridge regression, of pairs of features (S, F) and readings (S, d)."""
    x, y = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    scale = x.std(0)
    scale = np.where(scale > 1e-9, scale, np.inf)
    x = x / scale
    return np.asarray(np.linalg.solve(x.T @ x + RIDGE * len(x) * np.eye(x.shape[1]), x.T @ y) / scale[:, None])


def _errors(rows: Sequence[tuple[Array, Array]], coefficients: Array) -> list[Array]:
    """What the coefficients leave of the readings (S, d) of each episode."""
    return [y - x @ coefficients for x, y in rows]


def _centre_of(episodes: Sequence[Episode], key: str, channel: int) -> tuple[Array, float] | None:
    """What a channel that wraps around is near, modulo a turn: coefficients (n,) of the state, and a constant.

    That is the wrapping component, or its opposite, that varies most like it, such as the heading; zero coefficients
    if its mean direction is closer. None for other channels.
    """
    task = episodes[0].task
    readings = [readings_of(episode, key)[_steps(episode, key), channel] for episode in episodes]
    if not any(map(is_angle, readings)):
        return None
    states = np.concatenate([e.states[_steps(e, key)] for e in episodes]).astype(np.float64)
    values = np.concatenate(readings)
    unit = np.eye(states.shape[1])
    candidates = [0.0 * unit[0], *(s * unit[i] for i, c in enumerate(task.components) if c.wraps for s in (1.0, -1.0))]
    directions = [np.exp(1j * (values - states @ candidate)).mean() for candidate in candidates]
    best = int(np.abs(directions).argmax())
    return candidates[best], float(np.angle(directions[best]))


def _around(episode: Episode, readings: Array, centres: Sequence[tuple[Array, float] | None]) -> Array:
    """Readings (T, d): those of angles are continuous where what they are near is (``_centre_of``)."""
    states, result = episode.states.astype(np.float64), readings.copy()
    for i, component in enumerate(episode.task.components):
        if component.wraps:
            states[:, i] = np.unwrap(states[:, i])
    for channel, centre in enumerate(centres):
        if centre is not None:
            angle = states @ centre[0] + centre[1]
            result[:, channel] = angle + wrapped(readings[:, channel] - angle)
    return result


def _steps(episode: Episode, key: str) -> Mask:
    """(T,): steps with a reading and all features."""
    present = np.ones(len(episode), dtype=bool) if key == CONTROL else episode.present(key)
    return np.asarray(present & (np.arange(len(episode)) >= FIRST_CHANGES))


def features(episode: Episode, limits: Array) -> tuple[Array, list[Indices]]:
    """(T, F): the state, its first and second changes by step, all in the body frame, and all of them in contact.

    Angles that wrap have their cosine and sine as well, rotations are their matrices. Changes are zero where they are
    unknown, at the first two steps. Polynomials of the state within its limits (2, n) are further features: they are
    bounded. Also returns the groups of features among which the model of a channel chooses, as their indices.
    """
    task, states = episode.task, episode.states.astype(np.float64)
    change, second = np.zeros((2, *states.shape))
    change[1:] = task.difference(states[1:], states[:-1])
    second[2:] = change[2:] - change[1:-1]
    others, frames = _values(task, states)
    vectors = np.concatenate([others, change, second], axis=1)
    in_frames = (frames[:, :, None] * vectors[:, None]).reshape(len(states), -1)
    powers = _polynomials(task, states, limits)
    linear = np.concatenate([others, frames, change, second, in_frames], axis=1)
    all_ = np.concatenate([linear, powers], axis=1)
    if CONTACT in task.covariates:
        contact = np.asarray(episode.contact, dtype=np.float64)[:, None]
        all_ = np.concatenate([all_, contact, contact * linear], axis=1)
    index, state = np.arange(all_.shape[1]), others.shape[1] + frames.shape[1]
    first, last = linear.shape[1], linear.shape[1] + powers.shape[1]
    groups: list[Indices] = [index[:state], index[: state + 2 * states.shape[1]], np.delete(index, np.s_[first:last])]
    if powers.shape[1]:
        groups += [np.concatenate([index[:state], index[first:last]]), index]
    return all_, groups


def _polynomials(task: Task, states: Array, limits: Array) -> Array:
    """(T, P): monomials of the second and third degree of components that neither wrap around nor rotate.

    The components are scaled from their limits (2, n) to [-1, 1], and constant beyond.
    """
    excluded = {i for i, c in enumerate(task.components) if c.wraps}
    excluded |= {i for at in task.rotations for i in range(at.start, at.stop)}
    chosen = [i for i in range(states.shape[1]) if i not in excluded]
    low, high = limits[:, chosen]
    scaled = ((2.0 * states[:, chosen] - high - low) / np.maximum(high - low, 1e-12)).clip(-1.0, 1.0)
    degrees = [degree for degree, most in DEGREES.items() if len(chosen) <= most]
    factors = [f for degree in degrees for f in combinations_with_replacement(range(len(chosen)), degree)]
    return np.array([scaled[:, f].prod(1) for f in factors]).T.reshape(len(states), -1)


def _values(task: Task, states: Array) -> tuple[Array, Array]:
    """State components (T, V) that do not jump, and those (T, R) that turn vectors of the world into the body frame.

    Angles that wrap around are among both, unwrapped.
    """
    turning = {i for i, c in enumerate(task.components) if c.wraps}
    rotated = {i for at in task.rotations for i in range(at.start, at.stop)}
    others = [np.unwrap(x, axis=0) if i in turning else x for i, x in enumerate(states.T) if i not in rotated]
    frames = [f(states[:, i]) for i in turning for f in (np.cos, np.sin)]
    if task.rotations:
        from scipy.spatial.transform import Rotation  # takes most of a second

        frames += [x for at in task.rotations for x in Rotation.from_rotvec(states[:, at]).as_matrix().reshape(-1, 9).T]
    return np.array(others).T.reshape(len(states), -1), np.array(frames).T.reshape(len(states), -1)
