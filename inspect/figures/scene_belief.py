"""The belief of a trace as it is drawn in 3D: positions of the estimates, contours, particles and viewpoints."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.simulation.camera import Camera
from beliefscope.datasets.simulation.replay import Replay
from beliefscope.datasets.task import Task
from beliefscope.inspect.figures.scene_shapes import RGB, grid, on_floor
from beliefscope.inspect.maps.modality_shares import modality_shares
from beliefscope.inspect.maps.plane import plane_of
from beliefscope.inspect.palette import colour
from beliefscope.inspect.statistics.measures import contours
from beliefscope.inspect.trace import Trace

Array = NDArray[Any]

SIGMAS = 2.0  # size of the contours
BELIEF_HEIGHT = 0.10  # m from the anchor to the plane of particles and contours
POLE_STEP = 0.06  # m, height difference between poles, so that their labels do not overlap
DISC_SPACING = 0.002  # m between contours; discs in the same plane would flicker
LARGE = 2.0  # m, extent of the true positions above which poles, points and spacings are larger in proportion
FULL_SIZE = 0.1  # m, half width of a map below which poles, points and spacings are smaller in proportion
MIN_AXIS = 1e-6  # m, half axis of a contour
GRAY_LEVEL = 130.0  # gray value of a particle without weight
MIN_STRENGTH = 0.25  # least color strength of particles colored by modality
EYE = np.array([-0.28, -1.32, 1.22])  # m, initial viewpoint relative to an object of 1 m height
# The same for a flat object: the robot and the camera beside the table with its image are in view.
EYE_LOW = np.array([-0.27, -1.3, 0.78])
EYE_ABOVE = np.array([0.0, -0.04, 3.6])  # viewpoint above the belief in half widths of a map, with x to the right
EYE_CAMERA = np.array([-0.6, -1.6, 0.4])  # viewpoint that shows the camera, in its distances from its target
EYE_GRID = np.array([-0.5, -1.2, 1.1])  # initial viewpoint without a robot, in side lengths of the grid


def rgb(source: str, trace: Trace) -> RGB:
    """Color of ``truth``, ``fused``, ``contact`` or a modality."""
    color = colour(source, trace.modalities)
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


class DrawnBelief:
    """Positions of the estimates of a trace; x away from the robot, y to its left, z up, m.

    Attributes:
        names: of S estimates: ``truth``, ``fused``, and the modalities if there are several.
        outline: of the object by step and estimate; None if the task has none.
        anchors: (T, S, 3) visible points of the object, or the estimates on the floor.
        above: from the anchors up to the plane of particles and contours. level: z of this plane at the first step.
    """

    def __init__(self, task: Task, trace: Trace) -> None:
        self._task, self._trace = task, trace
        estimates = list(_estimates(trace))
        self.names = [name for name, _, _ in estimates]
        states = np.stack([mean for _, mean, _ in estimates], axis=1)  # (T, S, n)
        self._means = on_floor(task, states[:, 1:])
        covariances = np.stack([covariance for _, _, covariance in estimates[1:]], axis=1)
        self._covariances = on_floor(task, on_floor(task, covariances).swapaxes(-1, -2))
        self.outline = None if task.outline is None else task.outline(states)
        flat = np.concatenate([on_floor(task, states), np.zeros_like(states[..., :1])], axis=-1)
        self.anchors: Array = flat if self.outline is None else self.outline.anchor
        half_width = plane_of(trace).half_widths[0]
        extent = float(np.ptp(on_floor(task, trace.anchors), axis=0).max())
        self._half_width = max(half_width, extent / 2.0)
        self.scale = max(min(1.0, half_width / FULL_SIZE), extent / LARGE) if task.floor is not None else 1.0
        self.above = 0.0 if self.outline is None else BELIEF_HEIGHT
        self.level = float(self.anchors[0, 0, 2]) + self.above

    def pole_height(self, index: int) -> float:
        """Height in m of the pole of an estimate."""
        return float(self.anchors[0, index, 2]) + self.above + self.scale * POLE_STEP * (len(self.names) - index)

    def discs(self, step: int) -> tuple[Array, Array, Array]:
        """Positions (S, 3), orientations (S, 4) and scales (S, 3) of contour discs of all estimates but the truth."""
        axes, turn = contours(self._covariances[step])
        count, zero = len(turn), np.zeros(len(turn))
        levels = self.level - self.scale * DISC_SPACING * np.arange(1, count + 1)
        wxyz = np.stack([np.cos(turn / 2.0), zero, zero, np.sin(turn / 2.0)], axis=1)
        scales = np.concatenate([SIGMAS * np.maximum(axes, MIN_AXIS), np.ones((count, 1))], axis=1)
        return np.column_stack([self._means[step], levels]), wxyz, scales

    def particles(self, step: int, tint: Literal["weight", "share"]) -> tuple[Array, Array]:
        """(M, 3) points; (M, 3) colors, from gray at weight 0 to full color at the maximum.

        tint: color of the fused estimate, or of the modalities by their share in the weight.
        """
        trace = self._trace
        assert trace.particles is not None
        assert trace.log_weights is not None
        points = np.full((trace.particles.shape[1], 3), self.level, np.float32)
        points[:, :2] = on_floor(self._task, trace.particles[step])
        weights = trace.log_weights[step]
        strength = np.sqrt(np.exp(weights - weights.max()))[:, None]
        color = np.array(rgb("fused", trace), np.float32)
        shares = modality_shares(trace, step) if tint == "share" else None
        if shares is not None:
            color = shares.T @ np.array([rgb(name, trace) for name in trace.modalities], np.float32)
            strength = MIN_STRENGTH + (1.0 - MIN_STRENGTH) * strength
        return points, np.rint(GRAY_LEVEL + strength * (color - GRAY_LEVEL)).astype(np.uint8)

    def viewpoints(self, replay: Replay | None) -> dict[str, tuple[Array, Array]]:
        """Name -> position (3,) of the eye, and the point (3,) that it faces."""
        target = self.anchors[:, 0].mean(axis=0)
        # The bodies of a scene with a robot extend over about a meter.
        if replay is None or np.ptp(replay.positions[:, 1:], axis=(0, 1)).max() < 0.5:
            floor = grid(self._task, self._trace)
            height = 0.0 if self.outline is None or replay is not None else float(max(self.outline.size))
            target = np.array([*(floor.low + floor.high) / 2.0, height / 3.0])
            # With a replay, the poles of the estimates are half a meter high.
            eye = EYE_GRID * (max((floor.high - floor.low).max(), 1.2 * height) if replay is None else 0.5)
        else:
            low = max(0.0, 1.0 - float(target[2]))
            eye = EYE + low * (EYE_LOW - EYE)
            target = target * [0.62 + 0.38 * low, 0.3 + 0.7 * low, 0.68] + [0.0, 0.0, 0.2 * low]
        center = np.array([*self.anchors[:, 0, :2].mean(axis=0), self.level])
        # Not vertically above, where the up direction of the view would be undefined.
        viewpoints = {
            "first": (target + eye, target),
            "above": (center + EYE_ABOVE * self._half_width, center),
        }
        if self._task.camera is not None:
            position, target = camera_axis(self._task.camera)
            middle, distance = (position + target) / 2.0, np.linalg.norm(position - target)
            viewpoints["camera"] = middle + distance * EYE_CAMERA, middle
        return viewpoints


def camera_axis(camera: Camera) -> tuple[Array, Array]:
    """Position (3,) of a camera and the point (3,) that it faces: on the floor if it faces down, else 1 m away."""
    forward = np.array(camera.forward)
    distance = camera.position[2] / -forward[2] if forward[2] < -0.1 else 1.0
    return np.array(camera.position), camera.position + distance * forward


def _estimates(trace: Trace) -> Iterator[tuple[str, Array, Array]]:
    """(name, states (T, n), covariances (T, n, n)) of the truth, the fused estimate and the unimodal updates."""
    yield "truth", trace.anchors, np.zeros_like(trace.estimate_covariance)
    yield "fused", trace.estimate_mean, trace.estimate_covariance
    if len(trace.modalities_with_posterior) > 1:
        for k, name in enumerate(trace.modalities_with_posterior):
            yield name, trace.modality_mean[:, k], trace.modality_covariance[:, k]
