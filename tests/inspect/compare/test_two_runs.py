"""Comparison of two runs: identity, symmetry, and agreement with single-run diagnostics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.compare.two_runs import Comparison, compare_runs
from beliefscope.inspect.diagnostics.consistency import consistency
from beliefscope.inspect.statistics.measures import nees
from beliefscope.inspect.trace import Trace, trace

FAULTS = "blackout=0.5"


def run(filter_: str, faults: str = "", episode: int = 9) -> Trace:
    checkpoint = load_checkpoint(pretrained_path("door", filter_))
    with open_dataset(sample_path("door")) as data:
        return trace(checkpoint, data[episode], episode, particles=50, faults=Faults.parse(faults))


@pytest.fixture(scope="module")
def ekf() -> Trace:
    return run("crossmodal-ekf")


@pytest.fixture(scope="module")
def pf() -> Trace:
    return run("crossmodal-pf")


@pytest.fixture(scope="module")
def faulty() -> Trace:
    return run("crossmodal-ekf", FAULTS)


def rows(result: Comparison) -> dict[tuple[str, str], tuple[float, float, float]]:
    (table,) = result.tables()
    return {(row[0].partition(" (")[0], row[1]): row[2:5] for row in table.rows}


def test_run_is_identical_to_itself(ekf: Trace) -> None:
    result = compare_runs(ekf, ekf, ("one", "two"))
    assert not result.distance.any()
    assert not result.modality_distance.any()
    assert result.verdict == "The estimates of one and two are identical."
    assert all(difference == 0.0 for _, _, difference in rows(result).values())


def test_numbers_equal_single_run_diagnostics(ekf: Trace, pf: Trace) -> None:
    result = compare_runs(ekf, pf)
    assert result.names == ("crossmodal-ekf", "crossmodal-pf")
    for i, trace_ in enumerate((ekf, pf)):
        single = consistency([trace_])
        for s, phase in enumerate(result.phases):
            layer = single.entry("fused", phase)
            assert result.steps[s] == layer.steps
            np.testing.assert_allclose(result.rmse[s, :, i], layer.rmse)
            np.testing.assert_allclose([result.nees[s, i], result.nll[s, i]], [layer.nees, layer.nll])


def test_swapping_runs_changes_signs(ekf: Trace, pf: Trace) -> None:
    forward, backward = rows(compare_runs(ekf, pf)), rows(compare_runs(pf, ekf))
    assert forward.keys() == backward.keys()
    for key, (first, second, difference) in forward.items():
        assert backward[key] == (second, first, -difference)


def test_planted_shift(ekf: Trace) -> None:
    shift = np.array([0.03, 0.04, 0.1], np.float32)
    exact = replace(ekf, estimate_mean=ekf.episode.states)
    shifted = replace(ekf, estimate_mean=ekf.episode.states + shift)
    result = compare_runs(exact, shifted, ("exact", "shifted"))
    np.testing.assert_allclose(result.distance, 0.05, atol=1e-6)  # float32 states near 1 m
    np.testing.assert_allclose(result.position[:, 1], 0.05, atol=1e-6)
    np.testing.assert_allclose(result.rmse[..., 1], np.broadcast_to(shift, result.rmse.shape[:-1]), atol=1e-6)
    assert rows(result)["all", "position RMSE (cm)"] == pytest.approx((0.0, 5.0, 5.0), abs=1e-4)
    assert result.verdict.startswith(
        "RMSE over 70 steps: exact 0.00 cm, shifted 5.00 cm (from zero); angle 0.00 -> 5.73 deg."
    )


def test_blackout_of_either_run_is_a_phase(ekf: Trace, faulty: Trace) -> None:
    result = compare_runs(ekf, faulty)
    assert result.names == ("no faults", FAULTS)
    blackout = result.phases.index("blackout")
    assert 0 < result.steps[blackout] < result.steps[0]
    assert result.steps[blackout] == (result.blackout & (np.arange(len(ekf)) >= 30)).sum()
    assert result.effective_weights is not None
    image = result.modalities.index("image")
    before, after = result.effective_weights[blackout, image]
    assert after < before
    np.testing.assert_allclose(result.effective_weights.sum(1), 1.0, atol=1e-5)
    np.testing.assert_allclose(result.nees_at[:, 1], nees(faulty)[:, -1])


def test_different_episodes_are_refused(ekf: Trace) -> None:
    with pytest.raises(BadInput, match="different episodes"):
        compare_runs(ekf, run("crossmodal-ekf", episode=10))


def test_run_without_covariance_has_no_nees(ekf: Trace) -> None:
    without = replace(ekf, estimate_covariance=np.full_like(ekf.estimate_covariance, np.nan), effective_weights=None)
    result = compare_runs(ekf, without, ("ekf", "lstm"))
    assert rows(result)["all", "NEES/n"][1:] == (None, None)
    assert result.effective_weights is None
    assert "NEES" not in result.verdict
    result.views()
