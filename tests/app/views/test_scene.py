"""Contents of the scene: outlines, floor map, particle colors, layers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from beliefscope.app.protocol.messages import LAYERS
from beliefscope.app.protocol.trace_format import scene_layers
from beliefscope.app.views.scene_belief import drawn_distances
from beliefscope.app.views.scene_context import IMAGE_DISTANCE
from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.simulation.replay import replay, replay_model
from beliefscope.datasets.simulation.shapes import hand_bodies, object_bodies, shapes
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.figures.scene_belief import DrawnBelief, camera_axis
from beliefscope.inspect.figures.scene_shapes import LOG_RANGE, OUTLINE_EDGES, body_meshes, map_pixels
from beliefscope.inspect.maps.map_engine import LikelihoodMap
from beliefscope.inspect.maps.modality_shares import modality_shares
from beliefscope.inspect.palette import colour_table
from beliefscope.inspect.trace import Trace, trace

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run() -> Trace:
    with open_dataset(sample_path("door")) as data:
        episode = data[9]
    return trace(load_checkpoint(pretrained_path("door", "crossmodal-pf")), episode, particles=60)


@pytest.fixture
def maps() -> LikelihoodMap:
    """Two layers: one increases to the right by 1 nat per cell from -9 to -1, the other upwards by 10."""
    ramp = np.arange(-9.0, 0.0, dtype=np.float32)
    offsets = np.linspace(-0.12, 0.12, 9, dtype=np.float32)
    layers = np.stack([np.broadcast_to(ramp, (9, 9)), np.broadcast_to(10 * ramp[:, None], (9, 9))])
    return LikelihoodMap(3, 0.1, ("image", "fused"), offsets, offsets, np.zeros(2, np.float32), layers)


@pytest.mark.parametrize("shape", OUTLINE_EDGES)
def test_an_outline_fills_its_size(shape: str) -> None:
    edges = OUTLINE_EDGES[shape]
    assert edges.shape[1:] == (2, 3)
    np.testing.assert_allclose(edges.reshape(-1, 3).min(axis=0), -0.5, atol=1e-9)
    np.testing.assert_allclose(edges.reshape(-1, 3).max(axis=0), 0.5, atol=1e-9)
    assert np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1).min() > 0.01, "no edge has length 0"


def test_a_cylinders_edges_lie_on_its_rims_or_join_them() -> None:
    points = OUTLINE_EDGES["cylinder"]
    np.testing.assert_allclose(np.linalg.norm(points[..., :2], axis=-1), 0.5)
    np.testing.assert_allclose(np.abs(points[..., 2]), 0.5)
    assert (points[:, 0, 2] != points[:, 1, 2]).sum() == 4


def test_every_task_has_a_known_outline_shape() -> None:
    for task in TASKS.values():
        if task.outline is not None:
            assert task.outline(np.zeros((2, len(task.components)))).shape in OUTLINE_EDGES


@pytest.mark.parametrize(("task", "bodies"), [("door", {"frame", "door"}), ("push", {"puck"})])
def test_hand_and_objects_are_separate_bodies(task: str, bodies: set[str]) -> None:
    with open_dataset(sample_path(task)) as data:
        model = replay_model(TASKS[task], data[0])
    assert {model.body(body).name for body in np.flatnonzero(object_bodies(model))} == bodies
    assert {model.body(body).name for body in np.flatnonzero(hand_bodies(model))} == {
        "hand",
        "finger_left",
        "finger_right",
    }


@pytest.mark.parametrize("task", ["door", "push"])
def test_every_displayed_shape_is_in_a_mesh_of_its_body(task: str) -> None:
    with open_dataset(sample_path(task)) as data:
        model = replay_model(TASKS[task], data[0])
    displayed, meshes = shapes(model), body_meshes(model)
    assert {f"link{i}" for i in range(8)} < {shape.name for shape in displayed}
    assert {part.body for part in meshes} == {shape.body for shape in displayed}
    for body in {part.body for part in meshes}:
        drawn = np.concatenate([part.vertices for part in meshes if part.body == body])
        expected = np.concatenate([shape.points for shape in displayed if shape.body == body])
        # Vertices are float32 values below 3 m, accurate to 1 micrometre.
        np.testing.assert_allclose(drawn.min(axis=0), expected.min(axis=0), atol=1e-6)
        np.testing.assert_allclose(drawn.max(axis=0), expected.max(axis=0), atol=1e-6)
    assert all(part.faces.max() < len(part.vertices) for part in meshes)
    assert {part.opacity for part in meshes} == {float(shape.rgba[3]) for shape in displayed}


def test_map_colors_match_the_page(maps: LikelihoodMap) -> None:
    table = colour_table("viridis")
    intensity = np.exp(np.arange(-8.0, 1.0))
    pixels = map_pixels(maps, 0, "viridis", False, False)
    assert pixels.shape == (9, 9, 3)
    np.testing.assert_array_equal(pixels[4], table[np.rint(255 * intensity).astype(int)])
    np.testing.assert_array_equal(pixels, pixels[:1].repeat(9, axis=0), "rows are y in increasing order")
    log = map_pixels(maps, 1, "viridis", True, False)[:, 0]
    np.testing.assert_array_equal(log[[0, 4, 8]], table[[0, 0, 255]], "40 nats below the peak is the lowest color")
    np.testing.assert_array_equal(log[7], table[round(255 * (1 - 10 / LOG_RANGE))])


def test_layers_can_share_a_color_range(maps: LikelihoodMap) -> None:
    table = colour_table("cividis")
    np.testing.assert_array_equal(map_pixels(maps, 0, "cividis", False, True)[0, 8], table[255])
    np.testing.assert_array_equal(
        map_pixels(maps, 1, "cividis", False, True)[8, 0], table[0], "its peak is 9 nats lower"
    )
    np.testing.assert_array_equal(map_pixels(maps, 1, "cividis", False, False)[8, 0], table[255])


def test_mean_particle_shares_equal_the_effective_weights(run: Trace) -> None:
    assert run.effective_weights is not None
    assert run.log_weights is not None
    for step in (0, 25, len(run) - 1):
        shares = modality_shares(run, step)
        assert shares is not None
        assert (shares >= 0.0).all()
        np.testing.assert_allclose(shares.sum(axis=0), 1.0, atol=1e-5)
        # The log-likelihoods are float32 values of several hundred nats, accurate to three digits.
        np.testing.assert_allclose(shares @ np.exp(run.log_weights[step]), run.effective_weights[step][:, 0], atol=2e-3)


def test_filters_without_separate_modalities_have_no_particle_shares(run: Trace) -> None:
    assert modality_shares(replace(run, effective_weights=None), 0) is None
    assert modality_shares(replace(run, log_likelihood=None), 0) is None


def test_layers_depend_on_the_trace(run: Trace) -> None:
    assert tuple(scene_layers(DOOR, run, None)) == LAYERS
    bare = replace(
        run,
        particles=None,
        estimate_covariance=np.full_like(run.estimate_covariance, np.nan),
        episode=replace(run.episode, qpos=run.episode.qpos[:, :0], observations={}),
    )
    assert scene_layers(replace(DOOR, outline=None), bare, "no maps") == ["estimates"]


@pytest.mark.parametrize(("task", "name"), [("push", "crossmodal-ekf"), ("push-field", "information-ekf")])
def test_the_start_view_contains_the_robot_and_the_camera_with_its_image(task: str, name: str) -> None:
    with open_dataset(sample_path(task)) as data:
        run = trace(load_checkpoint(pretrained_path(task, name)), data[9])
        motion = replay(data.task, data[9])
    camera = TASKS[task].camera
    assert motion is not None
    assert camera is not None
    position, target = camera_axis(camera)
    depth = IMAGE_DISTANCE * np.linalg.norm(target - position)
    half = depth * np.tan(camera.field_of_view / 2.0)
    forward, up = np.array(camera.forward), np.array(camera.up)
    right = np.cross(forward, up)
    corners = [position + depth * forward + half * (x * right + y * up) for x in (-1, 1) for y in (-1, 1)]
    points = np.concatenate([[position], corners, motion.positions[:, 1:].reshape(-1, 3)])

    eye, at = DrawnBelief(TASKS[task], run).viewpoints(motion)["first"]
    ahead = (at - eye) / np.linalg.norm(at - eye)
    aside = np.cross(ahead, [0.0, 0.0, 1.0])
    aside /= np.linalg.norm(aside)
    depths = (points - eye) @ ahead * np.tan(np.deg2rad(45.0 / 2.0))
    assert depths.min() > 0.0
    assert np.abs((points - eye) @ np.cross(aside, ahead) / depths).max() < 1.0
    assert np.abs((points - eye) @ aside / depths).max() < 4.0 / 3.0, "also in a panel of 4:3"


def test_all_of_a_scene_of_kilometres_is_drawn() -> None:
    target = np.zeros(3)
    assert drawn_distances([(np.array([0.0, 0.0, 5.0]), target)]) == (0.01, 1000.0)
    near, far = drawn_distances([(np.array([0.0, 0.0, 5.0]), target), (np.array([0.0, 0.0, 4000.0]), target)])
    assert far == 12_000.0
    assert near == pytest.approx(0.12)
