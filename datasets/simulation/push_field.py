"""Field version of the push task: pucks, sensors and starts that differ between episodes, and open-loop controls."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import TypeVar

import mujoco
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.ingredient import Ingredient
from beliefscope.datasets.simulation.ingredients import (
    SENSOR_INGREDIENTS,
    Draws,
    camera_pose,
    draw,
    drawn_sleeve,
    finish,
    moved_camera,
    nudge_steps,
    start_ingredient,
    wrist,
)
from beliefscope.datasets.simulation.push import (
    CAMERA,
    CENTRE,
    IMPEDANCE,
    PUSH,
    BlockPhysics,
    PuckPhysics,
    PushPuck,
    push_model,
)
from beliefscope.datasets.simulation.simulate import (
    DT,
    ROBOT_JOINTS,
    Policy,
    Scene,
    Waypoint,
    first_free_start,
    simulate,
)
from beliefscope.datasets.task import Task

Vector = NDArray[np.float64]
Physics = TypeVar("Physics", PuckPhysics, BlockPhysics)

GRAVITY = 9.81  # m/s^2
PUCK = slice(ROBOT_JOINTS, ROBOT_JOINTS + 2)
"""Where the puck's position is in qpos."""


class PushPuckWithAimError(PushPuck):
    """Estimates the puck's position with an error at the beginning of each push, and does not correct it."""

    clearance = (0.03, 0.05)  # wider, so that the fingers seldom descend onto the puck

    def __init__(self, rng: Generator, puck: PuckPhysics | BlockPhysics, aim: float) -> None:
        """aim: standard deviation of the error along each axis, m."""
        super().__init__(rng, puck)
        self._aim = aim
        self._estimate = np.zeros(2)

    def next(self, joints: Vector) -> Waypoint:
        if not self._queue:
            self._estimate = joints[:2] + self._rng.normal(0.0, self._aim, 2)
        return super().next(self._estimate)


class Nudges:
    """Gives the puck the velocity at which it slides 2 to 4 cm towards the middle of the workspace."""

    def __init__(self, draws: Draws, friction: float, steps: int) -> None:
        self._friction = friction
        self._begins, self._numbers = nudge_steps(draws["nudges"], steps, DT)
        self._distance = draws["nudges"].values["distance"]
        self.steps = np.flatnonzero(self._begins).tolist()

    def __call__(self, step: int, data: mujoco.MjData) -> None:
        if not self._begins[step]:
            return
        joint = data.joint("puck")
        to_middle = CENTRE - joint.qpos[:2]
        turn = np.pi * (self._numbers[step, 0] - 0.5)
        direction = np.arctan2(to_middle[1], to_middle[0]) + turn
        distance = self._distance * (0.5 + self._numbers[step, 1])
        speed = np.sqrt(2.0 * self._friction * GRAVITY * distance)
        joint.qvel[:2] += speed * np.array([np.cos(direction), np.sin(direction)])


def simulate_push_field(seed: int, index: int, steps: int, without: Collection[str] = ()) -> Episode:
    """Simulate episode ``index`` of the collection with ``seed``: ``steps`` steps of 0.1 s. Deterministic.

    Args:
        without: names of ingredients to switch off. The draws of the others do not change.
    """
    return first_free_start(lambda rng: _simulate(rng, seed, index, steps, without), seed, index)


def _simulate(rng: Generator, seed: int, index: int, steps: int, without: Collection[str]) -> Episode:
    draws = draw(PUSH_FIELD, seed, index, without)
    puck = PuckPhysics(**draws["puck"].values) if "puck" in draws else PuckPhysics()
    policy = PushPuckWithAimError(rng, puck, aim_error(draws))
    return simulate_draws(PUSH_FIELD, draws, puck, policy, lambda qpos: qpos[:, PUCK], seed, index, steps)


def aim_error(draws: Draws) -> float:
    """Standard deviation of the error of the policy's aim, m."""
    return draws["aim"].values["std"] if "aim" in draws else 0.0


def simulate_draws(
    task: Task,
    draws: Draws,
    puck: PuckPhysics | BlockPhysics,
    policy: Policy,
    states: Callable[[NDArray[np.float32]], NDArray[np.float32]],
    seed: int,
    index: int,
    steps: int,
) -> Episode:
    """An episode of a field task with a pushed object and drawn ingredients. states: of ``simulate``."""
    nudges = Nudges(draws, puck.friction, steps) if "nudges" in draws else None
    scene = Scene(
        push_model(puck=puck, sleeve=drawn_sleeve(draws)),
        IMPEDANCE,
        moved_camera(CAMERA, draws),
        open_loop=True,
        disturb=nudges,
    )
    episode = simulate(
        task,
        scene,
        policy,
        states,
        seed,
        index,
        steps,
        {"policy": "push"},
    )
    return finish(task, episode, draws, {"nudges": [] if nudges is None else nudges.steps})


def recorded(episode: Episode, name: str, physics: type[Physics], expected: str, initial: str = "") -> Physics:
    """The pushed object that an episode's provenance describes. Raises BadInput if there is none.

    Args:
        name: of the ingredient with its parameters. expected: these parameters, for the error.
        initial: another parameter of the ingredient, of the first state.
    """
    try:
        values = episode.provenance["ingredients"].get(name, {})
        return physics(**{key: float(value) for key, value in values.items() if key != initial})
    except (KeyError, TypeError, ValueError, AttributeError):
        raise BadInput(
            f"The episode's provenance does not describe its {name}: expected 'ingredients': {{'{name}': {expected}}}."
        ) from None


def _replay(episode: Episode) -> mujoco.MjModel:
    puck = recorded(episode, "puck", PuckPhysics, "{'radius': m, 'mass': kg, 'friction': number}")
    return push_model(visual=True, puck=puck)


START = {"m": (0.03, 0.05)}

PUSH_FIELD = replace(
    PUSH,
    name="push-field",
    control_size=6,
    replay=_replay,
    simulate=simulate_push_field,
    start_distance=START,
    warmup=0,
    ingredients={
        "puck": Ingredient(
            "radius (m), mass (kg) and friction of the puck",
            {"radius": (0.042, 0.058), "mass": (0.4, 0.9), "friction": (0.2, 0.8)},
            {"radius": "m", "mass": "kg"},
        ),
        "camera-pose": camera_pose(0.015, float(np.deg2rad(1.0))),
        "wrist": wrist(0.5),
        **SENSOR_INGREDIENTS,
        "aim": Ingredient(
            "error of the position at which the policy aims, standard deviation (m)",
            {"std": (0.01, 0.02)},
            {"std": "m"},
        ),
        "nudges": Ingredient(
            "external impulses on the puck: number per s, mean distance (m)",
            {"per_second": (0.05, 0.12), "distance": (0.02, 0.04)},
            {"per_second": "1/s", "distance": "m"},
        ),
        "start": start_ingredient(START),
    },
)
