"""Counterfactuals: interventions without effect are bit-identical, and those with faults equal runs with faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.inspect.diagnosis.checks.test_innovations import Boat, run as boat_run

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.compare.counterfactual import compare
from beliefscope.inspect.maps.map_engine import MapEngine
from beliefscope.inspect.trace import ARRAYS, Trace, trace
from beliefscope.inspect.traces.replay import Intervention, Replay


@pytest.fixture(scope="module", params=("crossmodal-ekf", "crossmodal-pf"))
def replay(request: pytest.FixtureRequest) -> Replay:
    checkpoint = load_checkpoint(pretrained_path("door", request.param))
    with open_dataset(sample_path("door")) as data:
        return Replay(checkpoint, trace(checkpoint, data[9], 9, seed=3, particles=100))


def different(run: Trace, other_run: Trace) -> list[str]:
    return [
        n for n in ARRAYS if getattr(run, n) is not None and not np.array_equal(getattr(run, n), getattr(other_run, n))
    ]


@pytest.mark.first(3)
@pytest.mark.parametrize("first", [0, 40, 99])
def test_empty_edit_is_bit_identical(replay: Replay, first: int) -> None:
    assert replay.exact
    intervention = Intervention(first, 100)
    again = replay.with_intervention(intervention)
    assert not different(replay.original, again)
    assert compare(replay.original, again, intervention).verdict.endswith(", nothing changed.")


def test_edit_equals_faults_over_its_steps(replay: Replay) -> None:
    intervention = Intervention(40, 60, Faults.parse("blackout"))
    counterfactual, original = replay.with_intervention(intervention), replay.original
    faults = Faults.parse("blackout:from=40:to=60")
    faulty = trace(replay.checkpoint, original.episode, 9, seed=3, particles=100, faults=faults)
    assert not different(faulty, counterfactual)
    assert counterfactual.faults == faults
    result = compare(original, counterfactual, intervention)
    assert not result.distance[:40].any()
    assert result.distance[40:60].all()
    assert result.carrier == "haptics"


def test_the_sentence_has_the_name_of_a_fault_as_it_is(replay: Replay) -> None:
    intervention = Intervention(40, 60, Faults.parse("force_bias=5"))
    verdict = compare(replay.original, replay.with_intervention(intervention), intervention).verdict
    assert verdict.startswith("With force_bias=5 over steps 40 to 59, the estimate moved by up to ")


def test_manual_beta(replay: Replay) -> None:
    counterfactual = replay.with_intervention(Intervention(40, 60, weights={"image": 0.25}))
    assert counterfactual.weights is not None
    np.testing.assert_allclose(counterfactual.weights[40:60, 0], 0.25, atol=1e-6)
    np.testing.assert_allclose(counterfactual.weights[40:60, 1], 0.75, atol=1e-6)
    assert Replay(replay.checkpoint, counterfactual).exact


def test_invalid_interventions(replay: Replay) -> None:
    with pytest.raises(BadInput, match="has no steps"):
        Intervention(60, 40)
    with pytest.raises(BadInput, match="has its own steps"):
        Intervention(40, 60, Faults.parse("blackout:from=3"))
    with pytest.raises(BadInput, match="must be between 0 and 1"):
        Intervention(40, 60, weights={"image": 1.5})
    with pytest.raises(BadInput, match="after the last step of this episode"):
        replay.with_intervention(Intervention(40, 101))
    with pytest.raises(BadInput, match="modality 'touch' of filter"):
        replay.with_intervention(Intervention(40, 60, weights={"touch": 0.5}))


@pytest.mark.parametrize("replay", ["crossmodal-pf", "crossmodal-ekf"], indirect=True)
def test_maps_use_manual_beta(replay: Replay) -> None:
    counterfactual = replay.with_intervention(Intervention(20, 40, weights={"image": 1.0}))
    step, size = 25, 21
    image, haptics, fused = MapEngine(replay.checkpoint, counterfactual).map(step, size=size).log_likelihood
    # The mixture subtracts a constant from each map; a one-hot beta leaves a single map.
    np.testing.assert_allclose(fused - fused.max(), image - image.max(), rtol=1e-4, atol=1e-4)
    assert np.abs((fused - fused.max()) - (haptics - haptics.max())).max() > 1.0
    same = (MapEngine(replay.checkpoint, run).map(step - 10, size=size) for run in (counterfactual, replay.original))
    np.testing.assert_array_equal(*(run.log_likelihood for run in same))


def test_curves_of_angles_are_in_the_turn_of_the_truth_and_unreported_updates_have_none() -> None:
    original = boat_run(Boat())
    turned = original.estimate_mean + np.float32([0.0, 0.0, 2.0 * np.pi, 0.0])
    unknown = np.full_like(original.modality_mean, np.nan)
    run = replace(original, estimate_mean=turned, modality_mean=unknown)
    curves = compare(run, run, Intervention(5, 9)).curves()
    estimate, *_ = [c.values for c in curves if c.chart == "heading" and c.name == "original"]
    truth, *_ = [c.values for c in curves if c.chart == "heading" and c.name == "truth"]
    assert np.abs(estimate - truth).max() < 90.0
    assert {c.name for c in curves if c.chart.startswith("Distance between")} == {"fused"}


def test_steps_with_an_unknown_covariance_are_left_out_of_the_verdict(replay: Replay) -> None:
    covariance = replay.original.estimate_covariance.copy()
    covariance[::2] = np.nan
    run = replace(replay.original, estimate_covariance=covariance)
    result = compare(run, run, Intervention(2, 6))
    assert result.verdict.endswith("nothing changed.")
