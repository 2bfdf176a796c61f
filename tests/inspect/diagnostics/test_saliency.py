"""Saliency: completeness, linear functions, finite differences, and inputs without effect."""

from __future__ import annotations

import json
import sys
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
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.filters.models.pf import MixtureParticleFilter
from beliefscope.inspect.diagnostics.attribution import MAX_POINTS, TOLERANCE, integrate, occlude
from beliefscope.inspect.diagnostics.saliency import ENTRY, MIN_CHANGE, Saliency, saliency
from beliefscope.inspect.diagnostics.single_step import SingleStep, channels_of
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace, trace
from beliefscope.inspect.traces.replay import Intervention, Replay

pytestmark = pytest.mark.slow

BLACK, VISIBLE = 15, 20
"""A step with image blackout and one without, both in contact."""


def run(checkpoint: Checkpoint, faults: str = f"blackout:from={BLACK}:to={BLACK + 2}", particles: int = 40) -> Trace:
    with open_dataset(sample_path("door")) as data:
        episode = data[9]
    cut: dict[str, Any] = {name: getattr(episode, name)[:40] for name in ("states", "controls", "contact", "qpos")}
    cut["observations"] = {key: array[:40] for key, array in episode.observations.items()}
    return trace(checkpoint, replace(episode, **cut), 9, seed=3, particles=particles, faults=Faults.parse(faults))


@cache
def builtin(name: str) -> Replay:
    checkpoint = load_checkpoint(pretrained_path("door", name))
    return Replay(checkpoint, run(checkpoint))


def untrained(name: str) -> Replay:
    checkpoint = Checkpoint(build(architecture("door", name)).eval().requires_grad_(False), name, "0" * 64, {})
    return Replay(checkpoint, run(checkpoint))


def linear(seed: int = 0) -> tuple[Any, tuple[Tensor, ...], tuple[Tensor, ...], tuple[Tensor, ...]]:
    """A linear function of an image and a vector, with its weights, inputs and baselines."""
    generator = torch.Generator().manual_seed(seed)
    weights, inputs, baselines = (
        tuple(torch.randn(1, *shape, generator=generator) for shape in ((8, 8), (5,))) for _ in range(3)
    )

    def function(*values: Tensor) -> Tensor:
        return sum((w * x).flatten(1).sum(1) for w, x in zip(weights, values, strict=True))  # type: ignore[return-value]

    return function, weights, inputs, baselines


def test_a_linear_function_gives_weights_times_changes() -> None:
    function, weights, inputs, baselines = linear()
    result, points, gap = integrate(function, inputs, baselines, 1e-3)
    assert points == 32
    assert gap < 1e-4
    occlusion = occlude(function, inputs, baselines, window=1)
    for w, x, b, integrated, occluded in zip(weights, inputs, baselines, result, occlusion, strict=True):
        torch.testing.assert_close(integrated, w * (x - b), rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(occluded, w * (x - b), rtol=1e-4, atol=2e-5)


def test_occlusion_is_the_mean_over_windows() -> None:
    function, _, inputs, baselines = linear()

    def bent(*values: Tensor) -> Tensor:
        return function(*values).square()

    result = occlude(bent, inputs, baselines, window=4)[0]
    total, count = torch.zeros(8, 8), torch.zeros(8, 8)
    for row in (0, 2, 4):
        for column in (0, 2, 4):
            window = (slice(row, row + 4), slice(column, column + 4))
            hidden = inputs[0].clone()
            hidden[0][window] = baselines[0][0][window]
            total[window] += bent(*inputs)[0] - bent(hidden, inputs[1])[0]
            count[window] += 1
    torch.testing.assert_close(result[0], total / count, rtol=1e-4, atol=1e-4)


def test_steep_segments_of_the_path_are_bisected() -> None:
    inputs, baselines = (torch.tensor([[2.0, 1.0]]),), (torch.zeros(1, 2),)

    def steep(x: Tensor) -> Tensor:
        return torch.relu(1000.0 * (x[:, 0] - 1.234)).clamp_max(10.0) + 0.1 * x[:, 1]

    parts: list[float] = []
    result, points, gap = integrate(steep, inputs, baselines, 1e-3, parts.append)
    assert parts == sorted(parts)
    assert parts[-1] == points / MAX_POINTS
    assert 32 < points < 400
    assert gap < TOLERANCE
    # The increase covers 0.5 % of the path, too little for a uniform grid.
    assert float(result[0][0, 0]) == pytest.approx(10.0, rel=TOLERANCE)
    assert float(result[0][0, 1]) == pytest.approx(0.1, rel=1e-4)


def test_equal_inputs_and_baselines_have_no_attribution() -> None:
    function, _, inputs, _ = linear()
    result, points, gap = integrate(function, inputs, inputs, 1e-3)
    assert (points, gap) == (32, 0.0)
    assert not any(x.any() for x in result)


INFORMATION = ("information-ekf", "information-pf")
KINDS = ("crossmodal-ukf", *INFORMATION, "unimodal-ekf", "unimodal-pf", "feature-ekf", "lstm", "haptics-pf")


@pytest.mark.long
@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf", *KINDS])
def test_original_inputs_reproduce_the_trace(name: str) -> None:
    replay = builtin(name) if name in ("crossmodal-ekf", "crossmodal-pf") else untrained(name)
    single_step, original = SingleStep(replay, VISIBLE), replay.original
    copies = tuple(x.expand(3, *x.shape[1:]) for x in single_step.inputs)
    for i, component in enumerate(replay.checkpoint.task.components):
        values = single_step.target(component.name)(*copies)
        # Rounding differs between batch sizes.
        np.testing.assert_allclose(values.detach().numpy(), original.estimate_mean[VISIBLE, i], atol=1e-5)
    if original.weights is not None:
        for k, model in enumerate(original.modalities):
            values = single_step.target(f"beta:{model}")(*copies)
            np.testing.assert_allclose(values.detach().numpy(), original.weights[VISIBLE, k].mean(), atol=1e-5)
    kinds = {target.partition(":")[0] for target in single_step.targets}
    assert ("beta" in kinds) == (original.weights is not None)
    assert ("log-likelihood" in kinds) == (name != "lstm")


def test_log_likelihood_of_a_kalman_filter_is_posterior_over_predicted() -> None:
    replay = builtin("crossmodal-ekf")
    single_step, run = SingleStep(replay, VISIBLE), replay.original
    assert run.predicted_mean is not None
    assert run.predicted_covariance is not None
    for k, name in enumerate(run.modalities):
        densities = []
        for mean, covariance in (
            (run.modality_mean, run.modality_covariance),
            (run.predicted_mean, run.predicted_covariance),
        ):
            error = run.episode.states[VISIBLE] - mean[VISIBLE, k].astype(np.float64)
            s = covariance[VISIBLE, k].astype(np.float64)
            densities.append(-0.5 * (error @ np.linalg.solve(s, error) + np.linalg.slogdet(s).logabsdet))
        result = float(single_step.target(f"log-likelihood:{name}")(*single_step.inputs))
        assert result == pytest.approx(densities[0] - densities[1], abs=2e-3)  # units cancel; single precision


def test_log_likelihood_of_particles_averages_to_one() -> None:
    """``sum_i w_i p(z | x_i) / p(z) = 1`` over the predicted particles, for any constant of the likelihood."""
    replay = builtin("crossmodal-pf")
    single_step = SingleStep(replay, VISIBLE)
    step, _ = single_step.run(*single_step.inputs)
    states: Tensor = step.predicted.states[0]  # type: ignore[union-attr]
    copies = tuple(x.expand(len(states), *x.shape[1:]) for x in single_step.inputs)
    single_step.place = states.unsqueeze(1)
    for name in replay.original.modalities:
        values = single_step.target(f"log-likelihood:{name}")(*copies)
        assert float(values.exp().mean()) == pytest.approx(1.0, abs=1e-4)
    assert isinstance(replay.checkpoint.filter, MixtureParticleFilter)


def test_position_of_the_log_likelihood() -> None:
    replay = builtin("crossmodal-ekf")
    truth, estimate = SingleStep(replay, VISIBLE), SingleStep(replay, VISIBLE, "estimate")
    si = replay.checkpoint.filter.statistics.state_to_si
    np.testing.assert_allclose(si(truth.place).numpy(), replay.original.episode.states[VISIBLE], atol=1e-6)
    np.testing.assert_allclose(si(estimate.place).numpy(), replay.original.estimate_mean[VISIBLE], atol=1e-6)


@pytest.mark.first(2)
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
    checkpoint = load_checkpoint(pretrained_path("door", name))  # a copy in double precision
    replay = Replay(checkpoint, run(checkpoint))
    checkpoint.filter.double()
    belief = replay.beliefs[VISIBLE]
    replay.beliefs[VISIBLE] = type(belief)(*(getattr(belief, x.name).double() for x in fields(belief)))
    single_step = SingleStep(replay, VISIBLE)
    function, generator = single_step.target(target), torch.Generator().manual_seed(0)
    inputs = tuple(x.clone().requires_grad_(True) for x in single_step.inputs)
    gradients = torch.autograd.grad(function(*inputs).sum(), inputs)
    for i, gradient in enumerate(gradients):
        way = torch.randn(gradient.shape, generator=generator, dtype=torch.float64)
        ends = []
        for sign in (1.0, -1.0):
            shifted = list(single_step.inputs)
            shifted[i] = shifted[i] + sign * 1e-6 * way  # small enough to rarely cross the kink of a ReLU
            ends.append(float(function(*shifted)))
        expected = (ends[0] - ends[1]) / 2e-6
        assert float((gradient * way).sum()) == pytest.approx(expected, rel=1e-4, abs=1e-8)


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("name", "target"),
    [("crossmodal-ekf", "hinge_y"), ("crossmodal-ekf", "beta:image"), ("crossmodal-pf", "hinge_x")],
)
def test_completeness(name: str, target: str) -> None:
    replay = builtin(name)
    single_step = SingleStep(replay, VISIBLE)
    function = single_step.target(target)
    for black in (False, True):
        baselines = single_step.baseline(black)
        result, _, gap = integrate(function, single_step.inputs, baselines, MIN_CHANGE / function.factor)
        change = float(function(*single_step.inputs) - function(*baselines))
        error = abs(sum(float(x.sum()) for x in result) - change)
        assert gap < TOLERANCE
        # Segment ends are rounded to single precision.
        assert error <= gap * max(abs(change), MIN_CHANGE / function.factor) + 1e-6


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_inputs_without_effect_have_no_attribution(name: str) -> None:
    replay = builtin(name)
    single_step = SingleStep(replay, VISIBLE)
    baselines = single_step.baseline(black=False)
    for k, model in enumerate(replay.original.modalities):
        function = single_step.target(f"log-likelihood:{model}")
        inputs = tuple(x.clone().requires_grad_(True) for x in single_step.inputs)
        gradients = torch.autograd.grad(function(*inputs).sum(), inputs)
        occlusion = occlude(function, single_step.inputs, baselines, window=8)
        for i in range(2):
            assert bool(gradients[i].any()) == (i == k)
            # Tolerance for rounding differences between batch sizes.
            assert bool(occlusion[i].abs().max() > 1e-4) == (i == k)


def saliency_of(name: str, **options: Any) -> Saliency:
    replay = builtin(name)
    return saliency([replay.original], replay.checkpoint, **options)


def test_blacked_out_image_has_no_attribution_relative_to_black() -> None:
    result = saliency_of("crossmodal-ekf", step=BLACK)
    gray, black = result.attributions
    assert (gray.baseline, black.baseline) == ("gray", "black")
    assert not black.integrated["image"].any()
    assert gray.integrated["image"].any()
    assert result.means["image"].std() == 0.0


def test_manual_beta_has_no_attribution() -> None:
    replay = builtin("crossmodal-pf")
    counterfactual = replay.with_intervention(Intervention(VISIBLE, VISIBLE + 3, weights={"image": 0.25}))
    result = saliency([counterfactual], replay.checkpoint, target="beta:image", step=VISIBLE + 1)
    assert result.value == pytest.approx(0.25)
    for x in result.attributions:
        assert not any(values.any() for values in x.integrated.values())


def test_defaults_are_the_worst_step_and_component() -> None:
    replay = builtin("crossmodal-ekf")
    original = replay.original
    checkpoint, y = replay.checkpoint, run(replay.checkpoint, "blackout")
    error = [measures.main_error(x)[30:, -1] for x in (original, y)]
    worst = int(np.argmax([x.max() for x in error]))
    result = saliency([original, y], checkpoint)
    assert result.step == 30 + int(error[worst].argmax())
    std = checkpoint.filter.statistics.mean_std("state")[1].numpy()
    error = np.abs(measures.errors((original, y)[worst])[result.step, -1]) / std
    component = int(error.argmax())
    assert result.target == checkpoint.task.components[component].name
    assert result.value == pytest.approx((original, y)[worst].estimate_mean[result.step, component], abs=1e-5)
    progress: list[float] = []
    saliency([original], checkpoint, step=VISIBLE, progress=progress.append)
    assert progress == sorted(progress)
    assert progress[-1] == 1.0


def test_views_match_the_fields() -> None:
    replay = builtin("crossmodal-ekf")
    result = saliency_of("crossmodal-ekf", step=VISIBLE, target="hinge_y")
    json.dumps(result.to_dict(), allow_nan=False)
    json.dumps(result.views(), allow_nan=False)
    assert result.unit == "cm"
    assert result.truth == pytest.approx(replay.original.episode.states[VISIBLE, 1])
    sums, channels = result.tables()
    for table in (sums, channels):
        assert {len(row) for row in table.rows} == {len(table.columns)}
    assert [row[1:3] for row in channels.rows[:4]] == [
        ("effector_position x", "cm"),
        ("effector_position y", "cm"),
        ("effector_position z", "cm"),
        ("force x", "N"),
    ]
    force = replay.original.episode.observations["force"][VISIBLE, 0]
    assert channels.rows[3][3] == pytest.approx(force, abs=1e-4)
    image, gray, black, occlusion = result.images()
    assert not image.signed
    np.testing.assert_array_equal(image.values, replay.original.episode.observations["image"][VISIBLE])
    for panel, x in zip((gray, black), result.attributions, strict=True):
        assert x.baseline in panel.title
        row = next(row for row in sums.rows if x.baseline in str(row[0]))
        assert 100 * x.integrated["image"].sum() == pytest.approx(row[1], abs=1e-4)
    assert occlusion.unit == "cm"
    assert result.verdict.startswith(f"At step {VISIBLE} of episode 9, hinge y is ")
    assert "complete within" in result.verdict
    incomplete = replace(result, attributions=(replace(result.attributions[0], gap=0.05), result.attributions[1]))
    assert "Relative to gray, the integrated gradients miss 5.0 % of the change" in incomplete.verdict
    assert "complete within" not in incomplete.verdict


def test_filter_without_images_has_one_baseline() -> None:
    replay = untrained("haptics-pf")
    result = saliency([replay.original], replay.checkpoint, step=VISIBLE)
    assert [x.baseline for x in result.attributions] == ["the mean"]
    assert list(result.inputs) == ["haptics"]
    assert not result.images()
    assert "Relative to mean haptics (" in result.verdict


def test_channels_have_names_and_units() -> None:
    task = builtin("crossmodal-ekf").checkpoint.task
    channels = channels_of(task, task.modalities)
    assert list(channels) == ["haptics"]
    assert [(x.name, x.unit) for x in channels["haptics"]][-2:] == [("torque z", "N m"), ("contact", "")]


def test_invalid_arguments_are_refused() -> None:
    with pytest.raises(
        BadInput, match=r"'beta:touch' of filter .* does not exist\. Available: hinge_x, hinge_y, angle, log-"
    ):
        saliency_of("crossmodal-ekf", target="beta:touch")
    with pytest.raises(BadInput, match="step 40 is not in this trace: it has steps 0 to 39"):
        saliency_of("crossmodal-ekf", step=40)
    for window in (0, 33):
        with pytest.raises(BadInput, match=f"window must be 1 to 32 pixels, the size of the image, not {window}"):
            saliency_of("crossmodal-ekf", window=window)
    assert ENTRY.refusal(builtin("crossmodal-ekf").original, None) is not None


def test_missing_captum_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "captum", None)
    with pytest.raises(BadInput, match=r"pip install 'beliefscope\[attribution\]'"):
        saliency_of("crossmodal-ekf", step=VISIBLE)
