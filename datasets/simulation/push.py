"""Push task: estimate the position of a puck that a robot pushes over the ground.

World frame: the robot's base, x forward, y left, z up; m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from beliefscope.datasets.covariate import CONTACT
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.simulation.camera import Camera
from beliefscope.datasets.simulation.controller import DOWN, Impedance, add_controller
from beliefscope.datasets.simulation.outline import Outline
from beliefscope.datasets.simulation.panda import ROBOT_BIT, WORLD_BIT, Sleeve, add_panda, new_spec
from beliefscope.datasets.simulation.panda_visual import add_appearance
from beliefscope.datasets.simulation.sensors import add_touch
from beliefscope.datasets.simulation.simulate import (
    DT,
    POSITION_BITS,
    ROBOT_JOINTS,
    Policy,
    Scene,
    Waypoint,
    first_free_start,
    quantise,
    random_speed,
    random_wait,
    simulate,
)
from beliefscope.datasets.task import Component, Task

Vector = NDArray[np.float64]
Size = tuple[float, float, float]

RADIUS, HEIGHT = 0.05, 0.06  # m
FRICTION = 0.45
CENTRE = np.array([0.55, 0.0])
HALF_RANGE = 0.105  # half side length of the square around CENTRE of start and target positions, m

ROAM = 0.13  # half side length of the square around CENTRE of free hand motion, m
HOVER = (0.095, 0.16)  # height range of free hand motion, m
PUSH_HEIGHTS = (0.035, 0.05)  # height range of pushes, m
MIN_PUSH = 0.08  # m
MAX_SPEED = 0.12  # m/s: the hand lags behind at higher speeds because of the short lead
TIP = 0.011  # from the centre of the closed fingertips to their front, m

ELEVATION = np.deg2rad(35)
_FORWARD = np.array([0.0, np.cos(ELEVATION), -np.sin(ELEVATION)])
CAMERA = Camera(
    position=tuple((0.55, 0.0, 0.03) - 1.15 * _FORWARD),
    forward=tuple(_FORWARD),
    up=(0.0, float(np.sin(ELEVATION)), float(np.cos(ELEVATION))),
    field_of_view=float(np.deg2rad(24)),
)
IMPEDANCE = Impedance(DOWN, (700, 700, 900), lead=0.03)


@dataclass(frozen=True)
class PuckPhysics:
    """Parameters of the puck: radius, m; mass, kg; friction coefficient on the ground."""

    radius: float = RADIUS
    mass: float = 0.6
    friction: float = FRICTION

    @property
    def geom(self) -> tuple[mujoco.mjtGeom, Size]:
        """Type and size of its geom."""
        return mujoco.mjtGeom.mjGEOM_CYLINDER, (self.radius, HEIGHT / 2, 0.0)


@dataclass(frozen=True)
class BlockPhysics:
    """Parameters of a rectangular block in place of the puck: length and width, m; mass, kg; friction coefficient."""

    length: float = 0.12
    width: float = 0.075
    mass: float = 0.6
    friction: float = FRICTION

    @property
    def radius(self) -> float:
        """Half the diagonal, m."""
        return math.hypot(self.length, self.width) / 2

    @property
    def geom(self) -> tuple[mujoco.mjtGeom, Size]:
        """Type and size of its geom."""
        return mujoco.mjtGeom.mjGEOM_BOX, (self.length / 2, self.width / 2, HEIGHT / 2)


class PushPuck(Policy):
    """Repeatedly descends behind the puck, pushes it to a random target, retracts and rises.

    Random motion between pushes makes sure that the position of a free hand reveals little about the puck.
    """

    fingers = 0.0
    squeeze = False
    clearance = (0.01, 0.03)  # range of the distance between fingers and puck before a push, m

    def __init__(self, rng: Generator, puck: PuckPhysics | BlockPhysics = PuckPhysics()) -> None:
        self._rng, self._radius = rng, puck.radius
        start = quantise(self._around(HALF_RANGE), POSITION_BITS)
        self.object_start = np.array([*start, HEIGHT / 2, 1.0, 0.0, 0.0, 0.0])
        self._queue: list[str] = []
        # Current push: unit vector, length (m), start position and height.
        self._direction, self._length, self._behind, self._height = np.zeros(2), 0.0, np.zeros(2), 0.0
        self._last = np.zeros(2)

    def yaw(self, joints: Vector) -> float:
        return 0.0

    def start(self) -> Vector:
        return self._above(self._around(ROAM))

    def next(self, joints: Vector) -> Waypoint:
        rng, puck = self._rng, joints[:2]
        if not self._queue:
            self._queue = ["approach", "descend", "push", "retract", "rise", *["roam"] * int(rng.integers(0, 2))]
        match self._queue.pop(0):
            case "approach":
                self._choose(puck)
                offset = rng.normal(0.0, 0.02) * _left(self._direction) - rng.uniform(0.0, 0.04) * self._direction
                return Waypoint(self._above(self._behind + offset), self._speed(0.08), 2)
            case "descend":
                return Waypoint(self._at(self._behind), self._speed(0.08), 2)
            case "push":
                gap = float((puck - self._behind) @ self._direction) - self._radius - TIP
                self._height += rng.normal(0.0, 0.006)
                return Waypoint(self._at(self._behind + (gap + self._length) * self._direction), self._speed(0.05), 0)
            case "retract":
                return Waypoint(self._at(self._last - rng.uniform(0.02, 0.05) * self._direction), self._speed(0.08), 0)
            case "rise":
                return Waypoint(self._above(self._last), self._speed(0.08), 0)
            case _:
                return Waypoint(self._above(self._around(ROAM)), self._speed(0.08), random_wait(rng))

    def _choose(self, puck: Vector) -> None:
        """Choose a target of the puck and a start position, slightly to the side behind the puck."""
        rng = self._rng
        while (length := float(np.linalg.norm(direction := self._around(HALF_RANGE) - puck))) < MIN_PUSH:
            pass
        self._direction, self._length = direction / length, length
        self._behind = puck - (self._radius + TIP + rng.uniform(*self.clearance)) * self._direction
        self._behind += rng.normal(0.0, 0.012) * _left(self._direction)
        self._height = float(rng.uniform(*PUSH_HEIGHTS))

    def _around(self, half_range: float) -> Vector:
        return CENTRE + self._rng.uniform(-half_range, half_range, 2)

    def _above(self, point: Vector) -> Vector:
        self._last = point
        return np.array([*point, self._rng.uniform(*HOVER)])

    def _at(self, point: Vector) -> Vector:
        self._last = point
        return np.array([*point, self._height])

    def _speed(self, minimum: float) -> float:
        return min(MAX_SPEED, max(minimum, random_speed(self._rng)))


def _left(direction: Vector) -> Vector:
    return np.array([-direction[1], direction[0]])


def puck_outline(states: ArrayLike) -> Outline:
    """Outline of the puck for states (..., 2) = (x, y)."""
    states = np.asarray(states, float)
    height = np.full_like(states[..., :1], HEIGHT / 2)
    return Outline(
        position=np.concatenate([states, height], -1),
        wxyz=np.broadcast_to([1.0, 0.0, 0.0, 0.0], (*states.shape[:-1], 4)),
        size=(2 * RADIUS, 2 * RADIUS, HEIGHT),
        anchor=np.concatenate([states, 2 * height], -1),
        shape="cylinder",
    )


def push_model(
    visual: bool = False,
    puck: PuckPhysics | BlockPhysics = PuckPhysics(),
    sleeve: Sleeve | None = None,
) -> mujoco.MjModel:
    """Model of robot, puck and ground. The puck's free joint is last in qpos.

    Args:
        visual: draw the robot as in replays.
    """
    spec = new_spec()
    add_panda(spec, sleeve)
    add_controller(spec, IMPEDANCE)
    world = spec.worldbody
    world.add_light(pos=(0, 0, 3.5), dir=(0, 0, -1), type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    world.add_geom(
        name="ground",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(3, 3, 0.1),
        rgba=(0.32, 0.35, 0.38, 1),
        friction=(puck.friction, 5e-3, 1e-4),
        contype=WORLD_BIT,
        conaffinity=ROBOT_BIT,
    )
    body = world.add_body(name="puck", pos=(*CENTRE, HEIGHT / 2))
    body.add_freejoint(name="puck")
    kind, size = puck.geom
    body.add_geom(
        name="puck",
        type=kind,
        size=size,
        rgba=(0.9, 0.75, 0.3, 1),
        mass=puck.mass,
        friction=(puck.friction, 5e-3, 1e-4),
        condim=4,
        contype=WORLD_BIT,
        conaffinity=ROBOT_BIT | WORLD_BIT,  # supported by the ground
    )
    add_touch(spec, "puck")
    if visual:
        add_appearance(spec)
    return spec.compile()


def simulate_push(seed: int, index: int, steps: int) -> Episode:
    """Simulate episode ``index`` of the collection with ``seed``: ``steps`` steps of 0.1 s. Deterministic."""
    return first_free_start(lambda rng: _simulate(rng, seed, index, steps), seed, index)


def _simulate(rng: Generator, seed: int, index: int, steps: int) -> Episode:
    return simulate(
        PUSH,
        Scene(push_model(), IMPEDANCE, CAMERA),
        PushPuck(rng),
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
    covariates={"contact": CONTACT},
    positions={"effector_position": (0, 1), "control": (0, 1)},
    replay=lambda _: push_model(visual=True),
    outline=puck_outline,
    camera=CAMERA,
    simulate=simulate_push,
)
