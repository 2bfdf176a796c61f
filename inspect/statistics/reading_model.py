"""Model of a sensor or of the controls: values that the labels lead to expect, from healthy episodes.

It shows what the readings of a sensor of unknown physics cannot show by themselves: channels that are inverted or
exchanged, a gain, a bias, and a delay behind the labels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.inspect.statistics.array_channels import reading_channels
from beliefscope.inspect.statistics.reading_features import (
    CONTROL,
    FIRST_CHANGES,
    Indices,
    features,
    landmark_features,
    monomials,
    positions,
    products,
)
from beliefscope.inspect.statistics.signals import (
    MAX_PAIRS,
    MIN_STEPS,
    Array,
    Mask,
    isolated,
    significant,
    wrapped,
)

DIGITS = 8
"""Significant digits of stored coefficients."""

EXTRAPOLATED = 1.0
"""Largest part of expected readings that is due to features outside of the limits, in standard deviations of the noise.
"""


@dataclass(frozen=True)
class ComparedReadings:
    """Readings and expected readings (T, A) of an episode, the steps (T,) that have both, and their model.

    Readings of angles are within half a turn of the expected ones. outliers: (T,) steps with readings that are not
    compared, since they are isolated, as some of the record are.
    """

    measured: Array
    expected: Array
    present: Mask
    model: ReadingModel
    outliers: Mask

    @property
    def readings(self) -> Array:
        near = self.expected + wrapped(self.measured - self.expected)
        return np.where(self.model.is_angle, near, self.measured)

    @property
    def known(self) -> Mask:
        """(T,): steps with expected readings."""
        return np.asarray(np.isfinite(self.expected).all(1))

    @property
    def fresh(self) -> Mask:
        """(T,): steps with a reading other than the one before, which may be repeated; all those of controls."""
        steps = np.flatnonzero(self.present)
        is_repeated = (np.diff(self.measured[steps], axis=0) == 0.0).all(1) & (self.model.key != CONTROL)
        result = self.present.copy()
        result[steps[1:][is_repeated]] = False
        return result

    def pairs(self, delay: int = 0) -> tuple[Array, Array]:
        """Readings (S, A) and the readings expected ``delay`` steps earlier, of the ``steps``."""
        steps = self.steps(delay)
        return self.readings[steps], self.expected[steps - delay]

    def steps(self, delay: int = 0) -> Indices:
        """(S,) at most ``MAX_PAIRS`` steps with a reading, and with an expected one ``delay`` steps earlier."""
        steps = np.flatnonzero(self.present)
        steps = steps[(steps - delay >= FIRST_CHANGES) & (steps - delay < len(self.present))]
        steps = steps[self.known[steps - delay]]
        return steps[:: 1 + len(steps) // MAX_PAIRS]

    def errors(self, delay: int = 0, others: Array | None = None) -> Array:
        """(2, B, A): mean square of reading i minus plus or minus expected reading j, of ``pairs``.

        Relative to the square of channel j's noise: about 1 if reading i is of channel j. NaN for too few steps.

        Args:
            others: (T, B) readings of other channels; default: those of the A channels of the model.
        """
        steps = self.steps(delay)
        readings, expected = (self.measured if others is None else others)[steps], self.expected[steps - delay]
        if len(readings) < MIN_STEPS:
            return np.full((2, readings.shape[1], expected.shape[1]), np.nan)
        signs = np.array([1.0, -1.0])[:, None, None, None]
        difference = readings[:, :, None] - signs * expected[:, None]  # (2, S, B, A)
        return np.asarray(np.square(self.model.relative(difference)).mean(1))

    def errors_with_biases(self, delay: int = 0) -> Array:
        """(A,): mean square of readings minus expected readings minus a bias each, of ``pairs``, as ``errors``."""
        readings, expected = self.pairs(delay)
        if len(readings) < MIN_STEPS:
            return np.full(readings.shape[1], np.nan)
        return np.asarray(self.model.relative(readings - expected).var(0))


@dataclass(frozen=True)
class ChannelModel:
    """Expected readings of one channel: ``w x + c`` of the features x.

    Of an angle that wraps around, ``h x' + atan2(w[1] x + c[1], w[0] x + c[0])``, where h turns it with a heading.

    Attributes:
        index: of the channel.
        coefficients: (F, 1), or (F, 2) of an angle, in units of the readings by those of the ``features``, or (3, 1)
            and (3, 2) by those of a landmark; F is that of ``monomials`` where these are the features.
        constants: (1,) or (2,).
        heading: (n,) h, coefficients of the state x': 1 or -1 for one component that wraps around, or none; not used
            for channels that are no angles.
        landmark: (p,) position of the landmark whose distance or direction is measured; (0,) for other features.
        noise: standard deviation of the readings from the expected ones, in episodes to which it is not fitted.
        bias: standard deviation between these episodes of the mean of this noise, beyond that of its average.
        degree: of the ``monomials`` that are the features; 0 for others.
        gain_spread: standard deviation between these episodes of the slope of the readings on the expected ones.
        explained: share of the variance of the readings within these episodes that the labels explain; NaN in records
            of earlier versions.
        limits: (2, V) range in the record of the V values that the monomials are products of, or of the V = F features;
            V is 0 without limits, as of landmarks and in records of earlier versions.
    """

    index: int
    coefficients: Array
    constants: Array
    heading: Array
    landmark: Array
    noise: float
    bias: float
    degree: int = 0
    gain_spread: float = 0.0
    explained: float = math.nan
    limits: Array = field(default_factory=lambda: np.empty((2, 0)))

    @property
    def is_angle(self) -> bool:
        return len(self.constants) > 1

    @property
    def kind(self) -> tuple[bool, int]:
        """Kind of the features: whether it is a landmark, and the degree of the monomials."""
        return len(self.landmark) > 0, self.degree

    def expected(self, inputs: Array, states: Array, places: Array) -> Array:
        """(T,) from features (T, F), states (T, n) and positions (T, p); NaN outside of the limits (``EXTRAPOLATED``).

        Angles are continuous.
        """
        own = landmark_features(places, self.landmark) if len(self.landmark) else inputs
        result = self._from(own, states)
        if not self.limits.size:
            return result
        low, high = self.limits
        inside = np.clip(own[:, : len(low)], low, high)
        extrapolated = result - self._from(products(inside, self.degree) if self.degree else inside, states)
        extrapolated = wrapped(extrapolated) if self.is_angle else extrapolated
        return np.where(np.abs(extrapolated) > EXTRAPOLATED * self.noise, np.nan, result)

    def _from(self, own: Array, states: Array) -> Array:
        """(T,) expected readings, from all features of the channel (T, F)."""
        columns = own @ self.coefficients + self.constants
        return np.unwrap(angle_of(columns, states, self.heading)) if self.is_angle else columns[:, 0]

    def to_json(self) -> dict[str, Any]:
        """JSON values; the rows of the coefficients are columns."""
        values = {f.name: getattr(self, f.name) for f in fields(self)} | {"coefficients": self.coefficients.T}
        if math.isnan(self.explained):
            del values["explained"]
        return {name: v if isinstance(v, int) else significant(v, DIGITS) for name, v in values.items()}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> ChannelModel:
        """Inverse of ``to_json``. Raises ValueError for arrays of different sizes."""
        names = ("coefficients", "constants", "heading", "landmark")
        coefficients, constants, heading, landmark = (np.array(value[name], dtype=np.float64) for name in names)
        if coefficients.ndim != 2 or len(coefficients) not in (1, 2) or constants.shape != (len(coefficients),):
            raise ValueError(f"coefficients {coefficients.shape}, constants {constants.shape}")
        noise, bias = float(value["noise"]), float(value["bias"])
        degree, spread = int(value.get("degree", 0)), float(value.get("gain_spread", 0.0))  # absent in earlier versions
        limits = np.array(value.get("limits", [[], []]), dtype=np.float64)
        explained = float(value.get("explained", math.nan))
        own = coefficients.T, constants, heading, landmark, noise, bias, degree, spread, explained, limits
        return cls(int(value["index"]), *own)


@dataclass(frozen=True)
class ReadingModel:
    """Expected readings of one sensor, or expected controls.

    Attributes:
        key: observation key of the sensor, or ``CONTROL``.
        of_channels: models of the A channels that the labels explain (``EXPLAINED``).
        of_weak_channels: models of other channels, which they explain in part (``WEAKLY_EXPLAINED``).
        outliers: share of the readings of the record that are isolated, such as false detections, and left out.
    """

    key: str
    of_channels: tuple[ChannelModel, ...]
    of_weak_channels: tuple[ChannelModel, ...] = ()
    outliers: float = 0.0

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
    def gain_spreads(self) -> Array:
        """(A,) standard deviations between episodes of the slope of the readings on the expected ones."""
        return np.array([model.gain_spread for model in self.of_channels])

    @property
    def explained(self) -> Array:
        """(A,) shares of the variance of the readings that the labels explain; NaN if unknown."""
        return np.array([model.explained for model in self.of_channels])

    @property
    def is_angle(self) -> Mask:
        """(A,): channels that are angles which wrap around."""
        return np.array([model.is_angle for model in self.of_channels])

    def relative(self, errors: Array) -> Array:
        """Errors (..., A) of readings, those of angles modulo a turn, in standard deviations of the noise."""
        return np.asarray(np.where(self.is_angle, wrapped(errors), errors) / self.noise)

    def with_noise_of(self, other: ReadingModel) -> ReadingModel:
        """The model with the noise of another one of the same channels, in which its errors then are."""
        pairs = zip(self.of_channels, other.of_channels, strict=True)
        return replace(self, of_channels=tuple(replace(own, noise=its.noise) for own, its in pairs))

    def to_json(self) -> dict[str, Any]:
        """JSON values."""
        weak = [model.to_json() for model in self.of_weak_channels]
        own: dict[str, Any] = {"key": self.key, "of_channels": [model.to_json() for model in self.of_channels]}
        own |= {"outliers": self.outliers} if self.outliers else {}
        return own | ({"of_weak_channels": weak} if weak else {})

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> ReadingModel:
        """Inverse of ``to_json``. Raises ValueError for arrays of different sizes."""
        models = (value["of_channels"], value.get("of_weak_channels", ()))
        strong, weak = (tuple(map(ChannelModel.from_json, of)) for of in models)
        return cls(str(value["key"]), strong, weak, float(value.get("outliers", 0.0)))

    def of_weak(self) -> ReadingModel:
        """The model with the channels that the labels explain in part only."""
        return ReadingModel(self.key, self.of_weak_channels, outliers=self.outliers)

    def with_weak_channels(self) -> ReadingModel:
        """The model with all channels that the labels explain at least in part, in their order."""
        both = sorted((*self.of_channels, *self.of_weak_channels), key=lambda model: model.index)
        return ReadingModel(self.key, tuple(both), outliers=self.outliers)

    def is_complete(self, episode: Episode) -> bool:
        """Whether all channels have models, of the state and controls at one step: neither of changes nor contact."""
        _, (state, *_) = features(episode, self.key != CONTROL)
        of_features = (m for m in self.of_channels if not len(m.landmark) and not m.degree)
        others = (np.delete(model.coefficients, state, axis=0) for model in of_features)
        readings = episode.controls if self.key == CONTROL else episode.observations[self.key]
        return len(self.of_channels) == readings[0].size and not any(values.any() for values in others)

    def expected(self, episode: Episode) -> Array:
        """(T, A) expected readings of the states of an episode; NaN if the model has features of another version.

        Also NaN at states that the record does not have.
        """
        if (inputs := self._inputs(episode)) is None:
            return np.full((len(episode), len(self.of_channels)), np.nan)
        states = episode.states.astype(np.float64)
        places = positions(episode.task, states)
        columns = [m.expected(inputs[m.degree], states, places) for m in self.of_channels]
        return np.stack(columns, axis=1)

    def _inputs(self, episode: Episode) -> dict[int, Array] | None:
        """Features (T, F), and monomials by degree, of an episode; None if the model has those of another version."""
        degrees = {model.degree for model in self.of_channels} - {0}
        inputs = {degree: monomials(episode, self.key != CONTROL, degree) for degree in degrees}
        inputs[0] = features(episode, self.key != CONTROL)[0]
        of_features = (m for m in self.of_channels if not len(m.landmark))
        return None if any(len(m.coefficients) != inputs[m.degree].shape[1] for m in of_features) else inputs

    def compare(self, episode: Episode) -> ComparedReadings:
        """The readings of an episode beside the expected ones.

        No step has both if the model has the features of another version.
        """
        readings, present = readings_of(episode, self.key)[:, self.channels], steps_of(episode, self.key)
        expected = self.expected(episode)
        present &= np.isfinite(expected).all(1)
        outliers = np.zeros_like(present)
        if self.outliers:
            outliers[present] = isolated(self.relative((readings - expected)[present])).any(1)
        return ComparedReadings(readings, expected, present & ~outliers, self, outliers)

    def unknown_steps(self, episode: Episode) -> tuple[int, int]:
        """Numbers of the steps with readings: at states that the record does not have, and all."""
        present = steps_of(episode, self.key)
        if self._inputs(episode) is None:
            return 0, int(present.sum())
        return int((present & np.isnan(self.expected(episode)).any(1)).sum()), int(present.sum())


def readings_of(episode: Episode, key: str) -> Array:
    """(T, d) readings of a vector sensor, channels of an array or a point cloud, or the controls."""
    readings = episode.controls if key == CONTROL else episode.observations[key]
    return reading_channels(episode.task, key, readings)


def angle_of(columns: Array, states: Array, heading: Array) -> Array:
    """(T,) angles whose cosine and sine, without the heading (n,), have the directions of columns (T, 2)."""
    return np.asarray(np.arctan2(columns[:, 1], columns[:, 0]) + states @ heading)


def steps_of(episode: Episode, key: str) -> Mask:
    """(T,): steps with a reading and all features."""
    present = np.ones(len(episode), dtype=bool) if key == CONTROL else episode.present(key)
    return np.asarray(present & (np.arange(len(episode)) >= FIRST_CHANGES))
