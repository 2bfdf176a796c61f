"""Door task: estimate the hinge position and the angle of a door that a robot pulls or pushes.

World frame: the robot's base, x forward, y left, z up; m. The closed door is perpendicular to x, with the hinge on the
robot's right; a positive angle opens it towards the robot.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from beliefscope.datasets.covariate import CONTACT
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.camera import Camera
from beliefscope.datasets.simulation.controller import FORWARD, Impedance, add_controller
from beliefscope.datasets.simulation.door_physics import (
    HINGE_CENTRE,
    HINGE_HALF_RANGE,
    MAX_ANGLE,
    PANEL_WIDTH,
    DoorPhysics,
)
from beliefscope.datasets.simulation.door_policies import POLICIES
from beliefscope.datasets.simulation.outline import Outline
from beliefscope.datasets.simulation.panda import ROBOT_BIT, STIFF, WORLD_BIT, Sleeve, add_panda, new_spec
from beliefscope.datasets.simulation.panda_visual import add_appearance
from beliefscope.datasets.simulation.sensors import add_touch
from beliefscope.datasets.simulation.simulate import DT, POSITION_BITS, Scene, first_free_start, quantise, simulate
from beliefscope.datasets.task import Array, Component, Task

PANEL_SIZE = (0.04, PANEL_WIDTH, 0.86)  # thickness, width, height; m
PANEL_BOTTOM = 0.02  # m above the floor
BAR_HEIGHTS = (0.55, 0.69)  # range, m
BAR_START, BAR_MARGIN = 0.20, 0.04  # m, distance of the bar's ends from the hinge and from the panel's other side
SPRING = 1.6  # N m/rad, opens a pushed door for the next push
SPRING_REST = 2.0  # rad; friction stops the door earlier

CAMERA = Camera((0.50, -0.08, 2.6), (0, 0, -1), (1, 0, 0), float(np.deg2rad(31)))
IMPEDANCE = Impedance(FORWARD, (1600, 1600, 1200), lead=0.05)


def panel_outline(states: ArrayLike) -> Outline:
    """Outline of the door's panel for states (..., 3) = (hinge_x, hinge_y, angle)."""
    x, y, angle = np.moveaxis(np.asarray(states, float), -1, 0)
    half = PANEL_SIZE[1] / 2
    height = np.full_like(x, PANEL_BOTTOM + PANEL_SIZE[2] / 2)
    zero = np.zeros_like(x)
    return Outline(
        position=np.stack([x - half * np.sin(angle), y + half * np.cos(angle), height], -1),
        wxyz=np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], -1),
        size=PANEL_SIZE,
        anchor=np.stack([x, y, np.full_like(x, PANEL_BOTTOM + PANEL_SIZE[2])], -1),
    )


def panel_direction(states: ArrayLike) -> Array:
    """(...,) rad from the x axis: direction from the hinge along the panel, for states (..., 3).

    The gripper holds the bar, which is parallel to the panel, at an unknown distance from the hinge: haptics determines
    the hinge across the panel, not along it.
    """
    return np.asarray(states, float)[..., 2] + np.pi / 2.0


def door_model(
    physics: DoorPhysics, visual: bool = False, frame: bool = True, sleeve: Sleeve | None = None
) -> mujoco.MjModel:
    """Model of robot, door, frame and floor. Joint ``door`` is last in qpos.

    Args:
        visual: draw the robot as in replays. frame: whether the frame is visible.
    """
    spec = new_spec()
    add_panda(spec, sleeve)
    add_controller(spec, IMPEDANCE)
    _add_environment(spec, physics, frame)
    _add_door(spec, physics)
    add_touch(spec, "door")
    if visual:
        add_appearance(spec)
    return spec.compile()


def _add_environment(spec: mujoco.MjSpec, physics: DoorPhysics, visible: bool) -> None:
    world = spec.worldbody
    world.add_light(pos=(0, 0, 3.5), dir=(0, 0, -1), type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    world.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(3, 3, 0.1),
        rgba=(0.32, 0.35, 0.38, 1),
        contype=0,
        conaffinity=0,
    )
    frame = world.add_body(name="frame", pos=(*physics.hinge, 0))
    width, top = physics.width, PANEL_BOTTOM + PANEL_SIZE[2]
    beam = {
        "type": mujoco.mjtGeom.mjGEOM_BOX,
        "rgba": (0.16, 0.17, 0.2, float(visible)),  # rays pass through geoms of opacity 0
        "contype": WORLD_BIT,
        "conaffinity": ROBOT_BIT,
    }
    for y in (-0.05, width + 0.05):
        frame.add_geom(pos=(0.03, y, (top + 0.04) / 2), size=(0.04, 0.03, (top + 0.04) / 2), **beam)
    frame.add_geom(pos=(0.03, width / 2, top + 0.06), size=(0.04, width / 2 + 0.08, 0.02), **beam)


def _add_door(spec: mujoco.MjSpec, physics: DoorPhysics) -> None:
    door = spec.worldbody.add_body(name="door", pos=(*physics.hinge, 0))
    door.add_joint(
        name="door",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=(0, 0, 1),
        limited=True,
        range=(0, MAX_ANGLE),
        damping=physics.damping,
        frictionloss=physics.friction,
        stiffness=physics.spring,
        springref=SPRING_REST,
        armature=0.02,
    )
    touch = {"contype": WORLD_BIT, "conaffinity": ROBOT_BIT, "condim": 4, **STIFF}
    thickness, width, height = PANEL_SIZE[0], physics.width, PANEL_SIZE[2]
    door.add_geom(
        name="panel",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(0, width / 2, PANEL_BOTTOM + height / 2),
        size=(thickness / 2, width / 2, height / 2),
        rgba=(0.76, 0.53, 0.32, 1),
        mass=3.0,
        **touch,
    )
    ends, offset, z = (BAR_START, width - BAR_MARGIN), physics.bar_offset, physics.bar_height
    capsule, steel = mujoco.mjtGeom.mjGEOM_CAPSULE, (0.88, 0.89, 0.92, 1)
    door.add_geom(
        name="bar",
        type=capsule,
        fromto=(-offset, ends[0], z, -offset, ends[1], z),
        size=(0.014, 0, 0),
        rgba=steel,
        mass=0.3,
        **touch,
    )
    for i, radius in enumerate(ends):
        door.add_geom(
            name=f"bracket{i}",
            type=capsule,
            fromto=(-offset, radius, z, 0, radius, z),
            size=(0.01, 0, 0),
            rgba=steel,
            mass=0.05,
            **touch,
        )


def _replay(episode: Episode) -> mujoco.MjModel:
    try:
        x, y = (float(value) for value in episode.provenance["hinge"])
        height = float(episode.provenance["bar_height"])
    except (KeyError, TypeError, ValueError):
        raise BadInput(
            "The episode's provenance does not describe its door: expected 'hinge': [x, y] and 'bar_height', in m."
        ) from None
    return door_model(DoorPhysics((x, y), height), visual=True)


def policy_name(index: int) -> str:
    """Policy of an episode: alternates with a swap every ten, so that every split contains both policies."""
    return ("pull", "push")[(index + index // 10) % 2]


def draw_door(rng: Generator, policy: str) -> DoorPhysics:
    """A door with a random hinge and bar height; a spring opens pushed doors."""
    hinge = quantise(HINGE_CENTRE + rng.uniform(-HINGE_HALF_RANGE, HINGE_HALF_RANGE, 2), POSITION_BITS)
    spring = 0.0 if policy == "pull" else SPRING
    return DoorPhysics((float(hinge[0]), float(hinge[1])), float(rng.uniform(*BAR_HEIGHTS)), spring)


def simulate_door(seed: int, index: int, steps: int) -> Episode:
    """Simulate episode ``index`` of the collection with ``seed``: ``steps`` steps of 0.1 s. Deterministic."""
    return first_free_start(lambda rng: _simulate(rng, seed, index, steps), seed, index)


def _simulate(rng: Generator, seed: int, index: int, steps: int) -> Episode:
    name = policy_name(index)
    door = draw_door(rng, name)
    hinge = np.array(door.hinge, np.float32)
    return simulate(
        DOOR,
        Scene(door_model(door), IMPEDANCE, CAMERA),
        POLICIES[name](door, rng),
        lambda qpos: np.concatenate([np.broadcast_to(hinge, (steps, 2)), qpos[:, -1:]], axis=1),
        seed,
        index,
        steps,
        {"policy": name, "hinge": list(door.hinge), "bar_height": door.bar_height, "spring": door.spring},
    )


DOOR = Task(
    name="door",
    components=(
        Component("hinge_x", "m", static=True),
        Component("hinge_y", "m", static=True),
        Component("angle", "rad"),
    ),
    observations={"image": (32, 32), "effector_position": (3,), "force": (3,), "torque": (3,), "contact": (1,)},
    modalities={"image": ("image",), "haptics": ("effector_position", "force", "torque", "contact")},
    control_size=7,
    dt=DT,
    map_components=("hinge_x", "hinge_y"),
    map_half_width=0.135,
    covariates={"contact": CONTACT},
    positions={"effector_position": (0, 1), "control": (0, 1)},
    replay=_replay,
    outline=panel_outline,
    camera=CAMERA,
    ridge_direction=panel_direction,
    simulate=simulate_door,
)
