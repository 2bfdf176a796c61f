"""Distance of the hand from the object in contact, as a function of its direction.

A hand of constant orientation touches a round object on a closed curve around its centre. Labels or hand positions with
an offset, and objects of another size, leave this curve; images and the networks of a filter have no part in it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from beliefscope.inspect.statistics.signals import MIN_STEPS, Array

HARMONICS = 4
"""Number of harmonics of the direction."""

RIDGE = 1e-3
"""Regularisation of the harmonics, relative to the number of steps: directions that never occur stay undetermined."""

PRECISION = 2e-4
"""m: residuals below this one count fully."""

ITERATIONS = 10
"""Number of reweighted fits."""


def fit_contact_distance(displacements: Sequence[Array]) -> Array | None:
    """(2 HARMONICS + 1,) m: Fourier coefficients of the distance over the direction, from displacements (T, 2).

    Cauchy weights against steps at which the contact slips off. None for less than ``MIN_STEPS`` steps.

    Args:
        displacements: by episode, in m, from the object to the hand at the steps in contact.
    """
    joined = np.concatenate([np.zeros((0, 2)), *displacements])
    if len(joined) < MIN_STEPS:
        return None
    distance, terms = np.linalg.norm(joined, axis=1), _terms(joined)
    ridge = RIDGE * len(joined) * np.diag([0.0] + [1.0] * 2 * HARMONICS)
    weights = np.ones(len(joined))
    coefficients = np.zeros(terms.shape[1])
    for _ in range(ITERATIONS):
        weighted = terms * weights[:, None]
        coefficients = np.linalg.solve(weighted.T @ terms + ridge, weighted.T @ distance)
        residual = np.abs(distance - terms @ coefficients)
        weights = 1.0 / (1.0 + np.square(residual / max(2.0 * float(np.median(residual)), PRECISION)))
    return coefficients


def contact_residual(displacement: Array, coefficients: Array) -> Array:
    """(T,) m: distances of displacements (T, 2) beyond those of the fitted curve."""
    return np.asarray(np.linalg.norm(displacement, axis=1) - _terms(displacement) @ coefficients)


def _terms(displacement: Array) -> Array:
    """(T, 2 HARMONICS + 1): one, cosines and sines of the multiples of the direction of displacements (T, 2)."""
    angle = np.arctan2(displacement[:, 1], displacement[:, 0])[:, None] * np.arange(1, HARMONICS + 1)
    return np.concatenate([np.ones((len(displacement), 1)), np.cos(angle), np.sin(angle)], axis=1)
