"""Saliency by its laws: completeness, linear functions, finite differences, and what has no part gets nothing."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, shipped
from beliefscope.filters.models.pf import ParticleFilter
from beliefscope.inspect.diagnostics.saliency import COMPLETE, ENTRY, LEAST, Saliency, integrate, occlude, saliency
from beliefscope.inspect.diagnostics.single_step import Moment, channel_names
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace, trace
from beliefscope.inspect.traces.replay import Edit, Replay

BLACK, SEEN = 15, 20
"""A step with a black picture, and one with a picture, both in contact."""


def run(checkpoint: Checkpoint, faults: str = f"blackout:from={BLACK}:to={BLACK + 2}", particles: int = 40) -> Trace:
    with open_dataset(sample_path("door")) as data:
        episode = data[9]
    cut: dict[str, Any] = {name: getattr(episode, name)[:40] for name in ("states", "controls", "contact", "qpos")}
    cut["observations"] = {key: array[:40] for key, array in episode.observations.items()}
    return trace(checkpoint, replace(episode, **cut), 9, seed=3, particles=particles, faults=Faults.parse(faults))


@cache
def ours(name: str) -> Replay:
    checkpoint = load_checkpoint(shipped("door", name))
    return Replay(checkpoint, run(checkpoint))


def untrained(name: str) -> Replay:
    checkpoint = Checkpoint(build(architecture("door", name)).eval().requires_grad_(False), name, "0" * 64, {})
    return Replay(checkpoint, run(checkpoint))


def linear(seed: int = 0) -> tuple[Any, tuple[Tensor, ...], tuple[Tensor, ...], tuple[Tensor, ...]]:
    """A linear function of a picture and of channels, its weights, inputs and baselines."""
    generator = torch.Generator().manual_seed(seed)
    weights, inputs, baselines = (
        tuple(torch.randn(1, *shape, generator=generator) for shape in ((8, 8), (5,))) for _ in range(3)
    )

    def function(*given: Tensor) -> Tensor:
        return sum((w * x).flatten(1).sum(1) for w, x in zip(weights, given, strict=True))  # type: ignore[return-value]

    return function, weights, inputs, baselines


def test_a_linear_function_gives_weights_times_changes() -> None:
    function, weights, inputs, baselines = linear()
    found, points, gap = integrate(function, inputs, baselines, 1e-3)
    assert points == 32
    assert gap < 1e-4
    alone = occlude(function, inputs, baselines, window=1)
    for w, x, b, one, other in zip(weights, inputs, baselines, found, alone, strict=True):
        torch.testing.assert_close(one, w * (x - b), rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(other, w * (x - b), rtol=1e-4, atol=2e-5)


def test_occlusion_is_the_mean_of_what_windows_change() -> None:
    function, _, inputs, baselines = linear()

    def bent(*given: Tensor) -> Tensor:
        return function(*given).square()

    found = occlude(bent, inputs, baselines, window=4)[0]
    total, count = torch.zeros(8, 8), torch.zeros(8, 8)
    for row in (0, 2, 4):
        for column in (0, 2, 4):
            window = (slice(row, row + 4), slice(column, column + 4))
            hidden = inputs[0].clone()
            hidden[0][window] = baselines[0][0][window]
            total[window] += bent(*inputs)[0] - bent(hidden, inputs[1])[0]
            count[window] += 1
    torch.testing.assert_close(found[0], total / count, rtol=1e-4, atol=1e-4)


def test_a_path_that_bends_is_halved_where_it_does() -> None:
    inputs, baselines = (torch.tensor([[2.0, 1.0]]),), (torch.zeros(1, 2),)

    def steep(x: Tensor) -> Tensor:
        return torch.relu(1000.0 * (x[:, 0] - 1.234)).clamp_max(10.0) + 0.1 * x[:, 1]

    found, points, gap = integrate(steep, inputs, baselines, 1e-3)
    assert 32 < points < 400
    assert gap < COMPLETE
    # The rise takes 0.5 % of the path, on which no even grid of so few points has many.
    assert float(found[0][0, 0]) == pytest.approx(10.0, rel=COMPLETE)
    assert float(found[0][0, 1]) == pytest.approx(0.1, rel=1e-4)


def test_what_does_not_change_is_complete_with_nothing() -> None:
    function, _, inputs, _ = linear()
    found, points, gap = integrate(function, inputs, inputs, 1e-3)
    assert (points, gap) == (32, 0.0)
    assert not any(one.any() for one in found)


KINDS = ("crossmodal-ukf", "unimodal-ekf", "unimodal-pf", "feature-ekf", "lstm", "haptics-pf")


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf", *KINDS])
def test_at_what_was_seen_it_is_the_step_of_the_trace(name: str) -> None:
    replay = ours(name) if name in ("crossmodal-ekf", "crossmodal-pf") else untrained(name)
    moment, original = Moment(replay, SEEN), replay.original
    copies = tuple(one.expand(3, *one.shape[1:]) for one in moment.inputs)
    for i, component in enumerate(replay.checkpoint.task.components):
        values = moment.target(component.name)(*copies)
        # Copies draw the same numbers; rounding differs between batches of one and of three.
        np.testing.assert_allclose(values.detach().numpy(), original.estimate_mean[SEEN, i], atol=1e-5)
    if original.weights is not None:
        for k, model in enumerate(original.modalities):
            values = moment.target(f"beta:{model}")(*copies)
            np.testing.assert_allclose(values.detach().numpy(), original.weights[SEEN, k].mean(), atol=1e-5)
    kinds = {target.partition(":")[0] for target in moment.targets}
    assert ("beta" in kinds) == (original.weights is not None)
    assert ("log-likelihood" in kinds) == (name != "lstm")


def test_log_likelihood_of_a_kalman_filter_is_posterior_over_predicted() -> None:
    replay = ours("crossmodal-ekf")
    moment, run = Moment(replay, SEEN), replay.original
    assert run.predicted_mean is not None
    assert run.predicted_covariance is not None
    for k, name in enumerate(run.modalities):
        densities = []
        for mean, covariance in (
            (run.modality_mean, run.modality_covariance),
            (run.predicted_mean, run.predicted_covariance),
        ):
            off = run.episode.states[SEEN] - mean[SEEN, k].astype(np.float64)
            s = covariance[SEEN, k].astype(np.float64)
            densities.append(-0.5 * (off @ np.linalg.solve(s, off) + np.linalg.slogdet(s).logabsdet))
        found = float(moment.target(f"log-likelihood:{name}")(*moment.inputs))
        assert found == pytest.approx(densities[0] - densities[1], abs=2e-3)  # units cancel; single precision


def test_log_likelihood_of_particles_averages_to_one() -> None:
    """``sum_i w_i p(z | x_i) / p(z) = 1`` over the predicted particles, whatever the likelihood's constant."""
    replay = ours("crossmodal-pf")
    moment = Moment(replay, SEEN)
    step, _ = moment.run(*moment.inputs)
    states: Tensor = step.predicted.states[0]  # type: ignore[union-attr]
    copies = tuple(one.expand(len(states), *one.shape[1:]) for one in moment.inputs)
    moment.place = states.unsqueeze(1)
    for name in replay.original.modalities:
        values = moment.target(f"log-likelihood:{name}")(*copies)
        assert float(values.exp().mean()) == pytest.approx(1.0, abs=1e-4)
    assert isinstance(replay.checkpoint.filter, ParticleFilter)


def test_at_the_estimate_it_is_another_place() -> None:
    replay = ours("crossmodal-ekf")
    truth, estimate = Moment(replay, SEEN), Moment(replay, SEEN, "estimate")
    si = replay.checkpoint.filter.statistics.state_to_si
    np.testing.assert_allclose(si(truth.place).numpy(), replay.original.episode.states[SEEN], atol=1e-6)
    np.testing.assert_allclose(si(estimate.place).numpy(), replay.original.estimate_mean[SEEN], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "target"),
    [
        ("crossmodal-ekf", "hinge_y"),
        ("crossmodal-ekf", "log-likelihood:haptics"),
        ("crossmodal-pf", "angle"),
        ("crossmodal-pf", "log-likelihood:image"),
        ("crossmodal-pf", "beta:haptics"),
    ],
)
def test_gradients_are_finite_differences(name: str, target: str) -> None:
    checkpoint = load_checkpoint(shipped("door", name))  # one of its own, in double precision
    replay = Replay(checkpoint, run(checkpoint))
    checkpoint.filter.double()
    belief = replay.beliefs[SEEN]
    replay.beliefs[SEEN] = type(belief)(*(getattr(belief, one.name).double() for one in fields(belief)))
    moment = Moment(replay, SEEN)
    function, generator = moment.target(target), torch.Generator().manual_seed(0)
    inputs = tuple(one.clone().requires_grad_(True) for one in moment.inputs)
    gradients = torch.autograd.grad(function(*inputs).sum(), inputs)
    for i, gradient in enumerate(gradients):
        way = torch.randn(gradient.shape, generator=generator, dtype=torch.float64)
        ends = []
        for sign in (1.0, -1.0):
            there = list(moment.inputs)
            there[i] = there[i] + sign * 1e-6 * way  # of 255 grays, N and m: seldom across a kink of a ReLU
            ends.append(float(function(*there)))
        expected = (ends[0] - ends[1]) / 2e-6
        assert float((gradient * way).sum()) == pytest.approx(expected, rel=1e-4, abs=1e-8)


@pytest.mark.parametrize(
    ("name", "target"),
    [("crossmodal-ekf", "hinge_y"), ("crossmodal-ekf", "beta:image"), ("crossmodal-pf", "hinge_x")],
)
def test_completeness(name: str, target: str) -> None:
    replay = ours(name)
    moment = Moment(replay, SEEN)
    function = moment.target(target)
    for black in (False, True):
        baselines = moment.baseline(black)
        found, _, gap = integrate(function, moment.inputs, baselines, LEAST / function.factor)
        change = float(function(*moment.inputs) - function(*baselines))
        off = abs(sum(float(one.sum()) for one in found) - change)
        assert gap < COMPLETE
        # Ends of pieces are rounded in single precision.
        assert off <= gap * max(abs(change), LEAST / function.factor) + 1e-6


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_what_has_no_part_gets_nothing(name: str) -> None:
    replay = ours(name)
    moment = Moment(replay, SEEN)
    baselines = moment.baseline(black=False)
    for k, model in enumerate(replay.original.modalities):
        function = moment.target(f"log-likelihood:{model}")
        inputs = tuple(one.clone().requires_grad_(True) for one in moment.inputs)
        gradients = torch.autograd.grad(function(*inputs).sum(), inputs)
        occlusion = occlude(function, moment.inputs, baselines, window=8)
        for i in range(2):
            assert bool(gradients[i].any()) == (i == k)
            # Nothing but what rounding differs by between batches of one and of many.
            assert bool(occlusion[i].abs().max() > 1e-4) == (i == k)


def of(name: str, **options: Any) -> Saliency:
    replay = ours(name)
    return saliency([replay.original], replay.checkpoint, **options)


def test_a_black_picture_has_no_part_against_black_ones() -> None:
    found = of("crossmodal-ekf", step=BLACK)
    gray, black = found.compared
    assert (gray.baseline, black.baseline) == ("gray", "black")
    assert not black.integrated["image"].any()
    assert gray.integrated["image"].any()
    assert found.means["image"].std() == 0.0


def test_beta_by_hand_depends_on_nothing() -> None:
    replay = ours("crossmodal-pf")
    edited = replay.edited(Edit(SEEN, SEEN + 3, weights={"image": 0.25}))
    found = saliency([edited], replay.checkpoint, target="beta:image", step=SEEN + 1)
    assert found.value == pytest.approx(0.25)
    for one in found.compared:
        assert not any(values.any() for values in one.integrated.values())


def test_by_default_the_worst_moment_and_its_worst_component() -> None:
    replay = ours("crossmodal-ekf")
    whole = replay.original
    checkpoint, other = replay.checkpoint, run(replay.checkpoint, "blackout")
    error = [measures.position_error(one)[30:, -1] for one in (whole, other)]
    worst = int(np.argmax([one.max() for one in error]))
    found = saliency([whole, other], checkpoint)
    assert found.step == 30 + int(error[worst].argmax())
    std = checkpoint.filter.statistics.mean_std("state")[1].numpy()
    off = np.abs(measures.errors((whole, other)[worst])[found.step, -1]) / std
    component = int(off.argmax())
    assert found.target == checkpoint.task.components[component].name
    assert found.value == pytest.approx((whole, other)[worst].estimate_mean[found.step, component], abs=1e-5)
    said: list[float] = []
    saliency([whole], checkpoint, step=SEEN, progress=said.append)
    assert said == sorted(said)
    assert said[-1] == 1.0


def test_views_say_what_the_fields_hold() -> None:
    replay = ours("crossmodal-ekf")
    found = of("crossmodal-ekf", step=SEEN, target="hinge_y")
    json.dumps(found.to_dict(), allow_nan=False)
    json.dumps(found.views(), allow_nan=False)
    assert found.unit == "cm"
    assert found.truth == pytest.approx(replay.original.episode.states[SEEN, 1])
    sums, channels = found.tables()
    for table in (sums, channels):
        assert {len(row) for row in table.rows} == {len(table.columns)}
    assert [row[1:3] for row in channels.rows[:4]] == [
        ("effector_position x", "cm"),
        ("effector_position y", "cm"),
        ("effector_position z", "cm"),
        ("force x", "N"),
    ]
    force = replay.original.episode.observations["force"][SEEN, 0]
    assert channels.rows[3][3] == pytest.approx(force, abs=1e-4)
    image, gray, black, occlusion = found.pictures()
    assert not image.signed
    np.testing.assert_array_equal(image.values, replay.original.episode.observations["image"][SEEN])
    for picture, one in zip((gray, black), found.compared, strict=True):
        assert one.baseline in picture.title
        row = next(row for row in sums.rows if one.baseline in str(row[0]))
        assert 100 * one.integrated["image"].sum() == pytest.approx(row[1], abs=1e-4)
    assert occlusion.unit == "cm"
    assert found.verdict.startswith(f"At step {SEEN} of episode 9 hinge_y is ")
    assert "complete within" in found.verdict
    sketch = replace(found, compared=(replace(found.compared[0], gap=0.05), found.compared[1]))
    assert "From gray the integrated gradients miss 5.0 % of the change" in sketch.verdict
    assert "complete within" not in sketch.verdict


def test_a_filter_without_pictures_has_one_baseline() -> None:
    replay = untrained("haptics-pf")
    found = saliency([replay.original], replay.checkpoint, step=SEEN)
    assert [one.baseline for one in found.compared] == ["the mean"]
    assert list(found.inputs) == ["haptics"]
    assert not found.pictures()
    assert "From mean haptics (" in found.verdict


def test_channels_have_names_and_units() -> None:
    task = ours("crossmodal-ekf").checkpoint.task
    names = channel_names(task, task.modalities)
    assert list(names) == ["haptics"]
    assert [(one.name, one.unit) for one in names["haptics"]][-2:] == [("torque z", "N m"), ("contact", "")]


def test_what_there_is_not_is_refused() -> None:
    with pytest.raises(BadInput, match=r"'beta:touch' does not exist\. Available: hinge_x, hinge_y, angle, log-like"):
        of("crossmodal-ekf", target="beta:touch")
    with pytest.raises(BadInput, match="step 40 is not in this trace: it has steps 0 to 39"):
        of("crossmodal-ekf", step=40)
    for window in (0, 33):
        with pytest.raises(BadInput, match=f"window is {window} pixels: the picture has 32"):
            of("crossmodal-ekf", window=window)
    assert ENTRY.refusal(ours("crossmodal-ekf").original, None) is not None
