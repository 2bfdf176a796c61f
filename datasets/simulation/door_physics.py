"""Physical parameters of a door, shared by the simulation and the policies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

HINGE_CENTRE = (0.81, -0.28)  # m, world
HINGE_HALF_RANGE = 0.098  # m; uniform distribution with a standard deviation of 5.7 cm
BAR_OFFSET = 0.085  # m, from the middle of the panel towards the robot
PANEL_WIDTH = 0.5  # m
MAX_ANGLE = 1.55  # rad


@dataclass(frozen=True)
class DoorPhysics:
    """Parameters that differ between doors.

    Attributes:
        hinge: (2,) m, world. bar_height: height of the handle's bar, m. spring: opening spring, N m/rad; 0: none.
        width: of the panel, m. bar_offset: distance of the bar from the middle of the panel, m.
        damping: N m s/rad. friction: N m.
    """

    hinge: tuple[float, float]
    bar_height: float
    spring: float = 0.0
    width: float = PANEL_WIDTH
    bar_offset: float = BAR_OFFSET
    damping: float = 8.0
    friction: float = 1.5

    def bar_point(self, angle: float, radius: float) -> NDArray[np.float64]:
        """(3,) m: point of the bar at ``radius`` m from the hinge, for a door at ``angle`` rad.

        ``hinge + R(angle) (-bar_offset, radius)``, with R the rotation about z.
        """
        c, s = np.cos(angle), np.sin(angle)
        x, y = self.hinge
        offset = self.bar_offset
        return np.array([x - offset * c - radius * s, y - offset * s + radius * c, self.bar_height])
