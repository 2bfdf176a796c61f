"""The hand's controller: a Cartesian impedance whose set point leads the hand, and a posture held in the null space."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.robot import ARM_JOINTS, FINGERS, GRIPPER_OPEN

Vector = NDArray[np.float64]

# The reference frame of the impedance: the hand's axes (x, y, z) lie along the world's (-y, -z, x), so that it points
# along +x and its fingers close vertically. Rotations are measured from it.
_REFERENCE = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])

# Elbow to the side, hand pointing along +x at the height of the handle: the posture the null space returns to.
POSTURE = np.array([-1.609, -0.615, 1.696, -1.627, 1.782, 3.228, 1.073])


@dataclass(frozen=True)
class Impedance:
    """Stiffness along world x, y, z (N/m) and about each axis (N m/rad), and how far the set point may lead (m)."""

    stiffness: tuple[float, float, float]
    rotational_stiffness: float = 60.0
    rotational_damping: float = 6.0
    posture_stiffness: float = 6.0
    lead: float = 0.05


def add_controller(spec: mujoco.MjSpec, impedance: Impedance) -> None:
    """Add six Cartesian actuators at the site ``grip`` and a posture servo on every arm joint.

    The effective mass that a stiffness kp acts on is about 4 kg, hence the damping 1.8 sqrt(4 kp).
    """
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, _REFERENCE.ravel())
    spec.worldbody.add_site(name="reference", quat=quaternion, group=5)
    kx, ky, kz = impedance.stiffness
    gains = [(kp, 1.8 * np.sqrt(4 * kp)) for kp in (ky, kz, kx)]
    gains += [(impedance.rotational_stiffness, impedance.rotational_damping)] * 3
    for axis, (kp, kv) in enumerate(gains):
        actuator = spec.add_actuator(
            name=f"hand{axis}",
            trntype=mujoco.mjtTrn.mjTRN_SITE,
            target="grip",
            refsite="reference",
            gear=np.eye(6)[axis],
        )
        actuator.set_to_position(kp=kp, kv=kv)
    for joint in ARM_JOINTS:
        actuator = spec.add_actuator(name=f"posture_{joint}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint)
        actuator.set_to_position(kp=impedance.posture_stiffness, kv=2.0)


class HandController:
    """Moves the hand of one model: ``place`` it, then ``command`` a set point every control step."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, impedance: Impedance) -> None:
        self._model, self._data, self._lead = model, data, impedance.lead
        self._grip = model.site("grip").id
        self._hand = [model.actuator(f"hand{axis}").id for axis in range(6)]
        self._posture = [model.actuator(f"posture_{joint}").id for joint in ARM_JOINTS]
        self._limits = model.jnt_range[: len(ARM_JOINTS)]

    @property
    def position(self) -> Vector:
        """(3,) m, world: the point between the fingertips."""
        return np.array(self._data.site_xpos[self._grip])

    def place(self, position: Vector, yaw: float) -> float:
        """Put the hand at a pose by damped least squares from the rest posture; returns the error left, m + rad."""
        data, n = self._data, len(ARM_JOINTS)
        data.qpos[:n] = POSTURE
        error = np.inf
        for _ in range(200):
            mujoco.mj_kinematics(self._model, data)
            mujoco.mj_comPos(self._model, data)
            turn = np.cross(data.site_xmat[self._grip].reshape(3, 3).T, (_rotation_z(yaw) @ _REFERENCE).T).sum(0) / 2
            twist = np.concatenate([position - self.position, turn])
            error = float(np.linalg.norm(twist[:3]) + np.linalg.norm(turn))
            if error < 1e-5:
                break
            twist *= min(1.0, 0.1 / error)
            jacobian = self._jacobian()
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-4 * np.eye(6), twist)
            null = np.eye(n) - np.linalg.pinv(jacobian) @ jacobian
            step += 0.05 * null @ (POSTURE - data.qpos[:n])
            data.qpos[:n] = np.clip(data.qpos[:n] + step, self._limits[:, 0], self._limits[:, 1])
        return error

    def set_fingers(self, opening: float, squeeze: bool) -> None:
        """Open each finger by ``opening`` m, then hold it there or, to ``squeeze``, close with the full force."""
        self._data.qpos[[self._model.joint(name).qposadr[0] for name in FINGERS]] = opening
        self._data.ctrl[self._model.actuator("gripper").id] = -GRIPPER_OPEN if squeeze else opening

    def command(self, target: Vector, yaw: float) -> Vector:
        """Aim at ``target`` (3,) m, cut to the allowed lead; returns the set point in force."""
        position = self.position
        offset = target - position
        length = float(np.linalg.norm(offset))
        set_point = position + offset * min(1.0, self._lead / max(length, 1e-9))
        self._data.ctrl[self._hand] = [*(_REFERENCE.T @ set_point), 0.0, -yaw, 0.0]
        # Without the projection the posture would pull at the hand with about 10 N.
        jacobian = self._jacobian()
        joints = np.array(self._data.qpos[: len(ARM_JOINTS)])
        null = np.eye(len(ARM_JOINTS)) - np.linalg.pinv(jacobian) @ jacobian
        self._data.ctrl[self._posture] = joints + null @ (POSTURE - joints)
        return set_point

    def _jacobian(self) -> Vector:
        jacobian = np.zeros((6, self._model.nv))
        mujoco.mj_jacSite(self._model, self._data, jacobian[:3], jacobian[3:], self._grip)
        return jacobian[:, : len(ARM_JOINTS)]


def _rotation_z(angle: float) -> Vector:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
