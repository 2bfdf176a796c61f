"""Top view: footprints, contours, maps and reproducible files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.patches import Ellipse, Polygon

from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.diagnostics.plotting import write_figure
from beliefscope.inspect.figures.top_view import draw_step, footprint, outline, scene_footprints
from beliefscope.inspect.maps.map_engine import LikelihoodMap, MapEngine
from beliefscope.inspect.statistics.measures import contours
from beliefscope.inspect.trace import Trace, trace

STEP = 25


@pytest.fixture(scope="module")
def run() -> Trace:
    with open_dataset(sample_path("door")) as data:
        episode = data[9]
    return trace(load_checkpoint(pretrained_path("door", "crossmodal-pf")), episode, episode_index=9, particles=60)


@pytest.fixture(scope="module")
def map_(run: Trace) -> LikelihoodMap:
    return MapEngine(load_checkpoint(pretrained_path("door", "crossmodal-pf")), run).map(STEP, size=41)


def inside(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether points (N, 2) are inside of a convex outline (P, 2), counter-clockwise."""
    edges = np.roll(corners, -1, axis=0) - corners
    offset = points[:, None] - corners
    return (edges[:, 0] * offset[..., 1] - edges[:, 1] * offset[..., 0] >= -1e-9).all(axis=1)


def test_outline_contains_its_points() -> None:
    points = np.random.default_rng(0).normal(size=(200, 2))
    assert inside(outline(points), points).all()
    np.testing.assert_array_equal(outline(points).max(axis=0), points.max(axis=0))


def test_end_effector_is_drawn_at_its_observed_position(run: Trace) -> None:
    footprints = scene_footprints(run, DOOR, STEP)
    effector = 100.0 * run.episode.observations["effector_position"][STEP, :2]
    assert any(np.linalg.norm(shape.outline.mean(axis=0) - effector) < 5.0 for shape in footprints)
    assert [shape.top for shape in footprints] == sorted(shape.top for shape in footprints)


@pytest.mark.parametrize("name", ["door", "push"])
def test_footprint_matches_the_object(name: str) -> None:
    task = TASKS[name]
    with open_dataset(sample_path(name)) as data:
        episode = data[9]
    assert task.outline is not None
    run = trace(load_checkpoint(pretrained_path(name, "crossmodal-ekf")), episode)
    corners = footprint(task.outline(episode.states[STEP]))
    x, y = corners.T
    area = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    points = [shape.outline for shape in scene_footprints(run, task, STEP)]
    nearest = min(points, key=lambda shape: np.abs(shape.max(axis=0) - corners.max(axis=0)).max())
    # The puck has 24 and 48 corners; the difference is 1 % of its radius.
    np.testing.assert_allclose(nearest.max(axis=0), corners.max(axis=0), atol=0.06)
    np.testing.assert_allclose(nearest.min(axis=0), corners.min(axis=0), atol=0.06)
    assert area == pytest.approx(200.0 if name == "door" else np.pi * 25.0, rel=0.01)


def test_contour_has_the_covariance() -> None:
    root = np.random.default_rng(2).normal(size=(50, 2, 2))
    covariance = root @ root.swapaxes(1, 2)
    half, angle = contours(covariance)
    axes = (
        np.stack([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]).transpose(2, 1, 0) * half[:, None]
    )
    np.testing.assert_allclose(axes @ axes.swapaxes(1, 2), covariance, atol=1e-12)
    assert (half[:, 0] <= half[:, 1]).all()
    flat = np.array([0.1, 0.3])
    np.testing.assert_allclose(contours(np.outer(flat, flat))[0], [0.0, np.hypot(*flat)], atol=1e-8)


def test_contours_contain_86_percent_of_the_gaussian(run: Trace) -> None:
    belief = draw_step(run, STEP).axes[1]
    ellipses = [patch for patch in belief.patches if isinstance(patch, Ellipse)]
    assert len(ellipses) == 3
    covariance = run.estimate_covariance[STEP][:2, :2].astype(float)
    points = np.random.default_rng(1).multivariate_normal(run.estimate_mean[STEP, :2], covariance, 4000)
    contained = ellipses[-1].contains_points(ellipses[-1].axes.transData.transform(100.0 * points))
    # 1 - exp(-2); standard error of half a percent with 4000 samples
    assert contained.mean() == pytest.approx(0.865, abs=0.02)


def test_map_is_centred_on_the_true_position_and_transparent_at_low_likelihood(run: Trace, map_: LikelihoodMap) -> None:
    scene, belief = draw_step(run, STEP, map_).axes
    for axes in (scene, belief):
        (image,) = axes.images
        left, right, bottom, top = image.get_extent()
        truth = 100.0 * run.episode.states[STEP, :2]
        np.testing.assert_allclose([(left + right) / 2, (bottom + top) / 2], truth, atol=1e-3)
        assert right - left == pytest.approx(27.0, abs=1e-3)
    alpha = belief.images[0].get_array()[..., 3]
    log = map_.log_likelihood[-1]
    np.testing.assert_allclose(alpha, np.exp(log - log.max()), atol=1e-6)


def test_true_and_estimated_object_and_contact_force(run: Trace) -> None:
    task = DOOR
    assert task.outline is not None
    scene = draw_step(run, STEP).axes[0]
    truth, estimate = scene.patches[-2:]
    for patch, states in ((truth, run.episode.states), (estimate, run.estimate_mean)):
        assert isinstance(patch, Polygon)
        np.testing.assert_allclose(patch.get_xy()[:-1], footprint(task.outline(states[STEP])))
    newtons = np.linalg.norm(run.episode.observations["force"][STEP])
    assert [text.get_text() for text in scene.texts if text.get_text()] == [f"{newtons:.0f} N"]
    free = int(np.flatnonzero(~run.episode.contact.astype(bool))[0])
    assert not draw_step(run, free).axes[0].texts


def test_axes_have_the_units_for_display(run: Trace) -> None:
    metres = tuple(replace(c, display=("m", 1.0)) if c.unit == "m" else c for c in DOOR.components)
    far = replace(run, episode=replace(run.episode, task=replace(DOOR, components=metres)))
    for plain, axes in zip(draw_step(run, STEP).axes, draw_step(far, STEP).axes, strict=True):
        assert axes.get_xlabel() == plain.get_xlabel().replace("(cm)", "(m)")
        assert axes.xaxis.get_major_formatter()(-12.0, 0) == "\N{MINUS SIGN}0.12"


def test_unavailable_values_are_omitted(run: Trace, tmp_path: Path) -> None:
    estimates_only = replace(
        run,
        particles=None,
        log_weights=None,
        estimate_covariance=np.full_like(run.estimate_covariance, np.nan),
        modality_mean=np.full_like(run.modality_mean, np.nan),
        episode=replace(run.episode, qpos=run.episode.qpos[:, :0]),
    )
    (belief,) = draw_step(estimates_only, STEP).axes
    assert not belief.collections
    assert not belief.patches
    assert [line.get_label() for line in belief.lines] == ["fused", "truth"]


@pytest.mark.long
def test_files_are_reproducible(run: Trace, map_: LikelihoodMap, tmp_path: Path) -> None:
    for name in ("a.svg", "b.svg"):
        write_figure(draw_step(run, STEP, map_), tmp_path / name)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert "<path" in (tmp_path / "a.svg").read_text()
