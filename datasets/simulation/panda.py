"""Model of a Franka Panda with hand, built from published frames, limits and inertias.

Link frames follow Craig's modified Denavit-Hartenberg convention: frame i is reached from frame i-1 by
``RotX(alpha) TransX(a) RotZ(q) TransZ(d)``. Shapes are primitives, used for collision and rendering.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

ARM_JOINTS = tuple(f"joint{i}" for i in range(1, 8))
FINGERS = ("finger_left", "finger_right")
GRIPPER_OPEN = 0.04  # m, travel of each finger
GRIP_FORCE = 70.0  # N on each finger
SLEEVE_LENGTH = 0.25  # m
GRIP_OFFSET = 0.1034  # m, from the hand's frame to the point between the fingertips

# Stiff contacts: with default parameters the light fingers would sink centimetres into a grasped object.
STIFF = {"solref": (0.008, 1.0), "solimp": (0.95, 0.99, 0.001, 0.5, 2.0)}

# Bits of contype/conaffinity: the robot collides with its environment but not with itself.
ROBOT_BIT, WORLD_BIT = 1, 2

# a (m), d (m), alpha (rad) of each joint frame: Franka Control Interface documentation.
_FRAMES = (
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -np.pi / 2),
    (0.0, 0.316, np.pi / 2),
    (0.0825, 0.0, np.pi / 2),
    (-0.0825, 0.384, -np.pi / 2),
    (0.0, 0.0, np.pi / 2),
    (0.088, 0.0, np.pi / 2),
)
_FLANGE = 0.107
_LIMITS = (
    (-2.8973, 2.8973),
    (-1.7628, 1.7628),
    (-2.8973, 2.8973),
    (-3.0718, -0.0698),
    (-2.8973, 2.8973),
    (-0.0175, 3.7525),
    (-2.8973, 2.8973),
)
_EFFORT = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)  # N m

# mass (kg), centre of mass (m), inertia about it (xx, yy, zz, xy, xz, yz; kg m^2), in the link's frame:
# Gaz et al., "Dynamic Identification of the Franka Emika Panda Robot", RA-L 2019. Link 1 rotates about the vertical, so
# the height of its centre cannot be identified and has no effect.
_INERTIAS = (
    (4.970684, (3.875e-3, 2.081e-3, -1.75e-1), (0.70337, 0.70661, 9.117e-3, -1.39e-4, 6.772e-3, 1.9169e-2)),
    (0.646926, (-3.141e-3, -2.872e-2, 3.495e-3), (7.962e-3, 2.811e-2, 2.5995e-2, -3.925e-3, 1.0254e-2, 7.04e-4)),
    (
        3.228604,
        (2.7518e-2, 3.9252e-2, -6.6502e-2),
        (3.7242e-2, 3.6155e-2, 1.083e-2, -4.761e-3, -1.1396e-2, -1.2805e-2),
    ),
    (
        3.587895,
        (-5.317e-2, 1.04419e-1, 2.7454e-2),
        (2.5853e-2, 1.9552e-2, 2.8323e-2, 7.796e-3, -1.332e-3, 8.641e-3),
    ),
    (
        1.225946,
        (-1.1953e-2, 4.1065e-2, -3.8437e-2),
        (3.5549e-2, 2.9474e-2, 8.627e-3, -2.117e-3, -4.037e-3, 2.29e-4),
    ),
    (1.666555, (6.0149e-2, -1.4117e-2, -1.0517e-2), (1.964e-3, 4.354e-3, 5.433e-3, 1.09e-4, -1.158e-3, 3.41e-4)),
    (0.735522, (1.0517e-2, -4.252e-3, 6.1597e-2), (1.2516e-2, 1.0027e-2, 4.815e-3, -4.28e-4, -1.196e-3, -7.41e-4)),
)

# Capsules of each link (from, to, radius), m, in the link's frame; the first entry is the fixed base.
_CAPSULES: tuple[tuple[tuple[tuple[float, ...], tuple[float, ...], float], ...], ...] = (
    (((-0.06, 0, 0.06), (0, 0, 0.08), 0.075),),
    (((0, 0, -0.19), (0, 0, -0.05), 0.062),),
    (((0, 0, -0.07), (0, 0, 0.07), 0.062), ((0, -0.05, 0), (0, -0.13, 0), 0.058)),
    (((0, 0, -0.12), (0, 0, -0.06), 0.06), ((0.03, 0, -0.02), (0.0825, 0.03, 0), 0.056)),
    (((0, 0, -0.06), (0, 0, 0.06), 0.06), ((-0.0825, 0.05, 0), (-0.0825, 0.11, 0), 0.055)),
    (((0, 0, -0.25), (0, 0, -0.20), 0.055), ((0, 0.05, -0.17), (0, 0.07, -0.04), 0.04)),
    (((0, 0, -0.06), (0, 0, 0.01), 0.05), ((0.05, 0.0, 0), (0.088, 0.01, 0), 0.045)),
    (((0, 0, -0.03), (0, 0, 0.06), 0.045),),
)

_WHITE = (0.93, 0.94, 0.95, 1.0)
_SILVER = (0.72, 0.75, 0.78, 1.0)
_DARK = (0.22, 0.24, 0.27, 1.0)
_PAD = (0.95, 0.55, 0.15, 1.0)
_FABRIC = (0.55, 0.57, 0.6, 1.0)


def new_spec() -> mujoco.MjSpec:
    """Return an empty scene with solver settings for stiff grasps."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = 0.004
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    spec.option.noslip_iterations = 3  # otherwise a grasped bar slips out of the fingers
    return spec


@dataclass(frozen=True)
class Sleeve:
    """A sleeve around the hand that hides what is behind it. Without mass or contact.

    Attributes:
        radius: m. end: m along the hand's axis from its frame; the point between the fingertips is at ``GRIP_OFFSET``.
    """

    radius: float
    end: float


def add_panda(spec: mujoco.MjSpec, sleeve: Sleeve | None = None) -> None:
    """Add the arm with hand, fingers and wrist sensors at the world's origin.

    Bodies ``link0`` .. ``link7``, ``hand``, ``finger_left``, ``finger_right``; joints ``joint1`` .. ``joint7``,
    ``finger_left``, ``finger_right``; sites ``wrist`` (the force/torque sensor) and ``grip`` (between the fingertips);
    sensors ``force`` and ``torque`` at ``wrist``; actuator ``gripper``.
    """
    body = spec.worldbody.add_body(name="link0")
    _add_capsules(body, 0)
    for i, ((a, d, alpha), limit, effort) in enumerate(zip(_FRAMES, _LIMITS, _EFFORT, strict=True)):
        body = body.add_body(
            name=f"link{i + 1}",
            pos=(a, -d * np.sin(alpha), d * np.cos(alpha)),
            quat=(np.cos(alpha / 2), np.sin(alpha / 2), 0, 0),
            gravcomp=1,
        )
        mass, centre, inertia = _INERTIAS[i]
        body.explicitinertial, body.mass, body.ipos, body.fullinertia = True, mass, centre, inertia
        body.add_joint(
            name=ARM_JOINTS[i],
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=(0, 0, 1),
            limited=True,
            range=limit,
            actfrclimited=True,
            actfrcrange=(-effort, effort),
            armature=0.1,
            damping=0.5,
        )
        _add_capsules(body, i + 1)
    _add_hand(spec, body)
    if sleeve is not None:
        spec.body("hand").add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            fromto=(0, 0, sleeve.end - SLEEVE_LENGTH, 0, 0, sleeve.end),
            size=(sleeve.radius, 0, 0),
            rgba=_FABRIC,
            contype=0,
            conaffinity=0,
            mass=0,
        )


def _add_capsules(body: mujoco.MjsBody, link: int) -> None:
    for start, end, radius in _CAPSULES[link]:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=(*start, *end),
            size=(radius, 0, 0),
            rgba=_WHITE if link % 2 else _SILVER,
            contype=ROBOT_BIT,
            conaffinity=WORLD_BIT,
            mass=0,
        )


def _add_hand(spec: mujoco.MjSpec, flange: mujoco.MjsBody) -> None:
    hand = flange.add_body(
        name="hand", pos=(0, 0, _FLANGE), quat=(np.cos(-np.pi / 8), 0, 0, np.sin(-np.pi / 8)), gravcomp=1
    )
    hand.explicitinertial, hand.mass, hand.ipos = True, 0.73, (-0.01, 0, 0.03)
    hand.inertia = (0.001, 0.0025, 0.0017)
    touch = {"contype": ROBOT_BIT, "conaffinity": WORLD_BIT, "mass": 0, "condim": 4, **STIFF}
    box, sphere = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE
    hand.add_geom(
        type=box, pos=(0, 0, 0.033), size=(0.031, 0.1, 0.033), rgba=_WHITE, friction=(0.3, 5e-3, 1e-4), **touch
    )
    hand.add_site(name="wrist")
    hand.add_site(name="grip", pos=(0, 0, GRIP_OFFSET))
    for side, name in zip((1, -1), FINGERS, strict=True):
        finger = hand.add_body(name=name, pos=(0, 0, 0.0584), gravcomp=1)
        finger.explicitinertial, finger.mass, finger.ipos = True, 0.05, (0, side * 0.01, 0.025)
        finger.inertia = (1.2e-5, 1.2e-5, 3e-6)
        finger.add_joint(
            name=name,
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=(0, side, 0),
            limited=True,
            range=(0, GRIPPER_OPEN),
            armature=0.1,
            damping=20,
        )
        finger.add_geom(type=box, pos=(0, side * 0.014, 0.015), size=(0.009, 0.009, 0.015), rgba=_DARK, **touch)
        finger.add_geom(
            type=box,
            pos=(0, side * 0.006, 0.041),
            size=(0.011, 0.006, 0.017),
            rgba=_PAD,
            friction=(1.5, 0.02, 1e-4),
            **touch,
        )
        # Rounded tip: contact points jump when pushing with the corner of a box.
        finger.add_geom(
            type=sphere,
            pos=(0, side * 0.011, 0.05),
            size=(0.011, 0, 0),
            rgba=_PAD,
            friction=(0.6, 5e-3, 1e-4),
            **touch,
        )
    spec.add_equality(
        name="fingers",
        type=mujoco.mjtEq.mjEQ_JOINT,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        name1="finger_right",
        name2="finger_left",
        data=[0.0, 1.0] + [0.0] * 10,
        solref=(0.008, 1.0),
    )
    gripper = spec.add_actuator(name="gripper", trntype=mujoco.mjtTrn.mjTRN_JOINT, target="finger_left")
    gripper.set_to_position(kp=4000)
    gripper.forcelimited, gripper.forcerange = True, (-2 * GRIP_FORCE, 2 * GRIP_FORCE)
    for name, kind in (("force", mujoco.mjtSensor.mjSENS_FORCE), ("torque", mujoco.mjtSensor.mjSENS_TORQUE)):
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="wrist")
