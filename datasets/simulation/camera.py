"""Ray-casting camera: reproducible images without a graphics library."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

Image = NDArray[np.uint8]

_LIGHT = np.array([-0.35, 0.45, 0.82])  # towards the light, world; unit length to three digits
_AMBIENT = 0.35
_LUMA = np.array([0.299, 0.587, 0.114])
_BACKGROUND = 0.05


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Attributes:
        position: m, world.
        forward: unit vector of the optical axis, world. up: unit vector towards the top of the image.
        field_of_view: rad, vertical.
        size: pixels per side. oversampling: rays per side of each pixel.
    """

    position: tuple[float, float, float]
    forward: tuple[float, float, float]
    up: tuple[float, float, float]
    field_of_view: float
    size: int = 32
    oversampling: int = 2

    def rays(self) -> NDArray[np.float64]:
        """(R, 3) unit vectors, world, row by row from the top left; R = (size x oversampling)^2."""
        side = self.size * self.oversampling
        ticks = (np.arange(side) + 0.5) / side * 2 - 1
        forward, up = np.array(self.forward), np.array(self.up)
        right = np.cross(forward, up)
        half = np.tan(self.field_of_view / 2)
        directions = forward + half * (ticks[None, :, None] * right - ticks[:, None, None] * up)
        return (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).reshape(-1, 3)

    def moved(self, shift: ArrayLike, turn: ArrayLike) -> Camera:
        """The camera moved by ``shift`` (3,), m, and turned by the rotation vector ``turn`` (3,), rad, world axes."""
        axis, quaternion, matrix = np.array(turn, float), np.zeros(4), np.zeros(9)
        angle = mujoco.mju_normalize(axis)
        mujoco.mju_axisAngle2Quat(quaternion, axis, angle)
        mujoco.mju_quat2Mat(matrix, quaternion)
        rotation = matrix.reshape(3, 3)
        return replace(
            self,
            position=_triple(np.add(self.position, shift)),
            forward=_triple(rotation @ self.forward),
            up=_triple(rotation @ self.up),
        )


def _triple(vector: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z


class RayCaster:
    """Renders a model with Lambertian shading: colour x (ambient + (1 - ambient) max(0, normal . light))."""

    def __init__(self, model: mujoco.MjModel, camera: Camera) -> None:
        self._model, self._camera = model, camera
        self._rays = camera.rays().ravel()
        count = len(self._rays) // 3
        self._hit = np.zeros(count, np.int32)
        self._distance = np.zeros(count)
        self._normal = np.zeros(3 * count)
        # Brightness of each geom and, at index -1, of the background.
        self._brightness = np.append(model.geom_rgba[:, :3] @ _LUMA, _BACKGROUND)

    def render(self, data: mujoco.MjData) -> Image:
        """(size, size) uint8 image of the current geometry. Call ``mj_kinematics`` first."""
        origin = np.array(self._camera.position)
        mujoco.mj_multiRay(
            self._model,
            data,
            origin,
            self._rays,
            None,
            True,
            -1,
            self._hit,
            self._distance,
            self._normal,
            len(self._hit),
            100.0,
        )
        lambert = np.maximum(0.0, self._normal.reshape(-1, 3) @ _LIGHT)
        shade = np.where(self._hit < 0, 1.0, _AMBIENT + (1 - _AMBIENT) * lambert)
        light = self._brightness[self._hit] * shade
        size, fine = self._camera.size, self._camera.oversampling
        averaged = light.reshape(size, fine, size, fine).mean(axis=(1, 3))
        return np.rint(255 * np.clip(averaged, 0, 1)).astype(np.uint8)
