"""Shapley values by their axioms, and of filters whose subsets have a closed form."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import permutations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, shipped
from beliefscope.filters.evaluate import evaluate
from beliefscope.inspect.diagnostics import shapley
from beliefscope.inspect.diagnostics.shapley import MOST, members, run_subsets, shapley_weights
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace, trace
from beliefscope.inspect.traces.replay import Edit, Replay

sys.path.insert(0, str(Path(__file__).parent))
import planted_traces as plant

Array = NDArray[np.float64]

STEPS = 50


def episode(index: int = 9) -> Any:
    with open_dataset(sample_path("door")) as data:
        return plant.of_length(data[index], STEPS)


@cache
def ours(name: str) -> tuple[Checkpoint, Trace]:
    """A shipped filter of the door, and a run with pictures missing."""
    checkpoint = load_checkpoint(shipped("door", name))
    return checkpoint, trace(checkpoint, episode(), 9, seed=3, particles=60, faults=Faults.parse("blackout=0.3"))


def untrained(name: str) -> Checkpoint:
    return Checkpoint(build(architecture("door", name)).eval().requires_grad_(False), name, "0" * 64, {})


def by_orders(values: Array, count: int) -> Array:
    """The definition: each player's mean gain over all orders in which they may come. values: (2^K,)."""
    found = np.zeros(count)
    for order in permutations(range(count)):
        there = 0
        for k in order:
            found[k] += values[there | 1 << k] - values[there]
            there |= 1 << k
    return found / math.factorial(count)


@pytest.mark.parametrize("count", range(1, 6))
def test_values_are_mean_gains_over_all_orders(count: int) -> None:
    values = np.random.default_rng(count).normal(size=2**count)
    found = shapley_weights(count) @ values
    np.testing.assert_allclose(found, by_orders(values, count), atol=1e-12)
    assert found.sum() == pytest.approx(values[-1] - values[0])  # efficiency


@pytest.mark.parametrize("count", [2, 4, MOST])
def test_axioms(count: int) -> None:
    rng, member, weights = np.random.default_rng(count), members(count), shapley_weights(count)
    one, other = rng.normal(size=(2, 2**count))
    np.testing.assert_allclose(weights @ (2 * one - other), 2 * weights @ one - weights @ other, atol=1e-12)
    each = rng.normal(size=count)
    np.testing.assert_allclose(weights @ (member @ each), each, atol=1e-12)  # where all gains add up
    last = 1 << (count - 1)
    without = one[np.arange(2**count) & ~last]  # the last player never matters
    assert (weights @ without)[-1] == pytest.approx(0.0, abs=1e-12)
    swap = member[:, [1, 0, *range(2, count)]] @ (1 << np.arange(count))
    found = weights @ (one + one[swap])  # the first two are alike
    assert found[0] == pytest.approx(found[1])


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_all_is_the_run_and_one_is_the_filter_on_it_alone(name: str) -> None:
    checkpoint, run = ours(name)
    found = run_subsets(checkpoint, run)
    assert found.shape == (STEPS, 4, 3)
    # The same numbers; a batch of four is rounded otherwise than one of one.
    np.testing.assert_allclose(found[:, -1], run.estimate_mean, atol=2e-5)
    error = measures.wrapped(checkpoint.task, found - run.episode.states[:, None])[measures.counted(run)]
    for k, modality in enumerate(run.modalities):
        metrics = evaluate(checkpoint.filter, [run.episode], only=modality, particles=60, seed=3)
        position = np.sqrt(np.square(error[:, 1 + k, :2]).sum(-1).mean())
        assert 100 * position == pytest.approx(metrics.rmse["position_cm"], abs=1e-3)


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_values_sum_to_what_all_modalities_change(name: str) -> None:
    checkpoint, run = ours(name)
    found = shapley.shapley([run], checkpoint)
    assert {one.split for one in found.splits} == {"all", "contact", "no contact", "blackout"} - {
        split for split, mask in measures.splits(run).items() if not mask.any()
    }
    for one in found.splits:
        np.testing.assert_allclose(one.shapley.sum(0), one.rmse[-1] - one.rmse[0], atol=1e-12)
    error = found.position_error
    np.testing.assert_allclose(found.of_position.sum(-1), error[:, -1] - error[:, 0], atol=1e-12)
    moved = measures.wrapped(checkpoint.task, np.diff(run_subsets(checkpoint, run)[:, [0, -1]], axis=1)[:, 0])
    np.testing.assert_allclose(found.of_estimate.sum(1), moved, atol=1e-6)


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_a_modality_of_beta_zero_is_worth_nothing(name: str) -> None:
    checkpoint, run = ours(name)
    edited = Replay(checkpoint, run).edited(Edit(0, STEPS, weights={"haptics": 0.0}))
    found = shapley.shapley([edited], checkpoint)
    np.testing.assert_allclose(found.of_estimate[:, 1], 0.0, atol=1e-7)  # of m and rad as float32
    assert np.abs(found.of_estimate[:, 0]).max() > 1e-3
    assert found.splits[0].shapley[1] == pytest.approx(0.0, abs=1e-7)


class Linear(nn.Module):
    """``x' = A x + u`` with the interface of ``Dynamics``; u is the first three controls."""

    matrix = torch.tensor([[0.9, 0.1, 0.0], [0.0, 0.8, 0.2], [0.1, 0.0, 0.7]])
    noise = torch.tensor([0.3, 0.2, 0.25])

    def control_part(self, controls: Tensor) -> Tensor:
        return controls[..., :3]

    def with_jacobian(self, states: Tensor, control_part: Tensor) -> tuple[Tensor, Tensor]:
        return states @ self.matrix.T + control_part, self.matrix.expand(*states.shape, 3)


class Reads(nn.Module):
    """A virtual sensor that hands on some channels of haptics, with a standard deviation."""

    def __init__(self, first: int, noise: float) -> None:
        super().__init__()
        self.first, self.noise = first, noise

    def forward(self, observations: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        z = observations["haptics"][..., self.first : self.first + 3]
        return z, torch.full_like(z, self.noise)


NOISE = (0.5, 0.3)


def linear(second: int = 3, noise: float = NOISE[1]) -> tuple[Checkpoint, Trace]:
    """A linear-Gaussian system seen by two sensors, channels 0..2 and from ``second``; product of experts."""
    checkpoint = untrained("unimodal-ekf")
    filter_: Any = checkpoint.filter
    filter_.dynamics = Linear()
    filter_.virtual_sensors = nn.ModuleDict({"image": Reads(0, NOISE[0]), "haptics": Reads(second, noise)})
    rng, base = np.random.default_rng(5), episode()
    controls, states = np.zeros_like(base.controls), np.zeros((STEPS, 3))
    controls[:, :3] = rng.normal(size=(STEPS, 3))
    for t in range(STEPS):
        before = states[t - 1] if t else np.zeros(3)
        states[t] = Linear.matrix.numpy() @ before + controls[t, :3] + Linear.noise.numpy() * rng.normal(size=3)
    felt = {
        key: np.float32(states + std * rng.normal(size=states.shape))
        for key, std in zip(("effector_position", "force"), NOISE, strict=True)
    }
    made = replace(base, states=np.float32(states), controls=controls, observations={**base.observations, **felt})
    return checkpoint, trace(checkpoint, made, 9)


def kalman(run: Trace, key: str | None, noise: float) -> tuple[Array, Array]:
    """Means (T, 3) and covariances (T, 3, 3) of the Kalman filter that sees ``key``, or nothing."""
    a, q = Linear.matrix.double().numpy(), np.diag(Linear.noise.double().numpy() ** 2)
    mean, covariance = run.start_mean.astype(np.float64), run.start_covariance.astype(np.float64)
    found = []
    for t in range(STEPS):
        mean, covariance = a @ mean + run.episode.controls[t, :3], a @ covariance @ a.T + q
        if key is not None:
            gain = covariance @ np.linalg.inv(covariance + noise**2 * np.eye(3))
            mean = mean + gain @ (run.episode.observations[key][t] - mean)
            covariance = (np.eye(3) - gain) @ covariance
        found.append((mean, covariance))
    means, covariances = zip(*found, strict=True)
    return np.array(means), np.array(covariances)


def test_linear_gaussian_closed_form() -> None:
    checkpoint, run = linear()
    none, first, second = kalman(run, None, 1.0), kalman(run, "effector_position", 0.5), kalman(run, "force", 0.3)
    precision = [np.linalg.inv(covariance) for _, covariance in (first, second)]
    information = sum(p @ mean[..., None] for p, (mean, _) in zip(precision, (first, second), strict=True))
    both = np.linalg.solve(precision[0] + precision[1], information)[..., 0]
    expected = np.stack([none[0], first[0], second[0], both], axis=1)
    # float32 over 50 steps of states of about 3.
    np.testing.assert_allclose(run_subsets(checkpoint, run), expected, atol=2e-5)
    found = shapley.shapley([run], checkpoint)
    gain = 0.5 * (expected[:, 1] - expected[:, 0] + expected[:, 3] - expected[:, 2])
    away = measures.wrapped(checkpoint.task, expected - run.episode.states[:, None])
    np.testing.assert_allclose(found.of_estimate[:, 0, :2], gain[:, :2], atol=5e-5)  # the third may be half a turn off
    distance = np.linalg.norm(away[..., :2], axis=-1)
    of_first = 0.5 * (distance[:, 1] - distance[:, 0] + distance[:, 3] - distance[:, 2])
    np.testing.assert_allclose(found.of_position[:, 0], of_first, atol=5e-5)


def test_a_copy_shares_equally() -> None:
    checkpoint, run = linear(second=0, noise=NOISE[0])
    found = shapley.shapley([run], checkpoint)
    np.testing.assert_allclose(found.of_position[:, 0], found.of_position[:, 1], atol=1e-6)
    np.testing.assert_allclose(found.splits[0].shapley[0], found.splits[0].shapley[1], atol=1e-6)
    assert abs(found.splits[0].shapley[0, 0]) > 0.01


@pytest.mark.parametrize("name", ["feature-ekf", "feature-pf", "lstm"])
def test_what_a_joined_model_lacks_is_black_or_the_training_mean(name: str) -> None:
    checkpoint = untrained(name)
    mean, std = checkpoint.filter.statistics.mean_std("haptics")
    mean.copy_(torch.linspace(-1.0, 1.0, 10))
    std.fill_(2.0)
    base = episode()
    run = trace(checkpoint, base, 9, seed=1, particles=40)
    found = run_subsets(checkpoint, run)
    assert shapley.seen(checkpoint.filter) == ("image", "haptics")
    black = trace(checkpoint, base, 9, seed=1, particles=40, faults=Faults.parse("blackout"))
    keys, first = checkpoint.task.modalities["haptics"], 0
    average = dict(base.observations)
    for key in keys:
        size = base.observations[key].shape[1]
        average[key] = np.tile(mean[first : first + size].numpy(), (STEPS, 1))
        first += size
    numb = trace(checkpoint, replace(base, observations=average), 9, seed=1, particles=40)
    for subset, same in ((1, numb), (2, black), (3, run)):
        np.testing.assert_allclose(found[:, subset], same.estimate_mean, atol=2e-5)
    assert np.abs(found[:, 1] - found[:, 3]).max() > 1e-4


def test_off_starts_elsewhere_and_none_of_it_is_the_default() -> None:
    checkpoint, run = ours("crossmodal-ekf")
    there, one, two = (run_subsets(checkpoint, run, off) for off in (0.0, 1.0, 2.0))
    first, second = one[0, 0] - there[0, 0], two[0, 0] - there[0, 0]
    assert np.linalg.norm(first) > 1e-3
    np.testing.assert_allclose(second, 2 * first, rtol=0.05)  # one step of dynamics that are nearly linear here
    np.testing.assert_allclose(run_subsets(checkpoint, run), there)
    assert "start at the truth" in shapley.shapley([run], checkpoint).verdict
    assert "start at the truth" not in shapley.shapley([run], checkpoint, off=1.0).verdict
    for off in (-1.0, math.inf, math.nan):
        with pytest.raises(BadInput, match="must be 0 or more, and finite"):
            shapley.shapley([run], checkpoint, off=off)


def test_several_traces_have_intervals_around_their_values() -> None:
    checkpoint, _ = ours("crossmodal-ekf")
    runs = [trace(checkpoint, episode(i), i, seed=0) for i in (9, 19, 29, 39, 49)]
    said: list[float] = []
    found = shapley.shapley(runs, checkpoint, progress=said.append)
    assert said == sorted(said)
    assert said[-1] == pytest.approx(1.0)
    whole = found.splits[0]
    assert whole.trajectories == 5
    # A resample's mean of squares is not that of all, yet the middle of intervals of 95 % holds it.
    assert ((whole.low <= whole.shapley) & (whole.shapley <= whole.high)).all()
    assert (whole.low < whole.high).all()
    alike = shapley.shapley([runs[0]] * 5, checkpoint).splits[0]
    np.testing.assert_allclose(alike.low, alike.shapley, atol=1e-9)
    assert not found.curves()
    assert not found.bands()
    assert {len(row) for row in found.tables()[0].rows} == {len(found.tables()[0].columns)}


def test_views_say_what_the_fields_hold() -> None:
    checkpoint, run = ours("crossmodal-pf")
    made: Callable[..., Any] = shapley.ENTRY
    found = made([run], checkpoint)
    json.dumps(found.to_dict(), allow_nan=False)
    json.dumps(found.views(), allow_nan=False)
    assert {curve.values.shape for curve in found.curves()} == {(STEPS,)}
    values, runs = found.tables()
    assert values.columns == ("steps", "count", "RMSE of", "dynamics alone", "image", "haptics", "with all")
    assert runs.columns[3:] == ("dynamics alone", "image", "haptics", "image + haptics")
    np.testing.assert_allclose(runs.rows[0][3:], 100 * found.splits[0].rmse[:, 0])
    for row in values.rows:
        assert row[3] + row[4] + row[5] == pytest.approx(row[6])
    value = 100 * next(one for one in found.splits if one.split == "contact").shapley[1, 0]
    assert f"haptics {'lowers' if value < 0 else 'raises'} it by {abs(value):.2f} cm" in found.verdict


def test_too_many_modalities_are_refused() -> None:
    run = ours("crossmodal-ekf")[1]
    many: Any = SimpleNamespace(filter=SimpleNamespace(names=tuple("abcdefg")))
    assert shapley.why_not(run, many) == "crossmodal-ekf has 7 modalities: 128 subsets are more runs than 64"
    assert shapley.ENTRY.refusal(run, None) == "shapley needs the filter's checkpoint, not only its trace"
