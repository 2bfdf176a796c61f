"""Shapley values: axioms, and filters whose subsets have a closed form."""

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
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.filters.evaluate import evaluate
from beliefscope.inspect.diagnostics import shapley
from beliefscope.inspect.diagnostics.shapley import MAX_MODALITIES, members, run_subsets, shapley_weights
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace, trace
from beliefscope.inspect.traces.replay import Intervention, Replay

sys.path.insert(0, str(Path(__file__).parent))
import planted_traces as plant

Array = NDArray[np.float64]

STEPS = 50


def episode(index: int = 9, steps: int = STEPS) -> Any:
    with open_dataset(sample_path("door")) as data:
        return plant.of_length(data[index], steps)


@cache
def builtin(name: str) -> tuple[Checkpoint, Trace]:
    """A pretrained filter for the door task, and a run with image blackout."""
    checkpoint = load_checkpoint(pretrained_path("door", name))
    return checkpoint, trace(checkpoint, episode(), 9, seed=3, particles=60, faults=Faults.parse("blackout=0.3"))


def untrained(name: str) -> Checkpoint:
    return Checkpoint(build(architecture("door", name)).eval().requires_grad_(False), name, "0" * 64, {})


def by_orders(values: Array, count: int) -> Array:
    """Shapley values by definition, as mean gains over all permutations; values: (2^K,)."""
    result = np.zeros(count)
    for order in permutations(range(count)):
        joined = 0
        for k in order:
            result[k] += values[joined | 1 << k] - values[joined]
            joined |= 1 << k
    return result / math.factorial(count)


@pytest.mark.parametrize("count", range(1, 6))
def test_values_are_mean_gains_over_permutations(count: int) -> None:
    values = np.random.default_rng(count).normal(size=2**count)
    result = shapley_weights(count) @ values
    np.testing.assert_allclose(result, by_orders(values, count), atol=1e-12)
    assert result.sum() == pytest.approx(values[-1] - values[0])  # efficiency


@pytest.mark.parametrize("count", [2, 4, MAX_MODALITIES])
def test_axioms(count: int) -> None:
    rng, member, weights = np.random.default_rng(count), members(count), shapley_weights(count)
    first, second = rng.normal(size=(2, 2**count))
    np.testing.assert_allclose(weights @ (2 * first - second), 2 * weights @ first - weights @ second, atol=1e-12)
    each = rng.normal(size=count)
    np.testing.assert_allclose(weights @ (member @ each), each, atol=1e-12)  # additive game
    last = 1 << (count - 1)
    without = first[np.arange(2**count) & ~last]  # null player
    assert (weights @ without)[-1] == pytest.approx(0.0, abs=1e-12)
    swap = member[:, [1, 0, *range(2, count)]] @ (1 << np.arange(count))
    result = weights @ (first + first[swap])  # symmetric players
    assert result[0] == pytest.approx(result[1])


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_complete_and_single_subsets_match_the_filter(name: str) -> None:
    checkpoint, run = builtin(name)
    result = run_subsets(checkpoint, run)
    assert result.shape == (STEPS, 4, 3)
    # Rounding differs between batch sizes.
    np.testing.assert_allclose(result[:, -1], run.estimate_mean, atol=2e-5)
    error = measures.wrapped(checkpoint.task, result - run.episode.states[:, None])[measures.counted(run)]
    for k, modality in enumerate(run.modalities):
        metrics = evaluate(checkpoint.filter, [run.episode], only=modality, particles=60, seed=3)
        position = np.sqrt(np.square(error[:, 1 + k, :2]).sum(-1).mean())
        assert 100 * position == pytest.approx(metrics.rmse["position_cm"], abs=1e-3)


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_values_sum_to_the_total_change(name: str) -> None:
    checkpoint, run = builtin(name)
    result = shapley.shapley([run], checkpoint)
    assert {first.phase for first in result.phases} == {"all", "contact", "free motion", "blackout"} - {
        phase for phase, mask in measures.phases(run).items() if not mask.any()
    }
    for first in result.phases:
        np.testing.assert_allclose(first.shapley.sum(0), first.rmse[-1] - first.rmse[0], atol=1e-12)
    error = result.position_error
    np.testing.assert_allclose(result.position_values.sum(-1), error[:, -1] - error[:, 0], atol=1e-12)
    changes = measures.wrapped(checkpoint.task, np.diff(run_subsets(checkpoint, run)[:, [0, -1]], axis=1)[:, 0])
    np.testing.assert_allclose(result.estimate_values.sum(1), changes, atol=1e-6)


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_modality_with_zero_beta_has_zero_value(name: str) -> None:
    checkpoint, run = builtin(name)
    counterfactual = Replay(checkpoint, run).with_intervention(Intervention(0, STEPS, weights={"haptics": 0.0}))
    result = shapley.shapley([counterfactual], checkpoint)
    np.testing.assert_allclose(result.estimate_values[:, 1], 0.0, atol=1e-7)  # float32
    assert np.abs(result.estimate_values[:, 0]).max() > 1e-3
    assert result.phases[0].shapley[1] == pytest.approx(0.0, abs=1e-7)


class Linear(nn.Module):
    """``x' = A x + u`` with the interface of ``Dynamics``; u is the first three controls."""

    matrix = torch.tensor([[0.9, 0.1, 0.0], [0.0, 0.8, 0.2], [0.1, 0.0, 0.7]])
    noise = torch.tensor([0.3, 0.2, 0.25])

    def control_part(self, controls: Tensor) -> Tensor:
        return controls[..., :3]

    def with_jacobian(self, states: Tensor, control_part: Tensor) -> tuple[Tensor, Tensor]:
        return states @ self.matrix.T + control_part, self.matrix.expand(*states.shape, 3)


class ChannelSensor(nn.Module):
    """A virtual sensor that returns three haptics channels with a constant standard deviation."""

    def __init__(self, first: int, noise: float) -> None:
        super().__init__()
        self.first, self.noise = first, noise

    def forward(self, observations: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        z = observations["haptics"][..., self.first : self.first + 3]
        return z, torch.full_like(z, self.noise)


NOISE = (0.5, 0.3)


def linear(second: int = 3, noise: float = NOISE[1]) -> tuple[Checkpoint, Trace]:
    """A linear-Gaussian system with two sensors, channels 0..2 and from ``second``; product of experts."""
    checkpoint = untrained("unimodal-ekf")
    filter_: Any = checkpoint.filter
    filter_.dynamics = Linear()
    filter_.virtual_sensors = nn.ModuleDict(
        {"image": ChannelSensor(0, NOISE[0]), "haptics": ChannelSensor(second, noise)}
    )
    rng, base = np.random.default_rng(5), episode()
    controls, states = np.zeros_like(base.controls), np.zeros((STEPS, 3))
    controls[:, :3] = rng.normal(size=(STEPS, 3))
    for t in range(STEPS):
        previous = states[t - 1] if t else np.zeros(3)
        states[t] = Linear.matrix.numpy() @ previous + controls[t, :3] + Linear.noise.numpy() * rng.normal(size=3)
    observations = {
        key: np.float32(states + std * rng.normal(size=states.shape))
        for key, std in zip(("effector_position", "force"), NOISE, strict=True)
    }
    entry = replace(
        base, states=np.float32(states), controls=controls, observations={**base.observations, **observations}
    )
    return checkpoint, trace(checkpoint, entry, 9)


def kalman(run: Trace, key: str | None, noise: float) -> tuple[Array, Array]:
    """Means (T, 3) and covariances (T, 3, 3) of the Kalman filter that observes ``key``, or nothing."""
    a, q = Linear.matrix.double().numpy(), np.diag(Linear.noise.double().numpy() ** 2)
    mean, covariance = run.start_mean.astype(np.float64), run.start_covariance.astype(np.float64)
    result = []
    for t in range(STEPS):
        mean, covariance = a @ mean + run.episode.controls[t, :3], a @ covariance @ a.T + q
        if key is not None:
            gain = covariance @ np.linalg.inv(covariance + noise**2 * np.eye(3))
            mean = mean + gain @ (run.episode.observations[key][t] - mean)
            covariance = (np.eye(3) - gain) @ covariance
        result.append((mean, covariance))
    means, covariances = zip(*result, strict=True)
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
    result = shapley.shapley([run], checkpoint)
    gain = 0.5 * (expected[:, 1] - expected[:, 0] + expected[:, 3] - expected[:, 2])
    errors = measures.wrapped(checkpoint.task, expected - run.episode.states[:, None])
    np.testing.assert_allclose(result.estimate_values[:, 0, :2], gain[:, :2], atol=5e-5)  # the third component wraps
    distance = np.linalg.norm(errors[..., :2], axis=-1)
    of_first = 0.5 * (distance[:, 1] - distance[:, 0] + distance[:, 3] - distance[:, 2])
    np.testing.assert_allclose(result.position_values[:, 0], of_first, atol=5e-5)


def test_duplicate_modalities_have_equal_values() -> None:
    checkpoint, run = linear(second=0, noise=NOISE[0])
    result = shapley.shapley([run], checkpoint)
    np.testing.assert_allclose(result.position_values[:, 0], result.position_values[:, 1], atol=1e-6)
    np.testing.assert_allclose(result.phases[0].shapley[0], result.phases[0].shapley[1], atol=1e-6)
    assert abs(result.phases[0].shapley[0, 0]) > 0.01


@pytest.mark.first(1)
@pytest.mark.parametrize("name", ["feature-ekf", "feature-pf", "lstm"])
def test_missing_inputs_of_shared_models_are_neutral(name: str) -> None:
    checkpoint = untrained(name)
    mean, std = checkpoint.filter.statistics.mean_std("haptics")
    mean.copy_(torch.linspace(-1.0, 1.0, 10))
    std.fill_(2.0)
    base = episode()
    run = trace(checkpoint, base, 9, seed=1, particles=40)
    result = run_subsets(checkpoint, run)
    assert shapley.modalities_of(checkpoint) == ("image", "haptics")
    black = trace(checkpoint, base, 9, seed=1, particles=40, faults=Faults.parse("blackout"))
    keys, first = checkpoint.task.modalities["haptics"], 0
    average = dict(base.observations)
    for key in keys:
        size = base.observations[key].shape[1]
        average[key] = np.tile(mean[first : first + size].numpy(), (STEPS, 1))
        first += size
    constant = trace(checkpoint, replace(base, observations=average), 9, seed=1, particles=40)
    for subset, same in ((1, constant), (2, black), (3, run)):
        np.testing.assert_allclose(result[:, subset], same.estimate_mean, atol=2e-5)
    assert np.abs(result[:, 1] - result[:, 3]).max() > 1e-4


def test_offset_of_the_initial_state() -> None:
    checkpoint, run = builtin("crossmodal-ekf")
    joined, first, two = (run_subsets(checkpoint, run, offset) for offset in (0.0, 1.0, 2.0))
    first, second = first[0, 0] - joined[0, 0], two[0, 0] - joined[0, 0]
    assert np.linalg.norm(first) > 1e-3
    np.testing.assert_allclose(second, 2 * first, rtol=0.05)  # nearly linear dynamics
    np.testing.assert_allclose(run_subsets(checkpoint, run), joined)
    assert "start at the true state" in shapley.shapley([run], checkpoint).verdict
    assert "start at the true state" not in shapley.shapley([run], checkpoint, offset=1.0).verdict
    for offset in (-1.0, math.inf, math.nan):
        with pytest.raises(BadInput, match="must be a finite number of standard deviations, at least 0"):
            shapley.shapley([run], checkpoint, offset=offset)


@pytest.mark.slow
def test_intervals_contain_the_values() -> None:
    checkpoint, _ = builtin("crossmodal-ekf")
    runs = [trace(checkpoint, episode(i, 36), i, seed=0) for i in (9, 19, 29, 39, 49)]
    progress: list[float] = []
    result = shapley.shapley(runs, checkpoint, progress=progress.append)
    assert progress == sorted(progress)
    assert progress[-1] == pytest.approx(1.0)
    total = result.phases[0]
    assert total.trajectories == 5
    assert ((total.low <= total.shapley) & (total.shapley <= total.high)).all()
    assert (total.low < total.high).all()
    equal = shapley.shapley([runs[0]] * 5, checkpoint).phases[0]
    np.testing.assert_allclose(equal.low, equal.shapley, atol=1e-9)
    assert not result.curves()
    assert not result.bands()
    assert {len(row) for row in result.tables()[0].rows} == {len(result.tables()[0].columns)}


def test_views_match_the_fields() -> None:
    checkpoint, run = builtin("crossmodal-pf")
    entry: Callable[..., Any] = shapley.ENTRY
    result = entry([run], checkpoint)
    json.dumps(result.to_dict(), allow_nan=False)
    json.dumps(result.views(), allow_nan=False)
    assert {curve.values.shape for curve in result.curves()} == {(STEPS,)}
    values, runs = result.tables()
    assert values.columns == ("phase", "steps", "RMSE of", "dynamics only", "image", "haptics", "all modalities")
    assert runs.columns[3:] == ("dynamics only", "image", "haptics", "image + haptics")
    np.testing.assert_allclose(runs.rows[0][3:], 100 * result.phases[0].rmse[:, 0])
    for row in values.rows:
        assert row[3] + row[4] + row[5] == pytest.approx(row[6])
    value = 100 * next(first for first in result.phases if first.phase == "contact").shapley[1, 0]
    assert f"haptics {'lowers' if value < 0 else 'raises'} it by {abs(value):.2f} cm" in result.verdict
    nothing = replace(result, phases=tuple(replace(p, shapley=0.0 * p.shapley) for p in result.phases))
    assert "image hardly changes the position RMSE, haptics hardly changes it (" in nothing.verdict


def test_too_many_modalities_are_refused() -> None:
    run = builtin("crossmodal-ekf")[1]
    checkpoint: Any = SimpleNamespace(filter=SimpleNamespace(names=tuple("abcdefg")))
    assert shapley.why_not(run, checkpoint) == "filter crossmodal-ekf has 7 modalities; at most 6 are supported"
    assert (
        shapley.ENTRY.refusal(run, None)
        == "diagnostic shapley needs the filter, not only its trace: give its checkpoint, or --filter FILE.py:FUNCTION"
    )
