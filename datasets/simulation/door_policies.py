"""Policies that pull and push a door. They know the state, but the hand position alone must not reveal it.

Hence grasp radii are random, retreats vary widely around the average door, and targets are noisy.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from beliefscope.datasets.simulation.door_physics import HINGE_CENTRE, MAX_ANGLE, DoorPhysics
from beliefscope.datasets.simulation.simulate import Policy, Waypoint, random_speed, random_wait

Vector = NDArray[np.float64]

YAW_RATIO = 0.45  # rotation of the hand per rotation of the door


@dataclass(frozen=True)
class AimError:
    """Error of the door that a policy assumes. hinge: m. angle: rad."""

    hinge: tuple[float, float] = (0.0, 0.0)
    angle: float = 0.0


class _DoorPolicy(Policy):
    """Common parts. The hand rotates with the door so that the fingertips touch the panel first."""

    def __init__(self, door: DoorPhysics, rng: Generator, angles: tuple[float, float], aim: AimError) -> None:
        """aim: of all waypoints but the start."""
        self._door, self._rng, self._aim = door, rng, aim
        self._start_angle = float(rng.uniform(*angles))
        self.object_start = np.array([self._start_angle])

    def next(self, joints: Vector) -> Waypoint:
        (x, y), (dx, dy) = self._door.hinge, self._aim.hinge
        return self._next(replace(self._door, hinge=(x + dx, y + dy)), float(joints[0]) + self._aim.angle)

    @abstractmethod
    def _next(self, door: DoorPhysics, angle: float) -> Waypoint:
        """The next waypoint, for the door and angle that the policy assumes."""

    def yaw(self, joints: Vector) -> float:
        return YAW_RATIO * float(joints[0])


class PullDoor(_DoorPolicy):
    """Holds the bar and moves along its arc to random angles, with a noise of a few centimetres."""

    fingers = 0.016
    squeeze = True

    def __init__(self, door: DoorPhysics, rng: Generator, aim: AimError = AimError()) -> None:
        super().__init__(door, rng, (0.0, 1.3), aim)
        self._radius = float(rng.uniform(0.25, door.width - 0.08))
        self._goal = self._start_angle

    def start(self) -> Vector:
        return self._on_bar(self._door, self._start_angle)

    def _next(self, door: DoorPhysics, angle: float) -> Waypoint:
        rng = self._rng
        if abs(self._goal - angle) < 0.12 or rng.random() < 0.15:
            self._goal = float(rng.uniform(-0.1, MAX_ANGLE + 0.05))
        angle_next = angle + float(np.clip(self._goal - angle, -0.35, 0.35))
        noise = rng.normal(0.0, 0.03, 3)
        return Waypoint(self._on_bar(door, angle_next) + noise, random_speed(rng), random_wait(rng))

    def _on_bar(self, door: DoorPhysics, angle: float) -> Vector:
        """(3,) m: grasp position on the bar, with clearance to the fingertips."""
        return door.bar_point(angle, self._radius) + 0.006 * _inward(angle)


class PushDoor(_DoorPolicy):
    """Repeatedly pushes the bar with closed fingers and retreats. A spring opens the door."""

    fingers = 0.0
    squeeze = False

    def __init__(self, door: DoorPhysics, rng: Generator, aim: AimError = AimError()) -> None:
        super().__init__(door, rng, (0.15, 1.45), aim)
        self._average = DoorPhysics(HINGE_CENTRE, door.bar_height)
        self._radius = 0.0
        self._queue: list[str] = []

    def start(self) -> Vector:
        return self._retreat(self._door, self._start_angle)

    def _next(self, door: DoorPhysics, angle: float) -> Waypoint:
        rng = self._rng
        if not self._queue:
            self._queue = ["touch", *["push"] * int(rng.integers(1, 3)), *["retreat"] * int(rng.integers(2, 5))]
        move = self._queue.pop(0)
        if move == "retreat":
            return Waypoint(self._retreat(door, angle), max(0.12, random_speed(rng)), 2 * random_wait(rng))
        if move == "touch":
            self._radius = float(rng.uniform(0.23, door.width - 0.07))
            target = door.bar_point(angle, self._radius) - 0.03 * _inward(angle)
            target[2] += rng.normal(0.0, 0.006)
            return Waypoint(target, max(0.08, random_speed(rng)), 0)
        slip = rng.normal(0.0, 0.02, 3) * (1, 1, 0.5)
        depth = float(rng.uniform(0.02, 0.16))
        target = door.bar_point(angle, self._radius) + depth * _inward(angle) + slip
        return Waypoint(target, max(0.05, random_speed(rng)), random_wait(rng) // 2)

    def _retreat(self, door: DoorPhysics, angle: float) -> Vector:
        """(3,) m: random position in front of both the average door and this door at this angle."""
        rng = self._rng
        inward = _inward(angle)
        along = np.array([-inward[1], inward[0], 0.0])
        away = self._average.bar_point(angle, float(rng.uniform(0.23, 0.43)))
        away += -rng.uniform(0.06, 0.24) * inward + rng.uniform(-0.12, 0.12) * along
        away[2] += rng.uniform(-0.1, 0.12)
        clearance = float((door.bar_point(angle, 0.3) - away) @ inward)
        return away - max(0.0, 0.04 - clearance) * inward


POLICIES: dict[str, type[PullDoor] | type[PushDoor]] = {"pull": PullDoor, "push": PushDoor}


def _inward(angle: float) -> Vector:
    """Unit normal of the panel, away from the robot."""
    return np.array([np.cos(angle), np.sin(angle), 0.0])
