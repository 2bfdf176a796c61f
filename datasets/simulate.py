"""One simulated trajectory of the door task."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.camera import RayCaster
from beliefscope.datasets.control import HandController
from beliefscope.datasets.door import (
    BAR_HEIGHTS,
    CAMERA,
    HINGE_CENTRE,
    HINGE_HALF_RANGE,
    IMPEDANCE,
    DoorPhysics,
    door_model,
)
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.policies import YAW_SHARE, Policy, Pull, Push

Vector = NDArray[np.float64]

DT = 0.1
SPRING = 1.6  # N m/rad, where pushes are to find the door open again

# Resolution of the sensors, as powers of two so that quantised values compress: 15 um, 1 mN, 61 uN m, 15 urad.
POSITION_BITS, FORCE_BITS, TORQUE_BITS, ANGLE_BITS = 16, 10, 14, 16


def quantise(values: NDArray[np.float64], bits: int) -> NDArray[np.float32]:
    """Round to multiples of 2^-bits; exact in float32 up to 2^(24 - bits)."""
    return (np.rint(values * 2.0**bits) / 2.0**bits).astype(np.float32)


def split_of(index: int) -> str:
    """Of every ten trajectories, number 8 validates and number 9 tests."""
    return {8: "val", 9: "test"}.get(index % 10, "train")


def policy_of(index: int) -> str:
    """Alternates, and swaps every ten, so that every split holds both policies."""
    return ("pull", "push")[(index + index // 10) % 2]


@dataclass
class Sensors:
    """What is read off the simulation: force and torque of the surroundings on the hand, in world axes, at the wrist."""

    model: mujoco.MjModel
    data: mujoco.MjData

    def __post_init__(self) -> None:
        model = self.model
        self._force, self._torque, self._contact = (
            slice(model.sensor(name).adr[0], model.sensor(name).adr[0] + model.sensor(name).dim[0])
            for name in ("force", "torque", "contact")
        )
        self._hand, self._wrist = model.body("hand").id, model.site("wrist").id
        self._tool_mass = float(model.body_subtreemass[self._hand])

    def wrench(self) -> Vector:
        """(6,) N, N m. The raw sensor gives what link 7 exerts on the hand: that of the surroundings is its opposite,
        after the tool's weight (which it carries, whatever compensates gravity) is taken off."""
        data = self.data
        axes = data.site_xmat[self._wrist].reshape(3, 3)
        weight = self._tool_mass * np.array(self.model.opt.gravity)
        lever = data.subtree_com[self._hand] - data.site_xpos[self._wrist]
        force = -(axes @ data.sensordata[self._force] + weight)
        torque = -(axes @ data.sensordata[self._torque] + np.cross(lever, weight))
        return np.concatenate([force, torque])

    def touching(self) -> bool:
        """Whether the hand, its fingers included, touches the door."""
        return bool(self.data.sensordata[self._contact][0] > 0)


def simulate_door(seed: int, index: int, steps: int) -> Episode:
    """The trajectory ``index`` of the collection with ``seed``: ``steps`` steps of 0.1 s. The same on every call."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))
    hinge = quantise(HINGE_CENTRE + rng.uniform(-HINGE_HALF_RANGE, HINGE_HALF_RANGE, 2), POSITION_BITS)
    name = policy_of(index)
    spring = 0.0 if name == "pull" else SPRING
    physics = DoorPhysics((float(hinge[0]), float(hinge[1])), float(rng.uniform(*BAR_HEIGHTS)), spring)
    policy: Policy = Pull(physics, rng) if name == "pull" else Push(physics, rng)
    model = door_model(physics)
    data = mujoco.MjData(model)
    controller = HandController(model, data, IMPEDANCE)
    angle_at = int(model.joint("door").qposadr[0])

    data.qpos[angle_at] = policy.start_angle
    yaw = YAW_SHARE * policy.start_angle
    controller.place(policy.start(), yaw)
    opening = 0.016 if name == "pull" else 0.0
    data.qpos[[model.joint(f"finger_{side}").qposadr[0] for side in ("left", "right")]] = opening
    data.ctrl[model.actuator("gripper").id] = -0.06  # closed, with the full force
    mujoco.mj_forward(model, data)
    sensors = Sensors(model, data)
    substeps = round(DT / model.opt.timestep)
    hold = controller.position
    for _ in range(5):
        controller.command(hold, yaw)
        mujoco.mj_step(model, data, substeps)

    camera = RayCaster(model, CAMERA)
    log: dict[str, list[object]] = {key: [] for key in ("image", "effector", "wrench", "contact", "qpos")}
    waypoint = policy.next(float(data.qpos[angle_at]), controller.position)
    set_point, waited, budget = controller.position, 0, 0
    for _ in range(steps):
        # Follow the door's angle slowly, so that the fingers do not meet the panel.
        yaw += float(np.clip(YAW_SHARE * data.qpos[angle_at] - yaw, -0.05, 0.05))
        way = waypoint.position - set_point
        distance = float(np.linalg.norm(way))
        set_point = set_point + way * min(1.0, waypoint.speed * DT / max(distance, 1e-9))
        set_point = controller.command(set_point, yaw)
        wrench, touched = np.zeros(6), False
        for _ in range(substeps):
            mujoco.mj_step(model, data)
            wrench += sensors.wrench() / substeps
            touched |= sensors.touching()
        mujoco.mj_kinematics(model, data)
        log["image"].append(camera.picture(data))
        log["effector"].append(controller.position)
        log["wrench"].append(wrench)
        log["contact"].append(touched)
        log["qpos"].append(np.array(data.qpos))
        budget += 1
        arrived = distance < 0.005 or budget > 40
        waited += arrived
        if arrived and waited > waypoint.wait:
            waypoint = policy.next(float(data.qpos[angle_at]), controller.position)
            waited, budget = 0, 0
    return _episode(log, hinge, name, seed, index, physics, policy)


def _episode(log, hinge, name, seed, index, physics, policy) -> Episode:  # type: ignore[no-untyped-def]
    qpos = np.stack(log["qpos"])
    wrench = np.stack(log["wrench"])
    contact = np.array(log["contact"])
    angle = quantise(qpos[:, -1:], ANGLE_BITS)
    place = np.broadcast_to(hinge, (len(qpos), 2))
    effector = quantise(np.stack(log["effector"]), POSITION_BITS)
    observations = {
        "image": np.stack(log["image"]),
        "effector_position": effector,
        "force": quantise(wrench[:, :3], FORCE_BITS),
        "torque": quantise(wrench[:, 3:], TORQUE_BITS),
        "contact": contact[:, None].astype(np.float32),
    }
    return Episode(
        task="door",
        states=np.concatenate([place, angle], 1),
        controls=hand_controls(effector, observations["contact"]),
        observations=observations,
        contact=contact,
        qpos=quantise(qpos, ANGLE_BITS),
        dt=DT,
        seed=seed,
        split=split_of(index),
        provenance={
            "policy": name,
            "spawn_index": index,
            "hinge": [float(h) for h in place[0]],
            "bar_height": physics.bar_height,
            "spring": physics.spring,
            "mujoco": mujoco.__version__,
        },
    )


def hand_controls(position: NDArray[np.float32], contact: NDArray[np.float32]) -> NDArray[np.float32]:
    """(T, 7): previous effector position, its change, contact. At step 0 the previous position is the first one."""
    previous = np.concatenate([position[:1], position[:-1]])
    return np.concatenate([previous, position - previous, contact], axis=1)
