"""Laws of angles that wrap around: no result depends on the turn in which an angle is given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Component, Task
from beliefscope.datasets.task_json import check_definition, task_from_json, task_to_json
from beliefscope.filters.angles import TURN, Angles, wrapping_warning
from beliefscope.filters.batch import Batch, Statistics, Steps
from beliefscope.filters.belief import Gaussian, moments
from beliefscope.filters.catalog import architecture, build, filters_of
from beliefscope.filters.models.dynamics import Dynamics
from beliefscope.filters.models.fusion import in_one_turn, product_of_experts
from beliefscope.filters.rollout import Rollout, first_belief, rollout

COMPONENTS = (Component("x", "m"), Component("heading", "rad", wraps=True), Component("speed", "m/s"))
ROBOT = Task("robot", COMPONENTS, {"gps": (2,), "compass": (2,)}, {"gps": ("gps",), "compass": ("compass",)}, 2, 0.1)
ANGLES = Angles.from_task(ROBOT)
HEADING = 1


def robot(heading: np.ndarray, split: str = "train", task: Task = ROBOT) -> Episode:
    """An episode with this heading; its other values are those of a robot that turns about a point."""
    x = 5.0 * np.cos(heading)
    states = np.stack([x, heading, 0.1 * np.sin(heading)], axis=1).astype(np.float32)
    seen = {"gps": states[:, [0, 2]], "compass": np.stack([np.cos(heading), np.sin(heading)], 1).astype(np.float32)}
    return Episode(task, states, states[:, [0, 2]], seen, split=split)


def batch_of(heading: np.ndarray) -> Batch:
    return Steps.from_episodes(ROBOT, [robot(heading)]).episode(0)


def random_states(*shape: int, seed: int = 0) -> Tensor:
    return 3.0 * torch.randn(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def turned(states: Tensor, turns: float = 1.0) -> Tensor:
    """States with their heading some turns further."""
    return states + TURN * turns * torch.eye(3, dtype=states.dtype)[HEADING]


def test_features_determine_the_state_and_are_continuous() -> None:
    states = random_states(4, 5)
    features = ANGLES.features(states)
    assert features.shape == (4, 5, 4)
    torch.testing.assert_close(ANGLES.features(turned(states)), features)
    torch.testing.assert_close(ANGLES.states(features), ANGLES.wrapped(states))


def test_without_wrapping_angles_nothing_changes() -> None:
    none, states = Angles(), random_states(4)
    for values in (none.features(states), none.states(states), none.near(states, states), none.wrapped(states)):
        assert values is states


def test_angles_near_a_reference_are_within_half_a_turn_and_broadcast() -> None:
    states, reference = random_states(1, 6), random_states(4, 1, seed=1)
    near = ANGLES.near(states, reference)
    assert near.shape == (4, 6, 3)
    assert bool(((near - reference)[..., HEADING].abs() <= TURN / 2 + 1e-9).all())
    turns = (near - states)[..., HEADING] / TURN
    torch.testing.assert_close(turns, turns.round())
    torch.testing.assert_close(near[..., [0, 2]], states[..., [0, 2]].expand(4, -1, -1))


def test_jacobian_of_the_dynamics_equals_the_automatic_derivative() -> None:
    torch.manual_seed(0)
    dynamics = Dynamics(3, 2, 8, ANGLES).double()
    torch.nn.init.normal_(dynamics.output.weight)
    states, control = random_states(5), dynamics.control_part(torch.randn(5, 2, dtype=torch.float64))
    mean, jacobian = dynamics.with_jacobian(states, control)
    torch.testing.assert_close(mean, dynamics(states, control))
    for i in range(5):
        expected = torch.autograd.functional.jacobian(lambda x, i=i: dynamics(x, control[i]), states[i])  # type: ignore[misc]
        torch.testing.assert_close(jacobian[i], expected)
    torch.testing.assert_close(dynamics(turned(states), control), turned(mean))


def test_moments_of_particles_turn_with_the_particles() -> None:
    states = random_states(200) * torch.tensor([1.0, 0.2, 1.0], dtype=torch.float64)
    log_weights = torch.log_softmax(random_states(200, seed=2)[:, 0], 0)
    apart = moments(states, log_weights)  # far from half a turn: the moments of numbers
    for turn in (0.5, 0.45, -2.5):
        moved = ANGLES.wrapped(turned(states, turn))
        result = moments(moved, log_weights, ANGLES)
        torch.testing.assert_close(result.covariance, apart.covariance)
        torch.testing.assert_close(result.mean, ANGLES.wrapped(turned(apart.mean, turn)))


def test_a_fused_heading_does_not_depend_on_the_turns_of_the_modalities() -> None:
    half = torch.tensor([[[1.0, 3.1, 0.0], [1.0, -3.1, 0.0]]], dtype=torch.float64)
    bank = Gaussian(half, torch.eye(3, dtype=torch.float64).expand(1, 2, 3, 3))
    fused = product_of_experts(in_one_turn(bank, ANGLES)).mean
    torch.testing.assert_close(ANGLES.wrapped(fused)[:, HEADING].abs(), torch.tensor([np.pi], dtype=torch.float64))
    second = torch.tensor([0.0, 1.0])[:, None].double()
    moved = product_of_experts(in_one_turn(Gaussian(half + second * (turned(half) - half), bank.covariance), ANGLES))
    torch.testing.assert_close(ANGLES.difference(moved.mean, fused), torch.zeros(1, 3, dtype=torch.float64))


@pytest.mark.first(5)
@pytest.mark.parametrize("name", filters_of(ROBOT))
def test_estimates_do_not_depend_on_the_turn_of_the_start(name: str) -> None:
    filter_, batch = build(architecture(ROBOT, name)), batch_of(np.linspace(2.0, 5.0, 8))

    def run(turns: float) -> Rollout:
        start = first_belief(filter_, batch)
        start = replace(start, mean=turned(start.mean, turns))
        return rollout(filter_, filter_.encode(batch), start, torch.Generator().manual_seed(0), particles=30, keep=True)

    with torch.no_grad():
        here, there = run(0.0), run(-3.0)
    difference = filter_.angles.difference(there.estimate.mean, here.estimate.mean)
    # Single precision of angles of 20 rad: 2e-6.
    torch.testing.assert_close(difference, torch.zeros_like(difference), atol=1e-4, rtol=0.0)
    torch.testing.assert_close(there.estimate.covariance, here.estimate.covariance, atol=1e-4, rtol=0.0, equal_nan=True)
    assert bool((here.estimate.mean[..., HEADING].abs() <= np.pi + 1e-5).all())


def test_statistics_leave_wrapping_angles_in_rad() -> None:
    statistics = Statistics(ROBOT)
    statistics.fit(Steps.from_episodes(ROBOT, [robot(np.linspace(0.0, 30.0, 50))]))
    mean, std = statistics.mean_std("state")
    assert (float(mean[HEADING]), float(std[HEADING])) == (0.0, 1.0)
    assert float(std[0]) > 1.0


def test_definitions_store_which_angles_wrap() -> None:
    assert task_from_json(task_to_json(ROBOT)).components == COMPONENTS
    former = task_to_json(ROBOT)
    for component in former["components"]:
        del component["wraps"]
    assert not task_from_json(former).components[HEADING].wraps
    with pytest.raises(BadInput, match="component 'x' has wraps True, expected true for an angle in rad only"):
        check_definition(replace(ROBOT, components=(Component("x", "m", wraps=True),)))


def test_undeclared_angles_that_wrap_are_named() -> None:
    turning = np.linspace(2.0, 5.0, 50)
    half_turn = (turning + np.pi) % TURN - np.pi
    task = replace(ROBOT, components=(COMPONENTS[0], Component("heading", "rad"), COMPONENTS[2]))
    wrapped = robot(half_turn, task=task)
    message = wrapping_warning([robot(turning, task=task), wrapped, wrapped])
    assert message is not None
    assert message.startswith("heading wraps around in 2 of 3 training episodes")
    assert wrapping_warning([robot(turning, task=task)]) is None
    assert wrapping_warning([replace(wrapped, split="test")]) is None
    assert wrapping_warning([robot(half_turn)]) is None
    assert wrapping_warning([]) is None
