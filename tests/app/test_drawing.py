"""What outlines an object in the scene."""

from __future__ import annotations

import numpy as np
import pytest

from beliefscope.app.drawing import OUTLINES
from beliefscope.datasets.catalog import TASKS


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
