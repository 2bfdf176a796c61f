"""Fusion efficiency: the closed-form optimum of correlated errors, and constructed traces for each reason of a gap."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics.fusion_efficiency import FusionEfficiency, efficiency_of, fusion_efficiency
from beliefscope.inspect.diagnostics.fusion_gaps import CALIBRATION, DRIFT, PRIOR, WEIGHTS, Reason, reasons_of
from beliefscope.inspect.standalone import standalone
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.oracle import squared_error, unbiased_weights
from beliefscope.inspect.trace import Trace, trace

sys.path.insert(0, str(Path(__file__).parent))
import planted_traces as plant

IMAGE, HAPTICS = 0.03, 0.05
"""m: position RMSE of image and haptics."""


def checkpoint(name: str) -> Checkpoint:
    filter_ = build(architecture("door", name)).eval().requires_grad_(False)
    return Checkpoint(filter_, name, plant.real("crossmodal-ekf").checkpoint_hash, {})


def optimum(correlation: float) -> float:
    i, h = IMAGE**2, HAPTICS**2
    return float(np.sqrt((1.0 - correlation**2) * i * h / (i + h - 2.0 * correlation * IMAGE * HAPTICS)))


def with_errors(correlation: float, weight: float, trajectories: int) -> tuple[list[Trace], list[Any]]:
    """Traces in one phase whose standalone errors have exactly these moments; fused is their weighted mean."""
    rng = np.random.default_rng(1)
    moments = np.array([[IMAGE**2, correlation * IMAGE * HAPTICS], [correlation * IMAGE * HAPTICS, HAPTICS**2]])
    factor = np.linalg.cholesky(moments / 2.0)
    traces, alone = [], []
    base = plant.real("crossmodal-ekf")
    states = base.episode.states.astype(np.float64)
    keep = measures.counted(base)
    for _ in range(trajectories):
        error = np.zeros((len(base), 2, 3))
        for component in range(3):
            white = np.linalg.qr(rng.normal(size=(int(keep.sum()), 2)))[0] * np.sqrt(keep.sum())
            error[keep, :, component] = white @ factor.T
        mean = states + weight * error[:, 0] + (1.0 - weight) * error[:, 1]
        traces.append(plant.planted(base, states, np.ones(len(base)), estimate_mean=mean))
        alone.append(error)
    return traces, alone


@pytest.mark.parametrize("correlation", [0.0, 0.4, 0.9, -0.5])
def test_optimum_of_two_correlated_errors(correlation: float) -> None:
    gram = np.array([[IMAGE**2, correlation * IMAGE * HAPTICS], [correlation * IMAGE * HAPTICS, HAPTICS**2]])
    weights = unbiased_weights(gram)
    assert weights.sum() == pytest.approx(1.0)
    assert np.sqrt(squared_error(weights, gram)) == pytest.approx(optimum(correlation), rel=1e-6)
    around = np.stack([weights + step * np.array([1.0, -1.0]) for step in (-0.1, 0.1)])
    assert (squared_error(around, gram) > squared_error(weights, gram)).all()
    assert optimum(0.0) == pytest.approx(IMAGE / np.sqrt(1.0 + (IMAGE / HAPTICS) ** 2))


@pytest.mark.parametrize("correlation", [0.0, 0.6])
@pytest.mark.parametrize("trajectories", [1, 6])
def test_efficiency_of_known_errors(correlation: float, trajectories: int) -> None:
    traces, alone = with_errors(correlation, 0.5, trajectories)
    result = efficiency_of(traces, checkpoint("information-ekf"), alone)
    total = result.phases[0]
    achieved = np.sqrt((IMAGE**2 + HAPTICS**2 + 2.0 * correlation * IMAGE * HAPTICS) / 4.0)
    np.testing.assert_allclose(total.standalone[:, 0], [IMAGE, HAPTICS], rtol=1e-5)
    assert total.correlation[0] == pytest.approx(correlation, abs=1e-5)
    assert total.fused[0] == pytest.approx(achieved, rel=1e-4)
    assert total.best[0] == pytest.approx(optimum(correlation), rel=1e-5)
    assert total.independent[0] == pytest.approx(optimum(0.0), rel=1e-5)
    assert total.efficiency[0] == pytest.approx(optimum(correlation) / achieved, rel=1e-4)
    if trajectories == 1:
        assert "No interval and no reasons: too few episodes (1" in result.verdict
        best = next(curve for curve in result.curves() if curve.name == "best combination").values
        keep = measures.counted(traces[0])
        assert np.sqrt(np.square(best[keep]).mean()) == pytest.approx(100.0 * optimum(correlation), rel=1e-4)
    else:
        assert total.low[0] <= total.efficiency[0] <= total.high[0] < 1.0
        assert not result.curves()


def test_best_combination_is_fully_efficient() -> None:
    weight = HAPTICS**2 / (IMAGE**2 + HAPTICS**2)
    traces, alone = with_errors(0.0, weight, 6)
    result = efficiency_of(traces, checkpoint("information-ekf"), alone)
    assert result.phases[0].efficiency[0] == pytest.approx(1.0, rel=1e-4)
    none: dict[str, Any] = dict.fromkeys(("observation_covariance", "predicted_covariance", "effective_weights"))
    far = [replace(run, estimate_mean=run.episode.states + np.float32(0.1), **none) for run in traces]
    worse = efficiency_of(far, checkpoint("lstm"), alone)
    assert worse.phases[0].efficiency[0] < 0.3
    assert "0 measured reasons" in worse.verdict  # an LSTM reports neither sensors nor weights


def contributing(traces: list[Trace], name: str) -> dict[tuple[str, str], Reason]:
    return {(r.name, r.modality): r for r in reasons_of(traces, checkpoint(name)) if r.contributes}


def simulated(**changes: Any) -> list[Trace]:
    """Traces with two sensors of the same isotropic noise, equal weights and consistent covariances."""
    rng = np.random.default_rng(0)
    base, shape = plant.real("crossmodal-ekf", 90), (90, 2)
    unit = np.eye(3) * 0.02**2
    traces = []
    for _ in range(8):
        states = rng.normal(scale=0.1, size=(90, 3))
        z = states[:, None] + rng.normal(scale=0.02, size=(90, 2, 3))
        prior = states + rng.normal(scale=0.02, size=(90, 3))
        arrays: dict[str, Any] = {
            "observation_mean": z,
            "observation_covariance": np.broadcast_to(unit, (*shape, 3, 3)),
            "predicted_mean": np.broadcast_to(prior[:, None], z.shape),
            "predicted_covariance": np.broadcast_to(unit, (*shape, 3, 3)),
            "modality_mean": (z + prior[:, None]) / 2.0,
            "modality_covariance": np.broadcast_to(unit / 2.0, (*shape, 3, 3)),
            "weights": np.full((*shape, 3), 0.5),
            "effective_weights": np.full((*shape, 3), 0.5),
            "estimate_mean": (prior + z.sum(1)) / 3.0,
            "estimate_covariance": np.broadcast_to(unit / 3.0, (90, 3, 3)),
        }
        traces.append(plant.planted(base, states, **arrays | {k: change(arrays[k]) for k, change in changes.items()}))
    return traces


def test_consistent_fusion_has_no_reason() -> None:
    assert not contributing(simulated(), "information-ekf")


def test_overconfident_sensor() -> None:
    first = np.array([0.25, 1.0])[:, None, None]
    reasons = contributing(simulated(observation_covariance=lambda r: r * first), "information-ekf")
    assert set(reasons) == {(CALIBRATION, "image")}
    reason = reasons[CALIBRATION, "image"]
    assert reason.value == pytest.approx(4.0, rel=0.15)
    assert reason.low < 4.0 < reason.high
    assert "deviations of the image sensor are too small" in reason.headline


def test_readings_without_information_are_no_reason() -> None:
    """In half of the steps, R exceeds the variance of the states."""
    wide = np.where(np.arange(90) % 2, 1.0, 1e4)[:, None, None, None]
    assert not contributing(simulated(observation_covariance=lambda r: r * wide), "information-ekf")


def test_biased_sensor_is_drifted_not_uncalibrated() -> None:
    shift = np.array([[0.0, 0.0, 0.0], [0.0, 0.03, 0.0]])
    reasons = contributing(simulated(observation_mean=lambda z: z + shift), "information-ekf")
    assert set(reasons) == {(DRIFT, "haptics"), (WEIGHTS, "")}  # a biased sensor deserves less than half of the weight
    assert reasons[DRIFT, "haptics"].value == pytest.approx(0.03 / np.hypot(0.03, 0.02), rel=0.05)
    assert "hinge y of the haptics sensor has a bias of +2.99 cm" in reasons[DRIFT, "haptics"].headline


@pytest.mark.parametrize("product", [False, True])
def test_prior_in_two_posteriors_counts_twice(product: bool) -> None:
    """Equal sensors: the product of posteriors ``4 / s^2`` has the mean of their average; it counts the prior twice."""
    traces = simulated(estimate_covariance=lambda c: c * 3.0 / 4.0)
    if product:
        traces = [replace(trace, weights=None) for trace in traces]
    reasons = contributing(traces, "crossmodal-ekf")
    assert set(reasons) == {(PRIOR, "")}
    assert reasons[PRIOR, ""].value == pytest.approx(2.0, rel=1e-4)
    assert not contributing(traces, "information-ekf")  # its trace has updates, but the rule fuses one prior
    assert not contributing(traces, "unimodal-ekf")  # every modality continues from its own belief


def test_weights_far_from_the_best_split() -> None:
    wrong = np.broadcast_to(np.array([0.9, 0.1])[:, None], (90, 2, 3))
    reasons = contributing(simulated(effective_weights=lambda w: wrong), "information-ekf")
    assert set(reasons) == {(WEIGHTS, "")}
    assert reasons[WEIGHTS, ""].value == pytest.approx(np.sqrt((0.9**2 + 0.1**2) / 0.5), rel=0.05)
    assert "mean weight of image 0.90, best 0.5" in reasons[WEIGHTS, ""].headline


@pytest.fixture(scope="module")
def doors() -> tuple[Checkpoint, list[Trace]]:
    filter_ = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
    with open_dataset(sample_path("door")) as data:
        return filter_, [trace(filter_, data[index], index) for index in (9, 11)]


@pytest.mark.slow
def test_errors_are_those_of_the_separate_runs(doors: tuple[Checkpoint, list[Trace]]) -> None:
    filter_, traces = doors
    shares: list[float] = []
    result = fusion_efficiency(traces, filter_, shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    alone = np.concatenate(
        [measures.main_error(standalone(filter_, run, "haptics"))[measures.counted(run), -1] for run in traces]
    )
    total = result.phases[0]
    assert total.standalone[1, 0] == pytest.approx(np.sqrt(np.square(alone).mean()))
    assert (total.best <= total.standalone.min(0) + 1e-12).all()
    single = fusion_efficiency(traces[:1], filter_)
    assert isinstance(single, FusionEfficiency)
    assert {curve.values.shape for curve in single.curves()} == {(len(traces[0]),)}
    for table in (*single.tables(), *result.tables()):
        assert {len(row) for row in table.rows} == {len(table.columns)}
    names = [row[0] for row in result.tables()[1].rows]
    assert names == [CALIBRATION, CALIBRATION, DRIFT, DRIFT, PRIOR, WEIGHTS]
    result.to_dict()


def test_filter_of_one_modality_is_refused(doors: tuple[Checkpoint, list[Trace]]) -> None:
    entry, single = DIAGNOSTICS["efficiency"], checkpoint("image-ekf")
    assert (
        entry.refusal(doors[1][0], None)
        == "diagnostic efficiency needs the filter, not only its trace: give its checkpoint, "
        "or --filter FILE.py:FUNCTION"
    )
    run = plant.real("crossmodal-ekf")
    assert entry.refusal(run, single) == "filter crossmodal-ekf has one modality: it is the standalone filter"


def test_the_verdict_states_that_fusion_gains_little() -> None:
    def verdict(correlation: float, weight: float) -> str:
        traces, alone = with_errors(correlation, weight, 2)
        return efficiency_of(traces, checkpoint("crossmodal-ekf"), alone).verdict

    assert "4.00 cm, 1.33 times that of the image-only filter: fusion gains nothing; the" in verdict(1.0 - 1e-9, 0.5)
    assert "1.00 times that of the image-only filter: fusion gains little; the" in verdict(0.5, 0.99)
    assert "fusion gains" not in verdict(0.0, 0.7)
