"""Two runs side by side: what is the same differs by nothing, and the numbers are those of each run by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.compare.two_runs import Comparison, compare_runs
from beliefscope.inspect.diagnostics.consistency import consistency
from beliefscope.inspect.statistics.measures import nees
from beliefscope.inspect.trace import Trace, trace

BROKEN = "blackout=0.5"


def run(filter_: str, faults: str = "", episode: int = 9) -> Trace:
    checkpoint = load_checkpoint(shipped("door", filter_))
    with open_dataset(sample_path("door")) as data:
        return trace(checkpoint, data[episode], episode, particles=50, faults=Faults.parse(faults))


@pytest.fixture(scope="module")
def ekf() -> Trace:
    return run("crossmodal-ekf")


@pytest.fixture(scope="module")
def pf() -> Trace:
    return run("crossmodal-pf")


@pytest.fixture(scope="module")
def broken() -> Trace:
    return run("crossmodal-ekf", BROKEN)


def rows(result: Comparison) -> dict[tuple[str, str], tuple[float, float, float]]:
    (table,) = result.tables()
    return {(row[0].partition(" (")[0], row[1]): row[2:5] for row in table.rows}


def test_a_run_does_not_differ_from_itself(ekf: Trace) -> None:
    result = compare_runs(ekf, ekf, ("one", "two"))
    assert not result.distance.any()
    assert not result.modality_distance.any()
    assert result.verdict == "two estimates exactly what one does."
    assert all(difference == 0.0 for _, _, difference in rows(result).values())


def test_numbers_are_those_of_each_run_by_itself(ekf: Trace, pf: Trace) -> None:
    result = compare_runs(ekf, pf)
    assert result.names == ("crossmodal-ekf", "crossmodal-pf")
    for i, one in enumerate((ekf, pf)):
        alone = consistency([one])
        for s, phase in enumerate(result.phases):
            layer = alone.entry("fused", phase)
            assert result.steps[s] == layer.steps
            np.testing.assert_allclose(result.rmse[s, :, i], layer.rmse)
            np.testing.assert_allclose([result.nees[s, i], result.nll[s, i]], [layer.nees, layer.nll])


def test_the_other_way_round_all_differences_change_their_sign(ekf: Trace, pf: Trace) -> None:
    there, back = rows(compare_runs(ekf, pf)), rows(compare_runs(pf, ekf))
    assert there.keys() == back.keys()
    for key, (first, second, difference) in there.items():
        assert back[key] == (second, first, -difference)


def test_a_planted_shift_is_found(ekf: Trace) -> None:
    shift = np.array([0.03, 0.04, 0.1], np.float32)
    exact = replace(ekf, estimate_mean=ekf.episode.states)
    shifted = replace(ekf, estimate_mean=ekf.episode.states + shift)
    result = compare_runs(exact, shifted, ("exact", "shifted"))
    np.testing.assert_allclose(result.distance, 0.05, atol=1e-6)  # float32 states near 1 m
    np.testing.assert_allclose(result.position[:, 1], 0.05, atol=1e-6)
    np.testing.assert_allclose(result.rmse[..., 1], np.broadcast_to(shift, result.rmse.shape[:-1]), atol=1e-6)
    assert rows(result)["all", "position RMSE (cm)"] == pytest.approx((0.0, 5.0, 5.0), abs=1e-4)
    assert result.verdict.startswith(
        "exact: 0.00 cm RMSE over 70 steps; shifted: 5.00, from none; angle 0.00 -> 5.73 deg."
    )


def test_black_pictures_of_either_run_are_a_kind_of_step(ekf: Trace, broken: Trace) -> None:
    result = compare_runs(ekf, broken)
    assert result.names == ("as recorded", BROKEN)
    black = result.phases.index("blackout")
    assert 0 < result.steps[black] < result.steps[0]
    assert result.steps[black] == (result.blackout & (np.arange(len(ekf)) >= 30)).sum()
    assert result.effective_weights is not None
    image = result.modalities.index("image")
    before, after = result.effective_weights[black, image]
    assert after < before
    np.testing.assert_allclose(result.effective_weights.sum(1), 1.0, atol=1e-5)
    np.testing.assert_allclose(result.nees_at[:, 1], nees(broken)[:, -1])


def test_runs_of_two_episodes_are_refused(ekf: Trace) -> None:
    with pytest.raises(BadInput, match="two episodes"):
        compare_runs(ekf, run("crossmodal-ekf", episode=10))


def test_a_run_without_covariance_has_no_nees(ekf: Trace) -> None:
    without = replace(ekf, estimate_covariance=np.full_like(ekf.estimate_covariance, np.nan), effective_weights=None)
    result = compare_runs(ekf, without, ("ekf", "lstm"))
    assert rows(result)["all", "NEES/n"][1:] == (None, None)
    assert result.effective_weights is None
    assert "NEES" not in result.verdict
    result.views()
