"""Model of a vector sensor or of the controls: values that the labels lead to expect, from healthy episodes.

It shows what the readings of a sensor of unknown physics cannot show by themselves: channels that are inverted or
exchanged, a gain, a bias, and a delay behind the labels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.inspect.statistics.reading_features import (
    FIRST_CHANGES,
    Indices,
    features,
    find_landmark,
    landmark_features,
    positions,
)
from beliefscope.inspect.statistics.signals import MAX_PAIRS, MIN_STEPS, Array, Mask, is_angle, wrapped

CONTROL = "control"
"""Key of the model of the controls."""

EXPLAINED = 0.5
"""Smallest share of the variance of a channel within episodes that its model explains in other episodes."""

SMALLEST_NOISE = 0.01
"""Smallest noise of a channel, relative to the standard deviation of its readings within episodes."""

RIDGE = 1e-3
"""Penalty of squared coefficients of standardised features, relative to the number of steps."""

CLOSER = 0.8
"""Largest share of the variance that a landmark leaves of what other features leave."""

MAX_STEPS = 20_000
"""Number of steps to which a model is fitted; of more, every second one and so on."""

MIN_EPISODES = 4
"""Smallest number of episodes of a model."""

DIGITS = 8
"""Significant digits of stored coefficients."""


@dataclass(frozen=True)
class ComparedReadings:
    """Readings and expected readings (T, A) of an episode, the steps (T,) that have both, and their model.

    Readings of angles are within half a turn of the expected ones.
    """

    measured: Array
    expected: Array
    present: Mask
    model: ReadingModel

    @property
    def readings(self) -> Array:
        near = self.expected + wrapped(self.measured - self.expected)
        return np.where(self.model.is_angle, near, self.measured)

    def pairs(self, delay: int = 0) -> tuple[Array, Array]:
        """Readings (S, A) and the readings expected ``delay`` steps earlier, of at most ``MAX_PAIRS`` steps."""
        steps = self._steps(delay)
        return self.readings[steps], self.expected[steps - delay]

    def _steps(self, delay: int) -> Indices:
        steps = np.flatnonzero(self.present)
        steps = steps[(steps - delay >= FIRST_CHANGES) & (steps - delay < len(self.present))]
        return steps[:: 1 + len(steps) // MAX_PAIRS]

    def errors(self, delay: int = 0) -> Array:
        """(2, A, A): mean square of reading i minus plus or minus expected reading j, of ``pairs``.

        Relative to the square of channel j's noise: about 1 if reading i is of channel j. NaN for too few steps.
        """
        steps = self._steps(delay)
        readings, expected = self.measured[steps], self.expected[steps - delay]
        if len(readings) < MIN_STEPS:
            return np.full((2, readings.shape[1], readings.shape[1]), np.nan)
        signs = np.array([1.0, -1.0])[:, None, None, None]
        difference = readings[:, :, None] - signs * expected[:, None]  # (2, S, A, A)
        difference = np.where(self.model.is_angle, wrapped(difference), difference)
        return np.asarray(np.square(difference / self.model.noise).mean(1))


@dataclass(frozen=True)
class ChannelModel:
    """Expected readings of one channel: ``w x + c`` of the features x.

    Of an angle that wraps around, ``h x' + atan2(w[1] x + c[1], w[0] x + c[0])``, where h turns it with a heading.

    Attributes:
        index: of the channel.
        coefficients: (F, 1), or (F, 2) of an angle, in units of the readings by those of the ``features``, or (3, 1)
            and (3, 2) by those of a landmark.
        constants: (1,) or (2,).
        heading: (n,) h, coefficients of the state x': 1 or -1 for one component that wraps around, or none; not used
            for channels that are no angles.
        landmark: (p,) position of the landmark whose distance or direction is measured; (0,) for other features.
        noise: standard deviation of the readings from the expected ones, in episodes to which it is not fitted.
        bias: standard deviation between these episodes of the mean of this noise, beyond that of its average.
    """

    index: int
    coefficients: Array
    constants: Array
    heading: Array
    landmark: Array
    noise: float
    bias: float

    @property
    def is_angle(self) -> bool:
        return len(self.constants) > 1

    def expected(self, inputs: Array, states: Array, places: Array) -> Array:
        """(T,) from features (T, F), states (T, n) and positions (T, p); angles are continuous."""
        own = landmark_features(places, self.landmark) if len(self.landmark) else inputs
        columns = own @ self.coefficients + self.constants
        return np.unwrap(_angle(columns, states, self.heading)) if self.is_angle else columns[:, 0]

    def to_json(self) -> dict[str, Any]:
        """JSON values."""

        def rounded(values: Array) -> list[float]:
            return [float(f"{value:.{DIGITS}g}") for value in values.tolist()]

        return {
            "index": self.index,
            "coefficients": [rounded(row) for row in self.coefficients.T],
            "constants": rounded(self.constants),
            "heading": rounded(self.heading),
            "landmark": rounded(self.landmark),
            "noise": float(f"{self.noise:.{DIGITS}g}"),
            "bias": float(f"{self.bias:.{DIGITS}g}"),
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> ChannelModel:
        """Inverse of ``to_json``. Raises ValueError for arrays of different sizes."""
        names = ("coefficients", "constants", "heading", "landmark")
        coefficients, constants, heading, landmark = (np.array(value[name], dtype=np.float64) for name in names)
        if coefficients.ndim != 2 or len(coefficients) not in (1, 2) or constants.shape != (len(coefficients),):
            raise ValueError(f"coefficients {coefficients.shape}, constants {constants.shape}")
        noise, bias = float(value["noise"]), float(value["bias"])
        return cls(int(value["index"]), coefficients.T, constants, heading, landmark, noise, bias)


@dataclass(frozen=True)
class ReadingModel:
    """Expected readings of one sensor, or expected controls.

    Attributes:
        key: observation key of the sensor, or ``CONTROL``.
        of_channels: models of the A channels that the labels explain (``EXPLAINED``).
    """

    key: str
    of_channels: tuple[ChannelModel, ...]

    @property
    def channels(self) -> tuple[int, ...]:
        """Indices of the A channels."""
        return tuple(model.index for model in self.of_channels)

    @property
    def noise(self) -> Array:
        """(A,) standard deviations of the readings from the expected ones."""
        return np.array([model.noise for model in self.of_channels])

    @property
    def biases(self) -> Array:
        """(A,) standard deviations between episodes of the mean noise."""
        return np.array([model.bias for model in self.of_channels])

    @property
    def is_angle(self) -> Mask:
        """(A,): channels that are angles which wrap around."""
        return np.array([model.is_angle for model in self.of_channels])

    def with_noise_of(self, other: ReadingModel) -> ReadingModel:
        """The model with the noise of another one of the same channels, in which its errors then are."""
        pairs = zip(self.of_channels, other.of_channels, strict=True)
        return replace(self, of_channels=tuple(replace(own, noise=its.noise) for own, its in pairs))

    def to_json(self) -> dict[str, Any]:
        """JSON values."""
        return {"key": self.key, "of_channels": [model.to_json() for model in self.of_channels]}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> ReadingModel:
        """Inverse of ``to_json``. Raises ValueError for arrays of different sizes."""
        return cls(str(value["key"]), tuple(map(ChannelModel.from_json, value["of_channels"])))

    def is_complete(self, episode: Episode) -> bool:
        """Whether all channels of the sensor have models, of the state at one step and neither changes nor contact."""
        _, (state, *_) = features(episode)
        others = (np.delete(m.coefficients, state, axis=0) for m in self.of_channels if not len(m.landmark))
        count = readings_of(episode, self.key).shape[1]
        return len(self.of_channels) == count and not any(values.any() for values in others)

    def expected(self, episode: Episode) -> Array | None:
        """(T, A) expected readings of the states of an episode; None if the model has other features."""
        inputs, _ = features(episode)
        if any(len(m.coefficients) != inputs.shape[1] for m in self.of_channels if not len(m.landmark)):
            return None
        states = states_of(episode)
        places = positions(episode.task, states)
        return np.stack([model.expected(inputs, states, places) for model in self.of_channels], axis=1)

    def compare(self, episode: Episode) -> ComparedReadings:
        """The readings of an episode beside the expected ones.

        No step has both if the model has the features of another version.
        """
        readings, present = readings_of(episode, self.key)[:, self.channels], _steps(episode, self.key)
        if (expected := self.expected(episode)) is None:
            return ComparedReadings(readings, readings, np.zeros_like(present), self)
        return ComparedReadings(readings, expected, present, self)


def fit_reading_models(episodes: Sequence[Episode], keys: Sequence[str]) -> tuple[ReadingModel, ...]:
    """Models of the vector sensors whose readings depend on the labels; none for too few labelled episodes.

    Each half of the episodes decides which channels the model of the other half explains, and by which features.
    """
    episodes = [episode for episode in episodes if np.isfinite(episode.states).all()]
    if len(episodes) < MIN_EPISODES or not keys:
        return ()
    inputs, (groups, *_) = zip(*(features(episode) for episode in episodes), strict=True)
    result = []
    for key in keys:
        present = [np.flatnonzero(_steps(episode, key)) for episode in episodes]
        stride = 1 + sum(map(len, present)) // MAX_STEPS
        rows = [
            Rows(episode, key, x, steps[::stride])
            for x, episode, steps in zip(inputs, episodes, present, strict=True)
            if len(steps) // stride >= MIN_STEPS
        ]
        if len(rows) >= MIN_EPISODES and (models := _fit(rows, groups, _options(episodes, key))):
            result.append(ReadingModel(key, models))
    return tuple(result)


def readings_of(episode: Episode, key: str) -> Array:
    """(T, d) readings of a vector sensor, or the controls."""
    return (episode.controls if key == CONTROL else episode.observations[key]).astype(np.float64)


def states_of(episode: Episode) -> Array:
    """(T, n) true states in double precision."""
    return episode.states.astype(np.float64)


class Rows:
    """Some steps of an episode.

    Attributes:
        features: (S, F). readings: (S, d). states: (S, n). places: (S, p) positions.
    """

    def __init__(self, episode: Episode, key: str, inputs: Array, steps: Indices) -> None:
        self.features, self.readings = inputs[steps], readings_of(episode, key)[steps]
        self.states = states_of(episode)[steps]
        self.places = positions(episode.task, self.states)


@dataclass(frozen=True)
class Option:
    """A way to expect a channel: its heading (n,), and its place among the columns that are fitted."""

    channel: int
    heading: Array
    columns: slice

    @property
    def is_angle(self) -> bool:
        return self.columns.stop - self.columns.start > 1

    def targets(self, rows: Rows) -> Array:
        """(S, 1) readings, or (S, 2) cosine and sine of an angle without the heading."""
        readings = rows.readings[:, self.channel]
        if not self.is_angle:
            return readings[:, None]
        angle = readings - rows.states @ self.heading
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def errors(self, rows: Rows, predicted: Array) -> Array:
        """(S,) readings minus those of predicted columns (S, C)."""
        columns, readings = predicted[:, self.columns], rows.readings[:, self.channel]
        if not self.is_angle:
            return readings - columns[:, 0]
        return wrapped(readings - _angle(columns, rows.states, self.heading))

    def fitted(
        self, rows: Sequence[Rows], coefficients: Array, constants: Array, predicted: Sequence[Array], landmark: Array
    ) -> _Fitted:
        """The part of a fit to all columns that is about the channel. predicted: (S, C) of each episode."""
        errors = [self.errors(row, columns) for row, columns in zip(rows, predicted, strict=True)]
        left = float(sum(len(e) * e.var() for e in errors))
        return _Fitted(self, coefficients[:, self.columns], constants[self.columns], landmark, errors, left)

    def variation(self, rows: Rows) -> float:
        """Sum of squared distances of the readings from their mean, or of angles from their mean direction."""
        readings = rows.readings[:, self.channel]
        if not self.is_angle:
            return float(len(readings) * readings.var())
        return float(np.square(wrapped(readings - np.angle(np.exp(1j * readings).mean()))).sum())


@dataclass(frozen=True)
class _Fitted:
    """A fit to a channel: what it leaves of the readings (S,) of each episode, and the sum of their squares."""

    option: Option
    coefficients: Array
    constants: Array
    landmark: Array
    errors: Sequence[Array]
    left: float


def _options(episodes: Sequence[Episode], key: str) -> list[Option]:
    """Channels, and angles that wrap around with each such component, against it and without one."""
    components, options, start = episodes[0].task.components, [], 0
    unit = np.eye(len(components))
    headings = [0.0 * unit[0], *(s * unit[i] for i, c in enumerate(components) if c.wraps for s in (1.0, -1.0))]
    series = [readings_of(episode, key)[_steps(episode, key)] for episode in episodes]
    for channel in range(series[0].shape[1]):
        turns = any(is_angle(readings[:, channel]) for readings in series)
        for heading in headings if turns else headings[:1]:
            options.append(Option(channel, heading, slice(start, start + (2 if turns else 1))))
            start = options[-1].columns.stop
    return options


def _fit(rows: Sequence[Rows], groups: Sequence[Indices], options: Sequence[Option]) -> tuple[ChannelModel, ...]:
    """The channels that the labels explain, each by the option and the features that leave the least of it.

    Further features, fitted to noise, would change the expected readings from step to step.
    """
    y = [np.concatenate([option.targets(row) for option in options], axis=1) for row in rows]
    fits = _ridges([row.features for row in rows], y, groups)
    best: dict[int, _Fitted] = {}
    for coefficients, constants, predicted in fits:
        for option in options:
            fitted = option.fitted(rows, coefficients, constants, predicted, np.empty(0))
            if option.channel not in best or fitted.left < best[option.channel].left:
                best[option.channel] = fitted
    steps = np.array([len(row.readings) for row in rows], dtype=np.float64)
    for option in options if rows[0].places.shape[1] else ():
        left = best[option.channel].left
        targets = [targets[:, option.columns] for targets in y]
        landmark = find_landmark(np.concatenate([row.places for row in rows]), np.concatenate(targets))
        alone = Option(option.channel, option.heading, slice(0, targets[0].shape[1]))
        inputs = [landmark_features(row.places, landmark) for row in rows]
        (fit,) = _ridges(inputs, targets, [np.arange(3)[1 if option.is_angle else 0 : 3 if option.is_angle else 1]])
        if (fitted := alone.fitted(rows, *fit, landmark)).left < CLOSER * left:
            best[option.channel] = fitted
    models = []
    for channel, fitted in best.items():
        total = sum(fitted.option.variation(row) for row in rows)
        if fitted.left >= (1.0 - EXPLAINED) * total:
            continue
        variance = max(fitted.left, SMALLEST_NOISE**2 * total) / steps.sum()
        between = np.var([error.mean() for error in fitted.errors]) - variance * (1.0 / steps).mean()
        noise, bias = float(np.sqrt(variance)), float(np.sqrt(max(between, 0.0)))
        heading, landmark = fitted.option.heading, fitted.landmark
        models.append(ChannelModel(channel, fitted.coefficients, fitted.constants, heading, landmark, noise, bias))
    return tuple(models)


def _ridges(
    x: Sequence[Array], y: Sequence[Array], groups: Sequence[Indices]
) -> list[tuple[Array, Array, list[Array]]]:
    """Ridge regression of columns (S, C) on each group of the features (S, F) of several episodes.

    Returns coefficients (F, C), constants (C,), and the predictions (S, C) for each episode, from coefficients that are
    fitted to half of the others.
    """
    mean_x, mean_y = (np.mean([values.mean(0) for values in parts], axis=0) for parts in (x, y))
    deviation = np.concatenate(x).std(0)
    scale = np.where(deviation > 1e-9, deviation, np.inf)
    x = [(inputs - mean_x) / scale for inputs in x]
    halves = [_moments(x[i::2], [targets - mean_y for targets in y[i::2]]) for i in (0, 1)]
    (gram, products, count), (other_gram, other_products, other_count) = halves
    both = gram + other_gram, products + other_products, count + other_count
    result = []
    for group in groups:
        by_half = [_ridge(halves[i], group) for i in (1, 0)]
        predicted = [inputs[:, group] @ by_half[i % 2][group] + mean_y for i, inputs in enumerate(x)]
        coefficients = _ridge(both, group) / scale[:, None]
        result.append((coefficients, mean_y - mean_x @ coefficients, predicted))
    return result


def _moments(x: Sequence[Array], y: Sequence[Array]) -> tuple[Array, Array, int]:
    """Sums over the steps of several episodes: ``x' x`` (F, F), ``x' y`` (F, C) and their number."""
    inputs, targets = np.concatenate(x), np.concatenate(y)
    return inputs.T @ inputs, inputs.T @ targets, len(inputs)


def _ridge(moments: tuple[Array, Array, int], group: Indices) -> Array:
    """(F, C) coefficients of ridge regression on a group of features, from ``_moments``; zero for others."""
    gram, products, steps = moments
    result = np.zeros_like(products)
    penalised = gram[np.ix_(group, group)] + RIDGE * steps * np.eye(len(group))
    result[group] = np.linalg.solve(penalised, products[group])
    return result


def _angle(columns: Array, states: Array, heading: Array) -> Array:
    """(T,) angles whose cosine and sine, without the heading (n,), have the directions of columns (T, 2)."""
    return np.asarray(np.arctan2(columns[:, 1], columns[:, 0]) + states @ heading)


def _steps(episode: Episode, key: str) -> Mask:
    """(T,): steps with a reading and all features."""
    present = np.ones(len(episode), dtype=bool) if key == CONTROL else episode.present(key)
    return np.asarray(present & (np.arange(len(episode)) >= FIRST_CHANGES))
