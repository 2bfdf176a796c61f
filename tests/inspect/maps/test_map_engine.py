"""Likelihood maps: comparison with a direct evaluation, and geometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.batch import Steps
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.filters.models.ekf import ExtendedKalmanFilter, update
from beliefscope.filters.models.pf import MixtureParticleFilter
from beliefscope.inspect.maps.map_engine import QUANTITIES, LikelihoodMap, MapEngine
from beliefscope.inspect.maps.particle_density import ParticleDensity
from beliefscope.inspect.trace import trace


def engine(name: str) -> MapEngine:
    with open_dataset(sample_path("door")) as dataset:
        episode = dataset[next(s.index for s in dataset.summaries if s.split == "test")]
    checkpoint = load_checkpoint(pretrained_path("door", name))
    return MapEngine(checkpoint, trace(checkpoint, episode, particles=50))


@pytest.fixture(scope="module")
def pf() -> MapEngine:
    return engine("crossmodal-pf")


@pytest.fixture(scope="module")
def ekf() -> MapEngine:
    return engine("crossmodal-ekf")


def states_of(map_: LikelihoodMap) -> np.ndarray:
    """(S, S, 3) states of the cells."""
    x, y = np.meshgrid(map_.centre[0] + map_.offsets_x, map_.centre[1] + map_.offsets_y)
    return np.stack([x, y, np.full_like(x, map_.angle)], axis=-1)


@torch.no_grad()
def test_particle_filter_maps_equal_a_direct_evaluation(pf: MapEngine) -> None:
    """Complete networks evaluated with the observation repeated for every cell."""
    step, size = 40, 21
    map_ = pf.map(step, size=size)
    filter_ = pf.checkpoint.filter
    assert isinstance(filter_, MixtureParticleFilter)
    batch = Steps.from_episodes(filter_.task, [pf.trace.episode]).episode(0)
    observed = {
        m: v[step : step + 1].expand(1, size * size, *v.shape[2:]) for m, v in filter_.observations(batch).items()
    }
    cells = torch.from_numpy(states_of(map_).reshape(1, -1, 3).astype(np.float32))
    standard = filter_.statistics.standardise("state", cells)
    expected = []
    for name in filter_.names:
        model = filter_.measurement_model(name)
        hidden = model.join_observation(model.encoders(observed)) + model.join_state(model.state_encoder(standard))
        expected.append(model.head(hidden).reshape(size, size).numpy())
    # Tolerance for float32 networks with outputs of order 10.
    np.testing.assert_allclose(map_.log_likelihood[0], expected[0], atol=2e-4)
    np.testing.assert_allclose(map_.log_likelihood[1], expected[1], atol=2e-4)
    weights = pf.trace.weights
    assert weights is not None
    # Each likelihood is divided by its evidence, the mean over the particles under the prior weights.
    assert pf.trace.prior_log_weights is not None
    assert pf.trace.log_likelihood is not None
    prior = np.exp(pf.trace.prior_log_weights[step])
    evidence = [(prior * np.exp(values)).sum() for values in pf.trace.log_likelihood[step]]
    fused = np.log(sum(weights[step, k] * np.exp(expected[k]) / evidence[k] for k in range(2)))
    np.testing.assert_allclose(map_.log_likelihood[2], fused, atol=2e-4)


def gaussian(cells: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(S, S) log density."""
    error, covariance = cells - mean, covariance.astype(np.float64)
    squared = np.einsum("yxi,ij,yxj->yx", error, np.linalg.inv(covariance), error)
    return -0.5 * (squared + np.log(np.linalg.det(2.0 * np.pi * covariance)))


def test_posteriors_of_an_ekf_are_gaussians(ekf: MapEngine) -> None:
    map_ = ekf.map(50, angle=0.5, size=31, quantity="posterior")
    trace_ = ekf.trace
    means = [*trace_.modality_mean[50], trace_.estimate_mean[50]]
    covariances = [*trace_.modality_covariance[50], trace_.estimate_covariance[50]]
    for layer, mean, covariance in zip(map_.log_likelihood, means, covariances, strict=True):
        np.testing.assert_allclose(layer, gaussian(states_of(map_), mean, covariance), rtol=1e-4, atol=1e-3)
    assert map_.title == "Posterior. Fused: beta-weighted mean of posteriors (crossmodal)"


def test_likelihoods_of_an_ekf_are_those_of_its_virtual_sensors(ekf: MapEngine) -> None:
    """``N(z_k; x, R_k)``, which does not depend on the prior; the default quantity."""
    map_, trace_ = ekf.map(50, angle=0.5, size=31), ekf.trace
    assert map_.quantity == "likelihood"
    assert trace_.observation_mean is not None
    assert trace_.observation_covariance is not None
    for k, layer in enumerate(map_.log_likelihood[:2]):
        expected = gaussian(states_of(map_), trace_.observation_mean[50, k], trace_.observation_covariance[50, k])
        np.testing.assert_allclose(layer, expected, rtol=1e-4, atol=1e-3)
    shifted = {
        name: getattr(trace_, name) + np.float32(0.05) for name in ("modality_mean", "estimate_mean", "predicted_mean")
    }
    other = MapEngine(ekf.checkpoint, replace(trace_, **shifted))
    np.testing.assert_array_equal(other.map(50, angle=0.5, size=31).log_likelihood, map_.log_likelihood)
    posteriors = (e.map(50, angle=0.5, size=31, quantity="posterior").log_likelihood for e in (other, ekf))
    assert np.abs(next(posteriors) - next(posteriors)).max() > 0.1


@pytest.mark.parametrize("name", ["crossmodal-ekf", "unimodal-ekf"])
def test_fused_likelihood_of_an_ekf_is_the_fused_posterior_of_a_flat_prior(name: str) -> None:
    """The filter's own update and fusion with a prior of large covariance."""
    step, flat = 50, engine(name)
    trace_, filter_ = flat.trace, flat.checkpoint.filter
    assert isinstance(filter_, ExtendedKalmanFilter)
    assert trace_.observation_mean is not None
    assert trace_.observation_covariance is not None
    z, r = (
        torch.from_numpy(a[step][None].astype(np.float64))
        for a in (trace_.observation_mean, trace_.observation_covariance)
    )
    prior = Gaussian(torch.zeros_like(z), 1e6 * torch.eye(3, dtype=torch.float64).expand_as(r))
    beta = None if trace_.weights is None else torch.from_numpy(trace_.weights[step][None].astype(np.float64)).log()
    fused = filter_.fuse(update(prior, z, r.diagonal(dim1=-2, dim2=-1).sqrt()), beta)
    map_ = flat.map(step, size=31)
    expected = gaussian(states_of(map_), fused.mean[0].numpy(), fused.covariance[0].numpy())
    np.testing.assert_allclose(map_.log_likelihood[2], expected, rtol=1e-3, atol=1e-3)
    if name == "unimodal-ekf":  # the product of both likelihoods, up to a factor
        difference = map_.log_likelihood[2] - map_.log_likelihood[:2].sum(axis=0)
        assert np.ptp(difference) < 1e-2
        assert map_.rule == "product of virtual sensors (unimodal)"


def test_posterior_of_a_particle_filter_is_prior_times_likelihood(pf: MapEngine) -> None:
    """Every layer has the same prior, and its density is normalised by the mean likelihood of the particles."""
    step, trace_ = 40, pf.trace
    likelihood, posterior = (pf.map(step, size=31, quantity=q) for q in QUANTITIES)
    assert trace_.particles is not None
    assert trace_.prior_log_weights is not None
    assert trace_.log_likelihood is not None
    density = ParticleDensity(pf.task, trace_.particles[step], trace_.prior_log_weights[step])
    offsets = likelihood.offsets_x.astype(np.float64)
    prior = density.log_density(trace_.episode.states[step].astype(np.float64), (0, 1), offsets, offsets)
    evidence = [np.logaddexp.reduce(trace_.prior_log_weights[step] + ll) for ll in trace_.log_likelihood[step]]
    # The mixture of normalised likelihoods with weights that sum to one has evidence 1.
    for layer, log in zip(range(3), [*evidence, 0.0], strict=True):
        expected = likelihood.log_likelihood[layer] + prior - log
        np.testing.assert_allclose(posterior.log_likelihood[layer], expected, atol=2e-3)
    assert posterior.rule == "prior times beta-weighted sum of normalised likelihoods (crossmodal)"
    assert likelihood.rule == "beta-weighted sum of normalised likelihoods (crossmodal)"


def test_axes_are_cell_centres_around_the_true_position(pf: MapEngine) -> None:
    map_ = pf.map(3)
    assert map_.layers == ("image", "haptics", "fused")
    assert map_.log_likelihood.shape == (3, 135, 135)
    np.testing.assert_allclose(np.diff(map_.offsets_x), 0.002, atol=1e-7)
    assert map_.offsets_x[0] == pytest.approx(-0.134)
    assert map_.offsets_y[67] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_array_equal(map_.centre, pf.trace.episode.states[3, :2])
    assert map_.angle == pf.trace.episode.states[3, 2]


def test_cross_sections_at_other_angles(pf: MapEngine) -> None:
    same = pf.map(60, angle=float(pf.trace.episode.states[60, 2]), size=41)
    other = pf.map(60, angle=float(pf.trace.episode.states[60, 2]) + 0.5, size=41)
    np.testing.assert_array_equal(same.log_likelihood, pf.map(60, size=41).log_likelihood)
    assert np.abs(other.log_likelihood - same.log_likelihood).max() > 0.1


def test_cached_grids_give_equal_maps(pf: MapEngine) -> None:
    """Maps of a repeated cross-section, interleaved with other grids, equal those of a new engine."""
    fresh = {step: engine("crossmodal-pf").map(step, 0.4, 41).log_likelihood for step in (5, 30)}
    for step in (5, 30, 5, 30, 5):
        pf.map(step, 0.9, size=135)
        # The cache changes the order of float32 sums.
        np.testing.assert_allclose(pf.map(step, 0.4, 41).log_likelihood, fresh[step], rtol=0, atol=1e-5)
        if step == 30:
            pf.map(step, 0.9, size=41), pf.map(step, size=21), pf.map(step, size=23)


def test_large_grids_are_evaluated_in_chunks(pf: MapEngine) -> None:
    """Every fifth cell of a grid with five times the resolution is a cell of the coarse grid."""
    coarse, fine = pf.map(30, size=31), pf.map(30, size=155)
    np.testing.assert_allclose(fine.log_likelihood[:, 2::5, 2::5], coarse.log_likelihood, atol=2e-4)


def test_number_of_threads_is_restored(pf: MapEngine) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        pf.map(3, size=5)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_normalised_maps_peak_at_255(pf: MapEngine) -> None:
    map_ = pf.map(60, size=41)
    normalised = map_.normalised()
    assert normalised.dtype == np.uint8
    for layer, (x, y) in zip(normalised, map_.peaks(), strict=True):
        iy, ix = np.unravel_index(layer.argmax(), layer.shape)
        assert layer.max() == 255
        assert (map_.offsets_x[ix], map_.offsets_y[iy]) == (x, y)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"step": -1}, "step -1 is not in this episode"),
        ({"step": 10**6}, "it has steps 0 to"),
        ({"step": 0, "size": 1}, "2 to 1024 cells per side, not 1"),
        ({"step": 0, "angle": float("nan")}, "finite number of rad, not nan"),
        ({"step": 0, "quantity": "prior"}, "map quantity 'prior'.*likelihood, posterior"),
    ],
)
def test_invalid_arguments(pf: MapEngine, arguments: dict, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        pf.map(**arguments)


def test_trace_of_another_checkpoint_is_refused(pf: MapEngine, ekf: MapEngine) -> None:
    with pytest.raises(BadInput, match="the trace is from checkpoint"):
        MapEngine(pf.checkpoint, ekf.trace)
