"""Best constant weights by phase: closed form, and that each trajectory's come from the others."""

from __future__ import annotations

import numpy as np

from beliefscope.inspect.statistics.oracle import constant_weights, oracle_weights


def test_weights_of_independent_errors_are_inverse_variances() -> None:
    rng = np.random.default_rng(0)
    scale = np.array([[1.0, 2.0], [3.0, 1.0]])  # (phase, K)
    phases = [rng.integers(0, 2, 4000) for _ in range(3)]
    errors = [(rng.normal(size=(4000, 2)) * scale[phase])[:, None, None] for phase in phases]
    near = [np.full((4000, 1, 2), 0.5)] * 3
    weights = constant_weights(errors, phases, near)
    for phase, first in ((0, 0.8), (1, 0.1)):
        np.testing.assert_allclose(weights[0][phases[0] == phase, 0, 0], first, atol=0.02)


def test_a_trajectory_does_not_choose_its_own_weights() -> None:
    rng = np.random.default_rng(1)
    errors = [rng.normal(size=(50, 1, 2, 2)) for _ in range(4)]
    phases, near = [np.zeros(50, dtype=int)] * 4, [np.full((50, 1, 2), 0.5)] * 4
    before = constant_weights(errors, phases, near)
    after = constant_weights([errors[0] * [0.0, 9.0], *errors[1:]], phases, near)
    np.testing.assert_array_equal(after[0], before[0])
    assert np.abs(after[1] - before[1]).max() > 0.01
    # No constant does better than the oracle.
    oracle = oracle_weights(errors[0][:, 0], near[0][:, 0])
    cost = [np.square((errors[0][:, 0] * w[:, None]).sum(-1)).sum() for w in (oracle, before[0][:, 0])]
    assert cost[0] <= cost[1]
