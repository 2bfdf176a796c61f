"""What is drawn in the 3D scene: the replay, and what the filter believes, at one step of a trace.

Axes: x away from the robot, y to its left, z up, m. Colours are the recordings' (``recordings.schema``).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from mjviser import ViserMujocoScene
from numpy.typing import NDArray
from viser import ViserServer

from beliefscope.app.library import Traced
from beliefscope.datasets.replay import Replay, replay
from beliefscope.datasets.task import Task
from beliefscope.inspect.palette import colour
from beliefscope.inspect.trace import Trace

Array = NDArray[Any]
RGB = tuple[int, int, int]

SIGMAS = 2.0
POLE_RADIUS = 0.005  # m
POLE_STEP = 0.06  # m that one pole ends above the next, so that their labels do not meet
BELIEF_ABOVE = 0.10  # m from the anchor to the plane on which particles and contours are drawn
FORCE_SCALE = 0.004  # m an N
FORCE_LENGTH = 0.30  # m, the longest arrow
PALE = 130.0  # gray of a particle without weight
EYE = np.array([-0.28, -1.32, 1.22])  # m from what the camera looks at, for what is 1 m high
UP = np.array([0.0, 0.0, 1.0])
CELLS = (0.05, 0.1, 0.25, 1.0)  # m between the lines of a bare plane, of which it has MOST_CELLS along a side
MOST_CELLS = 14
BARE_EYE = np.array([-0.5, -1.2, 1.1])  # from the middle of a bare plane, in its sides

MUJOCO_PLANE = 0  # mjtGeom.mjGEOM_PLANE
FLOOR_GRAY = (125, 125, 125)
LINES = np.arange(-1.0, 1.01, 0.25)
FLOOR = np.array(
    [[(-1.0, a, 0.0), (1.0, a, 0.0)] for a in LINES] + [[(a, -1.0, 0.0), (a, 1.0, 0.0)] for a in LINES], np.float32
)
# A unit disc in the plane z = 0: its rim, then its centre; and the triangles between.
ANGLES = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
DISC = np.append(np.stack([np.cos(ANGLES), np.sin(ANGLES), 0.0 * ANGLES], axis=1), [[0.0, 0.0, 0.0]], axis=0)
FAN = np.array([(64, i, (i + 1) % 64) for i in range(64)])
# Corners of the unit box are numbered by their three bits; an edge joins two that differ in one bit.
BOX = np.array([[bit >> axis & 1 for axis in range(3)] for bit in range(8)], np.float32) - 0.5
EDGES = np.array([(a, a | 1 << axis) for a in range(8) for axis in range(3) if not a >> axis & 1])
_RIM = np.stack([DISC[:-1], np.roll(DISC[:-1], -1, axis=0)], axis=1) / 2.0
OUTLINES = {
    "box": BOX[EDGES],
    "cylinder": np.concatenate([_RIM + 0.5 * UP, _RIM - 0.5 * UP, _RIM[::16, :1] + np.array([0.5 * UP, -0.5 * UP])]),
}
"""Shape of a ghost -> (E, 2, 3) its edges, for size 1."""


class Drawing:
    """The nodes of one trace in viser's scene, and where they are at each step."""

    def __init__(self, server: ViserServer, traced: Traced) -> None:
        self._trace = trace = traced.trace
        self._server = server
        self._task = task = traced.checkpoint.task
        self._replay = replay(task, trace.episode)
        server.scene.set_up_direction("+z")
        server.scene.world_axes.visible = False
        server.scene.configure_default_lights(cast_shadow=False)
        self._robot = None if self._replay is None else _add_replay(server, self._replay)
        if self._replay is None:
            _add_plane(server, task, trace)
        x, y = task.map_indices
        self._plane = [x, y]
        self._believed = list(_believed(trace))
        states = np.stack([mean for _, mean, _ in self._believed], axis=1)  # (T, S, n)
        self._ghost = None if task.ghost is None else task.ghost(states)
        flat = np.concatenate([states[..., self._plane], np.zeros_like(states[..., :1])], axis=-1)
        self._anchors = flat if self._ghost is None else self._ghost.anchor  # (T, S, 3)
        self._above = BELIEF_ABOVE if self._ghost is not None else 0.0
        self._level = float(self._anchors[0, 0, 2]) + self._above
        self._markers = [self._add_marker(i, name) for i, (name, _, _) in enumerate(self._believed)]
        self._discs = self._add_discs() if trace.has_covariance else None
        self._outlines = self._add_outlines()
        self._particles = None if trace.particles is None else self._add_particles()
        self._arrow = server.scene.add_arrows(
            "/belief/force",
            np.zeros((1, 2, 3), np.float32),
            rgb("contact", trace),
            shaft_radius=0.008,
            head_radius=0.02,
            head_length=0.05,
            visible=False,
        )
        self._place_camera()

    def move(self, step: int) -> None:
        """Put every node where it belongs at a step."""
        if self._robot is not None and self._replay is not None:
            self._robot.update_from_arrays(self._replay.positions[step][None], self._replay.rotations[step][None])
        for i, (pole, label) in enumerate(self._markers):
            foot = np.array([*self._anchors[step, i, :2], 0.0])
            pole.position = foot + pole.height / 2.0 * UP
            label.position = foot + pole.height * UP
        if self._discs is not None:
            pose = self._contours(step)
            self._discs.batched_positions, self._discs.batched_wxyzs, self._discs.batched_scales = pose
        for i, outline in self._outlines.items():
            assert self._ghost is not None
            outline.position, outline.wxyz = self._ghost.position[step, i], self._ghost.wxyz[step, i]
        if self._particles is not None:
            self._particles.points, self._particles.colors = self._cloud(step)
        self._move_arrow(step)

    def _add_marker(self, index: int, name: str) -> tuple[Any, Any]:
        trace, scene = self._trace, self._server.scene
        height = float(self._anchors[0, index, 2]) + self._above + POLE_STEP * (len(self._believed) - index)
        pole = scene.add_cylinder(
            f"/belief/{name}/pole", POLE_RADIUS, height, color=rgb(name, trace), cast_shadow=False
        )
        called = "estimate" if name == "fused" and len(trace.modalities) < 2 else name
        label = scene.add_label(
            f"/belief/{name}/label", called, font_screen_scale=0.7, anchor="bottom-center", depth_test=False
        )
        return pole, label

    def _add_discs(self) -> Any:
        """The 2 sigma contours as discs: instances of one mesh, because a line whose points change is compiled anew."""
        names = [name for name, _, _ in self._believed[1:]]
        positions, wxyzs, scales = self._contours(0)
        return self._server.scene.add_batched_meshes_simple(
            "/belief/contours",
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
        """The edges of the true and of the estimated object; the estimated one is filled with a breath of colour."""
        if self._ghost is None:
            return {}
        size = np.asarray(self._ghost.size, np.float32)
        outlines = {}
        for i, (name, _, _) in enumerate(self._believed[:2]):
            hue = rgb(name, self._trace)
            outlines[i] = self._server.scene.add_frame(f"/belief/{name}/ghost", show_axes=False)
            self._server.scene.add_line_segments(
                f"/belief/{name}/ghost/edges",
                (OUTLINES[self._ghost.shape] * (size + 0.004)).astype(np.float32),
                hue,
                thickness=2.0,
                thickness_units="screen",
            )
            if name == "fused":
                fill, x, z = f"/belief/{name}/ghost/{self._ghost.shape}", float(size[0]), float(size[2])
                look: dict[str, Any] = {"opacity": 0.25, "cast_shadow": False, "receive_shadow": False}
                if self._ghost.shape == "cylinder":
                    self._server.scene.add_cylinder(fill, x / 2, z, color=hue, **look)
                else:
                    self._server.scene.add_box(fill, hue, tuple(size), **look)
        return outlines

    def _add_particles(self) -> Any:
        points, colours = self._cloud(0)
        return self._server.scene.add_point_cloud(
            "/belief/particles", points, colours, point_size=0.006, point_shape="circle", precision="float32"
        )

    def _cloud(self, step: int) -> tuple[Array, Array]:
        """(M, 3) points on the belief's plane, and (M, 3) colours from gray (no weight) to the greatest weight's."""
        trace = self._trace
        assert trace.particles is not None
        assert trace.log_weights is not None
        points = np.full((trace.particles.shape[1], 3), self._level, np.float32)
        points[:, :2] = trace.particles[step][:, self._plane]
        weights = trace.log_weights[step]
        share = np.sqrt(np.exp(weights - weights.max()))[:, None]
        hue = np.array(rgb("fused", trace), np.float32)
        return points, np.rint(PALE + share * (hue - PALE)).astype(np.uint8)

    def _contours(self, step: int) -> tuple[Array, Array, Array]:
        """Positions (S, 3), orientations (S, 4) and scales (S, 3) of the unit disc for each source but the truth."""
        plane = np.ix_(range(len(self._believed) - 1), self._plane)
        means = np.stack([mean[step] for _, mean, _ in self._believed[1:]])[plane]
        covariances = np.stack([covariance[step] for _, _, covariance in self._believed[1:]]).astype(float)
        values, vectors = np.linalg.eigh(covariances[:, self._plane][:, :, self._plane])
        count = len(means)
        # Millimetres apart, the fused one on top: discs in one plane would flicker.
        levels = self._level - 0.002 * np.arange(1, count + 1)
        turn = np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0]) / 2.0
        zero = np.zeros(count)
        wxyz = np.stack([np.cos(turn), zero, zero, np.sin(turn)], axis=1)
        scales = np.concatenate([SIGMAS * np.sqrt(np.maximum(values, 1e-12)), np.ones((count, 1))], axis=1)
        return np.column_stack([means, levels]), wxyz, scales

    def _move_arrow(self, step: int) -> None:
        seen = self._trace.episode.observations
        touching = bool(self._trace.episode.contact[step]) and {"effector_position", "force"} <= seen.keys()
        self._arrow.visible = touching
        if touching:
            start, force = seen["effector_position"][step], seen["force"][step] * FORCE_SCALE
            length = float(np.linalg.norm(force))
            end = start + force * min(1.0, FORCE_LENGTH / max(length, 1e-9))
            self._arrow.points = np.stack([start, end])[None].astype(np.float32)

    def _place_camera(self) -> None:
        """Where robot, object and belief are seen. A browser that has moved its camera keeps it."""
        at, eye = self._anchors[:, 0].mean(axis=0), EYE
        # A robot is about a meter long; without one, all there is lies around the belief.
        if self._replay is None or np.ptp(self._replay.positions[:, 1:], axis=(0, 1)).max() < 0.5:
            low, high, _ = _extent(self._task, self._trace)
            at = np.array([*(low + high) / 2.0, 0.0])
            # Beside a replay's objects the masts of the estimates stand half a meter high.
            eye = BARE_EYE * ((high - low).max() if self._replay is None else 0.5)
        else:
            eye = EYE * (0.6 + 0.4 * min(1.0, at[2]))
            at = at * [0.62, 0.3, 0.68] + [0.0, 0.0, 0.2 * max(0.0, 1.0 - at[2])]
        camera = self._server.initial_camera
        camera.look_at = at
        camera.position = at + eye
        camera.fov = np.deg2rad(45.0)


def _add_replay(server: ViserServer, replayed: Replay) -> ViserMujocoScene:
    robot = ViserMujocoScene(server, replayed.model, num_envs=1)
    robot.camera_tracking_enabled = False
    for sites in robot.site_handles_by_group.values():
        sites.visible = False
    # Its infinite floor costs more than all the rest: 1.5 s a frame where there is no GPU, lines almost nothing.
    model = replayed.model
    for geom in np.flatnonzero((model.geom_type == MUJOCO_PLANE) & (model.geom_bodyid == 0)):
        server.scene.remove_by_name(f"/fixed_bodies/world/{model.geom(geom).name}")
    server.scene.add_line_segments(
        "/floor", FLOOR, FLOOR_GRAY, thickness=1.0, thickness_units="screen", position=(0.4, 0.0, 0.0)
    )
    return robot


def _add_plane(server: ViserServer, task: Task, trace: Trace) -> None:
    """Where there is no replay: a grid under the belief, and the axes of the two components that span it."""
    low, high, cell = _extent(task, trace)
    at = [np.arange(a, b + cell / 2, cell) for a, b in zip(low, high, strict=True)]
    lines = [((x, low[1], 0), (x, high[1], 0)) for x in at[0]] + [((low[0], y, 0), (high[0], y, 0)) for y in at[1]]
    server.scene.add_line_segments(
        "/plane", np.array(lines, np.float32), FLOOR_GRAY, thickness=1.0, thickness_units="screen"
    )
    ends = np.array([(high[0], low[1], 0.0), (low[0], high[1], 0.0)])
    axes = np.array([((*low, 0.0), end) for end in ends], np.float32)
    server.scene.add_line_segments("/plane/axes", axes, FLOOR_GRAY, thickness=3.0, thickness_units="screen")
    for name, end, edge in zip(task.map_components, ends, high, strict=True):
        text = f"{name.replace('_', ' ')} {100 * edge:.0f} cm"
        server.scene.add_label(f"/plane/{name}", text, position=end, font_screen_scale=0.7, depth_test=False)


def _extent(task: Task, trace: Trace) -> tuple[Array, Array, float]:
    """Lower and upper corner (2,), m, of the whole cells in which the truth and its maps lie, and a cell's side, m."""
    truth = trace.episode.states[:, list(task.map_indices)]
    low, high = truth.min(axis=0) - task.map_half_width, truth.max(axis=0) + task.map_half_width
    cell = next((side for side in CELLS if (high - low).max() <= MOST_CELLS * side), CELLS[-1])
    return np.floor(low / cell) * cell, np.ceil(high / cell) * cell, cell


def _believed(trace: Trace) -> Iterator[tuple[str, Array, Array]]:
    """(name, states (T, n), covariances (T, n, n)): the truth, the fused estimate, each modality's if it is another."""
    yield "truth", trace.episode.states, np.zeros_like(trace.estimate_covariance)
    yield "fused", trace.estimate_mean, trace.estimate_covariance
    if len(trace.alone) > 1:
        for k, name in enumerate(trace.alone):
            yield name, trace.modality_mean[:, k], trace.modality_covariance[:, k]


def rgb(source: str, trace: Trace) -> RGB:
    hue = colour(source, trace.modalities)
    return int(hue[1:3], 16), int(hue[3:5], 16), int(hue[5:7], 16)
