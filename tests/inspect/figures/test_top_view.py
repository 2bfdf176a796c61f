"""A moment drawn from above: outlines are where the bodies are, contours hold what they claim."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.patches import Ellipse, Polygon

from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.diagnostics.plotting import write_figure
from beliefscope.inspect.figures.top_view import draw_step, footprint, outline, scene_footprints
from beliefscope.inspect.likelihood import LikelihoodMap, MapEngine
from beliefscope.inspect.statistics.measures import contours
from beliefscope.inspect.trace import Trace, trace

STEP = 25


@pytest.fixture(scope="module")
def run() -> Trace:
    with open_dataset(sample_path("door")) as data:
        episode = data[9]
    return trace(load_checkpoint(shipped("door", "crossmodal-pf")), episode, episode_index=9, particles=60)


@pytest.fixture(scope="module")
def map_(run: Trace) -> LikelihoodMap:
    return MapEngine(load_checkpoint(shipped("door", "crossmodal-pf")), run).map(STEP, size=41)


def inside(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether points (N, 2) lie in a convex outline (P, 2), counter-clockwise."""
    edges = np.roll(corners, -1, axis=0) - corners
    off = points[:, None] - corners
    return (edges[:, 0] * off[..., 1] - edges[:, 1] * off[..., 0] >= -1e-9).all(axis=1)


def test_an_outline_holds_its_points() -> None:
    points = np.random.default_rng(0).normal(size=(200, 2))
    assert inside(outline(points), points).all()
    np.testing.assert_array_equal(outline(points).max(axis=0), points.max(axis=0))


def test_the_hand_is_drawn_where_it_was_felt(run: Trace) -> None:
    around = scene_footprints(run, DOOR, STEP)
    effector = 100.0 * run.episode.observations["effector_position"][STEP, :2]
    assert any(np.linalg.norm(one.outline.mean(axis=0) - effector) < 5.0 for one in around)
    assert [one.top for one in around] == sorted(one.top for one in around)


@pytest.mark.parametrize("name", ["door", "push"])
def test_a_footprint_is_the_objects_own(name: str) -> None:
    task = TASKS[name]
    with open_dataset(sample_path(name)) as data:
        episode = data[9]
    assert task.outline is not None
    run = trace(load_checkpoint(shipped(name, "crossmodal-ekf")), episode)
    corners = footprint(task.outline(episode.states[STEP]))
    x, y = corners.T
    area = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    drawn = [one.outline for one in scene_footprints(run, task, STEP)]
    nearest = min(drawn, key=lambda one: np.abs(one.max(axis=0) - corners.max(axis=0)).max())
    # The puck's rim has 24 corners in one and 48 in the other: a hundredth of its radius.
    np.testing.assert_allclose(nearest.max(axis=0), corners.max(axis=0), atol=0.06)
    np.testing.assert_allclose(nearest.min(axis=0), corners.min(axis=0), atol=0.06)
    assert area == pytest.approx(200.0 if name == "door" else np.pi * 25.0, rel=0.01)


def test_an_ellipse_has_the_covariance_that_it_is_drawn_for() -> None:
    root = np.random.default_rng(2).normal(size=(50, 2, 2))
    covariance = root @ root.swapaxes(1, 2)
    half, turn = contours(covariance)
    axes = np.stack([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]).transpose(2, 1, 0) * half[:, None]
    np.testing.assert_allclose(axes @ axes.swapaxes(1, 2), covariance, atol=1e-12)
    assert (half[:, 0] <= half[:, 1]).all()
    flat = np.array([0.1, 0.3])
    np.testing.assert_allclose(contours(np.outer(flat, flat))[0], [0.0, np.hypot(*flat)], atol=1e-8)


def test_contours_hold_86_percent_of_their_gaussian(run: Trace) -> None:
    belief = draw_step(run, STEP).axes[1]
    ellipses = [patch for patch in belief.patches if isinstance(patch, Ellipse)]
    assert len(ellipses) == 3
    covariance = run.estimate_covariance[STEP][:2, :2].astype(float)
    drawn = np.random.default_rng(1).multivariate_normal(run.estimate_mean[STEP, :2], covariance, 4000)
    held = ellipses[-1].contains_points(ellipses[-1].axes.transData.transform(100.0 * drawn))
    # 1 - exp(-2), with 4000 draws good to half a percent (one sigma)
    assert held.mean() == pytest.approx(0.865, abs=0.02)


def test_the_map_lies_about_the_truth_and_stays_white_where_nothing_is(run: Trace, map_: LikelihoodMap) -> None:
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


def test_the_object_is_drawn_twice_and_force_only_in_contact(run: Trace) -> None:
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


def test_what_a_run_has_not_is_left_out(run: Trace, tmp_path: Path) -> None:
    bare = replace(
        run,
        particles=None,
        log_weights=None,
        estimate_covariance=np.full_like(run.estimate_covariance, np.nan),
        modality_mean=np.full_like(run.modality_mean, np.nan),
        episode=replace(run.episode, qpos=run.episode.qpos[:, :0]),
    )
    (belief,) = draw_step(bare, STEP).axes
    assert not belief.collections
    assert not belief.patches
    assert [line.get_label() for line in belief.lines] == ["fused", "truth"]


def test_the_same_moment_gives_the_same_file(run: Trace, map_: LikelihoodMap, tmp_path: Path) -> None:
    for name in ("a.svg", "b.svg"):
        write_figure(draw_step(run, STEP, map_), tmp_path / name)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert "<path" in (tmp_path / "a.svg").read_text()
