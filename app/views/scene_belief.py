"""The replay and the filter's belief at one step of a trace, as nodes of the 3D scene.

Axes: x away from the robot, y to its left, z up, in m. Colors are those of the recordings (``recordings.schema``).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from viser import ViserServer

from beliefscope.app.protocol.map_format import particles
from beliefscope.app.protocol.messages import SceneLayers, Viewpoint
from beliefscope.app.protocol.trace_format import scene_layers
from beliefscope.app.runs.traced_run import TracedRun
from beliefscope.app.views.scene_context import (
    SMALL_LABEL,
    UP,
    Array,
    CameraView,
    FloorMap,
    ForceArrow,
    RobotScene,
    add_grid,
    extent,
    rgb,
)
from beliefscope.datasets.simulation.replay import replay
from beliefscope.datasets.task import Task
from beliefscope.inspect.likelihood import LikelihoodMap, no_maps
from beliefscope.inspect.statistics.measures import contours
from beliefscope.inspect.trace import Trace

SIGMAS = 2.0  # size of the contours
POLE_RADIUS = 0.005  # m
POLE_STEP = 0.06  # m, height difference between poles, so that their labels do not overlap
BELIEF_HEIGHT = 0.10  # m from the anchor to the plane of particles and contours
MIN_AXIS = 1e-6  # m, half axis of a contour
DISC_SPACING = 0.002  # m between contours; discs in the same plane would flicker
FLOOR_MAP_HEIGHT = 0.003  # m above the floor
GRAY_LEVEL = 130.0  # gray value of a particle without weight
MIN_STRENGTH = 0.25  # least color strength of particles colored by modality
EYE = np.array([-0.28, -1.32, 1.22])  # m, initial viewpoint relative to an object of 1 m height
EYE_ABOVE = np.array([0.0, -0.04, 3.6])  # viewpoint above the belief in half widths of a map, with x to the right
EYE_CAMERA = np.array([-0.6, -1.6, 0.4])  # viewpoint that shows the camera, in its distances from its target
EYE_GRID = np.array([-0.5, -1.2, 1.1])  # initial viewpoint without a robot, in side lengths of the grid

# A unit disc in the plane z = 0: vertices on its rim, then its center; and the triangles between them.
ANGLES = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
DISC = np.append(np.stack([np.cos(ANGLES), np.sin(ANGLES), 0.0 * ANGLES], axis=1), [[0.0, 0.0, 0.0]], axis=0)
FAN = np.array([(64, i, (i + 1) % 64) for i in range(64)])
# The bits of a corner's number are its coordinates in the unit box; an edge joins two corners that differ in one bit.
BOX = np.array([[bit >> axis & 1 for axis in range(3)] for bit in range(8)], np.float32) - 0.5
EDGES = np.array([(a, a | 1 << axis) for a in range(8) for axis in range(3) if not a >> axis & 1])
_RIM = np.stack([DISC[:-1], np.roll(DISC[:-1], -1, axis=0)], axis=1) / 2.0
OUTLINE_EDGES = {
    "box": BOX[EDGES],
    "cylinder": np.concatenate([_RIM + 0.5 * UP, _RIM - 0.5 * UP, _RIM[::16, :1] + np.array([0.5 * UP, -0.5 * UP])]),
}
"""Shape of an outline -> (E, 2, 3) its edges, at size 1."""


class BeliefScene:
    """Scene nodes of one trace.

    Attributes:
        viewpoints: available viewpoints -> position (3,) of the eye and the point (3,) that it faces, m.
    """

    def __init__(self, server: ViserServer, run: TracedRun, trace: Trace, layers: SceneLayers) -> None:
        """trace: of the whole run or a part of it, to which the steps of ``move`` refer."""
        self._server = server
        self._task = run.checkpoint.task
        self._plane = list(self._task.map_indices)
        self._layers = layers
        self._robot: RobotScene | None = None
        self._discs: Any = None
        self._particles: Any = None
        self._force: ForceArrow | None = None
        self._floor_map: FloorMap | None = None
        self._camera: CameraView | None = None
        self.set_trace(trace)
        server.scene.set_up_direction("+z")
        server.scene.world_axes.visible = False
        server.scene.configure_default_lights(cast_shadow=False)
        paths = {"replay": "/bodies", "objects": "/objects", "estimates": "/estimates", "force": "/force"}
        self._roots: dict[str, list[Any]] = {
            layer: [server.scene.add_frame(path, show_axes=False)] for layer, path in paths.items()
        }
        if self._replay is not None:
            self._robot = RobotScene(server, self._replay)
            self._roots["replay"].append(self._robot.fixed_bodies)
        else:
            add_grid(server, self._task, trace)
        self._above = BELIEF_HEIGHT if self._outline is not None else 0.0
        self._level = float(self._anchors[0, 0, 2]) + self._above
        self._markers = [self._add_marker(i, name) for i, (name, _, _) in enumerate(self._estimates)]
        self._outline_frames = self._add_outlines()
        self._add_layers(set(scene_layers(self._task, trace, no_maps(run.checkpoint, trace))))
        if np.isnan(trace.episode.states).any():  # unknown true state
            for node in (*self._markers[0], *([self._outline_frames[0]] if self._outline_frames else [])):
                node.visible = False
        self.set_layers(layers)
        self.viewpoints = self._viewpoints()
        camera = server.initial_camera
        camera.position, camera.look_at = self.viewpoints["first"]
        camera.fov = np.deg2rad(45.0)

    def set_trace(self, trace: Trace) -> None:
        """Use another part of the run: later steps of ``move`` refer to it."""
        self._trace = trace
        self._replay = replay(self._task, trace.episode)
        self._estimates = list(_estimates(trace))
        states = np.stack([mean for _, mean, _ in self._estimates], axis=1)  # (T, S, n)
        self._outline = None if self._task.outline is None else self._task.outline(states)
        flat = np.concatenate([states[..., self._plane], np.zeros_like(states[..., :1])], axis=-1)
        self._anchors = flat if self._outline is None else self._outline.anchor  # (T, S, 3)
        for part in (self._force, self._camera):
            if part is not None:
                part.set_trace(trace)

    def set_layers(self, layers: SceneLayers) -> None:
        """Show and hide layers. Their appearance changes with the next ``move``."""
        self._layers = layers
        for layer, roots in self._roots.items():
            for root in roots:
                root.visible = layer not in layers.hidden
        if self._robot is not None:
            map_on_floor = self._floor_map is not None and "map" not in layers.hidden and layers.height == "floor"
            self._robot.set_translucent(map_on_floor)

    def move(self, step: int, maps: LikelihoodMap | None) -> None:
        """Draw a step. maps: likelihood maps of the step."""
        if self._robot is not None and self._replay is not None:
            self._robot.move(self._replay.positions[step], self._replay.rotations[step])
        for i, (pole, label) in enumerate(self._markers):
            foot = np.array([*self._anchors[step, i, :2], 0.0])
            pole.position = foot + pole.height / 2.0 * UP
            label.position = foot + pole.height * UP
        if self._discs is not None:
            pose = self._disc_poses(step)
            self._discs.batched_positions, self._discs.batched_wxyzs, self._discs.batched_scales = pose
        for i, frame in self._outline_frames.items():
            assert self._outline is not None
            frame.position, frame.wxyz = self._outline.position[step, i], self._outline.wxyz[step, i]
        if self._particles is not None:
            self._particles.points, self._particles.colors = self._particle_cloud(step)
        if self._force is not None:
            self._force.show(step)
        if self._floor_map is not None:
            self._floor_map.show(maps, self._layers)
        if self._camera is not None:
            self._camera.show(step, self._layers)

    def _add_layers(self, available: set[str]) -> None:
        """Add the layers that depend on the filter and the data set."""
        if "contours" in available:
            self._discs = self._add_discs()
            self._roots["contours"] = [self._discs]
        if "particles" in available:
            points, colors = self._particle_cloud(0)
            self._particles = self._server.scene.add_point_cloud(
                "/particles", points, colors, point_size=0.006, point_shape="circle", precision="float32"
            )
            self._roots["particles"] = [self._particles]
        if "force" in available:
            self._force = ForceArrow(self._server, self._trace)
        if "map" in available:
            # Below all contours; without an outline, the belief lies on the floor and the map below it.
            below = self._level - 2.0 * DISC_SPACING * len(self._estimates)
            floor = below if self._outline is None else FLOOR_MAP_HEIGHT
            self._floor_map = FloorMap(self._server, self._trace, {"floor": floor, "belief": below})
        if "camera" in available:
            self._camera = CameraView(self._server, self._task, self._trace)

    def _add_marker(self, index: int, name: str) -> tuple[Any, Any]:
        """Pole and label of an estimate."""
        trace, scene = self._trace, self._server.scene
        height = float(self._anchors[0, index, 2]) + self._above + POLE_STEP * (len(self._estimates) - index)
        pole = scene.add_cylinder(
            f"/estimates/{name}/pole", POLE_RADIUS, height, color=rgb(name, trace), cast_shadow=False
        )
        text = "estimate" if name == "fused" and len(trace.modalities) < 2 else name
        label = scene.add_label(f"/estimates/{name}/label", text, anchor="bottom-center", **SMALL_LABEL)
        return pole, label

    def _add_discs(self) -> Any:
        """Contours as discs: instances of one mesh, because viser recompiles lines whose points change."""
        names = [name for name, _, _ in self._estimates[1:]]
        positions, wxyzs, scales = self._disc_poses(0)
        return self._server.scene.add_batched_meshes_simple(
            "/contours",
            DISC,
            FAN,
            batched_wxyzs=wxyzs,
            batched_positions=positions,
            batched_scales=scales,
            batched_colors=np.array([rgb(name, self._trace) for name in names], np.uint8),
            batched_opacities=np.array([0.45 if name == "fused" else 0.3 for name in names], np.float32),
            side="double",
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )

    def _add_outlines(self) -> dict[int, Any]:
        """Edges of the true and the estimated object; the estimated one is filled with a transparent color."""
        if self._outline is None:
            return {}
        size = np.asarray(self._outline.size, np.float32)
        frames = {}
        for i, (name, _, _) in enumerate(self._estimates[:2]):
            color = rgb(name, self._trace)
            frames[i] = self._server.scene.add_frame(f"/objects/{name}", show_axes=False)
            self._server.scene.add_line_segments(
                f"/objects/{name}/edges",
                (OUTLINE_EDGES[self._outline.shape] * (size + 0.004)).astype(np.float32),
                color,
                thickness=2.0,
                thickness_units="screen",
            )
            if name == "fused":
                path, x, z = f"/objects/{name}/{self._outline.shape}", float(size[0]), float(size[2])
                style: dict[str, Any] = {"opacity": 0.25, "cast_shadow": False, "receive_shadow": False}
                if self._outline.shape == "cylinder":
                    self._server.scene.add_cylinder(path, x / 2, z, color=color, **style)
                else:
                    self._server.scene.add_box(path, color, tuple(size), **style)
        return frames

    def _particle_cloud(self, step: int) -> tuple[Array, Array]:
        """(M, 3) points in the belief's plane; (M, 3) colors, from gray at weight 0 to full color at the maximum."""
        trace = self._trace
        assert trace.particles is not None
        assert trace.log_weights is not None
        points = np.full((trace.particles.shape[1], 3), self._level, np.float32)
        points[:, :2] = trace.particles[step][:, self._plane]
        weights = trace.log_weights[step]
        strength = np.sqrt(np.exp(weights - weights.max()))[:, None]
        color = np.array(rgb("fused", trace), np.float32)
        shares = modality_shares(trace, step, self._task) if self._layers.tint == "share" else None
        if shares is not None:
            color = shares.T @ np.array([rgb(name, trace) for name in trace.modalities], np.float32)
            strength = MIN_STRENGTH + (1.0 - MIN_STRENGTH) * strength
        return points, np.rint(GRAY_LEVEL + strength * (color - GRAY_LEVEL)).astype(np.uint8)

    def _disc_poses(self, step: int) -> tuple[Array, Array, Array]:
        """Positions (S, 3), orientations (S, 4) and scales (S, 3) of the discs of all estimates except the truth."""
        plane = np.ix_(range(len(self._estimates) - 1), self._plane)
        means = np.stack([mean[step] for _, mean, _ in self._estimates[1:]])[plane]
        covariances = np.stack([covariance[step] for _, _, covariance in self._estimates[1:]])
        axes, turn = contours(covariances[:, self._plane][:, :, self._plane])
        count = len(means)
        levels = self._level - DISC_SPACING * np.arange(1, count + 1)
        zero = np.zeros(count)
        wxyz = np.stack([np.cos(turn / 2.0), zero, zero, np.sin(turn / 2.0)], axis=1)
        scales = np.concatenate([SIGMAS * np.maximum(axes, MIN_AXIS), np.ones((count, 1))], axis=1)
        return np.column_stack([means, levels]), wxyz, scales

    def _viewpoints(self) -> dict[Viewpoint, tuple[Array, Array]]:
        target = self._anchors[:, 0].mean(axis=0)
        # The bodies of a scene with a robot extend over about a meter.
        if self._replay is None or np.ptp(self._replay.positions[:, 1:], axis=(0, 1)).max() < 0.5:
            low, high, _ = extent(self._task, self._trace)
            height = 0.0 if self._outline is None or self._replay is not None else float(max(self._outline.size))
            target = np.array([*(low + high) / 2.0, height / 3.0])
            # With a replay, the poles of the estimates are half a meter high.
            eye = EYE_GRID * (max((high - low).max(), 1.2 * height) if self._replay is None else 0.5)
        else:
            eye = EYE * (0.6 + 0.4 * min(1.0, target[2]))
            target = target * [0.62, 0.3, 0.68] + [0.0, 0.0, 0.2 * max(0.0, 1.0 - target[2])]
        center = np.array([*self._anchors[:, 0, :2].mean(axis=0), self._level])
        # Not vertically above, where the up direction of the view would be undefined.
        viewpoints: dict[Viewpoint, tuple[Array, Array]] = {
            "first": (target + eye, target),
            "above": (center + EYE_ABOVE * self._task.map_half_width, center),
        }
        if self._camera is not None:
            middle = (self._camera.position + self._camera.target) / 2.0
            distance = np.linalg.norm(self._camera.position - self._camera.target)
            viewpoints["camera"] = middle + distance * EYE_CAMERA, middle
        return viewpoints


def _estimates(trace: Trace) -> Iterator[tuple[str, Array, Array]]:
    """(name, states (T, n), covariances (T, n, n)) of the truth, the fused estimate and the unimodal updates."""
    yield "truth", trace.anchors, np.zeros_like(trace.estimate_covariance)
    yield "fused", trace.estimate_mean, trace.estimate_covariance
    if len(trace.modalities_with_posterior) > 1:
        for k, name in enumerate(trace.modalities_with_posterior):
            yield name, trace.modality_mean[:, k], trace.modality_covariance[:, k]


def modality_shares(trace: Trace, step: int, task: Task) -> Array | None:
    """(K, M) share of each modality in each particle's weight: ``e_k w_k / sum_j e_j w_j``.

    e_k are the effective weights and w_k the particle weights of a unimodal update, which sum to one. So the mean of
    the shares under the fused weights is the effective weight. None if the filter has no separate modalities.
    """
    cloud = particles(trace, step, task)
    if cloud is None or trace.effective_weights is None:
        return None
    joint = trace.effective_weights[step] * cloud[1][:-1]  # effective weights of particle filters are (K, 1)
    total = joint.sum(axis=0)
    shares = joint / np.maximum(total, np.finfo(np.float32).tiny)
    return np.where(total > 0.0, shares, trace.effective_weights[step])
