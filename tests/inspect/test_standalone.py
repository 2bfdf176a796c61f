"""Standalone runs: a Kalman filter with one sensor, and filters for which standalone and normal runs are equal."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.belief import Evidence, Gaussian
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.filters.models.ekf import ExtendedKalmanFilter
from beliefscope.filters.rollout import rollout
from beliefscope.filters.subsets import standalone_evidence
from beliefscope.inspect.standalone import standalone, standalone_runs
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import ARRAYS, Trace, load_trace, save_trace, trace
from beliefscope.inspect.traces.replay import Intervention, Replay

sys.path.insert(0, str(Path(__file__).parents[1] / "filters" / "models"))
import linear_system as linear

STEPS = 40


@pytest.fixture(scope="module")
def episode() -> Episode:
    with open_dataset(sample_path("door")) as data:
        whole = data[9]
    return replace(
        whole,
        **{name: getattr(whole, name)[:STEPS] for name in ("states", "controls", "contact", "qpos")},
        observations={key: value[:STEPS] for key, value in whole.observations.items()},
    )


def untrained(name: str, **changes: object) -> Checkpoint:
    filter_ = build(replace(architecture("door", name), **changes))  # type: ignore[arg-type]
    return Checkpoint(filter_.eval().requires_grad_(False), name, "0" * 64, {})


def equal(a: Trace, b: Trace, names: tuple[str, ...] = ARRAYS) -> bool:
    pairs = [(getattr(a, name), getattr(b, name)) for name in names]
    return all(x is y or (x is not None and y is not None and np.array_equal(x, y, equal_nan=True)) for x, y in pairs)


@pytest.mark.parametrize("fusion", ["unimodal", "crossmodal"])
def test_linear_system_with_two_sensors_equals_a_kalman_filter_with_one(fusion: str) -> None:
    """Feedback shares the fused belief, so updates use both sensors; standalone, the textbook filter of one."""
    filter_ = build(replace(architecture("door", "crossmodal-ekf"), feedback=True, fusion=fusion)).double()
    assert isinstance(filter_, ExtendedKalmanFilter)
    filter_.dynamics = linear.LinearDynamics()  # type: ignore[assignment]
    controls, first = linear.simulate(STEPS, seed=1)
    second = first + np.random.default_rng(2).normal(size=first.shape)
    log_beta = torch.full((STEPS, 1, 2, 3), 0.5, dtype=torch.float64).log()
    evidence = Evidence(
        control=torch.from_numpy(controls)[:, None],
        observation=torch.from_numpy(np.stack([first, second], axis=1))[:, None],
        noise=torch.from_numpy(np.tile(linear.R_STD, (STEPS, 2, 1)))[:, None],
        log_weights=log_beta if fusion == "crossmodal" else None,
    )
    batch = SimpleNamespace(states=torch.zeros(STEPS, 1, 3))
    start = Gaussian(torch.zeros(1, 3, dtype=torch.float64), torch.from_numpy(linear.START)[None])
    for k, (modality, observations) in enumerate({"image": first, "haptics": second}.items()):
        selected = standalone_evidence(filter_, batch, evidence, modality)  # type: ignore[arg-type]
        estimate = rollout(filter_, selected, start, torch.Generator()).estimate
        mean, covariance = linear.kalman(controls, observations)
        np.testing.assert_allclose(estimate.mean[:, 0], mean, atol=1e-9)
        np.testing.assert_allclose(estimate.covariance[:, 0], covariance, atol=1e-9)
        steps = rollout(filter_, evidence, start, torch.Generator(), keep=True).steps
        updates = np.array([update.mean[0, k].numpy() for step in steps if (update := step.updates()) is not None])
        np.testing.assert_allclose(updates[0], mean[0], atol=1e-9)  # the first prior is common
        assert np.abs(updates - mean).max() > 0.1


@pytest.mark.parametrize("name", ["image-ekf", "haptics-pf", "image-ekf:ukf"])
def test_filter_of_one_modality_is_standalone_bit_for_bit(name: str, episode: Episode) -> None:
    name, _, kind = name.partition(":")
    checkpoint = untrained(name, **({"kind": kind} if kind else {}))
    run = trace(checkpoint, episode, seed=5, particles=40, faults=Faults.parse("blackout=0.3"))
    result = standalone(checkpoint, run, name.split("-")[0])
    assert equal(run, result)
    assert result.settings["standalone"] == name.split("-")[0]


def test_bank_without_feedback_updates_are_standalone(episode: Episode) -> None:
    checkpoint = untrained("unimodal-ekf", feedback=False)
    run = trace(checkpoint, episode)
    for k, modality in enumerate(run.modalities):
        result = standalone(checkpoint, run, modality)
        np.testing.assert_allclose(result.estimate_mean, run.modality_mean[:, k], atol=1e-5)


@pytest.mark.first(3)
@pytest.mark.parametrize(
    "name", ["crossmodal-ekf", "crossmodal-pf", "unimodal-ekf", "unimodal-pf", "feature-pf", "lstm"]
)
def test_other_observations_and_weights_have_no_effect(name: str, episode: Episode) -> None:
    checkpoint = untrained(name)
    run = trace(checkpoint, episode, seed=2, particles=30)
    result = standalone(checkpoint, run, "haptics")
    other = trace(checkpoint, episode, seed=2, particles=30, faults=Faults.parse("blackout=1"))
    assert equal(result, standalone(checkpoint, other, "haptics"), ("estimate_mean", "estimate_covariance"))
    assert not equal(result, run, ("estimate_mean",))
    if run.weights is not None:
        counterfactual = Replay(checkpoint, run).with_intervention(Intervention(0, STEPS, weights={"haptics": 0.0}))
        assert equal(result, standalone(checkpoint, counterfactual, "haptics"))
    if len(run.modalities) == 2:
        assert result.modalities == ("haptics",)
        np.testing.assert_allclose(result.modality_mean[:, 0], result.estimate_mean, atol=1e-6)


@pytest.mark.first(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_haptics_update_of_the_door_is_not_the_haptics_filter(name: str) -> None:
    """The shared prior carries the image: labelled as haptics, the update hides what haptics is worth."""
    checkpoint = load_checkpoint(pretrained_path("door", name))
    with open_dataset(sample_path("door")) as data:
        runs = [trace(checkpoint, data[i], i, particles=100) for i in data.held_out()[:4]]

    def rmse(traces: list[Trace], layer: int) -> float:
        squares = [np.square(measures.main_error(run)[measures.counted(run), layer]) for run in traces]
        return float(100.0 * np.sqrt(np.concatenate(squares).mean()))

    update, alone = rmse(runs, 1), rmse([standalone(checkpoint, run, "haptics") for run in runs], -1)
    assert runs[0].modalities[1] == "haptics"
    assert update < 0.8
    assert alone > 3.0 * update
    assert measures.layer_label("haptics") == "haptics-only update"
    assert measures.layer_label("wrist_cam") == "wrist cam-only update"


def test_standalone_trace_is_saved_and_replayed_exactly(episode: Episode, tmp_path: Path) -> None:
    checkpoint = untrained("crossmodal-pf")
    result = standalone(checkpoint, trace(checkpoint, episode, particles=30), "image")
    save_trace(result, tmp_path / "image.trace")
    loaded = load_trace(tmp_path / "image.trace")
    replay = Replay(checkpoint, loaded)
    assert replay.exact
    with pytest.raises(BadInput, match="standalone image has no fusion weights"):
        replay.with_intervention(Intervention(3, 5, weights={"image": 0.5}))
    darkened = replay.with_intervention(Intervention(3, 5, faults=Faults.parse("blackout=1")))
    assert np.array_equal(darkened.estimate_mean[:3], loaded.estimate_mean[:3])
    assert darkened.modalities == ("image",)


def test_unknown_modality_is_rejected_with_the_valid_ones(episode: Episode) -> None:
    checkpoint = untrained("crossmodal-ekf")
    run = trace(checkpoint, episode)
    with pytest.raises(BadInput, match=r"Modality 'touch' is not in this filter. Available: image, haptics."):
        standalone(checkpoint, run, "touch")
    with pytest.raises(BadInput, match="the trace is from checkpoint 0000"):
        standalone(replace(checkpoint, hash="1" * 64), run, "image")


def test_a_filter_that_is_not_available_has_no_standalone_runs(episode: Episode) -> None:
    recorded = trace(untrained("crossmodal-ekf"), episode)
    missing = UnavailableFilter(recorded.filter, recorded.checkpoint_hash, recorded.task)
    assert standalone_runs([recorded], missing) == {}
