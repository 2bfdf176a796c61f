"""Numbers of maps against the closed forms of Gaussians, and what turning a map does to them."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.diagnostics.likelihood_maps import ENTRY
from beliefscope.inspect.likelihood import LikelihoodMap
from beliefscope.inspect.maps.statistics import MapStatistics, measure_maps
from beliefscope.inspect.trace import trace

SIZE, HALF = 135, 0.135
OFFSETS = (((np.arange(SIZE) + 0.5) / SIZE * 2.0 - 1.0) * HALF).astype(np.float32)
EFFECTOR = np.array([[0.3, 0.3, 0.5]])


def gaussian(mean: Any, covariance: Any) -> np.ndarray:
    """(S, S) log-likelihood up to a constant."""
    cells = np.stack(np.meshgrid(OFFSETS, OFFSETS), axis=-1) - np.asarray(mean)
    return 3.0 - 0.5 * np.einsum("yxi,ij,yxj->yx", cells, np.linalg.inv(covariance), cells)


def turned(sd: tuple[float, float], angle: float) -> np.ndarray:
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return turn @ np.diag(np.square(sd)) @ turn.T


def numbers(*layers: np.ndarray) -> MapStatistics:
    names = tuple(f"layer{i}" for i in range(len(layers)))
    map_ = LikelihoodMap(0, math.nan, names, OFFSETS, OFFSETS, np.zeros(2, np.float32), np.stack(layers))
    trace: Any = SimpleNamespace(episode=SimpleNamespace(observations={"effector_position": EFFECTOR}))
    return measure_maps([map_], trace)


@pytest.mark.parametrize("angle", [-1.2, -0.4, 0.0, 0.7, 1.5])
def test_a_gaussian_has_its_closed_forms(angle: float) -> None:
    """Cells of 2 mm under standard deviations of 12 and 25 mm: sums over cells are integrals to about 1e-3."""
    covariance = turned((0.025, 0.012), angle)
    found = numbers(gaussian((0.01, -0.02), covariance))
    det = math.sqrt(np.linalg.det(covariance))
    assert found.entropy[0, 0] == pytest.approx(1.0 + math.log(2.0 * math.pi * det), abs=5e-3)
    # chi-square quantiles of two degrees of freedom: -2 ln(1 - mass)
    assert found.area50[0, 0] == pytest.approx(-2.0 * math.log(0.5) * math.pi * det, rel=0.01)
    assert found.area95[0, 0] == pytest.approx(-2.0 * math.log(0.05) * math.pi * det, rel=0.01)
    assert found.axis[0, 0] == pytest.approx(angle, abs=2e-3)
    assert found.elongation[0, 0] == pytest.approx(25.0 / 12.0, rel=0.01)
    off = abs((angle - math.pi / 4 + math.pi / 2) % math.pi - math.pi / 2)
    assert found.off_line[0, 0] == pytest.approx(off, abs=2e-3)
    np.testing.assert_allclose(found.peak[0, 0], (0.01, -0.02), atol=0.0011)  # half a cell
    assert found.truth[0, 0] == pytest.approx(gaussian((0.01, -0.02), covariance)[67, 67] - found.log_peak[0, 0])


def test_divergence_between_gaussians() -> None:
    first, second = turned((0.02, 0.015), 0.3), turned((0.025, 0.02), -0.5)
    shift = np.array([0.01, -0.005])
    found = numbers(gaussian((0, 0), first), gaussian(shift, second))

    def closed(p: np.ndarray, q: np.ndarray) -> float:
        inverse = np.linalg.inv(q)
        ratio = math.log(np.linalg.det(q) / np.linalg.det(p))
        return 0.5 * float(np.trace(inverse @ p) + shift @ inverse @ shift - 2.0 + ratio)

    assert found.divergence[0, 0, 1] == pytest.approx(closed(first, second), rel=0.01)
    assert found.divergence[0, 1, 0] == pytest.approx(closed(second, first), rel=0.01)
    np.testing.assert_allclose(np.diagonal(found.divergence[0]), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.diagonal(found.overlap[0]), 1.0)
    assert 0.0 < found.overlap[0, 0, 1] < 1.0
    assert found.overlap[0, 0, 1] == found.overlap[0, 1, 0]


def test_a_flat_map_fills_its_square() -> None:
    found = numbers(np.full((SIZE, SIZE), -7.0))
    square = (2.0 * HALF) ** 2
    assert found.entropy[0, 0] == pytest.approx(math.log(square), abs=1e-6)
    assert found.area95[0, 0] == pytest.approx(0.95 * square, rel=1e-6)
    assert found.elongation[0, 0] == pytest.approx(1.0)
    assert found.truth[0, 0] == 0.0


def test_turning_a_map_turns_its_axis_and_nothing_else() -> None:
    layer = np.logaddexp(
        gaussian((0.03, 0.01), turned((0.03, 0.01), 0.5)), gaussian((-0.02, 0.02), turned((0.01, 0.01), 0))
    )
    before, after = numbers(layer), numbers(np.rot90(layer, -1))  # rows grow upwards: a quarter turn to the left
    assert abs(math.sin(after.axis[0, 0] - before.axis[0, 0])) == pytest.approx(1.0, abs=1e-9)
    for name in ("entropy", "area50", "area95", "elongation", "log_peak", "truth"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), rtol=1e-6)


def test_the_diagnostic_says_where_touch_sees_a_ridge() -> None:
    checkpoint = load_checkpoint(shipped("door", "crossmodal-pf"))
    with open_dataset(sample_path("door")) as data:
        index = data.held_out()[0]
        run = trace(checkpoint, data[index], index, particles=50)
    found = ENTRY([run], checkpoint, size=21)
    assert found.felt == ("haptics",)
    assert found.numbers.off_line.shape == (len(run), 3)
    assert "Long axis of the haptics map" in found.verdict
    touch, contact = found.numbers.layers.index("haptics"), found.kinds["contact"]
    # What ships has learned it: an axis at random would be off by less than 30 degrees a third of the time.
    assert np.degrees(np.median(found.numbers.off_line[contact, touch])) < 30.0
    assert len(found.views()["curves"]) == 1 + 3 + 2
