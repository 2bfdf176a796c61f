"""Simulation loop: policy, controller, sensors and camera."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import mujoco
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

import beliefscope
from beliefscope.datasets.episode import Episode, FloatArray
from beliefscope.datasets.simulation.camera import Camera, Image, RayCaster
from beliefscope.datasets.simulation.controller import HandController, Impedance
from beliefscope.datasets.simulation.panda import ARM_JOINTS, FINGERS
from beliefscope.datasets.simulation.sensors import HandSensors
from beliefscope.datasets.task import Task

Vector = NDArray[np.float64]

DT = 0.1  # s per step
SETTLING_STEPS = 5  # before recording starts, to close the grasp
JAMMED = 1000.0  # N at the start; the largest force of a free start is about 100 N
MAX_TURN = 0.05  # largest rotation of the hand per step, rad
CHANGE = slice(3, 6)  # channels of the controls with the change of the position, which is in the channels before
ROBOT_JOINTS = len(ARM_JOINTS) + len(FINGERS)  # first in qpos, followed by those of the object

# Sensor resolution in bits, powers of two for better compression: 15 um, 1 mN, 61 uN m, 15 urad.
POSITION_BITS, FORCE_BITS, TORQUE_BITS, ANGLE_BITS = 16, 10, 14, 16


@dataclass(frozen=True)
class Waypoint:
    """Target of the hand (m, world), speed of the set point (m/s) and steps to wait at the target."""

    position: Vector
    speed: float
    wait: int

    def steps(self, start: Vector) -> int:
        """Number of steps until the next waypoint: at most 4 s of motion, and the wait.

        A waypoint ends by time, because the hand never arrives if the door is at its stop.
        """
        offset = float(np.linalg.norm(self.position - start))
        return 1 + min(40, int(offset / (DT * self.speed))) + self.wait

    def approach(self, point: Vector, duration: float) -> Vector:
        """(3,) m: ``point`` after moving towards the waypoint for ``duration`` s."""
        offset = self.position - point
        return point + offset * min(1.0, self.speed * duration / max(float(np.linalg.norm(offset)), 1e-9))


class Policy(Protocol):
    """Motion of the hand. ``joints`` are the object's part of qpos (rad, m, unit quaternions).

    Attributes:
        object_start: (j,) initial joints of the object.
        fingers: initial opening of each finger, m. squeeze: whether the fingers close with full force.
    """

    object_start: Vector
    fingers: float
    squeeze: bool

    def start(self) -> Vector:
        """(3,) m, world: initial position of the hand."""

    def next(self, joints: Vector) -> Waypoint:
        """The next waypoint, requested when the previous one ends."""

    def yaw(self, joints: Vector) -> float:
        """rad: desired rotation of the hand about the vertical."""


@dataclass(frozen=True)
class Scene:
    """Simulated scene of a task.

    Attributes:
        model: robot and object. impedance: as passed to ``add_controller``. camera: camera of the images.
        open_loop: whether the commanded path ignores the measured hand, and is the control: (T, 6) previous commanded
            position and its change. Else the set point stays within the lead of the hand, and the control derives from
            the measured hand (``hand_controls``).
        disturb: called with step and simulation state before each step.
    """

    model: mujoco.MjModel
    impedance: Impedance
    camera: Camera
    open_loop: bool = False
    disturb: Callable[[int, mujoco.MjData], None] | None = None


class JammedStart(Exception):
    """The hand starts inside of the object."""


def first_free_start(simulate_with: Callable[[Generator], Episode], seed: int, index: int) -> Episode:
    """The episode of the first draw whose hand starts outside of the object: nearly always draw 0."""
    draw = 0
    while True:
        try:
            return simulate_with(episode_rng(seed, index, draw))
        except JammedStart:
            draw += 1


def episode_rng(seed: int, index: int, draw: int = 0) -> Generator:
    """Random numbers of episode ``index`` of the collection with ``seed``; ``draw``: number of jammed starts."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index, draw) if draw else (index,)))


def simulate(
    task: Task,
    scene: Scene,
    policy: Policy,
    states: Callable[[FloatArray], FloatArray],
    seed: int,
    index: int,
    steps: int,
    provenance: Mapping[str, Any],
) -> Episode:
    """Simulate episode ``index`` of the collection with ``seed``: ``steps`` steps of 0.1 s.

    Args:
        states: (T, nq) joint positions -> (T, n) true states.
        provenance: replay parameters and other metadata, JSON values.

    Raises JammedStart.
    """
    log = _run(scene, policy, steps)
    effector = quantise(np.stack(log.effector), POSITION_BITS)
    wrench, contact = np.stack(log.wrench), np.array(log.contact)
    qpos = quantise(np.stack(log.qpos), ANGLE_BITS)
    touch = contact[:, None].astype(np.float32)
    return Episode(
        task=task,
        states=states(qpos),
        controls=path_controls(quantise(np.stack(log.path), POSITION_BITS))
        if scene.open_loop
        else hand_controls(effector, touch),
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
            **provenance,
            "spawn_index": index,
            "beliefscope": beliefscope.__version__,
            "mujoco": mujoco.__version__,
        },
    )


def split_of(index: int) -> str:
    """Of every ten episodes, number 8 is for validation and number 9 for testing."""
    return {8: "val", 9: "test"}.get(index % 10, "train")


def quantise(values: NDArray[np.float64], bits: int) -> FloatArray:
    """Round to multiples of 2^-bits; exact in float32 up to 2^(24 - bits)."""
    return (np.rint(values * 2.0**bits) / 2.0**bits).astype(np.float32)


def hand_controls(position: FloatArray, touch: FloatArray) -> FloatArray:
    """(T, 7): previous hand position (T, 3), its change, touch (T, 1). The position before step 0 equals step 0."""
    previous = np.concatenate([position[:1], position[:-1]])
    return np.concatenate([previous, position - previous, touch], axis=1)


def path_controls(path: FloatArray) -> FloatArray:
    """(T, 6): previous commanded position, its change, of path (T, 3). The position before step 0 equals step 0."""
    previous = np.concatenate([path[:1], path[:-1]])
    return np.concatenate([previous, path - previous], axis=1)


def random_speed(rng: Generator) -> float:
    """3 to 25 cm/s, log-uniform."""
    return float(0.03 * np.exp(rng.uniform(0.0, np.log(25 / 3))))


def random_wait(rng: Generator) -> int:
    """0 to 5 steps."""
    return int(rng.integers(0, 6))


@dataclass
class _Log:
    """One entry per step. ``wrench`` is the mean over the step; ``contact`` is true for any contact during the step.

    ``path`` is the commanded position of the hand.
    """

    image: list[Image] = field(default_factory=list)
    effector: list[Vector] = field(default_factory=list)
    path: list[Vector] = field(default_factory=list)
    wrench: list[Vector] = field(default_factory=list)
    contact: list[bool] = field(default_factory=list)
    qpos: list[Vector] = field(default_factory=list)


def _run(scene: Scene, policy: Policy, steps: int) -> _Log:
    model = scene.model
    data = mujoco.MjData(model)
    controller, sensors = HandController(model, data, scene.impedance), HandSensors(model, data)
    camera, log = RayCaster(model, scene.camera), _Log()
    substeps = round(DT / model.opt.timestep)

    data.qpos[ROBOT_JOINTS:] = policy.object_start
    yaw = policy.yaw(policy.object_start)
    # About one door push in eighty starts out of reach; the arm then starts as close as possible.
    controller.place(policy.start(), yaw)
    controller.set_fingers(policy.fingers, policy.squeeze)
    mujoco.mj_forward(model, data)
    set_point = controller.position
    for _ in range(SETTLING_STEPS):
        controller.command(set_point, yaw)
        mujoco.mj_step(model, data, substeps)

    if np.linalg.norm(sensors.wrench()[:3]) > JAMMED:
        raise JammedStart

    waypoint, remaining = Waypoint(set_point, 0.0, 0), 0
    for step in range(steps):
        if scene.disturb is not None:
            scene.disturb(step, data)
        joints = np.array(data.qpos[ROBOT_JOINTS:])
        if remaining == 0:
            waypoint = policy.next(joints)
            remaining = waypoint.steps(set_point)
        remaining -= 1
        commanded = waypoint.approach(set_point, DT)
        limited = controller.command(commanded, yaw)
        set_point = commanded if scene.open_loop else limited
        yaw += float(np.clip(policy.yaw(joints) - yaw, -MAX_TURN, MAX_TURN))
        wrench, touched = np.zeros(6), False
        for _ in range(substeps):
            mujoco.mj_step(model, data)
            wrench += sensors.wrench() / substeps
            touched |= sensors.touching()
        mujoco.mj_kinematics(model, data)
        log.image.append(camera.render(data))
        log.effector.append(controller.position)
        log.path.append(set_point)
        log.wrench.append(wrench)
        log.contact.append(touched)
        log.qpos.append(np.array(data.qpos))
    return log
