"""MIT Push tasks: estimate the pose of a steel block that a robot's tip pushes over a table.

World frame: the robot's base, x forward, y left, z up from the table; m.
"""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefscope.datasets.covariate import CONTACT
from beliefscope.datasets.episode import Episode, FloatArray
from beliefscope.datasets.errors import unknown_name
from beliefscope.datasets.simulation.camera import Camera, Image, RayCaster
from beliefscope.datasets.simulation.ingredients import SENSOR_INGREDIENTS, camera_pose, start_ingredient
from beliefscope.datasets.simulation.outline import Outline
from beliefscope.datasets.task import Component, Task

Array = NDArray[np.float64]

RATE = 18  # Hz
CENTRE = (0.35, -0.03)  # centre of the workspace on the table, m
HEIGHT = 0.013  # height of every block, m
TIP_RADIUS = 0.00475  # m
CONTACT_GAP = 0.002
"""Largest gap that counts as contact, m: in contact, motion capture and outline differ by 1 to 2 mm."""

VIEW = 0.2  # half side length of the table area in an image, m
CAMERA = Camera((*CENTRE, 0.8), (0, 0, -1), (1, 0, 0), float(2 * np.arctan(VIEW / 0.8)))


def _ellipse(a: float, b: float) -> Array:
    angles = np.arange(64) * (2 * np.pi / 64)
    return np.stack([a * np.cos(angles), b * np.sin(angles)], 1)


def _box(a: float, b: float) -> Array:
    return np.array([(a, b), (-a, b), (-a, -b), (a, -b)])


OUTLINES: dict[str, Array] = {
    "rect1": _box(0.045, 0.045),
    "rect2": _box(0.045, 0.05625),
    "rect3": _box(0.0675, 0.045),
    "tri1": np.array([(0.045, 0.045), (-0.0809, 0.045), (0.045, -0.0809)]),
    "tri2": np.array([(0.045, 0.045), (-0.106, 0.045), (0.045, -0.0809)]),
    "tri3": np.array([(0.045, 0.045), (-0.1315, 0.045), (0.045, -0.0806)]),
    "ellip1": _ellipse(0.0525, 0.0525),
    "ellip2": _ellipse(0.0525, 0.0654),
    "ellip3": _ellipse(0.0525, 0.0785),
    "hex": 0.0605 * np.stack([np.cos(np.arange(6) * np.pi / 3), np.sin(np.arange(6) * np.pi / 3)], 1),
}
"""Shape -> (P, 2) corners of the convex outline in the block's frame, counter-clockwise, m."""


def gap(shape: str, poses: Array, tips: Array) -> Array:
    """(T,) distance between the tip's circle and the block's outline, m; negative where they overlap.

    Args:
        poses: (T, 3) x, y (m) and yaw (rad) of the block, world. tips: (T, 2) centre of the tip, world, m.
    """
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    dx, dy = (tips - poses[:, :2]).T
    local = np.stack([c * dx + s * dy, c * dy - s * dx], 1)[:, None]  # (T, 1, 2)
    corner = OUTLINES[shape]
    edge = np.roll(corner, -1, axis=0) - corner  # (P, 2)
    along = np.clip(((local - corner) * edge).sum(-1) / (edge**2).sum(-1), 0, 1)  # (T, P)
    nearest = np.linalg.norm(local - corner - along[..., None] * edge, axis=-1).min(1)
    beyond = edge[:, 1] * (local - corner)[..., 0] - edge[:, 0] * (local - corner)[..., 1]
    return np.where((beyond > 0).any(1), nearest, -nearest) - TIP_RADIUS


def block_model(shape: str) -> mujoco.MjModel:
    """Model of table, block and tip. qpos (5): x, y and yaw of the block, x and y of the tip."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    world = spec.worldbody
    world.add_light(pos=(0, 0, 3.5), dir=(0, 0, -1), type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    world.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(3, 3, 0.1), rgba=(0.36, 0.3, 0.24, 1))
    block = world.add_body(name="block", pos=(0, 0, HEIGHT / 2))
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    block.add_joint(name="block_x", type=slide, axis=(1, 0, 0))
    block.add_joint(name="block_y", type=slide, axis=(0, 1, 0))
    block.add_joint(name="block_yaw", type=hinge, axis=(0, 0, 1))
    outline = OUTLINES[shape]
    _add_prism(spec, block, "block", outline, HEIGHT / 2, (0.82, 0.84, 0.88, 1))
    # A dark mark off the centre makes the yaw visible in images.
    mark = 0.35 * outline + [0.5 * outline[:, 0].max(), 0.0]
    _add_prism(spec, block, "mark", mark, HEIGHT / 2 + 0.001, (0.12, 0.14, 0.2, 1))
    tip = world.add_body(name="tip", pos=(0, 0, 0.06))
    tip.add_joint(name="tip_x", type=slide, axis=(1, 0, 0))
    tip.add_joint(name="tip_y", type=slide, axis=(0, 1, 0))
    tip.add_geom(
        name="tip", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=(TIP_RADIUS, 0.06, 0), rgba=(0.75, 0.42, 0.12, 1)
    )
    return spec.compile()


def _add_prism(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, outline: Array, half: float, rgba: tuple[float, ...]
) -> None:
    corners = np.concatenate([np.column_stack([outline, np.full(len(outline), z)]) for z in (-half, half)])
    spec.add_mesh(name=name, uservert=corners.ravel())
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, rgba=rgba)


def render_images(shape: str, qpos: NDArray[np.floating], camera: Camera = CAMERA) -> Image:
    """(T, 32, 32) uint8: top views at joint positions (T, 5), x upwards and y to the left."""
    model = block_model(shape)
    data, caster = mujoco.MjData(model), RayCaster(model, camera)
    images = np.empty((len(qpos), camera.size, camera.size), np.uint8)
    for step, joints in enumerate(qpos):
        data.qpos[:] = joints
        mujoco.mj_kinematics(model, data)
        images[step] = caster.render(data)
    return images


def replay(episode: Episode) -> mujoco.MjModel:
    """Model of an episode's block and tip. Raises BadInput for an unknown shape in its provenance."""
    shape = episode.provenance.get("shape")
    if shape not in OUTLINES:
        raise unknown_name("shape", str(shape), OUTLINES)
    return block_model(str(shape))


def post_outline(states: ArrayLike) -> Outline:
    """Outline of a post at the block's centre for states (..., 2) = (x, y), which lack the yaw."""
    states = np.asarray(states, float)
    return _outline(states, np.zeros(states.shape[:-1]), (0.02, 0.02, 2 * HEIGHT))


def block_outline(states: ArrayLike) -> Outline:
    """Outline of the block ``rect1`` for states (..., 3) = (x, y, yaw)."""
    states = np.asarray(states, float)
    return _outline(states, states[..., 2], (0.09, 0.09, HEIGHT))


def _outline(states: Array, yaw: Array, size: tuple[float, float, float]) -> Outline:
    zero = np.zeros_like(yaw)
    return Outline(
        position=np.stack([states[..., 0], states[..., 1], np.full_like(yaw, size[2] / 2)], -1),
        wxyz=np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], -1),
        size=size,
        anchor=np.stack([states[..., 0], states[..., 1], np.full_like(yaw, size[2])], -1),
    )


def _task(name: str, rate: int, yaw: bool) -> Task:
    return Task(
        name=name,
        components=(Component("x", "m"), Component("y", "m"), *([Component("yaw", "rad")] if yaw else [])),
        observations={"image": (32, 32), "effector_position": (3,), "force": (3,), "torque": (3,), "contact": (1,)},
        modalities={"image": ("image",), "haptics": ("effector_position", "force", "torque", "contact")},
        control_size=7,
        dt=1 / rate,
        map_components=("x", "y"),
        map_half_width=0.135,
        covariates={"contact": CONTACT},
        positions={"effector_position": (0, 1), "control": (0, 1)},
        replay=replay,
        outline=block_outline if yaw else post_outline,
        camera=CAMERA,
    )


PUSH_REAL = _task("push-real", RATE, yaw=False)

START = {"m": (0.03, 0.05)}
PUSH_REAL_FIELD = replace(
    PUSH_REAL,
    name="push-real-field",
    control_size=6,
    start_distance=START,
    warmup=0,
    ingredients={
        "camera-pose": camera_pose(0.015, float(np.deg2rad(1.0))),
        **{name: SENSOR_INGREDIENTS[name] for name in ("image-quality", "outages")},
        "start": start_ingredient(START),
    },
)
"""The same recordings with a realistic camera, a start with an error, and controls without contact."""

PUSH_REAL_TASKS = (
    PUSH_REAL,
    PUSH_REAL_FIELD,
    _task("push-real-yaw", RATE, yaw=True),
    _task("push-real-50hz", 50, yaw=False),
    _task("push-real-yaw-50hz", 50, yaw=True),
)
"""Variants of ``push-real`` with the yaw as third state component and at a higher rate."""


def haptic_observations(tips: Array, force: Array, torque: Array, contact: NDArray[np.bool_]) -> dict[str, FloatArray]:
    """Haptic observations by key, from tips (T, 2) m, force (T, 2) N, torque about z (T,) N m, contact (T,).

    The sensor has three channels: the force in the table plane and the torque about its normal. The other components
    of ``force`` and ``torque`` are zero, so that they match the other tasks. The tip's height is half the block's.
    """
    steps = len(tips)
    position = np.column_stack([tips, np.full(steps, HEIGHT / 2)]).astype(np.float32)
    return {
        "effector_position": position,
        "force": np.column_stack([force, np.zeros(steps)]).astype(np.float32),
        "torque": np.column_stack([np.zeros((steps, 2)), torque]).astype(np.float32),
        "contact": contact[:, None].astype(np.float32),
    }
