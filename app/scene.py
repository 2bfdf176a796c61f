"""The 3D scene of one view: the replay, and what the filter believes, at one step of a trace.

Axes: x away from the robot, y to its left, z up, m. Colours are the recordings' (``recordings.schema``).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from mjviser import ViserMujocoScene
from numpy.typing import NDArray
from viser import GuiEvent, GuiInputHandle, ViserServer

from beliefscope.app.library import Traced
from beliefscope.app.proxy import EmbeddedViser
from beliefscope.datasets.replay import replay
from beliefscope.inspect.likelihood import LikelihoodMap
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.schema import colour

Array = NDArray[Any]
RGB = tuple[int, int, int]

SIGMAS = 2.0
POLE_RADIUS = 0.005  # m
POLE_STEP = 0.05  # m that one pole ends above the next, so that their labels do not meet
FORCE_SCALE = 0.004  # m an N
FORCE_LENGTH = 0.30  # m, the longest arrow
USER_HOLDS = 0.5  # s after the step was moved in the scene in which an echo does not move the slider under the hand
CIRCLE = np.stack([np.cos(a := np.linspace(0.0, 2.0 * np.pi, 65)), np.sin(a)], axis=1)
BELIEF_ABOVE = 0.10  # m from the anchor to the plane on which particles and contours are drawn
EYE = np.array([-0.35, -1.75, 1.25])  # m from what the camera looks at
PALE = 130.0  # gray of a particle without weight
# Corners of the unit box are numbered by their three bits; an edge joins two that differ in one bit.
BOX = np.array([[bit >> axis & 1 for axis in range(3)] for bit in range(8)], np.float32) - 0.5
EDGES = np.array([(a, a | 1 << axis) for a in range(8) for axis in range(3) if not a >> axis & 1])


class Scene:
    """Draws one trace at a time; ``show`` and ``close`` block and may be called from any thread.

    Args:
        moved: called in another thread with the step that somebody chose in the scene itself.
        dark: whether the background is dark.
    """

    def __init__(self, moved: Callable[[int], None], dark: bool) -> None:
        self.viser = EmbeddedViser()
        self._server = self.viser.server
        self._moved = moved
        self._lock = threading.Lock()
        self._drawing: Drawing | None = None
        self._key = ""
        self._slider: GuiInputHandle[int] | None = None
        self._user_moved = -USER_HOLDS
        self.set_dark(dark)

    def set_dark(self, dark: bool) -> None:
        """Follow the page's colours."""
        self._server.gui.configure_theme(
            dark_mode=dark, show_logo=False, show_share_button=False, control_width="small"
        )
        self._server.flush()

    def show(self, traced: Traced, step: int, maps: LikelihoodMap) -> None:
        """Draw a step of a trace and send it to the browser."""
        with self._lock:
            if self._key != traced.key:
                self._build(traced)
            assert self._drawing is not None
            with self._server.atomic():
                self._drawing.move(step, maps)
                if self._slider is not None and time.monotonic() - self._user_moved > USER_HOLDS:
                    self._slider.value = step
            self._server.flush()

    def close(self) -> None:
        """End the scene's connections and threads."""
        self.viser.close()

    def _build(self, traced: Traced) -> None:
        server = self._server
        with server.atomic():
            server.scene.reset()
            server.gui.reset()
            self._drawing = Drawing(server, traced)
            self._slider = server.gui.add_slider("step", 0, max(1, len(traced.trace) - 1), 1, 0)
            self._slider.on_update(self._on_slider)
            server.gui.main_panel.minimize()
        self._key = traced.key

    def _on_slider(self, event: GuiEvent[GuiInputHandle[int]]) -> None:
        # Without a client it was we who moved it, following the page: that must not go back there.
        if event.client_id is not None:
            self._user_moved = time.monotonic()
            self._moved(int(event.target.value))


class Drawing:
    """The nodes of one trace in viser's scene, and where they are at each step."""

    def __init__(self, server: ViserServer, traced: Traced) -> None:
        self._trace = trace = traced.trace
        self._server = server
        self._task = task = traced.checkpoint.task
        self._replay = replay(task, trace.episode)
        server.scene.set_up_direction("+z")
        server.scene.world_axes.visible = False
        self._robot: ViserMujocoScene | None = None
        if self._replay is not None:
            self._robot = ViserMujocoScene(server, self._replay.model, num_envs=1)
            self._robot.camera_tracking_enabled = False
        x, y = task.map_indices
        self._plane = [x, y]
        self._believed = list(_believed(trace))
        states = np.stack([mean for _, mean, _ in self._believed], axis=1)  # (T, S, n)
        self._ghost = None if task.ghost is None else task.ghost(states)
        flat = np.concatenate([states[..., self._plane], np.zeros_like(states[..., :1])], axis=-1)
        self._anchors = flat if self._ghost is None else self._ghost.anchor  # (T, S, 3)
        self._level = float(self._anchors[0, 0, 2]) + BELIEF_ABOVE
        self._markers = [self._add_marker(i, name) for i, (name, _, _) in enumerate(self._believed)]
        self._outlines = self._add_outlines()
        self._particles = None if trace.particles is None else self._add_particles()
        self._arrow = server.scene.add_arrows(
            "/belief/force",
            np.zeros((1, 2, 3), np.float32),
            _rgb("contact", trace),
            shaft_radius=0.008,
            head_radius=0.02,
            head_length=0.05,
            visible=False,
        )
        self._place_camera()

    def move(self, step: int, maps: LikelihoodMap) -> None:
        """Put every node where it belongs at a step."""
        if self._robot is not None and self._replay is not None:
            self._robot.update_from_arrays(self._replay.positions[step][None], self._replay.rotations[step][None])
        for i, ((_, mean, covariance), (pole, label, ellipse)) in enumerate(
            zip(self._believed, self._markers, strict=True)
        ):
            foot = np.array([*self._anchors[step, i, :2], 0.0])
            pole.position = foot + [0.0, 0.0, pole.height / 2.0]
            label.position = foot + [0.0, 0.0, pole.height]
            if ellipse is not None and covariance is not None:
                ellipse.points = self._ellipse(mean[step], covariance[step])
        for i, outline in self._outlines.items():
            assert self._ghost is not None
            outline.position, outline.wxyz = self._ghost.position[step, i], self._ghost.wxyz[step, i]
        if self._particles is not None:
            self._particles.points, self._particles.colors = self._cloud(step)
        self._move_arrow(step)

    def _add_marker(self, index: int, name: str) -> tuple[Any, Any, Any]:
        trace, scene = self._trace, self._server.scene
        height = float(self._anchors[0, index, 2]) + BELIEF_ABOVE + POLE_STEP * (len(self._believed) - index)
        pole = scene.add_cylinder(
            f"/belief/{name}/pole", POLE_RADIUS, height, color=_rgb(name, trace), cast_shadow=False
        )
        label = scene.add_label(
            f"/belief/{name}/label", name, font_screen_scale=0.75, anchor="bottom-center", depth_test=False
        )
        if name == "truth":
            return pole, label, None
        ellipse = scene.add_line_segments(
            f"/belief/{name}/ellipse",
            np.zeros((64, 2, 3), np.float32),
            _rgb(name, trace),
            thickness=3.0 if name == "fused" else 1.5,
        )
        return pole, label, ellipse

    def _add_outlines(self) -> dict[int, Any]:
        """The edges of the true and of the estimated object; the estimated one is filled with a breath of colour."""
        if self._ghost is None:
            return {}
        size = np.asarray(self._ghost.size, np.float32)
        outlines = {}
        for i, (name, _, _) in enumerate(self._believed[:2]):
            hue = _rgb(name, self._trace)
            outlines[i] = self._server.scene.add_frame(f"/belief/{name}/ghost", show_axes=False)
            self._server.scene.add_line_segments(
                f"/belief/{name}/ghost/edges", (BOX * (size + 0.004))[EDGES], hue, thickness=2.0
            )
            if name == "fused":
                self._server.scene.add_box(
                    f"/belief/{name}/ghost/panel",
                    hue,
                    tuple(size),
                    opacity=0.25,
                    cast_shadow=False,
                    receive_shadow=False,
                )
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
        hue = np.array(_rgb("fused", trace), np.float32)
        return points, np.rint(PALE + share * (hue - PALE)).astype(np.uint8)

    def _ellipse(self, mean: Array, covariance: Array) -> Array:
        """(64, 2, 3) segments of the 2 sigma contour on the belief's plane."""
        values, vectors = np.linalg.eigh(covariance[np.ix_(self._plane, self._plane)].astype(float))
        axes = vectors * np.sqrt(np.maximum(values, 0.0))
        points = np.full((len(CIRCLE), 3), self._level, np.float32)
        points[:, :2] = mean[self._plane] + SIGMAS * CIRCLE @ axes.T
        return np.stack([points[:-1], points[1:]], axis=1)

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
        at = self._anchors[:, 0].mean(axis=0)
        camera = self._server.initial_camera
        camera.look_at = at * [0.6, 0.3, 0.6]
        camera.position = at * [0.6, 0.3, 0.6] + EYE
        camera.fov = np.deg2rad(45.0)


def _believed(trace: Trace) -> Iterator[tuple[str, Array, Array | None]]:
    """(name, states (T, n), covariances (T, n, n)): the truth, the fused estimate, each modality's."""
    yield "truth", trace.episode.states, None
    yield "fused", trace.estimate_mean, trace.estimate_covariance
    for k, name in enumerate(trace.modalities):
        yield name, trace.modality_mean[:, k], trace.modality_covariance[:, k]


def _rgb(source: str, trace: Trace) -> RGB:
    hue = colour(source, trace.modalities)
    return int(hue[1:3], 16), int(hue[3:5], 16), int(hue[5:7], 16)
