"""Weight audit: the oracle against closed forms and brute force, regrets, and correlations with their intervals."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics.weight_audit import ENTRY, audit
from beliefscope.inspect.statistics.intervals import MIN_TRAJECTORIES, correlate, correlation_sums
from beliefscope.inspect.statistics.measures import UPDATES_NOTE
from beliefscope.inspect.statistics.oracle import oracle_weights
from beliefscope.inspect.trace import Trace

sys.path.insert(0, str(Path(__file__).parent))
import planted_traces as plant

REAL = ("crossmodal-ekf", "crossmodal-pf", "unimodal-ekf")


def erring(image: Any, haptics: Any, weight: Any, base: Trace | None = None, **arrays: Any) -> Trace:
    """A trace with given unimodal errors and image weight, all broadcast to (T, n)."""
    base = plant.real("crossmodal-ekf") if base is None else base
    steps = len(base)
    states = base.episode.states.astype(float)
    share = np.broadcast_to(weight, (steps, 3))
    error = np.stack([np.broadcast_to(e, (steps, 3)) for e in (image, haptics)], 1)
    weights = np.stack([share, 1.0 - share], 1)
    defaults: dict[str, Any] = {"effective_weights": weights, "weights": weights} | arrays
    return plant.planted(
        base,
        states,
        modality_mean=states[:, None] + error,
        estimate_mean=states + (weights * error).sum(1),
        **defaults,
    )


def test_oracle_of_two_scalar_errors() -> None:
    cases = [(2.0, -1.0, 1 / 3), (-1.0, 3.0, 3 / 4), (0.5, 1.0, 1.0), (-2.0, -1.0, 0.0), (0.0, 5.0, 1.0)]
    for first, second, weight in cases:
        for scale in (1e-4, 1.0, 100.0):  # independent of the unit
            result = oracle_weights(scale * np.array([[first, second]]), np.array([0.5, 0.5]))
            np.testing.assert_allclose(result, [weight, 1.0 - weight], atol=1e-7)


def test_oracle_of_two_points_is_the_foot_of_the_perpendicular() -> None:
    rng = np.random.default_rng(0)
    errors = rng.normal(size=(200, 2, 2))
    a, b = errors[..., 0], errors[..., 1]
    foot = np.clip(-(b * (a - b)).sum(-1) / np.square(a - b).sum(-1), 0.0, 1.0)
    result = oracle_weights(errors, np.full((200, 2), 0.5))
    np.testing.assert_allclose(result[:, 0], foot, atol=1e-5)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_oracle_beats_every_weight_of_the_simplex(d: int) -> None:
    rng = np.random.default_rng(d)
    errors = rng.normal(size=(60, d, 3)) + rng.normal(size=(60, d, 1))
    near = rng.dirichlet(np.ones(3), 60)
    result = oracle_weights(errors, near)
    assert result.min() >= 0.0
    np.testing.assert_allclose(result.sum(-1), 1.0, rtol=1e-12)
    side = np.linspace(0.0, 1.0, 101)
    first, second = (grid.ravel() for grid in np.meshgrid(side, side))
    scan = np.stack([first, second, 1.0 - first - second], 1)[first + second <= 1.0 + 1e-9]
    best = np.square(errors @ scan.T).sum(1).min(-1)
    cost = np.square((errors @ result[..., None])[..., 0]).sum(-1)
    size = np.square(errors).sum((1, 2))
    assert (cost <= best + 1e-8 * size).all()  # TIE against errors scaled to 1
    # A cell of the scan is 0.01 wide: near its minimum the scan is worse by its square.
    assert (best - cost <= 2e-4 * size).all()


def test_ties_are_resolved_towards_the_effective_weights() -> None:
    near = np.array([[0.3, 0.7], [0.9, 0.1]])
    np.testing.assert_allclose(oracle_weights(np.ones((2, 1, 2)), near), near, atol=1e-6)
    np.testing.assert_allclose(oracle_weights(np.zeros((2, 1, 2)), near), near, atol=1e-6)


def test_regret_of_a_worked_example() -> None:
    """Errors of 2 cm and -1 cm with equal weights give 0.5 cm; an image weight of one third gives zero."""
    result = audit([erring((0.02, 0.0, 0.0), (-0.01, 0.0, 0.0), 0.5)])
    total = result.phases[0]
    np.testing.assert_allclose(total.oracle[:, 0], [1 / 3, 2 / 3], atol=1e-4)
    np.testing.assert_allclose(total.fused[:2], 0.005, rtol=1e-4)
    np.testing.assert_allclose(total.hindsight, 0.0, atol=1e-6)
    np.testing.assert_allclose(total.regret[:2], 0.005, rtol=1e-3)
    np.testing.assert_allclose(total.unimodal[:, 0], [0.02, 0.01], rtol=1e-4)
    np.testing.assert_allclose(result.regret[:, 0], 0.005, rtol=1e-3)
    assert (
        "Position RMSE 0.500 cm, 1.000 cm for the haptics-only update, 0.000 cm with the oracle's weights"
        in result.verdict
    )
    assert "constant weights: too few episodes (1; at least 5 needed)." in result.verdict
    assert UPDATES_NOTE in result.verdict
    assert f"diagnostic {DIAGNOSTICS['standalone'].title} " in UPDATES_NOTE


def test_angles_wrap() -> None:
    plain = audit([erring((0.01, 0.0, 0.2), (0.0, 0.01, -0.1), 0.5)])
    turned = audit([erring((0.01, 0.0, 0.2 + 2 * np.pi), (0.0, 0.01, -0.1 - 2 * np.pi), 0.5)])
    np.testing.assert_allclose(turned.phases[0].hindsight, plain.phases[0].hindsight, atol=1e-6)
    np.testing.assert_allclose(turned.phases[0].oracle, plain.phases[0].oracle, atol=1e-4)
    np.testing.assert_allclose(turned.phases[0].oracle[0, 2], 1 / 3, atol=1e-4)


def test_optimal_weights_have_no_regret() -> None:
    rng = np.random.default_rng(1)
    image, haptics = np.abs(rng.normal(0.0, 0.02, (60, 3))), -np.abs(rng.normal(0.0, 0.01, (60, 3)))
    result = audit([erring(image, haptics, haptics / (haptics - image))])
    assert result.phases[0].fused.max() < 1e-6
    assert result.regret.max() < 1e-6
    np.testing.assert_allclose(result.effective_weights, result.oracle, atol=1e-3)
    worse = audit([erring(image, haptics, 0.99)])
    assert (worse.phases[0].regret > 0.005).all()


def test_only_weights_that_a_constant_beats_would_reduce_the_error() -> None:
    """The oracle is far better than any filter, so its regret is no alarm."""

    def planted_traces(weight: float) -> list[Trace]:
        errors = np.random.default_rng(2).normal(0.0, [[[0.01]], [[0.03]]], (6, 2, 60, 3))
        return [erring(image, haptics, weight) for image, haptics in errors]

    best = audit(planted_traces(0.9))  # inverse variances
    assert best.phases[0].regret[0] > 0.3 * best.phases[0].fused[0]
    assert best.excess[1] < 0.05
    assert "The best constant weights by phase would hardly reduce the error" in best.verdict
    assert best.alarms == ()
    worse = audit(planted_traces(0.1))
    assert "The best constant weights by phase would reduce the error" in worse.verdict
    assert worse.alarms == ("better weights would reduce the error",)
    # Independent errors: RMSE with weight w is sqrt(w^2 + 9 (1 - w)^2) cm by component.
    expected = math.sqrt((0.1**2 + 9 * 0.9**2) / (0.9**2 + 9 * 0.1**2)) - 1.0
    assert worse.excess[0] == pytest.approx(expected, rel=0.25)  # 360 errors: three standard errors


@pytest.mark.parametrize("name", REAL)
def test_real_filters(name: str) -> None:
    trace = plant.real(name)
    result = audit([trace])
    assert (result.regret >= 0.0).all()
    assert (result.oracle >= 0.0).all()
    np.testing.assert_allclose(result.oracle.sum(1), 1.0, rtol=1e-9)
    total = result.phases[0]
    # One-hot weights are among the oracle's choices.
    assert total.hindsight[0] <= total.unimodal[:, 0].min() + 1e-9
    if name == "crossmodal-ekf":  # its mean is a convex combination by component; float32 in a trace
        assert (total.hindsight <= total.fused + 1e-6).all()


def test_scalar_oracle_weight_minimises_the_position_error() -> None:
    trace = plant.real("crossmodal-pf")
    result = audit([trace])
    assert result.oracle.shape == (60, 2, 1)
    scan = np.linspace(0.0, 1.0, 1001)
    where = [0, 1]
    away = (trace.modality_mean - trace.episode.states[:, None]).astype(float)[..., where]
    mixed = scan[:, None, None] * away[:, 0] + (1.0 - scan[:, None, None]) * away[:, 1]
    least = np.linalg.norm(mixed, axis=-1).min(0)
    mine = np.linalg.norm((result.oracle * away).sum(1), axis=-1)
    assert (mine <= least + 1e-6).all()
    np.testing.assert_allclose(mine, least, atol=1e-4)


@pytest.mark.parametrize("name", REAL)
def test_order_of_modalities_is_irrelevant(name: str) -> None:
    trace = plant.real(name)
    first, second = audit([trace]), audit([plant.swapped(trace)])
    assert second.modalities == first.modalities[::-1]
    np.testing.assert_allclose(second.oracle, first.oracle[:, ::-1], atol=1e-9)
    np.testing.assert_allclose(second.regret, first.regret, atol=1e-12)
    for mine, theirs in zip(first.phases, second.phases, strict=True):
        np.testing.assert_allclose(theirs.unimodal, mine.unimodal[::-1])
        np.testing.assert_allclose(theirs.effective_weights, mine.effective_weights[::-1])
    values = [{(c.weight, c.modality, c.component, c.other): c.value for c in x.correlations} for x in (first, second)]
    assert values[0].keys() == values[1].keys()
    for key, value in values[0].items():
        np.testing.assert_allclose(values[1][key], value, atol=1e-6, err_msg=str(key))


def test_weight_determined_by_contact_correlates_with_it() -> None:
    base = plant.real("crossmodal-ekf")
    touching = np.arange(60) % 3 == 0
    base = replace(base, episode=replace(base.episode, contact=touching))
    share = np.where(touching, 0.2, 0.8)[:, None]

    def planted_trace(seed: int) -> Trace:
        rng = np.random.default_rng(seed)
        image, haptics = rng.normal(0.0, 0.01, (2, 60, 3))
        planted = erring(image, haptics, share, base)
        return replace(planted, episode=replace(planted.episode, contact=touching))

    result = audit([planted_trace(seed) for seed in range(6)])
    first = result.correlation("effective_weights", "haptics", "contact")
    assert first is not None
    assert (first.value, first.low, first.high) == pytest.approx((1.0, 1.0, 1.0), abs=1e-5)
    second = result.correlation("effective_weights", "image", "contact")
    assert second is not None
    assert second.value == pytest.approx(-1.0, abs=1e-5)
    contact = result.entry("contact")
    assert contact is not None
    np.testing.assert_allclose(contact.effective_weights[0], 0.2, rtol=1e-5)
    assert "0.80 in free motion, 0.20 in contact" in result.verdict
    assert "-1.00 with contact" in result.verdict
    assert "too few" not in result.verdict
    assert result.correlation("effective_weights", "image", "blackout") is None  # no blackout


def test_correlations_are_pearson_correlations() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 8, 3, 40))
    y += 0.5 * x
    y[:, 2] = 7.0  # constant
    value, low, high = correlate(np.stack([correlation_sums(a, b) for a, b in zip(x, y, strict=True)]))
    for c in range(2):
        assert value[c] == pytest.approx(np.corrcoef(x[:, c].ravel(), y[:, c].ravel())[0, 1], rel=1e-9)
        assert low[c] < value[c] < high[c]
    assert math.isnan(value[2])
    assert math.isnan(low[2])


def test_intervals_cover_a_known_correlation() -> None:
    """Each value is repeated ten times, so only the number of trajectories determines the interval."""
    rng = np.random.default_rng(1)
    studies, trajectories, correlation = 200, 25, 0.5
    x, noise = rng.normal(size=(2, trajectories, studies, 4))
    y = correlation * x + math.sqrt(1.0 - correlation**2) * noise
    x, y = np.repeat(x, 10, -1), np.repeat(y, 10, -1)
    _, low, high = correlate(np.stack([correlation_sums(a, b) for a, b in zip(x, y, strict=True)]))
    covered = ((low <= correlation) & (correlation <= high)).mean()
    assert 0.88 <= covered <= 0.985  # 95 % +- 3 standard errors
    # Intervals over independent steps would be narrower by sqrt(10).
    assert np.median(high - low) == pytest.approx(
        2 * 1.96 * (1 - correlation**2) / math.sqrt(4 * trajectories), rel=0.15
    )


def test_few_trajectories_give_no_interval() -> None:
    rng = np.random.default_rng(2)
    sums = np.stack([correlation_sums(*rng.normal(size=(2, 1, 50))) for _ in range(MIN_TRAJECTORIES)])
    assert MIN_TRAJECTORIES == 5
    value, low, high = correlate(sums[:4])
    assert np.isfinite(value).all()
    assert np.isnan([low, high]).all()
    assert np.isfinite(correlate(sums)).all()
    np.testing.assert_array_equal(correlate(sums), correlate(sums))


def test_single_model_filters_are_refused() -> None:
    first = plant.real("image-ekf")
    assert ENTRY.refusal(first, None) == "filter image-ekf has only one measurement model, image"
    for name in REAL:
        assert ENTRY.refusal(plant.real(name), None) is None


def test_updates_of_a_bank_without_feedback_have_their_own_priors() -> None:
    run = erring(0.01, 0.02, 0.5)
    common = np.zeros((len(run), 2, len(run.task.components)), np.float32)
    for prior, is_common in ((common, True), (common + 0.01 * np.arange(2)[:, None], False), (None, True)):
        verdict = audit([replace(run, predicted_mean=prior, kind="ekf")]).verdict
        assert (UPDATES_NOTE in verdict) == is_common
