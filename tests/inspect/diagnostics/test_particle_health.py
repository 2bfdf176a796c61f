"""Particle health of traces with planted weights, ancestors and particles."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beliefscope.inspect.diagnostics.particle_health import ENTRY, measure_steps, modes, particle_health
from beliefscope.inspect.trace import Trace

sys.path.insert(0, str(Path(__file__).parent))
import planted_traces as plant

M = 100


def with_weights(weights: Any, **arrays: Any) -> Trace:
    """A trace with equal posterior weights (M,) at every step."""
    base = plant.real("crossmodal-pf")
    with np.errstate(divide="ignore"):
        log = np.tile(np.log(np.asarray(weights, dtype=float)), (len(base), 1))
    return plant.planted(base, base.episode.states, log_weights=log, **arrays)


@pytest.mark.parametrize("count", [1, 4, 25, 100])
def test_effective_sample_size_of_equal_weights_is_their_number(count: int) -> None:
    weights = np.where(np.arange(M) < count, 1.0 / count, 0.0)
    result = particle_health([with_weights(weights)])
    assert result.steps is not None
    np.testing.assert_allclose(result.steps.effective, count, rtol=1e-5)
    np.testing.assert_allclose(result.steps.largest, 1.0 / count, rtol=1e-5)
    total = result.phases[0]
    assert (total.phase, total.steps) == ("all", 30)
    assert total.degenerate == float(count < 0.1 * M)
    assert ("never below 10 % of 100 particles" in result.verdict) == (count >= 10)


def test_effective_sample_size_of_unequal_weights() -> None:
    weights = np.r_[0.5, np.full(M - 1, 0.5 / (M - 1))]
    steps = measure_steps(with_weights(weights))
    np.testing.assert_allclose(steps.effective, 1.0 / (0.25 + 0.25 / (M - 1)), rtol=1e-5)
    np.testing.assert_allclose(steps.largest, 0.5, rtol=1e-5)


def test_effective_sample_size_equals_that_of_the_trace() -> None:
    real = plant.real("crossmodal-pf")
    np.testing.assert_allclose(measure_steps(real).effective, real.effective_sample_size, rtol=1e-4)


def test_ancestors_are_counted_once() -> None:
    base = plant.real("crossmodal-pf")
    rows = np.tile(np.arange(M, dtype=np.int32), (len(base), 1))
    rows[1], rows[2] = 7, np.arange(M) // 2
    steps = measure_steps(replace(base, ancestors=rows))
    assert list(steps.ancestors[:4]) == [100, 1, 50, 100]
    assert list(steps.resampled[:4]) == [False, True, True, False]
    never = measure_steps(replace(base, ancestors=None))
    assert set(never.ancestors) == {100}
    assert not never.resampled.any()


def test_evidence_is_the_mean_likelihood_under_the_prior() -> None:
    base = plant.real("crossmodal-pf")
    rng = np.random.default_rng(0)
    prior, likelihood = rng.dirichlet(np.ones(M), len(base)), rng.uniform(0.1, 3.0, (len(base), 2, M))
    result = measure_steps(replace(base, prior_log_weights=np.log(prior), log_likelihood=np.log(likelihood)))
    np.testing.assert_allclose(result.evidence, np.log((prior[:, None] * likelihood).sum(-1)), rtol=1e-9)
    assert np.isnan(measure_steps(replace(base, log_likelihood=None)).evidence).all()


def test_true_state_outside_of_all_particles() -> None:
    base = plant.real("crossmodal-pf")
    assert base.particles is not None
    states = base.episode.states.astype(float)
    cloud = np.random.default_rng(1).normal(size=(len(base), M, 3)) * plant.SCALE
    flat = np.full((len(base), M), -np.log(M))
    cloud -= cloud.mean(1, keepdims=True)
    for offset, share in ((0.0, 1.0), (10.0, 0.0)):
        particles = states[:, None] + offset * plant.SCALE + cloud
        particles[..., 2] += 2.0 * np.pi  # the same angle
        planted = plant.planted(base, states, particles=particles, prior_log_weights=flat)
        result = particle_health([planted])
        assert result.steps is not None
        np.testing.assert_allclose(result.steps.farther, share, atol=0.011)  # one of 100 particles
        assert result.phases[0].outside == 1.0 - share
        sentence = (
            "always covered by the predicted particles"
            if share
            else "outside of all predicted particles in 100.0 % of steps"
        )
        assert sentence in result.verdict


def clouds(distance: float, steps: int = 40, count: int = 300) -> np.ndarray:
    """Two clusters whose centres are ``distance`` standard deviations apart."""
    points = np.random.default_rng(5).normal(size=(steps, count, 2))
    points[:, count // 2 :, 0] += distance
    return 0.01 * points


def test_number_of_modes_of_clusters() -> None:
    flat = np.full((40, 300), 1.0 / 300)
    first, two = modes(clouds(0.0), flat), modes(clouds(7.0), flat)
    assert (first == 1).mean() >= 0.95  # a random cluster may appear multimodal
    assert (two == 2).all()
    tilted = clouds(7.0) @ np.array([[0.6, -0.8], [0.8, 0.6]]) * 30.0 + np.array([4.0, -2.0])
    assert (modes(tilted, flat) == 2).all()
    three = np.concatenate([clouds(7.0), clouds(0.0) + np.array([0.035, 0.06])], axis=1)
    assert (modes(three, np.repeat([[1 / 450, 1 / 900]], [300, 300], axis=1).repeat(40, 0)) == 3).mean() > 0.9


def test_cluster_without_weight_is_no_mode() -> None:
    light = np.repeat([[1.0, 1e-4]], [150, 150], axis=1).repeat(40, 0)
    light /= light.sum(1, keepdims=True)
    assert (modes(clouds(7.0), light) == 1).mean() >= 0.9


def test_modes_of_steps_are_independent() -> None:
    both = np.stack([clouds(0.0), clouds(7.0)], axis=1).reshape(80, 300, 2)
    result = modes(both, np.full((80, 300), 1.0 / 300))
    alone = [modes(first[None], np.full((1, 300), 1.0 / 300))[0] for first in both]
    assert list(result) == alone


def test_a_collapsed_set_is_one_mode() -> None:
    points = np.tile(np.array([0.4, -0.3]), (2, M, 1))
    assert list(modes(points, np.full((2, M), 1.0 / M))) == [1, 1]


def test_verdict_names_the_worst_step() -> None:
    base = with_weights(np.full(M, 1.0 / M))
    assert base.log_weights is not None
    bad = base.log_weights.copy()
    bad[3] = bad[47] = np.where(np.arange(M) == 9, 0.0, -np.inf)  # step 3 is a warm-up step
    worse = replace(base, log_weights=bad, episode_index=31)
    result = particle_health([base, worse, base])
    assert (result.worst_episode, result.worst_step) == (31, 47)
    assert "step 47 of episode 31" in result.verdict
    assert "effective sample size 1.0, largest weight 1.00" in result.verdict
    assert result.phases[0].degenerate == pytest.approx(1.0 / 90)
    assert result.steps is None


def test_order_of_modalities_is_irrelevant() -> None:
    real = plant.real("crossmodal-pf")
    first, second = particle_health([real]), particle_health([plant.swapped(real)])
    assert second.modalities == first.modalities[::-1]
    for mine, theirs in zip(first.phases, second.phases, strict=True):
        np.testing.assert_array_equal(mine.evidence, theirs.evidence[::-1])
        assert repr(replace(mine, evidence=first.phases[0].evidence)) == repr(
            replace(theirs, evidence=first.phases[0].evidence)
        )


def test_filters_without_particles_are_refused() -> None:
    assert ENTRY.refusal(plant.real("crossmodal-ekf"), None) == "filter crossmodal-ekf has no particles"
    assert ENTRY.refusal(plant.real("crossmodal-pf"), None) is None
