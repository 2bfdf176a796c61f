"""Covariances of collapsed particle sets can be inverted."""

import numpy as np

from beliefscope.filters.covariance_floor import with_floor


def test_covariances_of_few_particles_among_collapsed_ones() -> None:
    """Two particles in eight components; in most other steps the particles are the same."""
    difference = np.random.default_rng(0).normal(0, 1, 8) * np.array([1, 1, 1, 0.1, 0.1, 0.1, 0.01, 1e-3])
    covariances = np.stack([np.outer(difference, difference), *(1e-34 * np.eye(8) for _ in range(5))])
    inverse = np.linalg.inv(with_floor(covariances))
    assert difference @ inverse[0] @ difference > 0.99
    assert (np.linalg.eigvalsh(with_floor(covariances)) > 0).all()
