"""One simulated trajectory of the door task: the policy decides, the controller acts, the sensors and camera record."""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

import beliefscope
from beliefscope.datasets.camera import Picture, RayCaster
from beliefscope.datasets.control import HandController
from beliefscope.datasets.door import (
    BAR_HEIGHTS,
    CAMERA,
    DT,
    HINGE_CENTRE,
    HINGE_HALF_RANGE,
    IMPEDANCE,
    DoorPhysics,
    door_model,
)
from beliefscope.datasets.episode import Episode, FloatArray
from beliefscope.datasets.policies import YAW_SHARE, Policy, Pull, Push, Waypoint
from beliefscope.datasets.sensors import HandSensors

Vector = NDArray[np.float64]

SPRING = 1.6  # N m/rad, opens the door for the next push
SETTLING_STEPS = 5  # before the record begins, so that the grasp has closed

# The sensors' resolution, in powers of two so that the values compress: 15 um, 1 mN, 61 uN m, 15 urad.
POSITION_BITS, FORCE_BITS, TORQUE_BITS, ANGLE_BITS = 16, 10, 14, 16


def simulate_door(seed: int, index: int, steps: int) -> Episode:
    """Trajectory ``index`` of the collection with ``seed``: ``steps`` steps of 0.1 s, the same on every call."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))
    hinge = quantise(HINGE_CENTRE + rng.uniform(-HINGE_HALF_RANGE, HINGE_HALF_RANGE, 2), POSITION_BITS)
    name = policy_of(index)
    spring = 0.0 if name == "pull" else SPRING
    door = DoorPhysics((float(hinge[0]), float(hinge[1])), float(rng.uniform(*BAR_HEIGHTS)), spring)
    policy: Policy = Pull(door, rng) if name == "pull" else Push(door, rng)
    log = _run(door, policy, steps)

    effector = quantise(np.stack(log.effector), POSITION_BITS)
    wrench, contact = np.stack(log.wrench), np.array(log.contact)
    qpos = quantise(np.stack(log.qpos), ANGLE_BITS)
    touch = contact[:, None].astype(np.float32)
    return Episode(
        task="door",
        states=np.concatenate([np.broadcast_to(hinge, (steps, 2)), qpos[:, -1:]], axis=1),
        controls=hand_controls(effector, touch),
        observations={
            "image": np.stack(log.image),
            "effector_position": effector,
            "force": quantise(wrench[:, :3], FORCE_BITS),
            "torque": quantise(wrench[:, 3:], TORQUE_BITS),
            "contact": touch,
        },
        contact=contact,
        qpos=qpos,
        dt=DT,
        seed=seed,
        split=split_of(index),
        provenance={
            "policy": name,
            "spawn_index": index,
            "hinge": list(door.hinge),
            "bar_height": door.bar_height,
            "spring": door.spring,
            "beliefscope": beliefscope.__version__,
            "mujoco": mujoco.__version__,
        },
    )


def split_of(index: int) -> str:
    """Of every ten trajectories, number 8 is for validation and number 9 for the test."""
    return {8: "val", 9: "test"}.get(index % 10, "train")


def policy_of(index: int) -> str:
    """Alternates, and swaps every ten, so that every split holds both policies."""
    return ("pull", "push")[(index + index // 10) % 2]


def quantise(values: NDArray[np.float64], bits: int) -> FloatArray:
    """Round to multiples of 2^-bits; exact in float32 up to 2^(24 - bits)."""
    return (np.rint(values * 2.0**bits) / 2.0**bits).astype(np.float32)


def hand_controls(position: FloatArray, touch: FloatArray) -> FloatArray:
    """(T, 7): previous hand position (T, 3), its change, touch (T, 1); the position before step 0 is that of step 0."""
    previous = np.concatenate([position[:1], position[:-1]])
    return np.concatenate([previous, position - previous, touch], axis=1)


@dataclass
class _Log:
    """One entry a step. ``wrench`` is the mean over the step; ``contact`` is true if there was any during it."""

    image: list[Picture] = field(default_factory=list)
    effector: list[Vector] = field(default_factory=list)
    wrench: list[Vector] = field(default_factory=list)
    contact: list[bool] = field(default_factory=list)
    qpos: list[Vector] = field(default_factory=list)


def _run(door: DoorPhysics, policy: Policy, steps: int) -> _Log:
    model = door_model(door)
    data = mujoco.MjData(model)
    controller, sensors = HandController(model, data, IMPEDANCE), HandSensors(model, data)
    camera, log = RayCaster(model, CAMERA), _Log()
    hinge = int(model.joint("door").qposadr[0])
    substeps = round(DT / model.opt.timestep)

    data.qpos[hinge] = policy.start_angle
    yaw = YAW_SHARE * policy.start_angle
    # One push in eighty would start out of reach. It then starts as near as the arm gets, and goes on from there.
    controller.place(policy.start(), yaw)
    controller.set_fingers(policy.fingers, policy.squeeze)
    mujoco.mj_forward(model, data)
    set_point = controller.position
    for _ in range(SETTLING_STEPS):
        controller.command(set_point, yaw)
        mujoco.mj_step(model, data, substeps)

    waypoint, left = Waypoint(set_point, 0.0, 0), 0
    for _ in range(steps):
        angle = float(data.qpos[hinge])
        if left == 0:
            waypoint = policy.next(angle)
            left = waypoint.steps(set_point)
        left -= 1
        set_point = controller.command(waypoint.approach(set_point, DT), yaw)
        # The hand turns with the door, gently: or its side would meet the panel before its fingertips do.
        yaw += float(np.clip(YAW_SHARE * angle - yaw, -0.05, 0.05))
        wrench, touched = np.zeros(6), False
        for _ in range(substeps):
            mujoco.mj_step(model, data)
            wrench += sensors.wrench() / substeps
            touched |= sensors.touching()
        mujoco.mj_kinematics(model, data)
        log.image.append(camera.picture(data))
        log.effector.append(controller.position)
        log.wrench.append(wrench)
        log.contact.append(touched)
        log.qpos.append(np.array(data.qpos))
    return log
