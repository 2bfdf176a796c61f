"""Field version of the door task: doors, sensors and starts that differ between episodes, and open-loop controls."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import mujoco
import numpy as np
from numpy.random import Generator

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.ingredient import Ingredient
from beliefscope.datasets.simulation.door import CAMERA, DOOR, IMPEDANCE, door_model, draw_door, policy_name
from beliefscope.datasets.simulation.door_physics import MAX_ANGLE, DoorPhysics
from beliefscope.datasets.simulation.door_policies import POLICIES, AimError
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
from beliefscope.datasets.simulation.simulate import DT, Scene, first_free_start, simulate

NUDGE_STEPS = 5  # duration of a nudge


class Nudges:
    """Turns the door by a torque that lasts 0.5 s, away from the nearer stop."""

    def __init__(self, draws: Draws, door: DoorPhysics, steps: int) -> None:
        self._door = door
        begins, numbers = nudge_steps(draws["nudges"], steps, DT)
        self.steps = np.flatnonzero(begins).tolist()
        speed = draws["nudges"].values["angle"] * (0.5 + numbers[:, 1]) / (NUDGE_STEPS * DT)
        self._torque = (begins * (door.friction + door.damping * speed)).tolist()

    def __call__(self, step: int, data: mujoco.MjData) -> None:
        torque = max(self._torque[max(0, step - NUDGE_STEPS + 1) : step + 1])
        joint = data.joint("door")
        joint.qfrc_applied[:] = torque if joint.qpos[0] < MAX_ANGLE / 2 else -torque


def simulate_door_field(seed: int, index: int, steps: int, without: Collection[str] = ()) -> Episode:
    """Simulate episode ``index`` of the collection with ``seed``: ``steps`` steps of 0.1 s. Deterministic.

    Args:
        without: names of ingredients to switch off. The draws of the others do not change.
    """
    return first_free_start(lambda rng: _simulate(rng, seed, index, steps, without), seed, index)


def _simulate(rng: Generator, seed: int, index: int, steps: int, without: Collection[str]) -> Episode:
    draws, name = draw(DOOR_FIELD, seed, index, without), policy_name(index)
    door = draw_door(rng, name)
    door = replace(door, **draws["panel"].values) if "panel" in draws else door
    aim = AimError()
    if "aim" in draws:
        values, unit = draws["aim"].values, draws["aim"].rng.standard_normal(3)
        aim = AimError((values["hinge"] * unit[0], values["hinge"] * unit[1]), values["angle"] * unit[2])
    nudges = Nudges(draws, door, steps) if "nudges" in draws else None
    model = door_model(door, frame="hidden-frame" not in draws, sleeve=drawn_sleeve(draws))
    scene = Scene(model, IMPEDANCE, moved_camera(CAMERA, draws), open_loop=True, disturb=nudges)
    hinge = np.array(door.hinge, np.float32)
    episode = simulate(
        DOOR_FIELD,
        scene,
        POLICIES[name](door, rng, aim),
        lambda qpos: np.concatenate([np.broadcast_to(hinge, (steps, 2)), qpos[:, -1:]], axis=1),
        seed,
        index,
        steps,
        {"policy": name, "hinge": list(door.hinge), "bar_height": door.bar_height, "spring": door.spring},
    )
    return finish(DOOR_FIELD, episode, draws, {"nudges": [] if nudges is None else nudges.steps})


def _replay(episode: Episode) -> mujoco.MjModel:
    try:
        provenance = episode.provenance
        x, y = (float(value) for value in provenance["hinge"])
        panel = {key: float(value) for key, value in provenance["ingredients"].get("panel", {}).items()}
        door = DoorPhysics((x, y), float(provenance["bar_height"]), **panel)
    except (KeyError, TypeError, ValueError, AttributeError):
        raise BadInput(
            "The episode's provenance does not describe its door: expected 'hinge': [x, y], 'bar_height' and "
            "'ingredients': {'panel': {'width', 'bar_offset', 'damping', 'friction'}}, in SI units."
        ) from None
    return door_model(door, visual=True)


START = {"m": (0.03, 0.05), "rad": (float(np.deg2rad(10.0)), float(np.deg2rad(20.0)))}

DOOR_FIELD = replace(
    DOOR,
    name="door-field",
    control_size=6,
    replay=_replay,
    simulate=simulate_door_field,
    start_distance=START,
    warmup=0,
    ingredients={
        "panel": Ingredient(
            "width of the panel and offset of the bar (m), damping (N m s/rad) and friction (N m) of the hinge",
            {"width": (0.42, 0.58), "bar_offset": (0.07, 0.1), "damping": (4.0, 12.0), "friction": (0.5, 3.0)},
            {"width": "m", "bar_offset": "m", "damping": "N m s/rad", "friction": "N m"},
        ),
        "hidden-frame": Ingredient("the frame, which shows the hinge, is invisible to the camera", {}),
        "camera-pose": camera_pose(0.03, float(np.deg2rad(1.0))),
        "wrist": wrist(2.0),
        **SENSOR_INGREDIENTS,
        "aim": Ingredient(
            "error of the door that the policy assumes, standard deviations: hinge (m), angle (rad)",
            {"hinge": (0.01, 0.02), "angle": (0.02, 0.06)},
            {"hinge": "m", "angle": "rad"},
        ),
        "nudges": Ingredient(
            "external torques on the door: number per s, mean rotation (rad)",
            {"per_second": (0.05, 0.12), "angle": (0.1, 0.25)},
            {"per_second": "1/s", "angle": "rad"},
        ),
        "start": start_ingredient(START),
    },
)
