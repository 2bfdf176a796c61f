"""Fits the models of the readings of vector sensors to healthy episodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.inspect.statistics.reading_features import (
    CONTROL,
    DEGREES,
    Indices,
    features,
    find_landmark,
    landmark_features,
    monomials,
    positions,
)
from beliefscope.inspect.statistics.reading_model import (
    ChannelModel,
    ReadingModel,
    angle_of,
    readings_of,
    steps_of,
)
from beliefscope.inspect.statistics.signals import MIN_STEPS, Array, Mask, is_angle, isolated, wrapped

EXPLAINED = 0.5
"""Smallest share of the variance of a channel within episodes that its model explains in other episodes."""

WEAKLY_EXPLAINED = 0.05
"""The same of a channel whose model is used to judge its level, likelihoods and measurement functions only."""

SMALLEST_NOISE = 0.01
"""Smallest noise of a channel, relative to the standard deviation of its readings within episodes."""

RIDGE, RIDGE_OF_MONOMIALS = 1e-3, 1e-6
"""Penalty of squared coefficients of standardised features, relative to the number of steps. Monomials depend on each
other: their coefficients are large."""

MORE_FEATURES = 0.99
"""Largest share of the variance that changes of the state leave of what the state leaves: noise decides on others."""

CLOSER, CURVED = 0.8, 0.95
"""Largest share of the variance that a landmark or a cubic polynomial, or a quadratic one, leaves of what simpler
features leave. Readings that are slightly curved over most states differ from a line at rare ones."""

REACHED = 0.95
"""Quantile of the largest values of a feature in the episodes that limits it: some other episodes also reach it."""

MAX_STEPS = 20_000
"""Number of steps to which a model is fitted; of more, every second one and so on."""

FEW, PASSES = 0.1, 4
"""Largest share of isolated readings that are left out of a fit, and largest number of times that they are searched."""

MIN_EPISODES = 4
"""Smallest number of episodes of a model."""

NOWHERE: Array = np.empty(0)
"""The landmark of fits to other features."""

Fit = tuple[Array, Array, list[Array]]
"""Coefficients (F, C) and constants (C,) of columns, and their predictions (S, C) for each episode."""


def fit_reading_models(
    episodes: Sequence[Episode], keys: Sequence[str], whole: Sequence[ReadingModel] = ()
) -> tuple[ReadingModel, ...]:
    """Models of the vector sensors whose readings depend on the labels; none for too few labelled episodes.

    Each half of the episodes decides which channels the model of the other half explains, and by which features.

    Args:
        whole: models of all episodes if these are some of them: the same channels have models, of the same kind of
            features, and isolated readings are left out as there.
    """
    of_all = {model.key: model for model in whole}
    episodes = [episode for episode in episodes if np.isfinite(episode.states).all()]
    if len(episodes) < MIN_EPISODES or not keys:
        return ()
    by_controls = {c: [features(episode, c) for episode in episodes] for c in {key != CONTROL for key in keys}}
    result = []
    for key in keys:
        inputs, (groups, *_) = zip(*by_controls[key != CONTROL], strict=True)
        present = [np.flatnonzero(steps_of(episode, key)) for episode in episodes]
        stride = 1 + sum(map(len, present)) // MAX_STEPS
        rows = [
            Rows(episode, key, x, steps[::stride])
            for x, episode, steps in zip(inputs, episodes, present, strict=True)
            if len(steps) // stride >= MIN_STEPS
        ]
        options = _options(episodes, key)
        same = of_all.get(key)
        fits = _fit(rows, groups, options, same) if len(rows) >= MIN_EPISODES else []
        limit = FEW if same is None else float(same.outliers > 0.0)
        rows, fits, outliers = _without_outliers(rows, fits, groups, options, limit, same)
        strong, weak = (tuple(fit.model(rows) for fit in chosen) for chosen in _chosen(fits, rows, same))
        if strong or weak:
            result.append(ReadingModel(key, strong, weak, outliers))
    return tuple(result)


def _chosen(
    fits: Sequence[_Fitted], rows: Sequence[Rows], same: ReadingModel | None
) -> tuple[Sequence[_Fitted], Sequence[_Fitted]]:
    """Fits to the channels that the labels explain, and to those explained in part, or to the channels of a model."""
    if same is not None:
        strong, weak = set(same.channels), {model.index for model in same.of_weak_channels}
        return [f for f in fits if f.option.channel in strong], [f for f in fits if f.option.channel in weak]
    explained = [(fit, fit.explained(rows)) for fit in fits]
    return [f for f, e in explained if e > EXPLAINED], [f for f, e in explained if WEAKLY_EXPLAINED < e <= EXPLAINED]


class Rows:
    """Some steps of an episode.

    Attributes:
        features: (S, F). monomials: (S, G) by degree. readings: (S, d). states: (S, n). places: (S, p) positions.
    """

    def __init__(self, episode: Episode, key: str, inputs: Array, steps: Indices) -> None:
        self.features, self.readings = inputs[steps], readings_of(episode, key)[steps]
        self.states = episode.states.astype(np.float64)[steps]
        self.places = positions(episode.task, self.states)
        self.monomials = {degree: monomials(episode, key != CONTROL, degree)[steps] for degree in (1, *DEGREES)}

    def part(self, chosen: Mask) -> Rows:
        """Some of the steps, by a mask (S,)."""
        result = copy(self)
        for name in ("features", "readings", "states", "places"):
            setattr(result, name, getattr(self, name)[chosen])
        result.monomials = {degree: values[chosen] for degree, values in self.monomials.items()}
        return result


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
        return wrapped(readings - angle_of(columns, rows.states, self.heading))

    def fitted(self, rows: Sequence[Rows], fit: Fit, landmark: Array = NOWHERE, degree: int = 0) -> _Fitted:
        """The part of a fit to all columns that is about the channel."""
        coefficients, constants, predicted = fit
        errors = [self.errors(row, columns) for row, columns in zip(rows, predicted, strict=True)]
        left = float(sum(len(e) * e.var() for e in errors))
        own = coefficients[:, self.columns], constants[self.columns]
        return _Fitted(self, *own, landmark, degree, errors, left)

    def slopes(self, rows: Sequence[Rows], errors: Sequence[Array]) -> Array:
        """(E,) slopes of the errors (S,) of each episode on the expected readings."""
        result = []
        for row, error in zip(rows, errors, strict=True):
            expected = row.readings[:, self.channel] - error
            expected = np.unwrap(expected) if self.is_angle else expected
            around = expected - expected.mean()
            result.append((around * error).sum() / max(np.square(around).sum(), 1e-24))
        return np.array(result)

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
    degree: int
    errors: Sequence[Array]
    left: float

    @property
    def kind(self) -> tuple[bool, int]:
        """As ``ChannelModel.kind``."""
        return len(self.landmark) > 0, self.degree

    def explained(self, rows: Sequence[Rows]) -> float:
        """Share of the variance of the channel within episodes; 0 of a constant."""
        total = self._total(rows)
        return 1.0 - self.left / total if total > 0.0 else 0.0

    def _total(self, rows: Sequence[Rows]) -> float:
        return sum(self.option.variation(row) for row in rows)

    def model(self, rows: Sequence[Rows]) -> ChannelModel:
        """The model of the channel."""
        total = self._total(rows)
        steps = np.array([len(error) for error in self.errors], dtype=np.float64)
        variance = max(self.left, SMALLEST_NOISE**2 * total) / steps.sum()
        between = np.var([error.mean() for error in self.errors]) - variance * (1.0 / steps).mean()
        noise, bias = float(np.sqrt(variance)), float(np.sqrt(max(between, 0.0)))
        fit = self.option.channel, self.coefficients, self.constants, self.option.heading, self.landmark
        spread = float(self.option.slopes(rows, self.errors).std())
        explained, limits = self.explained(rows), _limits(rows, self.degree, len(self.landmark) > 0)
        return ChannelModel(*fit, noise, bias, self.degree, spread, explained, limits)


def _limits(rows: Sequence[Rows], degree: int, has_landmark: bool) -> Array:
    """(2, V) range of the features, or of the values of monomials; V is 0 with a landmark, whose law has no limits."""
    if has_landmark:
        return np.empty((2, 0))
    values = [row.monomials[1] if degree else row.features for row in rows]
    low, high = ([f(x, axis=0) for x in values] for f in (np.min, np.max))
    return np.stack([np.quantile(low, 1.0 - REACHED, axis=0), np.quantile(high, REACHED, axis=0)])


def _options(episodes: Sequence[Episode], key: str) -> list[Option]:
    """Channels, and angles that wrap around with each such component, against it and without one."""
    components, options, start = episodes[0].task.components, [], 0
    unit = np.eye(len(components))
    headings = [0.0 * unit[0], *(s * unit[i] for i, c in enumerate(components) if c.wraps for s in (1.0, -1.0))]
    series = [readings_of(episode, key)[steps_of(episode, key)] for episode in episodes]
    for channel in range(series[0].shape[1]):
        turns = any(is_angle(readings[:, channel]) for readings in series)
        for heading in headings if turns else headings[:1]:
            options.append(Option(channel, heading, slice(start, start + (2 if turns else 1))))
            start = options[-1].columns.stop
    return options


def _fit(
    rows: Sequence[Rows], groups: Sequence[Indices], options: Sequence[Option], same: ReadingModel | None = None
) -> list[_Fitted]:
    """The fit to each channel, by the option and the features that leave the least of it.

    Further features, fitted to noise, would change the expected readings from step to step. Fits to channels of a model
    have its kind of features: a landmark and a polynomial that explain a channel about as well have other errors.
    """
    kinds = {} if same is None else {m.index: m.kind for m in (*same.of_channels, *same.of_weak_channels)}
    y = [np.concatenate([option.targets(row) for option in options], axis=1) for row in rows]

    def of_kind(has_landmark: bool, degree: int) -> list[Option]:
        kind = has_landmark, degree
        return [option for option in options if kinds.get(option.channel, kind) == kind]

    stages = [
        *(
            (MORE_FEATURES, [option.fitted(rows, fit) for option in of_kind(False, 0)])
            for fit in _ridges([row.features for row in rows], y, groups)
        ),
        (CLOSER, list(_landmark_fits(rows, y, of_kind(True, 0)))),
        *(
            (share, _polynomial_fits(rows, y, of_kind(False, degree), degree))
            for share, degree in zip((CURVED, CLOSER), DEGREES, strict=True)
        ),
    ]
    best: dict[int, _Fitted] = {}
    for share, fits in stages:
        for channel in {option.channel for option in options}:
            own = [fit for fit in fits if fit.option.channel == channel]
            least = min(own, key=lambda fitted: fitted.left, default=None)
            if least is not None and (channel not in best or least.left < share * best[channel].left):
                best[channel] = least
    return [best[channel] for channel in sorted(best)]


def _without_outliers(
    rows: list[Rows],
    fits: list[_Fitted],
    groups: Sequence[Indices],
    options: Sequence[Option],
    limit: float,
    same: ReadingModel | None,
) -> tuple[list[Rows], list[_Fitted], float]:
    """The rows and fits without isolated readings, whose errors would hide what the others depend on, and their share.

    The same ones, and 0, if no reading is isolated, or a share above the ``limit`` is.
    """
    every, before = sum(len(row.readings) for row in rows), (rows, fits, 0.0)
    for _ in range(PASSES if limit else 0):
        errors = [np.stack(of_channels, axis=1) for of_channels in zip(*(fit.errors for fit in fits), strict=True)]
        left_out = [isolated(error).any(axis=1) for error in errors]
        if not any(steps.any() for steps in left_out):
            break
        rows = [row.part(np.logical_not(steps)) for row, steps in zip(rows, left_out, strict=True)]
        fits = _fit(rows, groups, options, same)
    share = 1.0 - sum(len(row.readings) for row in rows) / max(every, 1)
    return (rows, fits, share) if 0.0 < share <= limit else before


def _landmark_fits(rows: Sequence[Rows], y: Sequence[Array], options: Sequence[Option]) -> Iterator[_Fitted]:
    """Fits to the distance or direction of a landmark; none without positions."""
    for option in options if rows[0].places.shape[1] else ():
        targets = [targets[:, option.columns] for targets in y]
        landmark = find_landmark(np.concatenate([row.places for row in rows]), np.concatenate(targets))
        alone = replace(option, columns=slice(0, targets[0].shape[1]))
        inputs = [landmark_features(row.places, landmark) for row in rows]
        (fit,) = _ridges(inputs, targets, [np.array([1, 2] if option.is_angle else [0])])  # direction or distance
        yield alone.fitted(rows, fit, landmark)


def _polynomial_fits(rows: Sequence[Rows], y: Sequence[Array], options: Sequence[Option], degree: int) -> list[_Fitted]:
    """Fits to a polynomial in state and controls; none with too many terms."""
    if not options or not (count := rows[0].monomials[degree].shape[1]):
        return []
    (fit,) = _ridges([row.monomials[degree] for row in rows], y, [np.arange(count)], RIDGE_OF_MONOMIALS)
    return [option.fitted(rows, fit, degree=degree) for option in options]


def _ridges(x: Sequence[Array], y: Sequence[Array], groups: Sequence[Indices], penalty: float = RIDGE) -> list[Fit]:
    """Ridge regression of columns (S, C) on each group of the features (S, F) of several episodes.

    The predictions of an episode are from coefficients that are fitted to half of the others.
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
        by_half = [_ridge(halves[i], group, penalty) for i in (1, 0)]
        predicted = [inputs[:, group] @ by_half[i % 2][group] + mean_y for i, inputs in enumerate(x)]
        coefficients = _ridge(both, group, penalty) / scale[:, None]
        result.append((coefficients, mean_y - mean_x @ coefficients, predicted))
    return result


def _moments(x: Sequence[Array], y: Sequence[Array]) -> tuple[Array, Array, int]:
    """Sums over the steps of several episodes: ``x' x`` (F, F), ``x' y`` (F, C) and their number."""
    inputs, targets = np.concatenate(x), np.concatenate(y)
    return inputs.T @ inputs, inputs.T @ targets, len(inputs)


def _ridge(moments: tuple[Array, Array, int], group: Indices, penalty: float) -> Array:
    """(F, C) coefficients of ridge regression on a group of features, from ``_moments``; zero for others."""
    gram, products, steps = moments
    result = np.zeros_like(products)
    penalised = gram[np.ix_(group, group)] + penalty * steps * np.eye(len(group))
    result[group] = np.linalg.solve(penalised, products[group])
    return result
