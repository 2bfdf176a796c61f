"""What is drawn in the scene: outlines, the map on the floor, the particles' colours, the layers there are."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from beliefscope.app.protocol.messages import LAYERS, Look, layers, look, viewpoint
from beliefscope.app.views.scene_belief import OUTLINES, modality_shares
from beliefscope.app.views.scene_context import LOG_SHOWN, around, hand, paint
from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.simulation.replay import model_of
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.diagnostics.plotting import colour_table
from beliefscope.inspect.likelihood import LikelihoodMap
from beliefscope.inspect.trace import Trace, trace


@pytest.fixture(scope="module")
def run() -> Trace:
    with open_dataset(sample_path("door")) as data:
        episode = data[9]
    return trace(load_checkpoint(shipped("door", "crossmodal-pf")), episode, particles=60)


@pytest.fixture
def maps() -> LikelihoodMap:
    """Two layers: one rises by a nat a cell to the right from -9 to -1, the other upwards by ten."""
    ramp = np.arange(-9.0, 0.0, dtype=np.float32)
    offsets = np.linspace(-0.12, 0.12, 9, dtype=np.float32)
    rising = np.stack([np.broadcast_to(ramp, (9, 9)), np.broadcast_to(10 * ramp[:, None], (9, 9))])
    return LikelihoodMap(3, 0.1, ("image", "fused"), offsets, offsets, np.zeros(2, np.float32), rising)


@pytest.mark.parametrize("shape", OUTLINES)
def test_an_outline_fills_its_size(shape: str) -> None:
    edges = OUTLINES[shape]
    assert edges.shape[1:] == (2, 3)
    np.testing.assert_allclose(edges.reshape(-1, 3).min(axis=0), -0.5, atol=1e-9)
    np.testing.assert_allclose(edges.reshape(-1, 3).max(axis=0), 0.5, atol=1e-9)
    assert np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1).min() > 0.01, "no edge is a point"


def test_a_cylinders_edges_lie_on_its_rims_or_join_them() -> None:
    points = OUTLINES["cylinder"]
    np.testing.assert_allclose(np.linalg.norm(points[..., :2], axis=-1), 0.5)
    np.testing.assert_allclose(np.abs(points[..., 2]), 0.5)
    assert (points[:, 0, 2] != points[:, 1, 2]).sum() == 4


def test_every_ghost_can_be_outlined() -> None:
    for task in TASKS.values():
        if task.ghost is not None:
            assert task.ghost(np.zeros((2, len(task.components)))).shape in OUTLINES


@pytest.mark.parametrize(("task", "bodies"), [("door", {"frame", "door"}), ("push", {"puck"})])
def test_the_map_is_seen_through_all_but_the_arm(task: str, bodies: set[str]) -> None:
    with open_dataset(sample_path(task)) as data:
        model = model_of(TASKS[task], data[0])
    assert {model.body(body).name for body in np.flatnonzero(around(model))} == bodies
    assert {model.body(body).name for body in np.flatnonzero(hand(model))} == {"hand", "finger_left", "finger_right"}


def test_a_map_is_painted_as_the_page_does(maps: LikelihoodMap) -> None:
    table = colour_table("viridis")
    share = np.exp(np.arange(-8.0, 1.0))
    painted = paint(maps, 0, Look())
    assert painted.shape == (9, 9, 3)
    np.testing.assert_array_equal(painted[4], table[np.rint(255 * share).astype(int)])
    np.testing.assert_array_equal(painted, painted[:1].repeat(9, axis=0), "rows are y, the smallest first")
    log = paint(maps, 1, Look(scale="log"))[:, 0]
    np.testing.assert_array_equal(log[[0, 4, 8]], table[[0, 0, 255]], "what lies 40 nats below the peak is the lowest")
    np.testing.assert_array_equal(log[7], table[round(255 * (1 - 10 / LOG_SHOWN))])


def test_maps_of_one_range_share_the_peak(maps: LikelihoodMap) -> None:
    table = colour_table("cividis")
    same = Look(range="same", colours="cividis")
    np.testing.assert_array_equal(paint(maps, 0, same)[0, 8], table[255])
    np.testing.assert_array_equal(paint(maps, 1, same)[8, 0], table[0], "its peak is 9 nats lower")
    np.testing.assert_array_equal(paint(maps, 1, replace(same, range="own"))[8, 0], table[255])


def test_shares_of_the_particles_add_up_to_what_acted(run: Trace) -> None:
    assert run.acting is not None
    assert run.log_weights is not None
    for step in (0, 25, len(run) - 1):
        shares = modality_shares(run, step, DOOR)
        assert shares is not None
        assert (shares >= 0.0).all()
        np.testing.assert_allclose(shares.sum(axis=0), 1.0, atol=1e-5)
        # float32 log-likelihoods of some hundred nats: three digits
        np.testing.assert_allclose(shares @ np.exp(run.log_weights[step]), run.acting[step][:, 0], atol=2e-3)


def test_without_modalities_told_apart_particles_have_no_shares(run: Trace) -> None:
    assert modality_shares(replace(run, acting=None), 0, DOOR) is None
    assert modality_shares(replace(run, log_likelihood=None), 0, DOOR) is None


def test_a_scene_has_the_layers_of_its_trace(run: Trace) -> None:
    assert tuple(layers(DOOR, run, None)) == LAYERS
    bare = replace(
        run,
        particles=None,
        estimate_covariance=np.full_like(run.estimate_covariance, np.nan),
        episode=replace(run.episode, qpos=run.episode.qpos[:, :0], observations={}),
    )
    assert layers(replace(DOOR, ghost=None), bare, "no maps") == ["estimates"]


def test_a_look_is_read() -> None:
    assert look({}) == Look()
    said = {"hidden": ["force", "map"], "ground": "haptics", "height": "belief", "tint": "share", "scale": "log"}
    expected = Look(frozenset({"force", "map"}), "haptics", "belief", "share", "log")
    assert look({"type": "look", **said, "other": 1}) == expected
    assert viewpoint({"at": "above"}) == "above"


@pytest.mark.parametrize(
    ("message", "said"),
    [
        ({"hidden": "map"}, "a list of layers; got 'map'"),
        ({"hidden": ["floor"]}, "'floor' does not exist. Available: replay, objects"),
        ({"hidden": [["map"]]}, "does not exist. Available: replay"),
        ({"tint": "modality"}, "'modality' does not exist. Available: weight, share"),
        ({"ground": 3}, "'ground' is text; got 3"),
    ],
)
def test_a_look_that_cannot_be_is_refused(message: dict[str, Any], said: str) -> None:
    with pytest.raises(BadInput, match=said):
        look(message)
    with pytest.raises(BadInput, match=r"viewpoint 'moon' does not exist\. Available: first, above, camera"):
        viewpoint({"at": "moon"})
