"""Channels of arrays: what a bias, a gain and another order of rows and columns do to them, and to the elements."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Component, Task
from beliefscope.inspect.statistics.array_channels import (
    array_channels,
    cloud_channels,
    element_statistics,
    with_array_channels,
)

ARRAYS = np.random.default_rng(0).gamma(1.0, 1.0, (20, 6, 9, 2))
TASK = Task("hand", (Component("x", "m"),), {"grid": (6, 9, 2)}, {"touch": ("grid",)}, 0, 0.1, arrays=("grid",))


def episode(values: np.ndarray, **changed: Any) -> Episode:
    return Episode(TASK, np.zeros((len(values), 1)), observations={"grid": values.astype(np.float32)}, **changed)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda a: a + 2.0, lambda m, s, r, c: (m + 2.0, s, r, c)),
        (lambda a: 3.0 * a, lambda m, s, r, c: (3.0 * m, 3.0 * s, r, c)),
        (lambda a: -a, lambda m, s, r, c: (-m, s, r, c)),
        (lambda a: a[:, ::-1], lambda m, s, r, c: (m, s, -r, c)),
        (lambda a: a[:, :, ::-1], lambda m, s, r, c: (m, s, r, -c)),
        (lambda a: a.swapaxes(1, 2), lambda m, s, r, c: (m, s, c, r)),
    ],
)
def test_changed_arrays_have_changed_channels(change: Any, expected: Any) -> None:
    before, after = array_channels(ARRAYS), array_channels(change(ARRAYS))
    np.testing.assert_allclose(after, np.stack(expected(*before.T), axis=1), atol=1e-12)


def test_a_peak_is_at_the_centre_and_equal_elements_have_none() -> None:
    arrays = np.zeros((2, 5, 7))
    arrays[0, 1, 6] = 4.0
    np.testing.assert_allclose(array_channels(arrays)[:, 2:], [[-1.0, 3.0], [0.0, 0.0]])


def test_large_arrays_are_thinned() -> None:
    places = np.arange(201.0) - 100.0
    arrays = np.exp(-np.square((places[:, None] - 31.0) / 8.0) - np.square((places - [[40.0]]) / 8.0))[None]
    np.testing.assert_allclose(array_channels(arrays)[0, 2:], [31.0, 40.0], atol=0.01)
    np.testing.assert_allclose(array_channels(arrays[:, ::-1])[0, 2:], [-31.0, 40.0], atol=0.01)


def test_statistics_of_elements() -> None:
    rng = np.random.default_rng(1)
    values = np.minimum(rng.normal(size=(400, 6, 9, 2)), 2.5)  # 0.6 % of normal values exceed 2.5
    values[:, 0, :3] = 0.0
    result = element_statistics(episode(values))
    assert result["dead/grid/all"] == 6 / 108
    # The mean over all elements, of which those that are dead have none; its standard error is about 0.004.
    assert result["noise/grid/all"] == pytest.approx(102 / 108, abs=0.03)
    assert result["roughness/grid/all"] == pytest.approx(1.0, abs=0.03)
    assert result["saturation/grid/all"] == pytest.approx(0.0062 * 102 / 108, abs=0.001)
    assert result["stuck/grid/all"] == 0.0
    assert result["holes/grid/all"] == 6 / 108
    values[200:300] = values[200]
    assert element_statistics(episode(values))["stuck/grid/all"] == 99 / 400


def test_only_arrays_become_vectors() -> None:
    result = with_array_channels(episode(ARRAYS))
    assert result.observations["grid"].shape == (20, 4)
    np.testing.assert_allclose(result.observations["grid"], array_channels(ARRAYS), rtol=1e-5)  # of float32
    image = Task("view", TASK.components, {"image": (6, 9)}, {"image": ("image",)}, 0, 0.1)
    seen = Episode(image, np.zeros((3, 1)), observations={"image": np.zeros((3, 6, 9), np.uint8)})
    assert with_array_channels(seen) is seen


def test_channels_of_a_point_cloud() -> None:
    rng = np.random.default_rng(2)
    points = np.concatenate([rng.normal(size=(3, 50, 3)) + np.array([5.0, -2.0, 1.0]), np.zeros((3, 10, 3))], axis=1)
    points[1] = 0.0  # the sensor sees nothing
    result = cloud_channels(points)
    np.testing.assert_allclose(result[0, :3], points[0, :50].mean(0))
    np.testing.assert_allclose(result[0, 3] ** 2, points[0, :50].var(0).sum())
    np.testing.assert_array_equal(result[1], result[0])
    np.testing.assert_allclose(cloud_channels(3.0 * points), 3.0 * result)
    moved = cloud_channels(np.where(points == 0.0, 0.0, points + np.array([1.0, 2.0, 3.0])))
    np.testing.assert_allclose(moved - result, np.tile([1.0, 2.0, 3.0, 0.0], (3, 1)), atol=1e-12)
    order = rng.permutation(60)
    np.testing.assert_allclose(cloud_channels(points[:, order]), result)
    assert cloud_channels(points[..., :2]).shape == (3, 3)
