"""Kernel density of particles: moments, thinning, and the Kalman posterior of a linear-Gaussian system."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from tests.filters.models import linear_system as linear

from beliefscope.datasets.catalog import find_task
from beliefscope.filters.belief import Gaussian, Particles
from beliefscope.filters.filter import Architecture
from beliefscope.filters.rollout import rollout
from beliefscope.inspect.maps.particle_density import MAX_KERNELS, ParticleDensity

PUSH, DOOR = find_task("push"), find_task("door")


@pytest.fixture(autouse=True)
def float64() -> Iterator[None]:
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(default)


@pytest.mark.parametrize("particles", [40, 2 * MAX_KERNELS])
def test_moments_are_those_of_the_particles(particles: int) -> None:
    """Integrals over a grid; with thinning they have the sampling error of the kernels."""
    rng = np.random.default_rng(1)
    states = rng.multivariate_normal((0.4, -0.2), [[4e-4, 2e-4], [2e-4, 9e-4]], particles)
    weights = rng.dirichlet(np.ones(particles))
    density = ParticleDensity(PUSH, states, np.log(weights))
    offsets = np.linspace(-0.2, 0.2, 81)
    p = np.exp(density.log_density(np.array([0.4, -0.2]), (0, 1), offsets, offsets)) * (offsets[1] - offsets[0]) ** 2
    cells = np.stack(np.meshgrid(0.4 + offsets, -0.2 + offsets), axis=-1)
    assert p.sum() == pytest.approx(1.0, abs=1e-3)
    mean = np.einsum("yx,yxi->i", p, cells)
    covariance = np.einsum("yx,yxi,yxj->ij", p, cells - mean, cells - mean)
    tolerance = 1e-6 if particles < MAX_KERNELS else 1e-3
    np.testing.assert_allclose(mean, weights @ states, atol=tolerance)
    expected = np.cov(states.T, aweights=weights, ddof=0)
    np.testing.assert_allclose(covariance, expected, rtol=0.05, atol=1e-6)


def test_angles_wrap_and_collapsed_particles_have_a_density() -> None:
    states = np.tile([0.5, 0.1, np.pi - 0.01], (20, 1)) + 1e-3 * np.random.default_rng(0).normal(size=(20, 3))
    log_weights = np.full(20, -np.log(20.0))
    offsets = np.linspace(-0.01, 0.01, 5)
    middle = np.array([0.5, 0.1, np.pi - 0.01])
    density = ParticleDensity(DOOR, states, log_weights)
    turned = density.log_density(middle - [0.0, 0.0, 2.0 * np.pi], (0, 1), offsets, offsets)
    np.testing.assert_allclose(turned, density.log_density(middle, (0, 1), offsets, offsets), atol=1e-3)
    single = ParticleDensity(DOOR, states[:1], np.zeros(1))
    values = single.log_density(states[0], (0, 1), offsets, offsets)
    assert np.isfinite(values).all()
    assert values.argmax() == 12


def divergence(particles: int, seed: int) -> float:
    """nats, KL from the Kalman posterior to prior density times likelihood of a PF, over a grid at the true angle."""
    controls, observations = linear.simulate(10, 3)
    means, covariances = linear.kalman(controls, observations)
    filter_ = linear.GaussianLikelihood(Architecture(task=DOOR, kind="pf", fusion="none", models=("image",)))
    filter_.dynamics = linear.LinearDynamics()  # type: ignore[assignment]
    start = Gaussian(torch.zeros(1, 3), torch.from_numpy(linear.START)[None])
    evidence = linear.evidence(controls, observations)
    run = rollout(filter_, evidence, start, torch.Generator().manual_seed(seed), particles, keep=True)
    predicted = run.steps[-1].predicted
    assert isinstance(predicted, Particles)
    density = ParticleDensity(DOOR, predicted.states[0].numpy(), predicted.log_weights[0].numpy())
    middle, offsets = means[-1], np.linspace(-1.0, 1.0, 41)
    cells = np.stack(np.meshgrid(middle[0] + offsets, middle[1] + offsets), axis=-1)
    cells = np.concatenate([cells, np.full((*cells.shape[:2], 1), middle[2])], axis=-1)
    likelihood = -0.5 * np.square((observations[-1] - cells) / linear.R_STD).sum(-1)
    posterior = density.log_density(middle, (0, 1), offsets, offsets) + likelihood
    error = cells - middle
    exact = -0.5 * np.einsum("yxi,ij,yxj->yx", error, np.linalg.inv(covariances[-1]), error)
    exact, posterior = (log - np.logaddexp.reduce(log, axis=None) for log in (exact, posterior))
    return float((np.exp(exact) * (exact - posterior)).sum())


@pytest.mark.slow
def test_posterior_approaches_that_of_the_kalman_filter() -> None:
    few, many = (np.mean([divergence(particles, seed) for seed in range(4)]) for particles in (100, 20_000))
    assert many < 0.01
    assert many < 0.25 * few
