"""The measured contact force as an arrow of a 3D scene, with a ring every few newtons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beliefscope.inspect.figures.scene_shapes import Array
from beliefscope.inspect.maps.plane import round_up
from beliefscope.inspect.trace import Trace

RING_DISTANCE = 0.05  # m between the rings
MAX_RINGS = 6
RING_RADIUS = 0.014  # m


@dataclass(frozen=True)
class ForceDrawing:
    """The force of one step, in m.

    arrow: (2, 3) tail and head. rings: positions (R, 3), orientations (R, 4) and scales (R, 3) of discs; absent rings
    have scale 0. text: force and spacing of the rings, shown at ``label`` (3,).
    """

    arrow: Array
    head_length: float
    rings: tuple[Array, Array, Array]
    text: str
    label: Array


class DrawnForce:
    """The forces of a trace as arrows.

    The head is at the end effector, so that the arm, which the force points at, does not hide it. If it came through
    the floor in that way, its tail is there.
    """

    def __init__(self, trace: Trace) -> None:
        episode = trace.episode
        self._contact = episode.contact.astype(bool)
        self._positions, self._forces = episode.observations["effector_position"], episode.observations["force"]
        positions, forces = self._positions[self._contact], self._forces[self._contact]
        newtons = np.linalg.norm(forces, axis=-1)
        self._spacing = ring_spacing(float(newtons[np.isfinite(newtons)].max(initial=0.0)))
        starts = positions[:, 2] - RING_DISTANCE / self._spacing * forces[:, 2]
        self._ahead = bool((starts < np.minimum(0.0, positions[:, 2])).any())

    def at(self, step: int) -> ForceDrawing | None:
        """The arrow of a step; None if it is not in contact."""
        if not self._contact[step]:
            return None
        hand, force = np.asarray(self._positions[step], float), np.asarray(self._forces[step], float)
        newtons = float(np.linalg.norm(force))
        direction = force / max(newtons, 1e-9)
        length = RING_DISTANCE * newtons / self._spacing
        start = hand if self._ahead else hand - length * direction
        end = start + length * direction
        along = RING_DISTANCE * np.arange(1, MAX_RINGS + 1)
        rings = (
            start + along[:, None] * direction,
            np.tile(_turned(direction), (MAX_RINGS, 1)),
            np.where(along <= length, RING_RADIUS, 0.0)[:, None] * np.ones(3),
        )
        text = f"{newtons:.{newtons < 9.95:d}f} N, rings {self._spacing:g} N"
        arrow = np.stack([start, end])
        return ForceDrawing(arrow, min(0.03, 0.6 * length), rings, text, end if self._ahead else start)


def ring_spacing(largest: float) -> float:
    """The smallest 1, 2 or 5 times a power of ten, N, for which the largest force has at most ``MAX_RINGS`` rings."""
    return round_up(largest / MAX_RINGS) if largest > 0.0 else 1.0


def _turned(direction: Array) -> Array:
    """Quaternion (4,), w first, of the shortest rotation from z to a unit vector (3,)."""
    x, y, z = direction
    wxyz = np.array([1.0 + z, -y, x, 0.0]) if z > -1.0 + 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])
    return wxyz / np.linalg.norm(wxyz)
