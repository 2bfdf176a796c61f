"""The door task: estimate where a door's hinge is, and its angle, while a robot pulls or pushes it.

World axes: x away from the robot's base, y to its left, z up; m. The closed door stands across x, its hinge to the
robot's right; a positive angle opens it towards the robot.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.camera import Camera
from beliefscope.datasets.simulation.controller import FORWARD, Impedance, add_controller
from beliefscope.datasets.simulation.panda import ROBOT_BIT, STIFF, WORLD_BIT, add_panda, new_spec
from beliefscope.datasets.simulation.panda_meshes import dress
from beliefscope.datasets.simulation.sensors import add_touch
from beliefscope.datasets.simulation.simulate import DT, POSITION_BITS, Scene, episode_rng, quantise, simulate
from beliefscope.datasets.task import Component, Ghost, Task

HINGE_CENTRE = (0.81, -0.28)
HINGE_HALF_RANGE = 0.098  # uniform, so that the standard deviation is 5.7 cm
PANEL_SIZE = (0.04, 0.5, 0.86)  # thickness, width, height
PANEL_BOTTOM = 0.02
BAR_HEIGHTS = (0.55, 0.69)
BAR_OFFSET = 0.085  # from the panel's middle towards the robot
BAR_RADII = (0.20, 0.46)  # from the hinge, where the bar begins and ends
MAX_ANGLE = 1.55
SPRING = 1.6  # N m/rad, opens a pushed door for the next push
SPRING_REST = 2.0  # rad; friction stops the door before it

CAMERA = Camera((0.50, -0.08, 2.6), (0, 0, -1), (1, 0, 0), float(np.deg2rad(31)))
IMPEDANCE = Impedance(FORWARD, (1600, 1600, 1200), lead=0.05)


@dataclass(frozen=True)
class DoorPhysics:
    """What differs between doors.

    Attributes:
        hinge: (2,) m, world. bar_height: of the handle's bar, m. spring: opens the door, N m/rad; 0 is none.
    """

    hinge: tuple[float, float]
    bar_height: float
    spring: float = 0.0

    def bar_point(self, angle: float, radius: float) -> NDArray[np.float64]:
        """(3,) m: the point of the bar at ``radius`` m from the hinge, for a door at ``angle`` rad.

        ``hinge + R(angle) (-BAR_OFFSET, radius)``, with R the rotation about z.
        """
        c, s = np.cos(angle), np.sin(angle)
        x, y = self.hinge
        return np.array([x - BAR_OFFSET * c - radius * s, y - BAR_OFFSET * s + radius * c, self.bar_height])


def panel_ghost(states: ArrayLike) -> Ghost:
    """The door's panel as a box for states (..., 3) = (hinge_x, hinge_y, angle): see ``Ghost``."""
    x, y, angle = np.moveaxis(np.asarray(states, float), -1, 0)
    half = PANEL_SIZE[1] / 2
    height = np.full_like(x, PANEL_BOTTOM + PANEL_SIZE[2] / 2)
    zero = np.zeros_like(x)
    return Ghost(
        position=np.stack([x - half * np.sin(angle), y + half * np.cos(angle), height], -1),
        wxyz=np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], -1),
        size=PANEL_SIZE,
        anchor=np.stack([x, y, np.full_like(x, PANEL_BOTTOM + PANEL_SIZE[2])], -1),
    )


def door_model(physics: DoorPhysics, looks: bool = False) -> mujoco.MjModel:
    """Robot, door, frame and floor. Joint ``door`` comes last in qpos; bodies are named after what they are.

    Looks: with the robot's meshes, where they are installed.
    """
    spec = new_spec()
    add_panda(spec)
    add_controller(spec, IMPEDANCE)
    _add_surroundings(spec, physics.hinge)
    _add_door(spec, physics)
    add_touch(spec, "door")
    if looks:
        dress(spec)
    return spec.compile()


def _add_surroundings(spec: mujoco.MjSpec, hinge: tuple[float, float]) -> None:
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
    frame = world.add_body(name="frame", pos=(hinge[0], hinge[1], 0))
    width, top = PANEL_SIZE[1], PANEL_BOTTOM + PANEL_SIZE[2]
    beam = {
        "type": mujoco.mjtGeom.mjGEOM_BOX,
        "rgba": (0.16, 0.17, 0.2, 1),
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
        damping=8.0,
        frictionloss=1.5,
        stiffness=physics.spring,
        springref=SPRING_REST,
        armature=0.02,
    )
    touch = {"contype": WORLD_BIT, "conaffinity": ROBOT_BIT, "condim": 4, **STIFF}
    thickness, width, height = PANEL_SIZE
    door.add_geom(
        name="panel",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(0, width / 2, PANEL_BOTTOM + height / 2),
        size=(thickness / 2, width / 2, height / 2),
        rgba=(0.76, 0.53, 0.32, 1),
        mass=3.0,
        **touch,
    )
    (near, far), z = BAR_RADII, physics.bar_height
    capsule, steel = mujoco.mjtGeom.mjGEOM_CAPSULE, (0.88, 0.89, 0.92, 1)
    door.add_geom(
        name="bar",
        type=capsule,
        fromto=(-BAR_OFFSET, near, z, -BAR_OFFSET, far, z),
        size=(0.014, 0, 0),
        rgba=steel,
        mass=0.3,
        **touch,
    )
    for i, radius in enumerate(BAR_RADII):
        door.add_geom(
            name=f"bracket{i}",
            type=capsule,
            fromto=(-BAR_OFFSET, radius, z, 0, radius, z),
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
    return door_model(DoorPhysics((x, y), height), looks=True)


def policy_of(index: int) -> str:
    """Alternates, and swaps every ten, so that every split holds both policies."""
    return ("pull", "push")[(index + index // 10) % 2]


def simulate_door(seed: int, index: int, steps: int) -> Episode:
    """Trajectory ``index`` of the collection with ``seed``: ``steps`` steps of 0.1 s, the same on every call."""
    # Imported here because the policies need this module's door.
    from beliefscope.datasets.simulation.policies import Pull, Push

    rng = episode_rng(seed, index)
    hinge = quantise(HINGE_CENTRE + rng.uniform(-HINGE_HALF_RANGE, HINGE_HALF_RANGE, 2), POSITION_BITS)
    name = policy_of(index)
    spring = 0.0 if name == "pull" else SPRING
    door = DoorPhysics((float(hinge[0]), float(hinge[1])), float(rng.uniform(*BAR_HEIGHTS)), spring)
    return simulate(
        "door",
        Scene(door_model(door), IMPEDANCE, CAMERA),
        {"pull": Pull, "push": Push}[name](door, rng),
        lambda qpos: np.concatenate([np.broadcast_to(hinge, (steps, 2)), qpos[:, -1:]], axis=1),
        seed,
        index,
        steps,
        {"policy": name, "hinge": list(door.hinge), "bar_height": door.bar_height, "spring": door.spring},
    )


DOOR = Task(
    name="door",
    components=(Component("hinge_x", "m"), Component("hinge_y", "m"), Component("angle", "rad")),
    observations={"image": (32, 32), "effector_position": (3,), "force": (3,), "torque": (3,), "contact": (1,)},
    modalities={"image": ("image",), "haptics": ("effector_position", "force", "torque", "contact")},
    control_size=7,
    dt=DT,
    map_components=("hinge_x", "hinge_y"),
    map_half_width=0.135,
    positions={"effector_position": (0, 1), "control": (0, 1)},
    replay=_replay,
    ghost=panel_ghost,
    camera=CAMERA,
    simulate=simulate_door,
)
