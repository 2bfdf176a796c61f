"""Episodes from other physics than the training data: the cause ``data.shift``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.simulation.door import (
    CAMERA as DOOR_CAMERA,
    DOOR,
    IMPEDANCE as DOOR_IMPEDANCE,
    door_model,
    draw_door,
    policy_name,
)
from beliefscope.datasets.simulation.door_policies import POLICIES
from beliefscope.datasets.simulation.push import CAMERA, IMPEDANCE, PUSH, RADIUS, PuckPhysics, PushPuck, push_model
from beliefscope.datasets.simulation.simulate import ROBOT_JOINTS, Scene, first_free_start, simulate

TASKS = ("door", "push")

MAGNITUDES = (0.1, 0.15, 0.5, 0.4)
"""Four levels: relative change of the door's width and its bar's distance, or of the puck's radius and mass."""


def shifted_episode(task: str, seed: int, index: int, steps: int, magnitude: float) -> Episode:
    """Door: a wider panel whose bar is closer. Push: a larger, heavier puck with less friction."""
    return first_free_start(lambda rng: _simulate(rng, task, seed, index, steps, magnitude), seed, index)


def _simulate(rng: Generator, task: str, seed: int, index: int, steps: int, magnitude: float) -> Episode:
    if task == "door":
        policy = policy_name(index)
        door = draw_door(rng, policy)
        door = replace(door, width=door.width * (1 + 0.4 * magnitude), bar_offset=door.bar_offset * (1 - magnitude))
        hinge = np.array(door.hinge, np.float32)
        return simulate(
            DOOR,
            Scene(door_model(door), DOOR_IMPEDANCE, DOOR_CAMERA),
            POLICIES[policy](door, rng),
            lambda qpos: np.concatenate([np.broadcast_to(hinge, (steps, 2)), qpos[:, -1:]], axis=1),
            seed,
            index,
            steps,
            {"policy": policy, "hinge": list(door.hinge), "bar_height": door.bar_height, "spring": door.spring},
        )
    puck = PuckPhysics(RADIUS * (1 + 0.5 * magnitude), 0.6 * (1 + 2 * magnitude), 0.45 * (1 - magnitude))
    return simulate(
        PUSH,
        Scene(push_model(puck=puck), IMPEDANCE, CAMERA),
        PushPuck(rng, puck),
        lambda qpos: qpos[:, ROBOT_JOINTS : ROBOT_JOINTS + 2],
        seed,
        index,
        steps,
        {"policy": "push"},
    )
