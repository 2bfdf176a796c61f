"""Particle health: weights, ancestors and clouds of known answers, planted into a real particle filter's trace."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beliefscope.inspect.diagnostics.particle_health import ENTRY, modes, of_trace, particle_health
from beliefscope.inspect.trace import Trace

sys.path.insert(0, str(Path(__file__).parent))
import planted_traces as plant

M = 100


def weighed(weights: Any, **arrays: Any) -> Trace:
    """The real trace with the same posterior weights (M,) at every step."""
    base = plant.real("crossmodal-pf")
    with np.errstate(divide="ignore"):
        log = np.tile(np.log(np.asarray(weights, dtype=float)), (len(base), 1))
    return plant.planted(base, base.episode.states, log_weights=log, **arrays)


@pytest.mark.parametrize("few", [1, 4, 25, 100])
def test_effective_sample_size_of_equal_weights_is_their_number(few: int) -> None:
    weights = np.where(np.arange(M) < few, 1.0 / few, 0.0)
    found = particle_health([weighed(weights)])
    assert found.lone is not None
    np.testing.assert_allclose(found.lone.effective, few, rtol=1e-5)
    np.testing.assert_allclose(found.lone.largest, 1.0 / few, rtol=1e-5)
    whole = found.splits[0]
    assert (whole.split, whole.steps) == ("all", 30)
    assert whole.degenerate == float(few < 0.1 * M)
    assert ("never below 10% of 100 particles" in found.verdict) == (few >= 10)


def test_effective_sample_size_of_unequal_weights() -> None:
    weights = np.r_[0.5, np.full(M - 1, 0.5 / (M - 1))]
    steps = of_trace(weighed(weights))
    np.testing.assert_allclose(steps.effective, 1.0 / (0.25 + 0.25 / (M - 1)), rtol=1e-5)
    np.testing.assert_allclose(steps.largest, 0.5, rtol=1e-5)


def test_effective_sample_size_is_that_of_the_trace() -> None:
    real = plant.real("crossmodal-pf")
    np.testing.assert_allclose(of_trace(real).effective, real.effective_sample_size, rtol=1e-4)


def test_ancestors_are_counted_once() -> None:
    base = plant.real("crossmodal-pf")
    rows = np.tile(np.arange(M, dtype=np.int32), (len(base), 1))
    rows[1], rows[2] = 7, np.arange(M) // 2
    steps = of_trace(replace(base, ancestors=rows))
    assert list(steps.ancestors[:4]) == [100, 1, 50, 100]
    assert list(steps.resampled[:4]) == [False, True, True, False]
    never = of_trace(replace(base, ancestors=None))
    assert set(never.ancestors) == {100}
    assert not never.resampled.any()


def test_evidence_is_the_likelihoods_mean_under_the_prior_weights() -> None:
    base = plant.real("crossmodal-pf")
    rng = np.random.default_rng(0)
    prior, likelihood = rng.dirichlet(np.ones(M), len(base)), rng.uniform(0.1, 3.0, (len(base), 2, M))
    found = of_trace(replace(base, prior_log_weights=np.log(prior), log_likelihood=np.log(likelihood)))
    np.testing.assert_allclose(found.evidence, np.log((prior[:, None] * likelihood).sum(-1)), rtol=1e-9)
    assert np.isnan(of_trace(replace(base, log_likelihood=None)).evidence).all()


def test_truth_outside_of_all_particles() -> None:
    base = plant.real("crossmodal-pf")
    assert base.particles is not None
    states = base.episode.states.astype(float)
    cloud = np.random.default_rng(1).normal(size=(len(base), M, 3)) * plant.SCALE
    flat = np.full((len(base), M), -np.log(M))
    cloud -= cloud.mean(1, keepdims=True)
    for off, share in ((0.0, 1.0), (10.0, 0.0)):
        particles = states[:, None] + off * plant.SCALE + cloud
        particles[..., 2] += 2.0 * np.pi  # the same angle
        given = plant.planted(base, states, particles=particles, prior_log_weights=flat)
        found = particle_health([given])
        assert found.lone is not None
        np.testing.assert_allclose(found.lone.farther, share, atol=0.011)  # a particle of 100
        assert found.splits[0].outside == 1.0 - share
        said = "always among the predicted" if share else "outside all predicted particles in 100.0% of steps"
        assert said in found.verdict


def clouds(apart: float, steps: int = 40, count: int = 300) -> np.ndarray:
    """Two halves of a cloud whose centres are so many of their own standard deviations from one another."""
    away = np.random.default_rng(5).normal(size=(steps, count, 2))
    away[:, count // 2 :, 0] += apart
    return 0.01 * away


def test_one_cloud_has_one_mode_and_two_parted_ones_have_two() -> None:
    flat = np.full((40, 300), 1.0 / 300)
    one, two = modes(clouds(0.0), flat), modes(clouds(7.0), flat)
    assert (one == 1).mean() >= 0.95  # a random cloud may clump
    assert (two == 2).all()
    tilted = clouds(7.0) @ np.array([[0.6, -0.8], [0.8, 0.6]]) * 30.0 + np.array([4.0, -2.0])
    assert (modes(tilted, flat) == 2).all()
    three = np.concatenate([clouds(7.0), clouds(0.0) + np.array([0.035, 0.06])], axis=1)
    assert (modes(three, np.repeat([[1 / 450, 1 / 900]], [300, 300], axis=1).repeat(40, 0)) == 3).mean() > 0.9


def test_a_mode_needs_weight() -> None:
    """Particles of the second cloud that weigh next to nothing are no mode: weights count, not particles."""
    light = np.repeat([[1.0, 1e-4]], [150, 150], axis=1).repeat(40, 0)
    light /= light.sum(1, keepdims=True)
    assert (modes(clouds(7.0), light) == 1).mean() >= 0.9


def test_steps_do_not_touch_one_another() -> None:
    both = np.stack([clouds(0.0), clouds(7.0)], axis=1).reshape(80, 300, 2)
    found = modes(both, np.full((80, 300), 1.0 / 300))
    alone = [modes(one[None], np.full((1, 300), 1.0 / 300))[0] for one in both]
    assert list(found) == alone


def test_a_collapsed_set_is_one_mode() -> None:
    points = np.tile(np.array([0.4, -0.3]), (2, M, 1))
    assert list(modes(points, np.full((2, M), 1.0 / M))) == [1, 1]


def test_the_verdict_names_the_worst_step_and_its_episode() -> None:
    base = weighed(np.full(M, 1.0 / M))
    assert base.log_weights is not None
    bad = base.log_weights.copy()
    bad[3] = bad[47] = np.where(np.arange(M) == 9, 0.0, -np.inf)  # step 3 does not count
    worse = replace(base, log_weights=bad, episode_index=31)
    found = particle_health([base, worse, base])
    assert (found.worst_episode, found.worst_step) == (31, 47)
    assert "step 47 of episode 31" in found.verdict
    assert "1.0 effective, the largest weight 1.00" in found.verdict
    assert found.splits[0].degenerate == pytest.approx(1.0 / 90)
    assert found.lone is None


def test_modalities_in_another_order_give_the_same() -> None:
    real = plant.real("crossmodal-pf")
    one, other = particle_health([real]), particle_health([plant.swapped(real)])
    assert other.modalities == one.modalities[::-1]
    for mine, theirs in zip(one.splits, other.splits, strict=True):
        np.testing.assert_array_equal(mine.evidence, theirs.evidence[::-1])
        assert repr(replace(mine, evidence=one.splits[0].evidence)) == repr(
            replace(theirs, evidence=one.splits[0].evidence)
        )


def test_only_of_particles() -> None:
    assert ENTRY.refusal(plant.real("crossmodal-ekf"), None) == "crossmodal-ekf has no particles"
    assert ENTRY.refusal(plant.real("crossmodal-pf"), None) is None
