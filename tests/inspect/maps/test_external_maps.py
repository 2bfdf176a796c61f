"""Maps of external particle filters: kernel densities, and calls of their own measurement models."""

from __future__ import annotations

import sys
from base64 import b64decode
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torch import Tensor

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.likelihood import log_likelihood
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.inspect.diagnostics.likelihood_maps import maps
from beliefscope.inspect.figures import paper
from beliefscope.inspect.maps.availability import no_maps
from beliefscope.inspect.maps.map_engine import MapEngine
from beliefscope.inspect.trace import Trace, trace
from beliefscope.recordings.interactive.export import run_document

sys.path.insert(0, str(Path(__file__).parents[1] / "traces"))
import torchfilter_stubs as stubs


def particle_filter() -> stubs.Particles:
    image = stubs.Likelihood(stubs.Sensor("effector_position", 3, 0.1, seed=1))
    return stubs.Particles(stubs.CrossmodalLikelihood(image, stubs.Likelihood(stubs.Sensor("force", 3, 0.08, seed=2))))


def external(**adapter: Any) -> ExternalFilter:
    return ExternalFilter(Adapter(particle_filter(), **adapter), DOOR, "mine")


@pytest.fixture(scope="module")
def particles() -> Trace:
    with open_dataset(sample_path("door")) as data:
        return trace(external(), data[data.held_out()[0]], seed=3)


def test_posterior_maps_of_particles_are_kernel_densities(particles: Trace) -> None:
    """Each layer has the mean of the particles with the weights of its posterior."""
    filter_ = external()
    unavailable = UnavailableFilter("mine", particles.checkpoint_hash, particles.task)
    assert "its measurement model is known only at its particles" in (
        no_maps(unavailable, particles, "likelihood") or ""
    )
    wide = replace(particles.episode, task=replace(particles.task, map_half_width=2.0))
    result = MapEngine(filter_, replace(particles, episode=wide)).map(
        5, size=200, quantity="posterior", others="marginal"
    )
    assert (result.quantity, result.layers) == ("posterior", ("image", "haptics", "fused"))
    p = np.exp(result.log_likelihood.astype(np.float64))
    p /= p.sum((1, 2), keepdims=True)
    means = np.stack([p.sum(1) @ result.offsets_x, p.sum(2) @ result.offsets_y], axis=-1)
    expected = np.concatenate([particles.modality_mean[5], particles.estimate_mean[5][None]])[:, :2] - result.centre
    np.testing.assert_allclose(means, expected, atol=0.02)  # m, a cell


def test_likelihood_maps_call_the_measurement_models(particles: Trace) -> None:
    """The models have the same values at the particles as in the run, and on the map as at its cells."""
    filter_, step = external(), 7
    assert particles.particles is not None
    assert particles.log_likelihood is not None
    assert particles.weights is not None
    values = log_likelihood(filter_, particles.episode, step, particles.particles[step], 2)
    np.testing.assert_allclose(values[:2], particles.log_likelihood[step], rtol=1e-4, atol=1e-4)
    fused = np.logaddexp.reduce(np.log(particles.weights[step]) + particles.log_likelihood[step], axis=0)
    np.testing.assert_allclose(values[2], fused, rtol=1e-4, atol=1e-4)
    map_ = MapEngine(filter_, particles).map(step, size=5, components=("hinge_y", "angle"))
    assert (map_.quantity, map_.others) == ("likelihood", "fixed")
    cell = particles.episode.states[step].copy()
    cell[1:] += map_.offsets_x[4], map_.offsets_y[1]
    at_cell = log_likelihood(filter_, particles.episode, step, cell[None], 2)[:, 0]
    np.testing.assert_allclose(map_.log_likelihood[:, 1, 4], at_cell, rtol=1e-4, atol=1e-4)


def test_likelihood_of_an_adapter_is_checked(particles: Trace) -> None:
    def wrong(states: Tensor, observations: Any) -> Tensor:
        return states[None, 1:, 0]

    with pytest.raises(
        BadInput, match=r"at the likelihood of step 0 returns shape \(1, 2\), expected \(2, 3\) numbers"
    ):
        log_likelihood(external(log_likelihood=wrong), particles.episode, 0, np.zeros((3, 3), np.float32), 2)


def test_a_step_without_a_positive_definite_covariance_has_no_map_and_the_others_have(particles: Trace) -> None:
    covariance = np.tile(1e-4 * np.eye(3, dtype=np.float32), (len(particles), 1, 1))
    covariance[4] *= -1.0
    filter_ = UnavailableFilter("mine", particles.checkpoint_hash, particles.task)
    run = replace(
        particles,
        estimate_covariance=covariance,
        modality_mean=np.full_like(particles.modality_mean, np.nan),
        **dict.fromkeys(("particles", "log_weights", "prior_log_weights", "log_likelihood")),
    )
    assert no_maps(filter_, run) is None
    everywhere = replace(run, estimate_covariance=-np.abs(covariance))
    assert "a covariance of step 0 is not positive definite" in (no_maps(filter_, everywhere) or "")
    assert "a covariance of step 4 is not positive definite" in (no_maps(filter_, run, "posterior", [4, 5]) or "")
    assert no_maps(filter_, run, "posterior", [5]) is None
    assert paper.maps_figure(filter_, run, {False: 5}, 5, "posterior").axes
    engine = MapEngine(filter_, run)
    assert [map_.step for map_ in engine.maps(range(3, 7), 5)] == [3, 5, 6]
    with pytest.raises(BadInput, match="a covariance of step 4 is not positive definite"):
        engine.map(4, size=5)
    survey = maps([run], filter_, size=5)
    assert len(survey.numbers.steps) == len(run) - 1
    assert [curve.values.shape for curve in survey.curves()] == [(len(run),)] * len(survey.curves())
    assert all(np.flatnonzero(np.isnan(curve.values)).tolist() == [4] for curve in survey.curves())
    assert {len(values) for values in (*survey.phases.values(), survey.trajectory)} == {len(run) - 1}
    document = run_document(run, filter_, 5, lambda share: None)["maps"]
    cells = np.frombuffer(b64decode(document["data"]), np.uint8).reshape(-1, *document["shape"])
    assert np.flatnonzero(~cells.any(axis=(1, 2, 3))).tolist() == [4], document["stride"]
