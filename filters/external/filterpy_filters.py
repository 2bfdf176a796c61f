"""Filters of filterpy (https://github.com/rlabbe/filterpy), and objects with the same attributes, as external filters.

The adapter reads attributes only, so filterpy is not required here: ``x`` and ``P`` of every filter, ``y`` and ``S`` of
Kalman filters, ``sigmas`` (M, n) of an ``EnsembleKalmanFilter``, ``mu`` of an ``IMMEstimator``.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from beliefscope.filters.external.calls import DT, PRESENT

Array = NDArray[np.float64]
Update = Callable[[Any, Array], None]


def _reading(observations: Mapping[str, Array], key: str) -> Array:
    """NaN at a step without a reading, by the mask of the sensor."""
    return np.where(np.all(observations.get(key + PRESENT, 1.0)), observations[key], np.nan)


class FilterPy:
    """A filterpy filter; use with ``Adapter(FilterPy(...), batched=False, absent="nan")``.

    Every step calls ``predict``, then the update of each sensor in order. A reading with NaN is skipped, and so is one
    at a step at which the mask of the sensor has none.

    Attributes:
        filter: the running copy.
    """

    def __init__(
        self,
        filter_: Any,
        updates: Mapping[str, Update] | None = None,
        *,
        predict: Callable[[Any, Array], None] | None = None,
        state: Sequence[int] | None = None,
        gate: float | None = None,
        own_start: bool = False,
    ) -> None:
        """filter_: initial filter, which is copied.

        Args:
            updates: observation key -> call of the filter's ``update`` with a reading, (m, 1) for a state (n, 1).
                Default: its ``update`` with all readings joined.
            predict: call of the filter's ``predict`` with the control. Default: without arguments.
            state: indices in the filter's state of the components of the task. Default: all.
            gate: probability of a smaller squared innovation beyond which a measurement is rejected, such as 0.999;
                default: none is.
            own_start: whether runs start at ``x`` and ``P`` of the filter instead of the true state.
        """
        self._initial, self.filter = filter_, copy.deepcopy(filter_)
        self._updates, self._predict, self._gate = updates, predict, gate
        self._state = np.arange(np.size(filter_.x)) if state is None else np.asarray(state)
        self.initialize_beliefs = self._start_own if own_start else self._start_at

    def _start_own(self) -> tuple[Array, Array]:
        self.filter = copy.deepcopy(self._initial)
        return self._mean(), self._covariance()

    def _start_at(self, mean: Array, covariance: Array) -> None:
        self.filter = copy.deepcopy(self._initial)
        x, p = np.array(self.filter.x, dtype=np.float64), np.array(self.filter.P, dtype=np.float64)
        x.reshape(-1)[self._state] = mean
        p[np.ix_(self._state, self._state)] = covariance
        self.filter.x, self.filter.P = x, p
        if hasattr(self.filter, "sigmas") and hasattr(self.filter, "initialize"):  # an ensemble
            self.filter.initialize(x, p)

    def forward(self, observations: Mapping[str, Array], controls: Array) -> dict[str, Any]:
        """Values of a step without axis N (docs/own_filter.md)."""
        if self._predict is None:
            self.filter.predict()
        else:
            self._predict(self.filter, controls)
        results, before = [], []
        for update, reading in self._readings(observations):
            before.append((self._mean(), self._covariance()))
            results.append(self._update(update, reading))
        values: dict[str, Any] = {"estimate_mean": self._mean(), "estimate_covariance": self._covariance()}
        if hasattr(self.filter, "y") and hasattr(self.filter, "S"):
            values |= {
                "innovation": [None if r is None else r[0] for r in results],
                "innovation_covariance": [None if r is None else r[1] for r in results],
                "predicted_mean": np.stack([mean for mean, _ in before]),  # updates are in turn
                "predicted_covariance": np.stack([covariance for _, covariance in before]),
            }
            if self._gate is not None:
                values["accepted"] = [None if r is None else r[2] for r in results]
        return values | self._ensemble()

    def _readings(self, observations: Mapping[str, Array]) -> list[tuple[Update, Array]]:
        """Updates and their readings, NaN at steps without one."""
        if self._updates is None:
            keys = [key for key in observations if key != DT and not key.endswith(PRESENT)]
            joined = np.concatenate([np.ravel(_reading(observations, key)) for key in keys])
            return [(lambda filter_, z: filter_.update(z), joined)]
        return [(update, _reading(observations, key)) for key, update in self._updates.items()]

    def _update(self, update: Update, reading: Array) -> tuple[Array, Array, bool] | None:
        """Innovation, its covariance and whether the gate accepts it; None without a reading."""
        if np.isnan(reading).any():
            return None
        before = None if self._gate is None else copy.deepcopy(self.filter)
        # Readings have the orientation of the state: filterpy broadcasts a row against a column without an error.
        update(self.filter, np.reshape(reading, (-1, 1)) if np.ndim(self.filter.x) == 2 else reading)
        y = getattr(self.filter, "y", None)
        if y is None:  # ensembles have no innovation
            return np.zeros(0), np.zeros((0, 0)), True
        nu, covariance = np.array(y, np.float64).ravel(), np.array(self.filter.S, np.float64).reshape(np.size(y), -1)
        accepted = True
        if before is not None and self._gate is not None:
            accepted = bool(chdtrc(len(nu), nu @ np.linalg.solve(covariance, nu)) >= 1.0 - self._gate)
            self.filter = self.filter if accepted else before
        return nu, covariance, accepted

    def _mean(self) -> Array:
        return np.array(self.filter.x, dtype=np.float64).ravel()[self._state]

    def _covariance(self) -> Array:
        return np.array(self.filter.P, dtype=np.float64)[np.ix_(self._state, self._state)]

    def _ensemble(self) -> dict[str, Any]:
        """Members of an ensemble, and mode probabilities of an interacting multiple model estimator."""
        values: dict[str, Any] = {}
        sigmas = getattr(self.filter, "sigmas", None)
        if sigmas is not None:
            members = np.array(sigmas, dtype=np.float64)[:, self._state]
            values |= {"particles": members, "log_weights": np.full(len(members), -np.log(len(members)))}
        mu = getattr(self.filter, "mu", None)
        if mu is not None:
            values["extra"] = {f"mode_{i + 1}": float(p) for i, p in enumerate(np.ravel(mu))}
        return values
