"""Ingredients of the field tasks: what differs between episodes, drawn per episode and stored in its provenance."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults import faults, image_faults
from beliefscope.datasets.faults.fault import Fault
from beliefscope.datasets.ingredient import Ingredient
from beliefscope.datasets.simulation.camera import Camera
from beliefscope.datasets.simulation.panda import Sleeve
from beliefscope.datasets.simulation.simulate import FORCE_BITS, POSITION_BITS, TORQUE_BITS, quantise
from beliefscope.datasets.task import Task

Values = Mapping[str, Any]


@dataclass(frozen=True)
class Draw:
    """Values of an ingredient in one episode, and its generator for random numbers at single steps."""

    values: Values
    rng: Generator


Draws = Mapping[str, Draw]
"""Ingredient -> its draw; ingredients that are switched off are missing."""


def draw(task: Task, seed: int, index: int, without: Collection[str] = ()) -> Draws:
    """The ingredients of episode ``index`` of the collection with ``seed``, except those in ``without``.

    Every ingredient has a generator of its own, so switching one off leaves the draws of the others unchanged.
    """
    draws = {}
    for position, (name, ingredient) in enumerate(task.ingredients.items()):
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index, position)))
        values = {key: float(rng.uniform(low, high)) for key, (low, high) in ingredient.ranges.items()}
        if name not in without:
            draws[name] = Draw(values, rng)
    return draws


def _symmetric(limit: float, *names: str) -> dict[str, tuple[float, float]]:
    return dict.fromkeys(names, (-limit, limit))


XYZ = ("x", "y", "z")


def camera_pose(shift: float, turn: float) -> Ingredient:
    """Pose error of the camera: up to ``shift`` m along and ``turn`` rad about each axis."""
    turns = _symmetric(turn, "turn_x", "turn_y", "turn_z")
    units = dict.fromkeys(XYZ, "m") | dict.fromkeys(turns, "rad")
    return Ingredient(
        "pose error of the camera: along (m) and about (rad) each axis", _symmetric(shift, *XYZ) | turns, units
    )


def wrist(force: float) -> Ingredient:
    """Errors of the force/torque sensor for forces of the order of ``force`` N, with levers of 0.1 m."""
    ranges = {
        **_symmetric(force, *(f"force_{axis}" for axis in XYZ)),
        **_symmetric(0.02 * force, *(f"drift_{axis}" for axis in XYZ)),
        **_symmetric(0.04 * force, *(f"torque_{axis}" for axis in XYZ)),
        "force_noise": (0.1 * force, 0.4 * force),
        "torque_noise": (0.01 * force, 0.04 * force),
    }
    unit_of = {"force": "N", "drift": "N/s", "torque": "N m"}
    units = {name: unit_of[name.partition("_")[0]] for name in ranges}
    return Ingredient("bias (N, N m), drift (N/s) and noise of the force/torque sensor", ranges, units)


SENSOR_INGREDIENTS = {
    "sleeve": Ingredient(
        "sleeve around the hand, which hides the object (m)",
        {"radius": (0.05, 0.1), "end": (0.03, 0.07)},
        {"radius": "m", "end": "m"},
    ),
    "image-quality": Ingredient(
        "exposure (factor), blur (pixels) and noise (gray levels) of the images",
        {"exposure": (0.6, 1.4), "blur": (0.0, 1.0), "noise": (2.0, 8.0)},
        {"blur": "pixels", "noise": "gray levels"},
    ),
    "outages": Ingredient(
        "stretches without images: share of all steps, mean duration (s)",
        {"fraction": (0.3, 0.5), "seconds": (1.0, 3.0)},
        {"seconds": "s"},
    ),
    "hand-pose": Ingredient(
        "bias and noise of the measured hand position (m)",
        _symmetric(0.003, *XYZ) | {"noise": (0.0005, 0.002)},
        dict.fromkeys((*XYZ, "noise"), "m"),
    ),
}
"""Sensor errors with the same ranges in all field tasks."""


def moved_camera(camera: Camera, draws: Draws) -> Camera:
    """The camera with the pose error ``camera-pose``."""
    if "camera-pose" not in draws:
        return camera
    v = draws["camera-pose"].values
    return camera.moved([v[axis] for axis in XYZ], [v[f"turn_{axis}"] for axis in XYZ])


def drawn_sleeve(draws: Draws) -> Sleeve | None:
    """The sleeve, if it is not switched off."""
    return Sleeve(**draws["sleeve"].values) if "sleeve" in draws else None


def _axes(values: Values, prefix: str = "") -> dict[str, Any]:
    return {axis: values[prefix + axis] for axis in XYZ}


SENSOR_FAULTS: dict[str, Callable[[Values], Sequence[Fault]]] = {
    "image-quality": lambda v: (
        image_faults.ImageUnderexposed(factor=v["exposure"]),
        image_faults.ImageBlur(std=v["blur"]),
        image_faults.ImageNoise(std=v["noise"]),
    ),
    "outages": lambda v: (image_faults.ImageOutage(fraction=v["fraction"], seconds=v["seconds"]),),
    "wrist": lambda v: (
        faults.ForceBias(**_axes(v, "force_")),
        faults.ForceDrift(**_axes(v, "drift_")),
        faults.ForceNoise(std=v["force_noise"]),
        faults.TorqueBias(**_axes(v, "torque_")),
        faults.TorqueNoise(std=v["torque_noise"]),
    ),
    "hand-pose": lambda v: (faults.EffectorOffset(**_axes(v)), faults.EffectorNoise(std=v["noise"])),
}
"""Ingredient -> the sensor faults that its values stand for, in the order of application."""

RESOLUTION = {"effector_position": POSITION_BITS, "force": FORCE_BITS, "torque": TORQUE_BITS}


def finish(task: Task, episode: Episode, draws: Draws, extra: Mapping[str, Any]) -> Episode:
    """The episode of a field task: with sensor errors, and in its provenance the ingredients and the start offset.

    Args:
        episode: simulated with the scene of the draws. extra: further provenance, JSON values.
    """
    observations = dict(episode.observations)
    for name, faults_of in SENSOR_FAULTS.items():
        if name not in draws:
            continue
        for fault in faults_of(draws[name].values):
            readings = fault.apply(observations[fault.sensor], episode.dt, draws[name].rng)
            bits = RESOLUTION.get(fault.sensor)
            observations[fault.sensor] = readings if bits is None else quantise(readings, bits)
    provenance: dict[str, Any] = {**episode.provenance, **extra}
    provenance["ingredients"] = {name: dict(drawn.values) for name, drawn in draws.items()}
    if "start" in draws:
        provenance["start_offset"] = _start_offset(task, draws["start"]).tolist()
    return replace(episode, task=task, observations=observations, provenance=provenance)


def start_ingredient(distances: Mapping[str, tuple[float, float]]) -> Ingredient:
    """Distance of the first belief's mean from the true state: unit -> range."""
    units = " and ".join(distances)
    return Ingredient(
        f"distance of the first belief from the true state ({units})",
        dict(distances),
        {unit: unit for unit in distances},
    )


def _start_offset(task: Task, drawn: Draw) -> NDArray[np.float64]:
    """(n,): the components of one unit form a vector of the drawn length and of uniform direction."""
    offset = np.zeros(len(task.components))
    for unit, length in drawn.values.items():
        members = [i for i, component in enumerate(task.components) if component.unit == unit]
        direction = drawn.rng.standard_normal(len(members))
        offset[members] = length * direction / np.linalg.norm(direction)
    return offset


def nudge_steps(drawn: Draw, steps: int, dt: float) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """At which steps (T,) a nudge begins, and its random numbers (T, 2) in [0, 1)."""
    numbers = drawn.rng.random((steps, 3))
    return numbers[:, 0] < drawn.values["per_second"] * dt, numbers[:, 1:]
