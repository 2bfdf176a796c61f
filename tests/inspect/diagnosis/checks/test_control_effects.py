"""Effects of single controls: their slope on the predicted ones, and the dynamics with one wrong sign."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from tests.inspect.diagnosis.checks.test_dynamics import LateCart, ParticleCart, cart
from tests.inspect.diagnosis.test_external_dynamics import SENSORS, TASK, Cart

import beliefscope as bs
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnosis.checks.control_effects import control_effects
from beliefscope.inspect.diagnosis.checks.true_starts import predictions_from_truth, some_steps
from beliefscope.inspect.diagnosis.diagnose import diagnose
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.healthy import profile_of

NAMES = [[f"dynamics effect/control {control}/{component}" for component in "xy"] for control in "xy"]
"""Of both controls on both components."""

MOVES = np.array([[1.0, 0.5], [0.5, 1.0]])
"""Displacements, m, of both components by the two controls."""

TRACTOR = replace(
    TASK, channels={"control": (bs.Component("steer", "m"), bs.Component("throttle", "m"))}, name="tractor"
)


def drive(seed: int, noise: float = 0.002, task: bs.Task = TASK) -> bs.Episode:
    """With ``MOVES``, and a process noise in m."""
    rng = np.random.default_rng(seed)
    controls = rng.normal(0.0, 0.05, (120, 2))
    states = np.cumsum(controls @ MOVES.T + rng.normal(0.0, noise, (120, 2)), axis=0)
    readings = {key: states + rng.normal(0.0, std, (120, 2)) for key, std in SENSORS.items()}
    return bs.Episode(task, states, controls, readings, seed=seed, split="test")


class Mixed(Cart):
    """Predicts ``MOVES`` of the controls times gains of both, or of each on each component."""

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        return super().__call__(observations=observations, controls=(MOVES * np.array(self.gains)) @ controls)

    def __init__(self, *gains: float | tuple[float, float]) -> None:
        super().__init__()
        self.gains = gains


class MixedParticles(ParticleCart):
    """The same of a particle filter."""

    def forward(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        return super().forward(observations=observations, controls=controls @ controls.new_tensor(MOVES.T))


def effects(filter_: Any, episode: bs.Episode) -> dict[str, float]:
    checkpoint = cart(filter_)
    trace = bs.trace(checkpoint, [episode])
    steps = some_steps(trace, checkpoint)
    predictions = predictions_from_truth(trace, checkpoint, steps)
    assert predictions is not None
    change = np.diff(episode.states.astype(np.float64), axis=0)[steps - 1]
    return control_effects(trace, checkpoint, steps, predictions, change)


@pytest.mark.parametrize("gains", [(1.0, 1.0), (1.0, -1.0), (-2.0, 0.5)])
def test_slopes_are_the_inverse_gains(gains: tuple[float, float]) -> None:
    """Up to single precision; a wrong gain of one control does not change the slope of the other one."""
    values = effects(Mixed(*gains), drive(0, noise=0.0))
    for names, gain in zip(NAMES, gains, strict=True):
        assert [values[name] for name in names] == pytest.approx([1.0 / gain] * 2, abs=1e-3)


def test_flags_have_no_effects() -> None:
    """The other value of a control with two values may never occur in the same states."""
    episode = drive(0, noise=0.0)
    controls = np.column_stack([episode.controls[:, 0], episode.controls[:, 1] > 0.0])
    assert effects(Mixed(1.0, 1.0), replace(episode, controls=controls)).keys() == set(NAMES[0])


def test_an_effect_on_one_component_does_not_change_that_on_the_other() -> None:
    values = effects(Mixed((1.0, 1.0), (-1.0, 1.0)), drive(0, noise=0.0))
    expected = {name: 1.0 for names in NAMES for name in names} | {NAMES[0][1]: -1.0}
    assert values == pytest.approx(expected, abs=1e-3)


def test_runs_of_particle_filters_share_their_random_numbers() -> None:
    """Otherwise the mean of the particles would have a standard deviation of 1e-4 m, and the slopes one of 5e-4."""
    values = effects(MixedParticles(), drive(0, noise=0.0))
    assert values == pytest.approx({name: 1.0 for names in NAMES for name in names}, abs=1e-2)


def test_a_first_call_without_prediction_is_no_obstacle() -> None:
    episode = drive(0, noise=0.0)
    straight = bs.Episode(TASK, np.cumsum(episode.controls, axis=0), episode.controls, episode.observations, seed=0)
    values = effects(LateCart(), straight)
    assert values == pytest.approx({NAMES[0][0]: 1.0, NAMES[1][1]: 1.0}, abs=1e-2)


def test_controls_without_a_known_effect_have_none() -> None:
    """One without effect, a constant one, one that follows from the state, and one with an effect below the noise."""
    assert effects(Mixed(1.0, 0.0), drive(0)).keys() == {*NAMES[0]}
    constant = drive(0)
    constant.controls[:, 1] = 0.3
    assert effects(Mixed(1.0, 1.0), constant).keys() == {*NAMES[0]}
    feedback = drive(0)
    feedback.controls[1:, 1] = 0.1 * feedback.states[:-1, 0]
    assert effects(Mixed(1.0, 1.0), feedback).keys() == {*NAMES[0]}
    assert effects(Mixed(1.0, 1.0), drive(0, noise=2.0)) == {}


def of_tractor(*gains: float | tuple[float, float]) -> Checkpoint:
    adapter = bs.Adapter(Mixed(*gains), batched=False, modalities=tuple(SENSORS), initial_std=(0.02, 0.02))
    return bs.load_filter(adapter, TRACTOR, name="tractor")


@cache
def profile() -> HealthyProfile:
    return profile_of(of_tractor(1.0, 1.0), [drive(seed, task=TRACTOR) for seed in range(12)], "tractor")


@pytest.mark.slow
@pytest.mark.parametrize(
    "gains", [(1.0, -1.0), pytest.param(((1.0, 1.0), (1.0, -1.0)), marks=pytest.mark.long)], ids=["both", "one"]
)
def test_the_wrong_sign_of_one_control_is_named(gains: tuple[Any, Any]) -> None:
    """In both components, and in one of them."""
    episodes = {seed: drive(seed, task=TRACTOR) for seed in range(20, 25)}
    result = diagnose(of_tractor(*gains), episodes, profile=profile())
    assert result.causes[0].cause.name == "dynamics.inverted"
    assert "(throttle)" in result.headline
