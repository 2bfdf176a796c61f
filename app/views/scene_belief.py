"""What is drawn in the 3D scene: the replay, and what the filter believes, at one step of a trace.

Axes: x away from the robot, y to its left, z up, m. Colours are the recordings' (``recordings.schema``).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from viser import ViserServer

from beliefscope.app.protocol.map_format import particles
from beliefscope.app.protocol.messages import Look, layers
from beliefscope.app.runs.trace_store import Traced
from beliefscope.app.views.scene_context import (
    SMALL,
    UP,
    Array,
    Force,
    Ground,
    Sight,
    Stage,
    add_plane,
    add_replay,
    extent,
    rgb,
)
from beliefscope.datasets.simulation.replay import replay
from beliefscope.datasets.task import Task
from beliefscope.inspect.likelihood import LikelihoodMap, no_maps
from beliefscope.inspect.statistics.measures import contours
from beliefscope.inspect.trace import Trace

SIGMAS = 2.0
POLE_RADIUS = 0.005  # m
POLE_STEP = 0.06  # m that one pole ends above the next, so that their labels do not meet
BELIEF_ABOVE = 0.10  # m from the anchor to the plane on which particles and contours are drawn
NARROWEST = 1e-6  # m, half an axis of a contour
DISC_STEP = 0.002  # m from one contour down to the next
FLOOR_MAP = 0.003  # m above the floor, and below the contours where they lie on it
PALE = 130.0  # gray of a particle without weight
FAINT = 0.25  # of its hue that one keeps where the hue tells its modalities
EYE = np.array([-0.28, -1.32, 1.22])  # m from what the camera looks at, for what is 1 m high
OVER = np.array([0.0, -0.04, 3.6])  # the eye over the belief, in half widths of a map: x to the right, as on the page
AWAY = np.array([-0.6, -1.6, 0.4])  # the eye that sees the camera, in its distances from what it looks at
BARE_EYE = np.array([-0.5, -1.2, 1.1])  # from the middle of a bare plane, in its sides

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
    """The nodes of one trace in viser's scene, and where they are at each step.

    Attributes:
        viewpoints: of ``VIEWPOINTS`` those that there are: where the eye is (3,) and what it looks at (3,), m.
    """

    def __init__(self, server: ViserServer, traced: Traced, trace: Trace, look: Look) -> None:
        """Trace: of the traced run, or of a part of it, whose steps ``move`` counts then."""
        self._server = server
        self._task = task = traced.checkpoint.task
        self._plane = list(task.map_indices)
        self._take(trace)
        there = layers(task, trace, no_maps(traced.checkpoint, trace))
        scene = server.scene
        scene.set_up_direction("+z")
        scene.world_axes.visible = False
        scene.configure_default_lights(cast_shadow=False)
        self._roots: dict[str, list[Any]] = {
            layer: [scene.add_frame(f"/{name}", show_axes=False)]
            for layer, name in (
                ("replay", "bodies"),
                ("objects", "objects"),
                ("estimates", "estimates"),
                ("force", "force"),
            )
        }
        self._robot = self._stage = None
        if self._replay is not None:
            self._stage = Stage(server, self._replay.model)
            self._robot = add_replay(server, self._replay)
            self._roots["replay"].append(self._robot.fixed_bodies_frame)
        else:
            add_plane(server, task, trace)
        self._above = BELIEF_ABOVE if self._ghost is not None else 0.0
        self._level = float(self._anchors[0, 0, 2]) + self._above
        self._markers = [self._add_marker(i, name) for i, (name, _, _) in enumerate(self._believed)]
        self._outlines = self._add_outlines()
        self._discs = self._particles = self._force = self._ground = self._sight = None
        if "contours" in there:
            self._discs = self._add_discs()
            self._roots["contours"] = [self._discs]
        self._look = look
        if "particles" in there:
            self._particles = self._add_particles()
            self._roots["particles"] = [self._particles]
        if "force" in there:
            self._force = Force(server, trace)
        if "map" in there:
            # Below all contours; where the belief lies on the floor itself, that is below the floor.
            below = self._level - 2.0 * DISC_STEP * len(self._believed)
            self._ground = Ground(server, trace, {"floor": FLOOR_MAP if self._above else below, "belief": below})
        if "camera" in there:
            self._sight = Sight(server, task, trace)
        if np.isnan(trace.episode.states).any():  # nobody knows the truth: it would hide behind the estimate
            for node in (*self._markers[0], *([self._outlines[0]] if self._outlines else [])):
                node.visible = False
        self.look(look)
        self.viewpoints = self._viewpoints()
        camera = server.initial_camera  # a browser that has moved its own keeps it
        camera.position, camera.look_at = self.viewpoints["first"]
        camera.fov = np.deg2rad(45.0)

    def turn_to(self, trace: Trace) -> None:
        """Another part of the run that is drawn: its steps are those of ``move`` from now on."""
        self._take(trace)
        for part in (self._force, self._sight):
            if part is not None:
                part.take(trace)

    def _take(self, trace: Trace) -> None:
        """Where everything is at each step of a trace."""
        self._trace = trace
        self._replay = replay(self._task, trace.episode)
        self._believed = list(_believed(trace))
        states = np.stack([mean for _, mean, _ in self._believed], axis=1)  # (T, S, n)
        self._ghost = None if self._task.ghost is None else self._task.ghost(states)
        flat = np.concatenate([states[..., self._plane], np.zeros_like(states[..., :1])], axis=-1)
        self._anchors = flat if self._ghost is None else self._ghost.anchor  # (T, S, 3)

    def look(self, look: Look) -> None:
        """Show and hide, from the next ``move`` on."""
        self._look = look
        for layer, roots in self._roots.items():
            for root in roots:
                root.visible = layer not in look.hidden
        if self._stage is not None:
            self._stage.see_through(self._ground is not None and "map" not in look.hidden and look.height == "floor")

    def move(self, step: int, maps: LikelihoodMap | None) -> None:
        """Put every node where it belongs at a step. Maps: of the step, where there are any."""
        if self._robot is not None and self._stage is not None and self._replay is not None:
            positions, rotations = self._replay.positions[step], self._replay.rotations[step]
            self._robot.update_from_arrays(positions[None], rotations[None])
            self._stage.move(positions, rotations)
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
        if self._force is not None:
            self._force.show(step)
        if self._ground is not None:
            self._ground.show(maps, self._look)
        if self._sight is not None:
            self._sight.show(step, self._look)

    def _add_marker(self, index: int, name: str) -> tuple[Any, Any]:
        trace, scene = self._trace, self._server.scene
        height = float(self._anchors[0, index, 2]) + self._above + POLE_STEP * (len(self._believed) - index)
        pole = scene.add_cylinder(
            f"/estimates/{name}/pole", POLE_RADIUS, height, color=rgb(name, trace), cast_shadow=False
        )
        called = "estimate" if name == "fused" and len(trace.modalities) < 2 else name
        label = scene.add_label(f"/estimates/{name}/label", called, anchor="bottom-center", **SMALL)
        return pole, label

    def _add_discs(self) -> Any:
        """The 2 sigma contours as discs: instances of one mesh, because a line whose points change is compiled anew."""
        names = [name for name, _, _ in self._believed[1:]]
        positions, wxyzs, scales = self._contours(0)
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
        """The edges of the true and of the estimated object; the estimated one is filled with a breath of colour."""
        if self._ghost is None:
            return {}
        size = np.asarray(self._ghost.size, np.float32)
        outlines = {}
        for i, (name, _, _) in enumerate(self._believed[:2]):
            hue = rgb(name, self._trace)
            outlines[i] = self._server.scene.add_frame(f"/objects/{name}", show_axes=False)
            self._server.scene.add_line_segments(
                f"/objects/{name}/edges",
                (OUTLINES[self._ghost.shape] * (size + 0.004)).astype(np.float32),
                hue,
                thickness=2.0,
                thickness_units="screen",
            )
            if name == "fused":
                fill, x, z = f"/objects/{name}/{self._ghost.shape}", float(size[0]), float(size[2])
                look: dict[str, Any] = {"opacity": 0.25, "cast_shadow": False, "receive_shadow": False}
                if self._ghost.shape == "cylinder":
                    self._server.scene.add_cylinder(fill, x / 2, z, color=hue, **look)
                else:
                    self._server.scene.add_box(fill, hue, tuple(size), **look)
        return outlines

    def _add_particles(self) -> Any:
        points, colours = self._cloud(0)
        return self._server.scene.add_point_cloud(
            "/particles", points, colours, point_size=0.006, point_shape="circle", precision="float32"
        )

    def _cloud(self, step: int) -> tuple[Array, Array]:
        """(M, 3) points on the belief's plane; (M, 3) colours from gray (no weight) to the greatest weight's."""
        trace = self._trace
        assert trace.particles is not None
        assert trace.log_weights is not None
        points = np.full((trace.particles.shape[1], 3), self._level, np.float32)
        points[:, :2] = trace.particles[step][:, self._plane]
        weights = trace.log_weights[step]
        strength = np.sqrt(np.exp(weights - weights.max()))[:, None]
        hue = np.array(rgb("fused", trace), np.float32)
        shares = modality_shares(trace, step, self._task) if self._look.tint == "share" else None
        if shares is not None:
            hue = shares.T @ np.array([rgb(name, trace) for name in trace.modalities], np.float32)
            strength = FAINT + (1.0 - FAINT) * strength
        return points, np.rint(PALE + strength * (hue - PALE)).astype(np.uint8)

    def _contours(self, step: int) -> tuple[Array, Array, Array]:
        """Positions (S, 3), orientations (S, 4) and scales (S, 3) of the unit disc for each source but the truth."""
        plane = np.ix_(range(len(self._believed) - 1), self._plane)
        means = np.stack([mean[step] for _, mean, _ in self._believed[1:]])[plane]
        covariances = np.stack([covariance[step] for _, _, covariance in self._believed[1:]])
        axes, turn = contours(covariances[:, self._plane][:, :, self._plane])
        count = len(means)
        # Apart, the fused one on top: discs in one plane would flicker.
        levels = self._level - DISC_STEP * np.arange(1, count + 1)
        zero = np.zeros(count)
        wxyz = np.stack([np.cos(turn / 2.0), zero, zero, np.sin(turn / 2.0)], axis=1)
        scales = np.concatenate([SIGMAS * np.maximum(axes, NARROWEST), np.ones((count, 1))], axis=1)
        return np.column_stack([means, levels]), wxyz, scales

    def _viewpoints(self) -> dict[str, tuple[Array, Array]]:
        """By their names, where the eye is (3,) and what it looks at (3,), m, world."""
        at, eye = self._anchors[:, 0].mean(axis=0), EYE
        # A robot is about a meter long; without one, all there is lies around the belief.
        if self._replay is None or np.ptp(self._replay.positions[:, 1:], axis=(0, 1)).max() < 0.5:
            low, high, _ = extent(self._task, self._trace)
            tall = 0.0 if self._ghost is None or self._replay is not None else float(max(self._ghost.size))
            at = np.array([*(low + high) / 2.0, tall / 3.0])
            # Beside a replay's objects the masts of the estimates stand half a meter high.
            eye = BARE_EYE * (max((high - low).max(), 1.2 * tall) if self._replay is None else 0.5)
        else:
            eye = EYE * (0.6 + 0.4 * min(1.0, at[2]))
            at = at * [0.62, 0.3, 0.68] + [0.0, 0.0, 0.2 * max(0.0, 1.0 - at[2])]
        over = np.array([*self._anchors[:, 0, :2].mean(axis=0), self._level])
        # A trifle to the side: straight from above, which way is up would be up to chance.
        found = {"first": (at + eye, at), "above": (over + OVER * self._task.map_half_width, over)}
        if self._sight is not None:
            middle = (self._sight.position + self._sight.target) / 2.0
            away = np.linalg.norm(self._sight.position - self._sight.target)
            found["camera"] = middle + away * AWAY, middle
        return found


def _believed(trace: Trace) -> Iterator[tuple[str, Array, Array]]:
    """(name, states (T, n), covariances (T, n, n)): the truth, the fused estimate, each modality's if it is another."""
    yield "truth", trace.anchors, np.zeros_like(trace.estimate_covariance)
    yield "fused", trace.estimate_mean, trace.estimate_covariance
    if len(trace.alone) > 1:
        for k, name in enumerate(trace.alone):
            yield name, trace.modality_mean[:, k], trace.modality_covariance[:, k]


def modality_shares(trace: Trace, step: int, task: Task) -> Array | None:
    """(K, M) share of each modality in each particle's weight: ``acting_k w_k / sum_j acting_j w_j``.

    w_k are the particles' weights as modality k alone sets them, each summing to one. So the shares' mean under the
    fused weights is ``acting``. None where modalities are not told apart.
    """
    cloud = particles(trace, step, task)
    if cloud is None or trace.acting is None:
        return None
    joint = trace.acting[step] * cloud[1][:-1]  # acting of particle filters is (K, 1)
    total = joint.sum(axis=0)
    return np.where(total > 0.0, joint / np.maximum(total, np.finfo(np.float32).tiny), trace.acting[step])
