"""Body poses of an episode's model from the recorded joint positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Replay:
    """Model of an episode and the poses of its B bodies (body 0 is the world).

    Attributes:
        model: a ``mujoco.MjModel`` that callers may modify.
        positions: (T, B, 3) m, world. rotations: (T, B, 3, 3), body to world.
    """

    model: Any
    positions: Array
    rotations: Array


def replay(task: Task, episode: Episode) -> Replay | None:
    """Replay an episode (about 10 ms for 800 steps). None without joint positions or a model of the task.

    Raises BadInput like ``replay_model``.
    """
    model = replay_model(task, episode)
    return None if model is None else Replay(model, *body_poses(model, episode.qpos))


def replay_model(task: Task, episode: Episode) -> Any:
    """The ``mujoco.MjModel`` of an episode. None without joint positions or a model of the task.

    Raises BadInput if the joint positions do not match the model.
    """
    if task.replay is None or episode.qpos.shape[1] == 0:
        return None
    model = task.replay(episode)
    if episode.qpos.shape[1] != model.nq:
        raise BadInput(
            f"The episode's 'qpos' has {episode.qpos.shape[1]} joint positions per step; the model of {task.name!r} "
            f"has {model.nq}."
        )
    return model


def body_poses(model: Any, qpos: NDArray[np.floating]) -> tuple[Array, Array]:
    """Positions (T, B, 3), m, and rotations (T, B, 3, 3), body to world, of all bodies at joint positions (T, nq)."""
    data = mujoco.MjData(model)
    positions = np.empty((len(qpos), model.nbody, 3))
    rotations = np.empty((len(qpos), model.nbody, 9))
    for step, joints in enumerate(qpos):
        data.qpos[:] = joints
        mujoco.mj_kinematics(model, data)
        positions[step], rotations[step] = data.xpos, data.xmat
    return positions, rotations.reshape(*rotations.shape[:2], 3, 3)
