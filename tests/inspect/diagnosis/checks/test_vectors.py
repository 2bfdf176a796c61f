"""Readings at a limit of their sensor, and those that are lost."""

from __future__ import annotations

import numpy as np

from beliefscope.inspect.diagnosis.checks.vectors import saturated


def test_saturated_readings_repeat_a_limit_in_several_stretches() -> None:
    stuck, limited = np.array([0.0, 1.0, 2.0, 2.0, 2.0]), np.array([0.0, 2.0, 2.0, 1.0, -2.0, 0.0])
    assert not saturated(stuck).any()
    np.testing.assert_array_equal(np.flatnonzero(saturated(limited)), [1, 2, 4])
    np.testing.assert_array_equal(np.flatnonzero(saturated(np.array([2.0, 1.0, 3.0, 1.0, 1.0]))), [1, 3, 4])
    assert not saturated(np.zeros(0)).any()
    lost = np.sin(0.1 * np.arange(60)) + 2.0
    lost[20:25] = lost[40:45] = 0.0
    assert not saturated(lost).any(), "readings that jump to zero are lost"
    assert saturated(np.maximum(np.sin(0.3 * np.arange(60)), -0.7)).sum() > 10
