"""Haptic sensors: force and torque at the wrist, and contact."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


def add_touch(spec: mujoco.MjSpec, body: str) -> None:
    """Add the sensor ``contact`` between the hand (with fingers) and a body."""
    touch = spec.add_sensor(
        name="contact",
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=mujoco.mjtObj.mjOBJ_XBODY,
        objname="hand",
        reftype=mujoco.mjtObj.mjOBJ_XBODY,
        refname=body,
    )
    count, force = int(mujoco.mjtConDataField.mjCONDATA_FOUND), int(mujoco.mjtConDataField.mjCONDATA_FORCE)
    touch.intprm = [1 << count | 1 << force, 3, 1]  # fields; reduce to the net force; one slot


class HandSensors:
    """Reads the sensors ``force``, ``torque`` (site ``wrist``) and ``contact`` of a model."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._data = data
        self._hand, self._wrist = model.body("hand").id, model.site("wrist").id
        self._weight = float(model.body_subtreemass[self._hand]) * np.array(model.opt.gravity)
        starts = {name: int(model.sensor(name).adr[0]) for name in ("force", "torque", "contact")}
        self._force, self._torque = (slice(starts[name], starts[name] + 3) for name in ("force", "torque"))
        self._contact = starts["contact"]

    def wrench(self) -> Vector:
        """(6,) N and N m, world axes: wrench of the environment on the hand, about the wrist.

        The raw sensor measures the wrench of link 7 on the hand, including the hand's weight even with gravity
        compensation. Without the weight, the wrench of the environment is its negative.
        """
        data = self._data
        axes = data.site_xmat[self._wrist].reshape(3, 3)
        lever = data.subtree_com[self._hand] - data.site_xpos[self._wrist]
        tilt = np.empty(3)
        mujoco.mju_cross(tilt, lever, self._weight)
        force = axes @ data.sensordata[self._force] + self._weight
        torque = axes @ data.sensordata[self._torque] + tilt
        return -np.concatenate([force, torque])

    def touching(self) -> bool:
        """Whether the hand or its fingers touch the object."""
        return bool(self._data.sensordata[self._contact] > 0)
