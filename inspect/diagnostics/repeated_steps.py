"""Single steps of an external Kalman filter, repeated from other beliefs, show its Jacobians."""

from __future__ import annotations

from copy import copy
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.calls import takes_start
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.inspect.statistics.innovations import least_certain
from beliefscope.inspect.statistics.measures import Array, Mask, deviations
from beliefscope.inspect.trace import Trace

MOST, COST = 6, 0.5
"""Largest number of repeated steps, and of all steps from other beliefs relative to those of the episode; at least one
step of each modality is repeated."""

SHIFT = 0.1
"""Shift of a component of the mean, in its standard deviations."""

SMALLEST_SHIFT = 1e-4
"""Smallest shift, relative to the largest value of the component: beliefs have single precision."""

GROWTH = 0.05
"""Growth of the variance of a component, relative to itself: gains remain almost the same."""

SMALLEST_CHANGE = 0.05
"""Smallest value to which an error is relative: share of a column of F, and of the largest column of H F."""

CURVED = 0.1
"""Largest second-order effect of one standard deviation, relative to the first-order one, of a nearly linear step."""

SAME = 0.02
"""Largest difference of a repeated step from the original one, in standard deviations and relative to variances."""


def why_not(trace: Trace, checkpoint: Checkpoint | None) -> str | None:
    """One-line reason why the steps of a filter cannot be repeated from other beliefs, or None."""
    if not isinstance(checkpoint, ExternalFilter):
        return "the Jacobians of this project's filters are derivatives by construction"
    if isinstance(checkpoint, UnavailableFilter):
        return f"filter {trace.filter} is not available here, only its run"
    if trace.particles is not None or trace.predicted_covariance is None or not trace.has_covariance:
        return f"filter {trace.filter} does not report covariances of its predictions and estimates"
    if not takes_start(checkpoint.adapter.module):
        return f"filter {trace.filter} does not start each call at a given belief"
    return None


def repeat_steps(trace: Trace, checkpoint: ExternalFilter, at_truth: bool = False) -> RepeatedSteps | None:
    """Steps of an episode, by one call of the filter or, if its first call does not predict, by two.

    Without steps of different results, from another state than the belief; None if all have them, or if the filter
    fails. Its properties must allow it (``why_not``).

    Args:
        at_truth: from beliefs with the true states as means, where functions are as curved as in other episodes,
            although the filter may have lost the state.
    """
    steps = _steps(trace, with_narrowest=not at_truth)
    if not len(steps):
        return None
    for calls in (1, 2):
        try:
            repeated = RepeatedSteps(trace, checkpoint, steps, calls, beliefs=1 if at_truth else None)
            same = repeated.are_same(trace)
            if same.any():
                is_complete = same.all() and not at_truth
                return repeated if is_complete else RepeatedSteps(trace, checkpoint, steps[same], calls, at_truth)
        except (BadInput, KeyError):  # the filter refuses a changed belief, or does not report all values
            return None
    return None


def _steps(trace: Trace, with_narrowest: bool) -> NDArray[np.intp]:
    """Steps to repeat: of each modality as many with its measurement, mostly early ones: the filter may diverge.

    with_narrowest: also those with the narrowest predictions, where functions are nearly linear within the belief.
    """
    beliefs = 2 + 3 * len(trace.task.components)
    count = int(np.clip(COST * len(trace) / beliefs, 1, MOST))
    used = np.ones((len(trace), 1), bool)
    if trace.innovation is not None:
        used = np.asarray(np.isfinite(trace.innovation).any(-1))
    chosen = [at for column in used.T if len(at := np.flatnonzero(column[1:]) + 1)]
    early = 2 ** np.arange(-(-count // max(1, len(chosen)))) - 1  # 0, 1, 3, ...
    rows = [at[early[early < len(at)]] for at in chosen]
    if with_narrowest:
        _, covariance = _beliefs(trace, np.arange(len(trace)), False)
        width = np.linalg.slogdet(covariance)[1]
        width = np.where(np.isfinite(width), width, np.inf)
        rows += [at[[width[at].argmin()]] for at in chosen]
    return np.unique(np.concatenate(rows)) if rows else np.empty(0, dtype=np.intp)


class RepeatedSteps:
    """J steps of a filter from B = 2 + 3 n beliefs each, by the last of one or two calls.

    They are the filter's own belief, those with a larger mean, a smaller mean and a larger variance of each component,
    and one with larger variances and covariances of all components, which shows the signs of columns. With two calls,
    they are before the update of the step before.

    Attributes:
        mean: (J, B, n) predictions. covariance: (J, B, n, n) of these.
        prior_mean, prior_covariance: (J, B, K, n), (J, B, K, n, n) before each update: predictions, or updated before.
        innovation: (J, B, K, m), NaN without a measurement; K = 0 if they are not reported. size: (J, B, K, m, m) their
            covariance, 0 without a measurement.
        correction, posterior: (J, n) and (J, n, n), from the filter's own belief.
        before: (J, n, n) covariance of the filter's own belief before the calls.
        between_mean, between_covariance: (J, B, n), (J, B, n, n) before the last call; means relative to the first one.
    """

    def __init__(
        self,
        trace: Trace,
        checkpoint: ExternalFilter,
        steps: NDArray[np.intp],
        calls: int,
        at_truth: bool = False,
        beliefs: int | None = None,
    ) -> None:
        """At the estimates or the true states, from all beliefs or the first few. BadInput if the filter fails."""
        self.steps, self.task, n = steps, trace.task, len(trace.task.components)
        before, covariance = _beliefs(trace, steps - 1, calls == 1)
        before = trace.episode.states[steps - 1].astype(np.float64) if at_truth else before
        self.before = covariance
        variance = np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0)
        smallest = SMALLEST_SHIFT * np.maximum(np.abs(before).max(0), 1e-6)
        self.shift, self.growth = np.maximum(SHIFT * np.sqrt(variance), smallest), GROWTH * variance  # (J, n)
        unit, none = np.eye(n), np.zeros((n + 1, n))
        shifts = np.concatenate([none[:1], unit, -unit, none])[:beliefs] * self.shift[:, None]  # (J, B, n)
        grown = np.concatenate([none, none[1:], unit, unit.sum(0, keepdims=True)])[:beliefs]
        grown = grown * np.sqrt(self.growth)[:, None]
        start = Gaussian(
            torch.from_numpy(self.task.moved(before[:, None], shifts).reshape(-1, n)),
            torch.from_numpy((covariance[:, None] + grown[..., None] * grown[..., None, :]).reshape(-1, n, n)),
        )
        episodes = [trace.episode.part(step + 1 - calls, step + 1) for step in steps for _ in range(shifts.shape[1])]
        values, _ = checkpoint.run(episodes, start=start)
        arrays = {k: v[-1].unflatten(0, (len(steps), -1)).double().numpy() for k, v in values.items()}
        self.prior_mean, self.prior_covariance = arrays["predicted_mean"], arrays["predicted_covariance"]
        if calls == 1:
            self.between_mean = shifts
            self.between_covariance = start.covariance.unflatten(0, (len(steps), -1)).double().numpy()
        else:
            mean, self.between_covariance = (
                values[name][-2].unflatten(0, (len(steps), -1)).double().numpy()
                for name in ("estimate_mean", "estimate_covariance")
            )
            self.between_mean = self.task.difference(mean, mean[:, :1])
        rows, first = np.arange(len(steps)), least_certain(self.prior_covariance[:, 0])
        self.mean, self.covariance = (a[rows, :, first] for a in (self.prior_mean, self.prior_covariance))
        self.correction = self.task.difference(arrays["estimate_mean"][:, 0], self.mean[:, 0])
        self.posterior = arrays["estimate_covariance"][:, 0]
        self.innovation, self.size = (np.empty((*shifts.shape[:2], *(0,) * axes)) for axes in (2, 3))
        if trace.innovation is not None:
            rejected = arrays.get("accepted", np.ones((1, 1, 1)))[:, :1] == 0.0  # of the filter's own belief
            self.innovation = np.where(rejected[..., None], np.nan, arrays["innovation"])
            self.size = np.where(rejected[..., None, None], 0.0, np.nan_to_num(arrays["innovation_covariance"]))

    def are_same(self, trace: Trace) -> Mask:
        """(J,) whether the filter's own beliefs give the trace's predictions, so that they are its whole state."""
        mean, covariance = _beliefs(trace, self.steps, False)
        moved = np.abs(self.task.difference(mean, self.mean[:, 0])) <= SAME * deviations(covariance)
        grown = weights_of(covariance) * (covariance - self.covariance[:, 0])
        return moved.all(-1) & (np.abs(grown).max((-2, -1)) < SAME)

    def linear(self) -> RepeatedSteps | None:
        """The steps whose functions are nearly linear within the belief; None without any.

        Covariances of filters that do not linearise, such as UKFs, follow from derivatives there only.
        """
        mean = self.task.difference(self.mean, self.mean[:, :1]) * inverse_std(self.covariance[:, :1])
        nu = np.nan_to_num((self.innovation - self.innovation[:, :1]) * inverse_std(self.size[:, :1]))
        n = self.shift.shape[1]
        scaled = np.concatenate([mean, nu.reshape(*mean.shape[:2], -1)], axis=-1)
        larger, smaller = scaled[:, 1 : n + 1], scaled[:, n + 1 : 2 * n + 1]
        shift = (self.shift / np.maximum(deviations(self.before), self.shift))[..., None]  # in standard deviations
        first, second = (larger - smaller) / (2.0 * shift), (larger + smaller) / (2.0 * shift**2)
        keep = np.square(second).sum((1, 2)) <= CURVED**2 * np.square(first).sum((1, 2))
        if not keep.any():
            return None
        part = copy(self)
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                setattr(part, name, value[keep])
        return part

    def dynamics_errors(self) -> Array:
        """(J, n) of F, relative to the difference from constant states, with a larger variance of each component."""
        weights, f = weights_of(self.covariance[:, :1]), self.dynamics_jacobian[:, None]
        before = self._growth(self.between_covariance)[:, :-1]  # (J, i, n, n)
        expected = weights * (f @ before @ f.mT)
        growth = weights * self._growth(self.covariance)[:, :-1]
        change = expected - weights * before
        smallest = SMALLEST_CHANGE * np.sqrt(np.square(expected).sum((-2, -1)))
        return relative(growth - expected, change, (-2, -1), smallest)

    def measurement_errors(self) -> Array:
        """(J, K) of the modalities' H."""
        return relative(*self._measured_growth, (1, -2, -1))

    def measurement_errors_by_component(self) -> Array:
        """(J, n + 1, K) of the modalities' H, with the variance of one component, and of all of them together."""
        difference, expected = self._measured_growth
        largest = np.sqrt(np.square(expected).sum((-2, -1)).max(1, keepdims=True))
        return relative(difference, expected, (-2, -1), SMALLEST_CHANGE * largest)

    def process_noise(self) -> Array:
        """(J, n, n) ``P - F P F^T`` of the prediction."""
        f = self.dynamics_jacobian
        return self.covariance[:, 0] - f @ self.between_covariance[:, 0] @ f.mT

    @cached_property
    def dynamics_jacobian(self) -> Array:
        """(J, n, n) F, derivative of the predicted mean by that before the last call."""
        return self._prediction_by_start @ np.linalg.pinv(np.moveaxis(self._derivative(self.between_mean), 1, -1))

    @cached_property
    def _prediction_by_start(self) -> Array:
        return np.moveaxis(self._derivative(self.task.difference(self.mean, self.mean[:, :1])), 1, -1)

    @cached_property
    def measurement_jacobian(self) -> Array:
        """(J, K, m, n) derivative of the predicted measurements by the prediction; 0 without a measurement."""
        by_mean = np.moveaxis(self._derivative(self.innovation), 1, -1)
        return np.nan_to_num(-by_mean @ np.linalg.pinv(self._prediction_by_start)[:, None])

    @cached_property
    def _measured_growth(self) -> tuple[Array, Array]:
        """(J, n + 1, K, m, m) growth of the innovations' covariance less that by their derivatives, and the latter.

        Both follow from the belief before the same update, which other updates may have changed.
        """
        count = self.innovation.shape[2]
        means = self.task.difference(self.prior_mean, self.prior_mean[:, :1])[:, :, :count]
        by_mean, change = (np.moveaxis(self._derivative(x), 1, -1) for x in (self.innovation, means))  # (J, K, ..., n)
        h, weights = np.nan_to_num(-by_mean @ np.linalg.pinv(change))[:, None], weights_of(self.size[:, :1])
        expected = h @ self._growth(self.prior_covariance[:, :, :count]) @ h.mT
        return weights * (self._growth(self.size) - expected), weights * expected

    def _derivative(self, values: Array) -> Array:
        """(J, n, ...) derivatives of (J, B, ...) by each component of the mean."""
        n = self.shift.shape[1]
        difference = values[:, 1 : n + 1] - values[:, n + 1 : 2 * n + 1]
        return np.asarray(difference / (2.0 * self.shift.reshape(*self.shift.shape, *(1,) * (values.ndim - 2))))

    def _growth(self, values: Array) -> Array:
        """(J, n + 1, ...) growth of (J, B, ...) with the variance of each component, and with all of them."""
        return np.asarray(values[:, 1 + 2 * self.shift.shape[1] :] - values[:, :1])


def _beliefs(trace: Trace, steps: NDArray[np.intp], is_updated: bool) -> tuple[Array, Array]:
    """Mean (J, n) and covariance (J, n, n) at the steps, before or after all updates."""
    if is_updated:
        return trace.estimate_mean[steps].astype(np.float64), trace.estimate_covariance[steps].astype(np.float64)
    assert trace.predicted_mean is not None
    assert trace.predicted_covariance is not None
    mean, covariance = (x[steps].astype(np.float64) for x in (trace.predicted_mean, trace.predicted_covariance))
    rows, first = np.arange(len(steps)), least_certain(covariance)
    return mean[rows, first], covariance[rows, first]


def inverse_std(covariance: Array) -> Array:
    """(..., n) inverse standard deviations; 0 for a variance of 0 or less."""
    std = deviations(covariance)
    return np.divide(1.0, std, out=np.zeros_like(std), where=std > 0.0)


def weights_of(covariance: Array) -> Array:
    """(..., n, n) products of the inverse standard deviations."""
    inverse = inverse_std(covariance)
    return np.asarray(inverse[..., :, None] * inverse[..., None, :])


def relative(difference: Array, expected: Array, axes: tuple[int, ...], smallest: Array | float = 0.0) -> Array:
    """Roots of the sum of squares over axes, relative to those of the expected values, which are at least the smallest.

    NaN where nothing is expected. difference, expected: of one shape; the result lacks the axes.
    """
    error = np.sqrt(np.square(difference).sum(axes))
    size = np.maximum(np.sqrt(np.square(expected).sum(axes)), smallest)
    return np.divide(error, size, out=np.full_like(error, np.nan), where=size > 0.0)


def known_median(values: Array) -> Array:
    """(...): median of the known values (N, ...) over the first axis; NaN where there are none."""
    unknown = np.isnan(values).all(0)
    return np.where(unknown, np.nan, np.nanmedian(np.where(unknown, 0.0, values), axis=0))
