"""Map statistics: closed forms of Gaussians, rotation, and the diagnostic."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.simulation.door import DOOR, panel_outline
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.diagnostics.likelihood_maps import ENTRY
from beliefscope.inspect.maps.map_engine import LikelihoodMap
from beliefscope.inspect.maps.map_statistics import MapStatistics, measure_maps
from beliefscope.inspect.trace import trace

SIZE, HALF = 135, 0.135
OFFSETS = (((np.arange(SIZE) + 0.5) / SIZE * 2.0 - 1.0) * HALF).astype(np.float32)
STATES = np.array([[0.0, 0.0, 0.3]])  # a door's hinge at the origin, at 0.3 rad


def gaussian(mean: Any, covariance: Any) -> np.ndarray:
    """(S, S) log-likelihood up to a constant."""
    cells = np.stack(np.meshgrid(OFFSETS, OFFSETS), axis=-1) - np.asarray(mean)
    return 3.0 - 0.5 * np.einsum("yxi,ij,yxj->yx", cells, np.linalg.inv(covariance), cells)


def rotated(sd: tuple[float, float], angle: float) -> np.ndarray:
    rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return rotation @ np.diag(np.square(sd)) @ rotation.T


def numbers(*layers: np.ndarray) -> MapStatistics:
    names = tuple(f"layer{i}" for i in range(len(layers)))
    map_ = LikelihoodMap(0, math.nan, names, OFFSETS, OFFSETS, np.zeros(2, np.float32), np.stack(layers))
    trace: Any = SimpleNamespace(task=find_task("door"), episode=SimpleNamespace(states=STATES))
    return measure_maps([map_], trace)


@pytest.mark.parametrize("angle", [-1.2, -0.4, 0.0, 0.7, 1.5])
def test_closed_forms_of_a_gaussian(angle: float) -> None:
    """With cells of 2 mm and standard deviations of 12 and 25 mm, sums approximate integrals to about 1e-3."""
    covariance = rotated((0.025, 0.012), angle)
    result = numbers(gaussian((0.01, -0.02), covariance))
    det = math.sqrt(np.linalg.det(covariance))
    assert result.entropy[0, 0] == pytest.approx(1.0 + math.log(2.0 * math.pi * det), abs=5e-3)
    # chi-square quantiles of two degrees of freedom: -2 ln(1 - mass)
    assert result.area50[0, 0] == pytest.approx(-2.0 * math.log(0.5) * math.pi * det, rel=0.01)
    assert result.area95[0, 0] == pytest.approx(-2.0 * math.log(0.05) * math.pi * det, rel=0.01)
    assert result.axis[0, 0] == pytest.approx(angle, abs=2e-3)
    assert result.elongation[0, 0] == pytest.approx(25.0 / 12.0, rel=0.01)
    # A closed door's panel is along y.
    off_panel = abs((angle - (math.pi / 2 + 0.3) + math.pi / 2) % math.pi - math.pi / 2)
    assert result.deviation[0, 0] == pytest.approx(off_panel, abs=2e-3)
    np.testing.assert_allclose(result.peak[0, 0], (0.01, -0.02), atol=0.0011)  # half a cell
    assert result.truth[0, 0] == pytest.approx(gaussian((0.01, -0.02), covariance)[67, 67] - result.log_peak[0, 0])


def test_divergence_between_gaussians() -> None:
    first, second = rotated((0.02, 0.015), 0.3), rotated((0.025, 0.02), -0.5)
    shift = np.array([0.01, -0.005])
    result = numbers(gaussian((0, 0), first), gaussian(shift, second))

    def closed(p: np.ndarray, q: np.ndarray) -> float:
        inverse = np.linalg.inv(q)
        ratio = math.log(np.linalg.det(q) / np.linalg.det(p))
        return 0.5 * float(np.trace(inverse @ p) + shift @ inverse @ shift - 2.0 + ratio)

    assert result.divergence[0, 0, 1] == pytest.approx(closed(first, second), rel=0.01)
    assert result.divergence[0, 1, 0] == pytest.approx(closed(second, first), rel=0.01)
    np.testing.assert_allclose(np.diagonal(result.divergence[0]), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.diagonal(result.overlap[0]), 1.0)
    assert 0.0 < result.overlap[0, 0, 1] < 1.0
    assert result.overlap[0, 0, 1] == result.overlap[0, 1, 0]


def test_uniform_map() -> None:
    result = numbers(np.full((SIZE, SIZE), -7.0))
    square = (2.0 * HALF) ** 2
    assert result.entropy[0, 0] == pytest.approx(math.log(square), abs=1e-6)
    assert result.area95[0, 0] == pytest.approx(0.95 * square, rel=1e-6)
    assert result.elongation[0, 0] == pytest.approx(1.0)
    assert result.truth[0, 0] == 0.0


def test_rotation_changes_only_the_axis() -> None:
    layer = np.logaddexp(
        gaussian((0.03, 0.01), rotated((0.03, 0.01), 0.5)), gaussian((-0.02, 0.02), rotated((0.01, 0.01), 0))
    )
    before, after = numbers(layer), numbers(np.rot90(layer, -1))  # rows increase upwards: 90 degrees counter-clockwise
    assert abs(math.sin(after.axis[0, 0] - before.axis[0, 0])) == pytest.approx(1.0, abs=1e-9)
    for name in ("entropy", "area50", "area95", "elongation", "log_peak", "truth"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), rtol=1e-6)


def test_expected_ridge_is_along_the_panel() -> None:
    """The direction of the outline's long horizontal axis, not that from the hinge to the gripper."""
    states = np.array([[0.8, -0.3, 0.0], [0.7, -0.2, 0.9], [0.9, 0.1, 2.0]])
    direction = DOOR.ridge_direction
    assert direction is not None
    centre = panel_outline(states).position[:, :2] - states[:, :2]
    along = np.stack([np.cos(direction(states)), np.sin(direction(states))], axis=1)
    np.testing.assert_allclose(along, centre / np.linalg.norm(centre, axis=1, keepdims=True), atol=1e-12)
    assert find_task("push").ridge_direction is None


def test_ridge_of_a_simulated_door_is_along_the_panel_not_towards_the_gripper() -> None:
    """Haptics map of the pretrained PF in contact; the bar stands off the panel, so the two directions differ."""
    checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-pf"))
    with open_dataset(sample_path("door")) as data:
        index = data.held_out()[0]
        run = trace(checkpoint, data[index], index, particles=50)
    result = ENTRY([run], checkpoint, size=21)
    assert result.ridge_layers == ("haptics",)
    assert result.numbers.deviation.shape == (len(run), 3)
    haptics, contact = result.numbers.layers.index("haptics"), result.phases["contact"]
    to_gripper = run.episode.observations["effector_position"][:, :2] - run.episode.states[:, :2]
    off_gripper = result.numbers.axis[:, haptics] - np.arctan2(to_gripper[:, 1], to_gripper[:, 0])
    off_gripper = np.abs((off_gripper + np.pi / 2) % np.pi - np.pi / 2)
    off_panel = result.numbers.deviation[:, haptics]
    # Properties of the pretrained filter; a random axis is 45 degrees off in the median.
    assert np.degrees(np.median(off_panel[contact])) < 8.0
    assert np.median(off_panel[contact]) < 0.6 * np.median(off_gripper[contact])
    assert "the haptics likelihood is a ridge" in result.verdict
    assert "off the direction that the task expects" in result.verdict
    assert len(result.views()["curves"]) == 1 + 3 + 2


def test_push_expects_no_direction() -> None:
    checkpoint = load_checkpoint(pretrained_path("push", "crossmodal-pf"))
    with open_dataset(sample_path("push")) as data:
        index = data.held_out()[0]
        run = trace(checkpoint, data[index], index, particles=50)
    result = ENTRY([run], checkpoint, size=21, quantity="posterior")
    assert np.isnan(result.numbers.expected).all()
    assert "expects" not in result.verdict
    assert result.tables()[0].title.startswith("Posterior. Fused: prior times beta-weighted sum")
    assert len(result.views()["curves"]) == 3 + 2
