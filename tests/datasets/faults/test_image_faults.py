"""Outages and blur of images: moments of the Markov chain and of the kernel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.faults import FAULTS
from beliefscope.datasets.faults.image_faults import ImageFault
from beliefscope.datasets.faults.injection import Faults, available_presets
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.training.plan import EVALUATED_BLACKOUTS, evaluated_blackouts


def test_outages_have_the_requested_share_and_mean_duration() -> None:
    white = np.full((200_000, 1, 1), 255, np.uint8)
    for fraction, seconds in ((0.3, 1.0), (0.8, 3.0)):
        fault = FAULTS["image_outage"](fraction=fraction, seconds=seconds)
        lost = fault.apply(white, 0.1, np.random.default_rng(0))[:, 0, 0] == 0
        begins = np.count_nonzero(lost[1:] & ~lost[:-1])
        assert lost.mean() == pytest.approx(fraction, rel=0.05)
        assert 0.1 * lost.sum() / begins == pytest.approx(seconds, rel=0.05)
    for fraction in (0.0, 1.0):
        fault = FAULTS["image_outage"](fraction=fraction)
        assert (fault.apply(white[:99], 0.1, np.random.default_rng(0)) == 255 * (1 - fraction)).all()


def test_blur_keeps_the_mean_and_spreads_a_point() -> None:
    point = np.zeros((1, 33, 33))
    point[0, 16, 16] = 200.0
    blurred = FAULTS["image_blur"](std=2.0).apply(point, 0.1, np.random.default_rng(0))[0]
    offset = np.arange(33) - 16
    assert blurred.sum() == pytest.approx(200.0)
    assert (blurred.sum(0) * offset**2).sum() / 200.0 == pytest.approx(4.0, rel=0.01)
    assert (FAULTS["image_blur"](std=0.0).apply(point, 0.1, np.random.default_rng(0)) == point).all()
    flat = np.full((2, 32, 32), 77, np.uint8)
    assert (FAULTS["image_blur"](std=3.0).apply(flat, 0.1, np.random.default_rng(0)) == 77).all()


def test_shifts_move_the_content_and_repeat_the_border() -> None:
    images = np.random.default_rng(0).integers(0, 256, (2, 32, 32), np.uint8)
    shifted = FAULTS["image_shift"](x=3, y=-2).apply(images, 0.1, np.random.default_rng(0))
    assert (shifted[:, :-2, 3:] == images[:, 2:, :-3]).all()
    assert (shifted[:, :-2, :3] == images[:, 2:, :1]).all()
    assert (shifted[:, -2:] == shifted[:, -3:-2]).all()
    wide = FAULTS["image_shift"](x=100).apply(images, 0.1, np.random.default_rng(0))
    assert (wide == images[:, :, :1]).all()


def cameras(*names: str) -> Episode:
    """Twenty steps of white 8 x 8 images of each name, and of a force."""
    task = Task(
        name="cameras",
        components=(Component("x", "m"),),
        observations={**dict.fromkeys(names, (8, 8)), "force": (3,), "tactile": (4, 4)},
        modalities={key: (key,) for key in (*names, "force", "tactile")},
        control_size=0,
        dt=0.1,
        arrays=("tactile",),
    )
    observations = {name: np.full((20, 8, 8), 255 - k, np.uint8) for k, name in enumerate(names)}
    observations |= {"force": np.ones((20, 3), np.float32), "tactile": np.ones((20, 4, 4), np.float32)}
    return Episode(task, np.zeros((20, 1)), observations=observations)


IMAGE_FAULTS = tuple(name for name, fault in FAULTS.items() if issubclass(fault, ImageFault))


@pytest.mark.parametrize("name", IMAGE_FAULTS)
def test_an_image_fault_changes_the_named_camera_only(name: str) -> None:
    rng = np.random.default_rng(0)
    episode = cameras("left", "right", "image")
    images = {key: rng.integers(0, 256, (20, 8, 8), np.uint8) for key in episode.task.images}
    episode = replace(episode, observations={**episode.observations, **images})
    for text, key in ((f"{name}:key=right", "right"), (name, "image")):
        after = Faults.parse(text).apply(episode).observations
        assert {k for k, v in episode.observations.items() if not np.array_equal(v, after[k])} == {key}
    named = Faults.parse(f"{name}:key=right")
    assert Faults.parse(str(named)) == Faults.from_json(named.to_json()) == named
    assert named.to_json()[0]["key"] == "right"


def test_the_only_camera_needs_no_name() -> None:
    episode = cameras("wrist")
    after = Faults.parse("blackout").apply(episode).observations["wrist"]
    assert not after.any()
    assert "blackout=0.4" in available_presets(episode.task).values()


def test_several_cameras_have_presets_of_their_own() -> None:
    task = cameras("image", "left").task
    presets = available_presets(task)
    assert (presets["40 % image blackout"], presets["40 % left blackout"]) == ("blackout=0.4", "blackout=0.4:key=left")
    for text in presets.values():
        Faults.parse(text).check(task)
    assert evaluated_blackouts(task) == evaluated_blackouts(cameras("wrist").task) == EVALUATED_BLACKOUTS
    assert evaluated_blackouts(cameras("left", "right").task) == evaluated_blackouts(cameras().task) == (0.0,)


@pytest.mark.parametrize(
    ("text", "names", "message"),
    [
        ("blackout", (), r"blackout needs an image sensor; task 'cameras' has none\. Its sensors: force, tactile\."),
        ("blackout", ("left", "right"), r"name of one of .* 'cameras': blackout:key=left, blackout:key=right$"),
        ("blackout:key=force", ("left",), r"image sensor 'force' of task 'cameras' does not exist\. Available: left\."),
        (
            "blackout:key=rigt",
            ("left", "right"),
            r"image sensor 'rigt' of task 'cameras' does not exist\. Available: left, right\.",
        ),
    ],
)
def test_sensors_that_are_no_image_are_refused(text: str, names: tuple[str, ...], message: str) -> None:
    with pytest.raises(BadInput, match=message):
        Faults.parse(text).check(cameras(*names).task)
