"""Heuristics that move the hand. They know the door, as a person in front of it does, but must not give it away.

Were the grasp always at the same radius, or the retreats always as far from the door, then the hand's position alone
would tell the hinge. Hence the random radii, the wide retreats around where a door stands on average, and the noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from beliefscope.datasets.door import HINGE_CENTRE, MAX_ANGLE, DoorPhysics

Vector = NDArray[np.float64]

YAW_SHARE = 0.45  # of the door's angle that the hand turns along with it


@dataclass(frozen=True)
class Waypoint:
    """Where to send the hand (m, world), how fast the set point goes (m/s), and steps to wait there."""

    position: Vector
    speed: float
    wait: int


class Policy(Protocol):
    """``start_angle`` rad, ``start`` (3,) m, ``fingers`` m of opening each, then a waypoint whenever one is reached."""

    start_angle: float
    fingers: float

    def start(self) -> Vector: ...

    def next(self, angle: float, position: Vector) -> Waypoint: ...


class Pull:
    """Holds the bar and moves along its arc to random angles, off the arc by a few centimetres."""

    fingers = 0.0

    def __init__(self, door: DoorPhysics, rng: Generator) -> None:
        self._door, self._rng = door, rng
        self.start_angle = float(rng.uniform(0.0, 1.3))
        self.radius = float(rng.uniform(0.25, 0.42))
        self._goal = self.start_angle

    def start(self) -> Vector:
        return self._door.bar_point(self.start_angle, self.radius)

    def next(self, angle: float, position: Vector) -> Waypoint:
        rng = self._rng
        if abs(self._goal - angle) < 0.12 or rng.random() < 0.15:
            self._goal = float(rng.uniform(-0.1, MAX_ANGLE + 0.05))
        angle_next = angle + float(np.clip(self._goal - angle, -0.35, 0.35))
        noise = rng.normal(0.0, (0.03, 0.03, 0.03))
        return Waypoint(self._door.bar_point(angle_next, self.radius) + noise, _speed(rng), _wait(rng))


class Push:
    """Pushes the bar with closed fingertips, draws back to some place, and comes again. A spring opens the door."""

    fingers = 0.0

    def __init__(self, door: DoorPhysics, rng: Generator) -> None:
        self._door, self._rng = door, rng
        self._average = DoorPhysics(HINGE_CENTRE, door.bar_height)
        self.start_angle = float(rng.uniform(0.15, 1.45))
        self._queue: list[str] = []

    def start(self) -> Vector:
        return self._retreat(self.start_angle)

    def next(self, angle: float, position: Vector) -> Waypoint:
        rng = self._rng
        if not self._queue:
            self._queue = ["touch", *["push"] * int(rng.integers(1, 3)), *["retreat"] * int(rng.integers(2, 5))]
        move = self._queue.pop(0)
        if move == "retreat":
            return Waypoint(self._retreat(angle), max(0.12, _speed(rng)), _wait(rng))
        if move == "touch":
            self._radius = float(rng.uniform(0.23, 0.43))
            target = self._door.bar_point(angle, self._radius) - 0.03 * _inward(angle)
            target[2] += rng.normal(0.0, 0.006)
            return Waypoint(target, max(0.08, _speed(rng)), 0)
        slip = rng.normal(0.0, 0.02, 3) * (1, 1, 0.5)
        depth = float(rng.uniform(0.02, 0.16))
        target = self._door.bar_point(angle, self._radius) + depth * _inward(angle) + slip
        return Waypoint(target, _speed(rng), _wait(rng))

    def _retreat(self, angle: float) -> Vector:
        """A place before an average door at this angle, but never through this door."""
        rng = self._rng
        inward = _inward(angle)
        along = np.array([-inward[1], inward[0], 0.0])
        away = self._average.bar_point(angle, float(rng.uniform(0.23, 0.43)))
        away += -rng.uniform(0.06, 0.24) * inward + rng.uniform(-0.12, 0.12) * along
        away[2] += rng.uniform(-0.1, 0.12)
        clearance = float((self._door.bar_point(angle, 0.3) - away) @ inward)
        return away - max(0.0, 0.04 - clearance) * inward


def _inward(angle: float) -> Vector:
    """Unit normal of the panel, away from the robot."""
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def _speed(rng: Generator) -> float:
    return float(0.03 * np.exp(rng.uniform(0.0, np.log(25 / 3))))


def _wait(rng: Generator) -> int:
    return int(rng.integers(0, 6))
