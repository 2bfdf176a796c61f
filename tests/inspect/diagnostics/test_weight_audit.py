"""Weight audit: the oracle against closed forms and brute force, regrets, and correlations with their intervals."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beliefscope.inspect.diagnostics.weight_audit import ENTRY, audit, oracle_weights
from beliefscope.inspect.statistics.bootstrap import FEWEST, correlate, sums_of
from beliefscope.inspect.trace import Trace

sys.path.insert(0, str(Path(__file__).parent))
import planted_traces as plant

REAL = ("crossmodal-ekf", "crossmodal-pf", "unimodal-ekf")


def erring(image: Any, haptics: Any, acting: Any, base: Trace | None = None, **arrays: Any) -> Trace:
    """A trace whose modalities err by so much, mixed by the weights that act on the image: all broadcast to (T, n)."""
    base = plant.real("crossmodal-ekf") if base is None else base
    steps = len(base)
    states = base.episode.states.astype(float)
    share = np.broadcast_to(acting, (steps, 3))
    error = np.stack([np.broadcast_to(e, (steps, 3)) for e in (image, haptics)], 1)
    weights = np.stack([share, 1.0 - share], 1)
    given: dict[str, Any] = {"acting": weights, "weights": weights} | arrays
    return plant.planted(
        base,
        states,
        modality_mean=states[:, None] + error,
        estimate_mean=states + (weights * error).sum(1),
        **given,
    )


def test_oracle_of_two_scalar_errors() -> None:
    cases = [(2.0, -1.0, 1 / 3), (-1.0, 3.0, 3 / 4), (0.5, 1.0, 1.0), (-2.0, -1.0, 0.0), (0.0, 5.0, 1.0)]
    for one, other, weight in cases:
        for scale in (1e-4, 1.0, 100.0):  # whatever the unit
            found = oracle_weights(scale * np.array([[one, other]]), np.array([0.5, 0.5]))
            np.testing.assert_allclose(found, [weight, 1.0 - weight], atol=1e-7)


def test_oracle_of_two_points_is_the_foot_of_the_perpendicular() -> None:
    rng = np.random.default_rng(0)
    errors = rng.normal(size=(200, 2, 2))
    a, b = errors[..., 0], errors[..., 1]
    foot = np.clip(-(b * (a - b)).sum(-1) / np.square(a - b).sum(-1), 0.0, 1.0)
    found = oracle_weights(errors, np.full((200, 2), 0.5))
    np.testing.assert_allclose(found[:, 0], foot, atol=1e-5)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_oracle_beats_every_weight_of_the_simplex(d: int) -> None:
    rng = np.random.default_rng(d)
    errors = rng.normal(size=(60, d, 3)) + rng.normal(size=(60, d, 1))
    near = rng.dirichlet(np.ones(3), 60)
    found = oracle_weights(errors, near)
    assert found.min() >= 0.0
    np.testing.assert_allclose(found.sum(-1), 1.0, rtol=1e-12)
    side = np.linspace(0.0, 1.0, 101)
    first, second = (grid.ravel() for grid in np.meshgrid(side, side))
    scan = np.stack([first, second, 1.0 - first - second], 1)[first + second <= 1.0 + 1e-9]
    best = np.square(errors @ scan.T).sum(1).min(-1)
    cost = np.square((errors @ found[..., None])[..., 0]).sum(-1)
    size = np.square(errors).sum((1, 2))
    assert (cost <= best + 1e-8 * size).all()  # TIE against errors scaled to 1
    # A cell of the scan is 0.01 wide: near its minimum the scan is worse by its square.
    assert (best - cost <= 2e-4 * size).all()


def test_equally_good_weights_stay_near_those_that_acted() -> None:
    near = np.array([[0.3, 0.7], [0.9, 0.1]])
    np.testing.assert_allclose(oracle_weights(np.ones((2, 1, 2)), near), near, atol=1e-6)
    np.testing.assert_allclose(oracle_weights(np.zeros((2, 1, 2)), near), near, atol=1e-6)


def test_regret_worked_by_hand() -> None:
    """Image errs by 2 cm, haptics by -1 cm, both count half: 0.5 cm off; a third of the image would err by nothing."""
    found = audit([erring((0.02, 0.0, 0.0), (-0.01, 0.0, 0.0), 0.5)])
    whole = found.splits[0]
    np.testing.assert_allclose(whole.oracle[:, 0], [1 / 3, 2 / 3], atol=1e-4)
    np.testing.assert_allclose(whole.fused[:2], 0.005, rtol=1e-4)
    np.testing.assert_allclose(whole.hindsight, 0.0, atol=1e-6)
    np.testing.assert_allclose(whole.regret[:2], 0.005, rtol=1e-3)
    np.testing.assert_allclose(whole.alone[:, 0], [0.02, 0.01], rtol=1e-4)
    np.testing.assert_allclose(found.regret[:, 0], 0.005, rtol=1e-3)
    assert "Regret 0.500 cm: a position RMSE of 0.500 cm, 0.000 cm with the oracle's weights" in found.verdict
    assert "1.000 cm by haptics alone, so weighing better would help." in found.verdict
    assert "Intervals need 5 trajectories." in found.verdict


def test_angles_wrap() -> None:
    plain = audit([erring((0.01, 0.0, 0.2), (0.0, 0.01, -0.1), 0.5)])
    turned = audit([erring((0.01, 0.0, 0.2 + 2 * np.pi), (0.0, 0.01, -0.1 - 2 * np.pi), 0.5)])
    np.testing.assert_allclose(turned.splits[0].hindsight, plain.splits[0].hindsight, atol=1e-6)
    np.testing.assert_allclose(turned.splits[0].oracle, plain.splits[0].oracle, atol=1e-4)
    np.testing.assert_allclose(turned.splits[0].oracle[0, 2], 1 / 3, atol=1e-4)


def test_best_weights_leave_no_regret() -> None:
    rng = np.random.default_rng(1)
    image, haptics = np.abs(rng.normal(0.0, 0.02, (60, 3))), -np.abs(rng.normal(0.0, 0.01, (60, 3)))
    found = audit([erring(image, haptics, haptics / (haptics - image))])
    assert found.splits[0].fused.max() < 1e-6
    assert found.regret.max() < 1e-6
    np.testing.assert_allclose(found.acting, found.oracle, atol=1e-3)
    worse = audit([erring(image, haptics, 0.99)])
    assert (worse.splits[0].regret > 0.005).all()
    assert "so weighing better would help" in worse.verdict


@pytest.mark.parametrize("name", REAL)
def test_of_a_real_filter(name: str) -> None:
    trace = plant.real(name)
    found = audit([trace])
    assert (found.regret >= 0.0).all()
    assert (found.oracle >= 0.0).all()
    np.testing.assert_allclose(found.oracle.sum(1), 1.0, rtol=1e-9)
    whole = found.splits[0]
    # Choosing one modality at every step is among the oracle's choices.
    assert whole.hindsight[0] <= whole.alone[:, 0].min() + 1e-9
    if name == "crossmodal-ekf":  # whose mean is a convex one, component by component; float32 in a trace
        assert (whole.hindsight <= whole.fused + 1e-6).all()


def test_one_weight_for_all_components_puts_the_position_nearest() -> None:
    trace = plant.real("crossmodal-pf")
    found = audit([trace])
    assert found.oracle.shape == (60, 2, 1)
    scan = np.linspace(0.0, 1.0, 1001)
    where = [0, 1]
    away = (trace.modality_mean - trace.episode.states[:, None]).astype(float)[..., where]
    mixed = scan[:, None, None] * away[:, 0] + (1.0 - scan[:, None, None]) * away[:, 1]
    least = np.linalg.norm(mixed, axis=-1).min(0)
    mine = np.linalg.norm((found.oracle * away).sum(1), axis=-1)
    assert (mine <= least + 1e-6).all()
    np.testing.assert_allclose(mine, least, atol=1e-4)


@pytest.mark.parametrize("name", REAL)
def test_modalities_in_another_order_give_the_same(name: str) -> None:
    trace = plant.real(name)
    one, other = audit([trace]), audit([plant.swapped(trace)])
    assert other.modalities == one.modalities[::-1]
    np.testing.assert_allclose(other.oracle, one.oracle[:, ::-1], atol=1e-9)
    np.testing.assert_allclose(other.regret, one.regret, atol=1e-12)
    for mine, theirs in zip(one.splits, other.splits, strict=True):
        np.testing.assert_allclose(theirs.alone, mine.alone[::-1])
        np.testing.assert_allclose(theirs.acting, mine.acting[::-1])
    values = [{(c.weight, c.modality, c.component, c.other): c.value for c in x.correlations} for x in (one, other)]
    assert values[0].keys() == values[1].keys()
    for key, value in values[0].items():
        np.testing.assert_allclose(values[1][key], value, atol=1e-6, err_msg=str(key))


def test_a_weight_that_follows_contact_correlates_with_it() -> None:
    base = plant.real("crossmodal-ekf")
    touching = np.arange(60) % 3 == 0
    base = replace(base, episode=replace(base.episode, contact=touching))
    share = np.where(touching, 0.2, 0.8)[:, None]

    def made(seed: int) -> Trace:
        rng = np.random.default_rng(seed)
        image, haptics = rng.normal(0.0, 0.01, (2, 60, 3))
        planted = erring(image, haptics, share, base)
        return replace(planted, episode=replace(planted.episode, contact=touching))

    found = audit([made(seed) for seed in range(6)])
    one = found.correlation("acting", "haptics", "contact")
    assert one is not None
    assert (one.value, one.low, one.high) == pytest.approx((1.0, 1.0, 1.0), abs=1e-5)
    other = found.correlation("acting", "image", "contact")
    assert other is not None
    assert other.value == pytest.approx(-1.0, abs=1e-5)
    contact = found.of("contact")
    assert contact is not None
    np.testing.assert_allclose(contact.acting[0], 0.2, rtol=1e-5)
    assert "0.80 in no contact, 0.20 in contact" in found.verdict
    assert "-1.00 with contact" in found.verdict
    assert "Intervals need" not in found.verdict
    assert found.correlation("acting", "image", "blackout") is None  # there is none


def test_correlations_are_pearsons() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 8, 3, 40))
    y += 0.5 * x
    y[:, 2] = 7.0  # never changes
    value, low, high = correlate(np.stack([sums_of(a, b) for a, b in zip(x, y, strict=True)]))
    for c in range(2):
        assert value[c] == pytest.approx(np.corrcoef(x[:, c].ravel(), y[:, c].ravel())[0, 1], rel=1e-9)
        assert low[c] < value[c] < high[c]
    assert math.isnan(value[2])
    assert math.isnan(low[2])


def test_intervals_cover_a_known_correlation() -> None:
    """Steps of a trajectory repeat one another (each value stands ten times): only whole trajectories are news."""
    rng = np.random.default_rng(1)
    studies, trajectories, true = 200, 25, 0.5
    x, noise = rng.normal(size=(2, trajectories, studies, 4))
    y = true * x + math.sqrt(1.0 - true**2) * noise
    x, y = np.repeat(x, 10, -1), np.repeat(y, 10, -1)
    _, low, high = correlate(np.stack([sums_of(a, b) for a, b in zip(x, y, strict=True)]))
    covered = ((low <= true) & (true <= high)).mean()
    assert 0.88 <= covered <= 0.985  # 95 %, a little less for a percentile of 25; +- 3 standard errors
    # Over steps as if independent it would be sqrt(10) times narrower than it is.
    assert np.median(high - low) == pytest.approx(2 * 1.96 * (1 - true**2) / math.sqrt(4 * trajectories), rel=0.15)


def test_few_trajectories_give_no_interval() -> None:
    rng = np.random.default_rng(2)
    sums = np.stack([sums_of(*rng.normal(size=(2, 1, 50))) for _ in range(FEWEST)])
    assert FEWEST == 5
    value, low, high = correlate(sums[:4])
    assert np.isfinite(value).all()
    assert np.isnan([low, high]).all()
    assert np.isfinite(correlate(sums)).all()
    np.testing.assert_array_equal(correlate(sums), correlate(sums))


def test_it_needs_two_models_to_weigh() -> None:
    one = plant.real("image-ekf")
    assert ENTRY.refusal(one, None) == "image-ekf has one measurement model, image, and nothing to weigh it against"
    for name in REAL:
        assert ENTRY.refusal(plant.real(name), None) is None
