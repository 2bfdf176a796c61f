"""The push task: estimate where a puck is, while a robot pushes it over the ground it stands on.

World axes: x away from the robot's base, y to its left, z up; m.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.simulation.camera import Camera
from beliefscope.datasets.simulation.controller import DOWN, Impedance, add_controller
from beliefscope.datasets.simulation.panda import ROBOT_BIT, WORLD_BIT, add_panda, new_spec
from beliefscope.datasets.simulation.panda_meshes import dress
from beliefscope.datasets.simulation.sensors import add_touch
from beliefscope.datasets.simulation.simulate import (
    DT,
    POSITION_BITS,
    ROBOT_JOINTS,
    Policy,
    Scene,
    Waypoint,
    episode_rng,
    quantise,
    random_speed,
    random_wait,
    simulate,
)
from beliefscope.datasets.task import Component, Ghost, Task

Vector = NDArray[np.float64]

RADIUS, HEIGHT = 0.05, 0.06  # m
MASS, FRICTION = 0.6, 0.45  # kg, -
CENTRE = np.array([0.55, 0.0])
HALF_RANGE = 0.105  # of the square around CENTRE in which pucks start and to whose places they are pushed

ROAM = 0.13  # m around CENTRE in x and y where the hand moves about
HOVER = (0.095, 0.16)  # m, the hand's height there
PUSH_HEIGHTS = (0.035, 0.05)
SHORTEST = 0.08  # m of a push
FASTEST = 0.12  # m/s: faster the hand cannot follow with so short a lead
TIP = 0.011  # m, from the middle of the closed fingertips to their front

ELEVATION = np.deg2rad(35)
_LOOK = np.array([0.0, np.cos(ELEVATION), -np.sin(ELEVATION)])
CAMERA = Camera(
    position=tuple((0.55, 0.0, 0.03) - 1.15 * _LOOK),
    forward=tuple(_LOOK),
    up=(0.0, float(np.sin(ELEVATION)), float(np.cos(ELEVATION))),
    field_of_view=float(np.deg2rad(24)),
)
IMPEDANCE = Impedance(DOWN, (700, 700, 900), lead=0.03)


class Pushes(Policy):
    """Comes down behind the puck, pushes it to some place of the square, draws back and rises, again and again.

    Between pushes the hand moves about, and comes down at once only near the puck: a free hand tells little of it.
    """

    fingers = 0.0
    squeeze = False

    def __init__(self, rng: Generator) -> None:
        self._rng = rng
        place = quantise(self._around(HALF_RANGE), POSITION_BITS)
        self.object_start = np.array([*place, HEIGHT / 2, 1.0, 0.0, 0.0, 0.0])
        self._queue: list[str] = []
        # Of the present push: unit vector, length (m), where and at which height it begins.
        self._way, self._length, self._behind, self._height = np.zeros(2), 0.0, np.zeros(2), 0.0
        self._last = np.zeros(2)

    def yaw(self, joints: Vector) -> float:
        return 0.0

    def start(self) -> Vector:
        return self._above(self._around(ROAM))

    def next(self, joints: Vector) -> Waypoint:
        rng, puck = self._rng, joints[:2]
        if not self._queue:
            self._queue = ["over", "down", "push", "back", "up", *["about"] * int(rng.integers(0, 2))]
        match self._queue.pop(0):
            case "over":
                self._choose(puck)
                aside = rng.normal(0.0, 0.02) * _left(self._way) - rng.uniform(0.0, 0.04) * self._way
                return Waypoint(self._above(self._behind + aside), self._speed(0.08), 2)
            case "down":
                return Waypoint(self._at(self._behind), self._speed(0.08), 2)
            case "push":
                gap = float((puck - self._behind) @ self._way) - RADIUS - TIP
                self._height += rng.normal(0.0, 0.006)
                return Waypoint(self._at(self._behind + (gap + self._length) * self._way), self._speed(0.05), 0)
            case "back":
                return Waypoint(self._at(self._last - rng.uniform(0.02, 0.05) * self._way), self._speed(0.08), 0)
            case "up":
                return Waypoint(self._above(self._last), self._speed(0.08), 0)
            case _:
                return Waypoint(self._above(self._around(ROAM)), self._speed(0.08), random_wait(rng))

    def _choose(self, puck: Vector) -> None:
        """Where to push the puck, and from where: a little to the side of straight behind it."""
        rng = self._rng
        while (length := float(np.linalg.norm(way := self._around(HALF_RANGE) - puck))) < SHORTEST:
            pass
        self._way, self._length = way / length, length
        self._behind = puck - (RADIUS + TIP + rng.uniform(0.01, 0.03)) * self._way
        self._behind += rng.normal(0.0, 0.012) * _left(self._way)
        self._height = float(rng.uniform(*PUSH_HEIGHTS))

    def _around(self, half_range: float) -> Vector:
        return CENTRE + self._rng.uniform(-half_range, half_range, 2)

    def _above(self, place: Vector) -> Vector:
        self._last = place
        return np.array([*place, self._rng.uniform(*HOVER)])

    def _at(self, place: Vector) -> Vector:
        self._last = place
        return np.array([*place, self._height])

    def _speed(self, least: float) -> float:
        return min(FASTEST, max(least, random_speed(self._rng)))


def _left(way: Vector) -> Vector:
    return np.array([-way[1], way[0]])


def puck_ghost(states: ArrayLike) -> Ghost:
    """The puck for states (..., 2) = (x, y): see ``Ghost``."""
    states = np.asarray(states, float)
    height = np.full_like(states[..., :1], HEIGHT / 2)
    return Ghost(
        position=np.concatenate([states, height], -1),
        wxyz=np.broadcast_to([1.0, 0.0, 0.0, 0.0], (*states.shape[:-1], 4)),
        size=(2 * RADIUS, 2 * RADIUS, HEIGHT),
        anchor=np.concatenate([states, 2 * height], -1),
        shape="cylinder",
    )


def push_model(looks: bool = False) -> mujoco.MjModel:
    """Robot, puck and ground. The puck's free joint comes last in qpos; bodies are named after what they are.

    Looks: with the robot's meshes, where they are installed.
    """
    spec = new_spec()
    add_panda(spec)
    add_controller(spec, IMPEDANCE)
    world = spec.worldbody
    world.add_light(pos=(0, 0, 3.5), dir=(0, 0, -1), type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    world.add_geom(
        name="ground",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(3, 3, 0.1),
        rgba=(0.32, 0.35, 0.38, 1),
        friction=(FRICTION, 5e-3, 1e-4),
        contype=WORLD_BIT,
        conaffinity=ROBOT_BIT,
    )
    puck = world.add_body(name="puck", pos=(*CENTRE, HEIGHT / 2))
    puck.add_freejoint(name="puck")
    puck.add_geom(
        name="puck",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=(RADIUS, HEIGHT / 2, 0),
        rgba=(0.9, 0.75, 0.3, 1),
        mass=MASS,
        friction=(FRICTION, 5e-3, 1e-4),
        condim=4,
        contype=WORLD_BIT,
        conaffinity=ROBOT_BIT | WORLD_BIT,  # the ground carries it
    )
    add_touch(spec, "puck")
    if looks:
        dress(spec)
    return spec.compile()


def simulate_push(seed: int, index: int, steps: int) -> Episode:
    """Trajectory ``index`` of the collection with ``seed``: ``steps`` steps of 0.1 s, the same on every call."""
    return simulate(
        "push",
        Scene(push_model(), IMPEDANCE, CAMERA),
        Pushes(episode_rng(seed, index)),
        lambda qpos: qpos[:, ROBOT_JOINTS : ROBOT_JOINTS + 2],
        seed,
        index,
        steps,
        {"policy": "push"},
    )


PUSH = Task(
    name="push",
    components=(Component("x", "m"), Component("y", "m")),
    observations={"image": (32, 32), "effector_position": (3,), "force": (3,), "torque": (3,), "contact": (1,)},
    modalities={"image": ("image",), "haptics": ("effector_position", "force", "torque", "contact")},
    control_size=7,
    dt=DT,
    map_components=("x", "y"),
    map_half_width=0.135,
    positions={"effector_position": (0, 1), "control": (0, 1)},
    replay=lambda _: push_model(looks=True),
    ghost=puck_ghost,
    camera=CAMERA,
    simulate=simulate_push,
)
