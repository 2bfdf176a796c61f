"""Cartesian impedance controller of the hand with a limited set-point lead and null-space posture control."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.simulation.panda import ARM_JOINTS, FINGERS, GRIPPER_OPEN

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Stance:
    """Reference orientation of the hand and posture of the arm.

    Attributes:
        axes: (3, 3) rows of the reference rotation from hand to world. The hand points along its z axis and its fingers
            close along its y axis.
        posture: (7,) rad: rest posture of the null-space control.
    """

    axes: tuple[tuple[float, float, float], ...]
    posture: tuple[float, ...]


# Elbow to the side, hand pointing along +x at handle height, fingers closing vertically.
FORWARD = Stance(((0, 0, 1), (-1, 0, 0), (0, -1, 0)), (-1.609, -0.615, 1.696, -1.627, 1.782, 3.228, 1.073))
# Elbow up, hand pointing at the ground half a metre in front of the robot, fingers closing along y.
DOWN = Stance(((1, 0, 0), (0, -1, 0), (0, 0, -1)), (0.0, 0.15, 0.0, -2.35, 0.0, 2.5, 0.785))


@dataclass(frozen=True)
class Impedance:
    """Parameters of the impedance controller.

    Attributes:
        stance: reference orientation and posture.
        stiffness: along world x, y, z, N/m. rotational_stiffness: about each axis, N m/rad.
        rotational_damping: N m s/rad. posture_stiffness: N m/rad per joint.
        lead: largest distance of the set point from the hand, m.
    """

    stance: Stance
    stiffness: tuple[float, float, float]
    lead: float
    rotational_stiffness: float = 60.0
    rotational_damping: float = 6.0
    posture_stiffness: float = 6.0


def add_controller(spec: mujoco.MjSpec, impedance: Impedance) -> None:
    """Add six Cartesian actuators at the site ``grip`` and a posture servo on every arm joint.

    The effective mass for a stiffness kp is about 4 kg, hence the damping 1.8 sqrt(4 kp).
    """
    quaternion = np.zeros(4)
    axes = np.array(impedance.stance.axes, float)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    spec.worldbody.add_site(name="reference", quat=quaternion, group=5)
    gains = [(kp, 1.8 * np.sqrt(4 * kp)) for kp in np.abs(axes.T) @ impedance.stiffness]
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
    """Controls the hand of a model: call ``place`` once, then ``command`` in every control step."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, impedance: Impedance) -> None:
        self._model, self._data, self._lead = model, data, impedance.lead
        self._axes, self._rest = np.array(impedance.stance.axes, float), np.array(impedance.stance.posture)
        self._grip = model.site("grip").id
        self._hand = [model.actuator(f"hand{axis}").id for axis in range(6)]
        self._posture = [model.actuator(f"posture_{joint}").id for joint in ARM_JOINTS]
        self._limits = model.jnt_range[: len(ARM_JOINTS)]

    @property
    def position(self) -> Vector:
        """(3,) m, world: the point between the fingertips."""
        return np.array(self._data.site_xpos[self._grip])

    def place(self, position: Vector, yaw: float) -> float:
        """Move the hand to a pose by damped least squares from the rest posture. Returns the residual, m + rad."""
        data, n = self._data, len(ARM_JOINTS)
        data.qpos[:n] = self._rest
        error = np.inf
        for _ in range(200):
            mujoco.mj_kinematics(self._model, data)
            mujoco.mj_comPos(self._model, data)
            turn = np.cross(data.site_xmat[self._grip].reshape(3, 3).T, (_rotation_z(yaw) @ self._axes).T).sum(0) / 2
            twist = np.concatenate([position - self.position, turn])
            error = float(np.linalg.norm(twist[:3]) + np.linalg.norm(turn))
            if error < 1e-5:
                break
            twist *= min(1.0, 0.1 / error)
            jacobian = self._jacobian()
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-4 * np.eye(6), twist)
            null = np.eye(n) - np.linalg.pinv(jacobian) @ jacobian
            step += 0.05 * null @ (self._rest - data.qpos[:n])
            data.qpos[:n] = np.clip(data.qpos[:n] + step, self._limits[:, 0], self._limits[:, 1])
        return error

    def set_fingers(self, opening: float, squeeze: bool) -> None:
        """Open each finger by ``opening`` m, then hold the opening or ``squeeze`` with full force."""
        self._data.qpos[[self._model.joint(name).qposadr[0] for name in FINGERS]] = opening
        self._data.ctrl[self._model.actuator("gripper").id] = -GRIPPER_OPEN if squeeze else opening

    def command(self, target: Vector, yaw: float) -> Vector:
        """Set the target (3,) m, limited to the allowed lead. Returns the active set point."""
        position = self.position
        offset = target - position
        length = float(np.linalg.norm(offset))
        set_point = position + offset * min(1.0, self._lead / max(length, 1e-9))
        self._data.ctrl[self._hand] = [*(self._axes.T @ set_point), *(yaw * self._axes[2])]
        # Without the projection, posture control would pull at the hand with about 10 N.
        jacobian = self._jacobian()
        joints = np.array(self._data.qpos[: len(ARM_JOINTS)])
        null = np.eye(len(ARM_JOINTS)) - np.linalg.pinv(jacobian) @ jacobian
        self._data.ctrl[self._posture] = joints + null @ (self._rest - joints)
        return set_point

    def _jacobian(self) -> Vector:
        jacobian = np.zeros((6, self._model.nv))
        mujoco.mj_jacSite(self._model, self._data, jacobian[:3], jacobian[3:], self._grip)
        return jacobian[:, : len(ARM_JOINTS)]


def _rotation_z(angle: float) -> Vector:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
