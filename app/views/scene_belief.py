"""The replay, the filter's belief and the comparison run at one step, as nodes of the 3D scene.

Axes: x away from the robot, y to its left, z up, in m. Colors are those of the recordings (``recordings.schema``).
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
from viser import ViserServer

from beliefscope.app.protocol.messages import SceneLayers
from beliefscope.app.runs.traced_run import TracedRun
from beliefscope.app.views.scene_context import (
    SHADING,
    SMALL_LABEL,
    CameraView,
    FloorMap,
    ForceArrow,
    RobotScene,
    add_grid,
    add_lines,
)
from beliefscope.datasets.simulation.outline import Outline
from beliefscope.datasets.simulation.replay import replay
from beliefscope.datasets.task import Task
from beliefscope.inspect.figures.scene_belief import DISC_SPACING, DrawnBelief, rgb
from beliefscope.inspect.figures.scene_shapes import DISC, FAN, OUTLINE_EDGES, RGB, UP, Array, dashed
from beliefscope.inspect.maps.map_engine import LikelihoodMap
from beliefscope.inspect.statistics.measures import layer_label
from beliefscope.inspect.trace import Trace

POLE_RADIUS = 0.005  # m
FLOOR_MAP_HEIGHT = 0.003  # m above the floor
NEAR, FAR = 0.01, 1000.0  # m, smallest and largest distance that is drawn, viser's defaults
AMBIENT_LIGHT = 1.0  # intensity, in place of the environment map
FLAT = (1.0, 1.0, 0.0)  # factors that project a point to the floor
EDGE_OFFSET = 0.002  # m from the surfaces of an object to the edges of its outline


class BeliefScene:
    """Scene nodes of one trace.

    viewpoints: available viewpoints -> position (3,) of the eye and the point (3,) that it faces, m.
    """

    def __init__(
        self, server: ViserServer, run: TracedRun, trace: Trace, layers: SceneLayers, labels: bool = False
    ) -> None:
        """Draw the first step.

        trace: of the whole run or a part of it, to which the steps of ``move`` refer. labels: whether the estimates
        have labels. The page has a legend instead, which nothing overlaps.
        """
        self._server = server
        self._task = run.checkpoint.task
        self._layers, self._labels = layers, labels
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
        # viser's environment map takes a second to prepare without a GPU, during which the scene is invisible.
        server.scene.configure_environment_map(None)
        server.scene.add_light_ambient("/light", intensity=AMBIENT_LIGHT)
        paths = {"replay": "/bodies", "objects": "/objects", "estimates": "/estimates", "force": "/force"}
        self._roots: dict[str, list[Any]] = {
            layer: [server.scene.add_frame(path, show_axes=False)] for layer, path in paths.items()
        }
        if self._replay is not None:
            self._robot = RobotScene(server, self._replay)
        elif self._task.floor is not None:
            add_grid(server, self._task, trace)
        available = set(run.header["scene"])
        poles = self._belief.names if "estimates" in available else ()
        self._pole_frames = [self._add_pole(i, name) for i, name in enumerate(poles)]
        self._outline_frames = [] if self._belief.outline is None else self._add_outlines(self._belief.outline)
        self._add_layers(available)
        if np.isnan(trace.episode.states).any():  # unknown true state
            for frame in (*self._pole_frames[:1], *self._outline_frames[:1]):
                frame.visible = False
        self.set_layers(layers)
        self.viewpoints = self._belief.viewpoints(self._replay)
        if self._camera is None:
            self.viewpoints.pop("camera", None)
        camera = server.initial_camera
        camera.position, camera.look_at = self.viewpoints["first"]
        camera.fov = np.deg2rad(45.0)
        camera.near, camera.far = drawn_distances(self.viewpoints.values())

    def set_trace(self, trace: Trace) -> None:
        """Use another part of the run: later steps of ``move`` refer to it."""
        self._trace = trace
        self._replay = replay(self._task, trace.episode)
        self._belief = DrawnBelief(self._task, trace)
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
        belief = self._belief
        if self._robot is not None and self._replay is not None:
            self._robot.move(self._replay.positions[step], self._replay.rotations[step])
        for i, frame in enumerate(self._pole_frames):
            frame.position = belief.anchors[step, i] * FLAT
        if self._discs is not None:
            pose = belief.discs(step)
            self._discs.batched_positions, self._discs.batched_wxyzs, self._discs.batched_scales = pose
        if belief.outline is not None:
            for i, frame in enumerate(self._outline_frames):
                frame.position, frame.wxyz = belief.outline.position[step, i], belief.outline.wxyz[step, i]
        if self._particles is not None:
            self._particles.points, self._particles.colors = belief.particles(step, self._layers.tint)
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
            points, colors = self._belief.particles(0, self._layers.tint)
            self._particles = self._server.scene.add_point_cloud(
                "/particles",
                points,
                colors,
                point_size=0.006 * self._belief.scale,
                point_shape="circle",
                precision="float32",
            )
            self._roots["particles"] = [self._particles]
        if "force" in available:
            self._force = ForceArrow(self._server, self._trace)
        if "map" in available:
            # Below all contours; without an outline, the belief lies on the floor and the map below it.
            below = self._belief.level - 2.0 * self._belief.scale * DISC_SPACING * len(self._belief.names)
            floor = below if self._belief.outline is None else FLOOR_MAP_HEIGHT
            self._floor_map = FloorMap(self._server, self._trace, {"floor": floor, "belief": below})
        if "camera" in available:
            self._camera = CameraView(self._server, self._task, self._trace)

    def _add_pole(self, index: int, name: str) -> Any:
        text = "estimate" if name == "fused" and len(self._trace.modalities) < 2 else layer_label(name)
        text = text if self._labels else ""
        color, height = rgb(name, self._trace), self._belief.pole_height(index)
        return add_pole(self._server, f"/estimates/{name}", text, height, POLE_RADIUS * self._belief.scale, color)

    def _add_discs(self) -> Any:
        """Contours as discs: instances of one mesh, because viser recompiles lines whose points change."""
        names = self._belief.names[1:]
        positions, wxyzs, scales = self._belief.discs(0)
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
            **SHADING,
        )

    def _add_outlines(self, outline: Outline) -> list[Any]:
        """Edges of the true and the estimated object; the estimated one is filled with a transparent color."""
        scene = self._server.scene
        edges = OUTLINE_EDGES[outline.shape] * (np.asarray(outline.size) + 2.0 * EDGE_OFFSET)
        frames = []
        for name in self._belief.names[:2]:
            color = rgb(name, self._trace)
            frames.append(scene.add_frame(f"/objects/{name}", show_axes=False))
            add_lines(self._server, f"/objects/{name}/edges", edges, color)
            if name == "fused":
                path, (x, y, z) = f"/objects/{name}/{outline.shape}", map(float, outline.size)
                if outline.shape == "cylinder":
                    scene.add_cylinder(path, x / 2, z, color=color, opacity=0.25, **SHADING)
                else:
                    scene.add_box(path, color, (x, y, z), opacity=0.25, **SHADING)
        return frames


def add_pole(server: ViserServer, path: str, text: str, height: float, radius: float, color: RGB) -> Any:
    """A frame on the floor with a pole of a height in m, and a label on its top unless the text is empty."""
    frame = server.scene.add_frame(path, show_axes=False)
    server.scene.add_cylinder(f"{path}/pole", radius, height, color=color, position=height / 2.0 * UP, **SHADING)
    if text:
        server.scene.add_label(f"{path}/label", text, anchor="bottom-center", position=height * UP, **SMALL_LABEL)
    return frame


def drawn_distances(viewpoints: Iterable[tuple[Array, Array]]) -> tuple[float, float]:
    """Smallest and largest distance from the eye that are drawn, m: more than the defaults in a scene of kilometres."""
    factor = max(1.0, *(3.0 * float(np.linalg.norm(eye - target)) / FAR for eye, target in viewpoints))
    return factor * NEAR, factor * FAR


class ComparisonEstimate:
    """Scene nodes of the comparison run's fused estimate, with a dashed outline."""

    def __init__(self, server: ViserServer, task: Task, trace: Trace) -> None:
        belief, color = DrawnBelief(task, trace), rgb("fused", trace)
        self._anchors, self._outline = belief.anchors[:, 1], belief.outline
        self._root = server.scene.add_frame("/other", show_axes=False)
        height = float(self._anchors[0, 2]) + belief.above  # below the labels of the selected run
        self._pole: Any = add_pole(server, "/other/pole", "comparison run", height, POLE_RADIUS / 2, color)
        self._frame: Any = server.scene.add_frame("/other/outline", show_axes=False)
        if self._outline is not None:
            size = np.asarray(self._outline.size) + 4.0 * EDGE_OFFSET
            add_lines(server, "/other/outline/edges", dashed(OUTLINE_EDGES[self._outline.shape] * size), color)

    def move(self, step: int) -> None:
        """Move all nodes to their poses at a step."""
        self._pole.position = self._anchors[step] * FLAT
        if self._outline is not None:
            self._frame.position, self._frame.wxyz = self._outline.position[step, 1], self._outline.wxyz[step, 1]

    def remove(self) -> None:
        """Remove all nodes from the scene."""
        self._root.remove()
