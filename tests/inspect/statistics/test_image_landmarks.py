"""Localisation of landmarks in images, here of a hand, on drawn scenes with a known camera."""

from __future__ import annotations

import json

import numpy as np
import pytest

from beliefscope.inspect.statistics.image_landmarks import LandmarkFilter, fit_landmark_filter, quadratic
from beliefscope.inspect.statistics.reference_images import normalised
from beliefscope.inspect.statistics.signals import Array

SIZE = 32
CAMERA = np.array([[16.0, 15.0], [40.0, 5.0], [-6.0, 35.0]])
"""x and y pixels of a hand position p in m: ``[1, p] @ CAMERA``."""


def scene(
    seed: int, shift: tuple[int, int] = (0, 0), contrast: float = 120.0, reach: float = 0.2
) -> tuple[Array, Array]:
    """(T, H, W) normalised images of a hand, a distractor and a fixed edge, and (T, 2) hand positions.

    Args:
        shift: (x, y) pixels by which the camera moves the images.
        contrast: gray levels of the hand. reach: amplitude of its motion, m; those above 0.4 leave the images.
    """
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 2.0 * np.pi, 40)[:, None]
    hand = reach * np.sin(time * rng.uniform(0.5, 1.5, 2) + rng.uniform(0.0, 6.0, 2))
    distractor = rng.uniform(-0.2, 0.2, 2) + 0.3 * (hand - hand[0])
    rows, columns = np.mgrid[:SIZE, :SIZE]

    def blob(position: Array, width: float) -> Array:
        x, y = (np.concatenate([np.ones((len(position), 1)), position], axis=1) @ CAMERA).T[:, :, None, None]
        return np.exp(-((columns - shift[0] - x) ** 2 + (rows - shift[1] - y) ** 2) / (2.0 * width**2))

    edge = 30.0 * (columns - shift[0] > 24)
    images = (
        60.0 + edge + contrast * blob(hand, 1.2) + 90.0 * blob(distractor, 2.5) + rng.normal(0.0, 3.0, (40, SIZE, SIZE))
    )
    return normalised(images.clip(0, 255).astype(np.uint8)), hand


@pytest.fixture(scope="module")
def hand_filter() -> LandmarkFilter:
    scenes = [scene(seed) for seed in range(20)]
    result = fit_landmark_filter(np.concatenate([s[0] for s in scenes]), np.concatenate([s[1] for s in scenes]))
    assert result is not None
    return result


def test_the_map_of_the_camera_is_recovered(hand_filter: LandmarkFilter) -> None:
    """Up to a constant: the filter may follow any point that moves with the hand."""
    hand = np.random.default_rng(1).uniform(-0.2, 0.2, (50, 2))
    difference = hand_filter.pixels(hand) - hand @ CAMERA[1:]
    np.testing.assert_allclose(difference, np.broadcast_to(difference.mean(0), (50, 2)), atol=0.4)


def test_a_landmark_that_leaves_the_images_is_localised_inside() -> None:
    scenes = [scene(seed, reach=0.5 if seed % 4 == 0 else 0.2) for seed in range(20)]
    result = fit_landmark_filter(np.concatenate([s[0] for s in scenes]), np.concatenate([s[1] for s in scenes]))
    assert result is not None
    assert max(result.pixels(hand).max() for _, hand in scenes) > SIZE + 1.0
    offset, match = result.locate(*scene(100, shift=(2, 0), reach=0.5))
    np.testing.assert_allclose(offset, (2.0, 0.0), atol=0.5)
    assert match > 0.7


@pytest.mark.parametrize("shift", [(0, 0), (1, 0), (-4, 3), (0, 6)])
def test_a_moved_camera_moves_the_hand_by_the_same_pixels(hand_filter: LandmarkFilter, shift: tuple[int, int]) -> None:
    offsets = [hand_filter.locate(*scene(seed, shift))[0] for seed in range(100, 106)]
    np.testing.assert_allclose(np.mean(offsets, axis=0), shift, atol=0.2)


def test_a_wrong_hand_position_is_seen_through_the_camera(hand_filter: LandmarkFilter) -> None:
    images, hand = scene(200)
    error = np.array([0.05, -0.03])
    np.testing.assert_allclose(hand_filter.locate(images, hand + error)[0], -error @ CAMERA[1:], atol=0.3)


def test_a_hand_outside_of_the_images_has_no_offset(hand_filter: LandmarkFilter) -> None:
    images, hand = scene(201)
    offset, match = hand_filter.locate(images, hand + 5.0)
    assert np.isnan([*offset, match]).all()


def test_a_healthy_hand_matches_and_a_hidden_one_has_no_offset(hand_filter: LandmarkFilter) -> None:
    """The match is the height of the mean response, so episodes vary around one."""
    matches = [hand_filter.locate(*scene(seed))[1] for seed in range(300, 306)]
    assert np.mean(matches) == pytest.approx(1.0, abs=0.1)
    offset, match = hand_filter.locate(*scene(300, contrast=0.0))
    assert match < 0.5
    assert np.isnan(offset).all()


def test_positions_that_move_nothing_in_the_images_have_no_filter() -> None:
    images = np.concatenate([scene(seed)[0] for seed in range(20)])
    positions = np.random.default_rng(0).uniform(-0.2, 0.2, (len(images), 2))
    assert fit_landmark_filter(images, positions) is None


def test_filters_of_earlier_versions_have_offsets_without_a_match(hand_filter: LandmarkFilter) -> None:
    document = {key: value for key, value in hand_filter.to_json().items() if key != "height"}
    offset, match = LandmarkFilter.from_json(document).locate(*scene(203, (2, 0)))
    np.testing.assert_allclose(offset, (2.0, 0.0), atol=0.3)
    assert np.isnan(match)


def test_json_keeps_the_offsets(hand_filter: LandmarkFilter) -> None:
    document = json.loads(json.dumps(hand_filter.to_json()))
    images, hand = scene(202)
    np.testing.assert_allclose(
        LandmarkFilter.from_json(document).locate(images, hand)[0], hand_filter.locate(images, hand)[0], atol=0.02
    )
    with pytest.raises(ValueError, match="kernel"):
        LandmarkFilter.from_json(document | {"kernel": [[1.0]]})


@pytest.mark.parametrize("shape", [(50, 1, 1), (50, 5, 40), (2, SIZE, SIZE), (6, 1200, 1200)])
def test_too_small_too_few_and_too_large_images_have_no_filter(shape: tuple[int, int, int]) -> None:
    assert fit_landmark_filter(np.zeros(shape), np.zeros((shape[0], 2))) is None


def test_quadratic_terms() -> None:
    np.testing.assert_array_equal(quadratic(np.array([[2.0, 3.0]])), [[1.0, 2.0, 3.0, 4.0, 6.0, 9.0]])
