"""Push task of the field with a rectangular block whose yaw is estimated as well."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import mujoco
import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.ingredient import Ingredient
from beliefscope.datasets.simulation.ingredients import draw, start_ingredient
from beliefscope.datasets.simulation.outline import Outline
from beliefscope.datasets.simulation.push import HEIGHT, BlockPhysics, push_model
from beliefscope.datasets.simulation.push_field import (
    PUCK,
    PUSH_FIELD,
    PushPuckWithAimError,
    aim_error,
    recorded,
    simulate_draws,
)
from beliefscope.datasets.simulation.simulate import first_free_start
from beliefscope.datasets.task import Component

BLOCK = BlockPhysics()
QUATERNION = slice(PUCK.stop + 1, PUCK.stop + 5)
"""Where the block's orientation (w, x, y, z) is in qpos."""


def simulate_push_field_yaw(seed: int, index: int, steps: int, without: Collection[str] = ()) -> Episode:
    """Simulate episode ``index`` of the collection with ``seed``: ``steps`` steps of 0.1 s. Deterministic.

    Args:
        without: names of ingredients to switch off. The draws of the others do not change.
    """
    return first_free_start(lambda rng: _simulate(rng, seed, index, steps, without), seed, index)


def _simulate(rng: Generator, seed: int, index: int, steps: int, without: Collection[str]) -> Episode:
    draws = draw(PUSH_FIELD_YAW, seed, index, without)
    values = dict(draws["block"].values) if "block" in draws else {"yaw": 0.0}
    yaw = values.pop("yaw")
    block = BlockPhysics(**values)
    policy = PushPuckWithAimError(rng, block, aim_error(draws))
    policy.object_start[3:] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
    return simulate_draws(PUSH_FIELD_YAW, draws, block, policy, _states, seed, index, steps)


def _states(qpos: NDArray[np.float32]) -> NDArray[np.float32]:
    """(T, 3) x, y and yaw of joint positions (T, q). The yaw is continuous in time."""
    w, x, y, z = qpos[:, QUATERNION].astype(np.float64).T
    yaw = np.unwrap(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
    return np.column_stack([qpos[:, PUCK], yaw]).astype(np.float32)


def block_outline(states: ArrayLike) -> Outline:
    """Outline of a block of mean size for states (..., 3) = (x, y, yaw)."""
    states = np.asarray(states, float)
    height, half = np.full_like(states[..., :1], HEIGHT / 2), states[..., 2] / 2
    zero = np.zeros_like(half)
    return Outline(
        position=np.concatenate([states[..., :2], height], -1),
        wxyz=np.stack([np.cos(half), zero, zero, np.sin(half)], -1),
        size=(BLOCK.length, BLOCK.width, HEIGHT),
        anchor=np.concatenate([states[..., :2], 2 * height], -1),
    )


def _replay(episode: Episode) -> mujoco.MjModel:
    expected = "{'length': m, 'width': m, 'mass': kg, 'friction': number}"
    block = recorded(episode, "block", BlockPhysics, expected, initial="yaw")
    return push_model(visual=True, puck=block)


START = {**PUSH_FIELD.start_distance, "rad": (float(np.deg2rad(10.0)), float(np.deg2rad(20.0)))}

PUSH_FIELD_YAW = replace(
    PUSH_FIELD,
    name="push-field-yaw",
    components=(Component("x", "m"), Component("y", "m"), Component("yaw", "rad")),
    replay=_replay,
    outline=block_outline,
    simulate=simulate_push_field_yaw,
    start_distance=START,
    ingredients={
        "block": Ingredient(
            "length and width (m), mass (kg), friction and initial yaw (rad) of the block",
            {
                "length": (0.1, 0.14),
                "width": (0.06, 0.09),
                "mass": (0.4, 0.9),
                "friction": (0.2, 0.8),
                "yaw": (-0.6, 0.6),
            },
            {"length": "m", "width": "m", "mass": "kg", "yaw": "rad"},
        ),
        **{name: value for name, value in PUSH_FIELD.ingredients.items() if name not in ("puck", "start")},
        "start": start_ingredient(START),
    },
)
