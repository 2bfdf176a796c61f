"""Surroundings of the belief in the 3D scene: robot, floor map, camera, contact force."""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from viser import ViserServer
from viser.transforms import SO3

from beliefscope.app.protocol.messages import SceneLayers
from beliefscope.app.protocol.trace_format import camera_images
from beliefscope.datasets.simulation.replay import Replay
from beliefscope.datasets.simulation.shapes import Shape, shapes
from beliefscope.datasets.task import Task
from beliefscope.inspect.diagnostics.plotting import colour_table
from beliefscope.inspect.figures.meshes import mesh_of
from beliefscope.inspect.likelihood import COARSE, LikelihoodMap
from beliefscope.inspect.palette import colour
from beliefscope.inspect.trace import Trace

Array = NDArray[Any]
RGB = tuple[int, int, int]

UP = np.array([0.0, 0.0, 1.0])
SMALL_LABEL: dict[str, Any] = {"font_screen_scale": 0.7, "depth_test": False}
FORCE_SCALE = 0.004  # m per N
MAX_ARROW_LENGTH = 0.30  # m
LOG_RANGE = 40.0  # nats below the peak at the lower end of a map's colors, as on the page
IMAGE_DISTANCE = 0.2  # of the way from the camera to its target
IMAGE_SCALE = 4  # enlargement, so that the browser's smoothing keeps pixels distinguishable
TRANSLUCENT_OPACITY = 0.35
TRANSLUCENT_GRAY = 150  # minimum of each color channel; darker surfaces would vanish against a dark background
GRID_CELLS = (0.05, 0.1, 0.25, 1.0)  # m, candidate cell sizes of the grid below a belief without replay
MAX_GRID_CELLS = 14  # per side

MUJOCO_PLANE = 0  # mjtGeom.mjGEOM_PLANE
GRAY = (125, 125, 125)
_TICKS = np.arange(-1.0, 1.01, 0.25)
FLOOR_LINES = np.array(
    [[(-1.0, a, 0.0), (1.0, a, 0.0)] for a in _TICKS] + [[(a, -1.0, 0.0), (a, 1.0, 0.0)] for a in _TICKS], np.float32
)


def rgb(source: str, trace: Trace) -> RGB:
    """Color of ``truth``, ``fused``, ``contact`` or a modality."""
    color = colour(source, trace.modalities)
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def set_png(handle: Any, prop: str, pixels: NDArray[np.uint8]) -> None:
    """Set the image of a viser handle to (H, W) gray or (H, W, 3) pixels.

    Sets the private property behind viser's ``image``, whose setter takes five times as long and accepts no gray
    images.
    """
    file = BytesIO()
    Image.fromarray(pixels).save(file, "png", compress_level=1)
    setattr(handle, prop, file.getvalue())


class FloorMap:
    """A likelihood map on the floor around the true position, with a rim in the color of its layer."""

    def __init__(self, server: ViserServer, trace: Trace, heights: Mapping[str, float]) -> None:
        """heights: z in m for each choice of ``SceneLayers.height``."""
        self._trace, self._heights = trace, heights
        self._displayed: tuple[LikelihoodMap, SceneLayers] | None = None
        self._image: Any = server.scene.add_image(
            "/map", np.zeros((1, 1, 3), np.uint8), 0.1, 0.1, format="png", receive_shadow=False, visible=False
        )

    def show(self, maps: LikelihoodMap | None, layers: SceneLayers) -> None:
        """Draw the selected layer of the maps, or nothing without maps or if the layer is hidden."""
        self._image.visible = maps is not None and "map" not in layers.hidden
        if maps is None or not self._image.visible:
            return
        if self._displayed is not None and self._displayed[0] is maps and self._displayed[1] == layers:
            return
        self._displayed = maps, layers
        layer = maps.layers.index(layers.ground) if layers.ground in maps.layers else len(maps.layers) - 1
        size = len(maps.offsets_x)
        rim = max(1, size // COARSE)
        cells = np.full((size + 2 * rim, size + 2 * rim, 3), rgb(maps.layers[layer], self._trace), np.uint8)
        cells[rim:-rim, rim:-rim] = map_pixels(maps, layer, layers)
        # viser's images have their top row at the smallest y, as maps have.
        set_png(self._image, "_data", cells)
        self._image.render_width = self._image.render_height = len(cells) * float(maps.offsets_x[1] - maps.offsets_x[0])
        self._image.position = (*map(float, maps.centre), self._heights[layers.height])


def map_pixels(maps: LikelihoodMap, layer: int, layers: SceneLayers) -> NDArray[np.uint8]:
    """(S, S, 3) one map layer in the page's colors; row 0 has the smallest y offset."""
    log = maps.log_likelihood
    color_range = log if layers.range == "same" else log[layer]
    peak = color_range.max()
    if layers.scale == "normalised":
        intensity = np.exp(log[layer] - peak)
    else:
        low = max(color_range.min(), peak - LOG_RANGE)
        intensity = np.clip((log[layer] - low) / max(peak - low, 1e-6), 0.0, 1.0)
    return colour_table(layers.colours)[np.rint(255.0 * intensity).astype(np.uint8)]


class CameraView:
    """The frustum of the task's camera, with the image that the filter received.

    Attributes:
        position, target: (3,) m, world: the camera and the point that it faces.
    """

    def __init__(self, server: ViserServer, task: Task, trace: Trace) -> None:
        camera = task.camera
        assert camera is not None
        self.set_trace(trace)
        forward, up = np.array(camera.forward), np.array(camera.up)
        rotation = np.stack([np.cross(forward, up), -up, forward], axis=1)
        self._frustum: Any = server.scene.add_camera_frustum(
            "/camera",
            camera.field_of_view,
            self._images.shape[2] / self._images.shape[1],
            thickness=1.5,
            thickness_units="screen",
            color=GRAY,
            image=np.repeat(self._pixels(0)[..., None], 3, axis=2),
            format="png",
            wxyz=SO3.from_matrix(rotation).wxyz,
            position=camera.position,
            cast_shadow=False,
            receive_shadow=False,
        )
        # The target is on the floor if the camera faces down, else at a distance of 1 m.
        distance = camera.position[2] / -forward[2] if forward[2] < -0.1 else 1.0
        self._frustum.scale = IMAGE_DISTANCE * distance / self._frustum.compute_canonical_frustum_size()[2]
        self.position, self.target = np.array(camera.position), camera.position + distance * forward

    def set_trace(self, trace: Trace) -> None:
        """Use the images of this trace in ``show``."""
        images = camera_images(trace)
        assert images is not None
        self._images = images

    def show(self, step: int, layers: SceneLayers) -> None:
        """Show the image of a step."""
        self._frustum.visible = "camera" not in layers.hidden
        if self._frustum.visible:
            set_png(self._frustum, "_image_data", self._pixels(step))

    def _pixels(self, step: int) -> NDArray[np.uint8]:
        return self._images[step].repeat(IMAGE_SCALE, axis=0).repeat(IMAGE_SCALE, axis=1)


class ForceArrow:
    """The measured contact force as an arrow of 4 cm per 10 N, labeled in newtons."""

    def __init__(self, server: ViserServer, trace: Trace) -> None:
        self.set_trace(trace)
        self._arrow: Any = server.scene.add_arrows(
            "/force/arrow",
            np.zeros((1, 2, 3), np.float32),
            rgb("contact", trace),
            shaft_radius=0.008,
            head_radius=0.02,
            head_length=0.05,
            visible=False,
        )
        self._label: Any = server.scene.add_label(
            "/force/label", "", anchor="bottom-center", visible=False, **SMALL_LABEL
        )

    def set_trace(self, trace: Trace) -> None:
        """Use the forces of this trace in ``show``."""
        episode = trace.episode
        self._contact = episode.contact.astype(bool)
        self._positions, self._forces = episode.observations["effector_position"], episode.observations["force"]

    def show(self, step: int) -> None:
        """Show the force of a step, if it is in contact."""
        contact = bool(self._contact[step])
        self._arrow.visible = self._label.visible = contact
        if contact:
            start, force = self._positions[step], self._forces[step]
            newtons = float(np.linalg.norm(force))
            end = start + force * min(FORCE_SCALE, MAX_ARROW_LENGTH / max(newtons, 1e-9))
            self._arrow.points = np.stack([start, end])[None].astype(np.float32)
            self._label.text, self._label.position = f"{newtons:.0f} N", end


class RobotScene:
    """The robot and its environment below ``/bodies`` and ``/fixed_bodies``.

    The robot's hand and the objects are separate meshes, which can be translucent so that they do not hide the map.

    Attributes:
        fixed_bodies: handle of the root of all bodies that do not move.
    """

    def __init__(self, server: ViserServer, replay: Replay) -> None:
        self._add_translucent_bodies(server, replay.model)
        from mjviser import ViserMujocoScene  # imports trimesh, which takes a second

        self._robot = ViserMujocoScene(server, replay.model, num_envs=1)
        self._robot.camera_tracking_enabled = False
        self.fixed_bodies = self._robot.fixed_bodies_frame
        for sites in self._robot.site_handles_by_group.values():
            sites.visible = False
        # The infinite floor takes 1.5 s per frame without a GPU, more than everything else. Lines take almost nothing.
        model = replay.model
        for geom in np.flatnonzero((model.geom_type == MUJOCO_PLANE) & (model.geom_bodyid == 0)):
            server.scene.remove_by_name(f"/fixed_bodies/world/{model.geom(geom).name}")
        server.scene.add_line_segments(
            "/floor", FLOOR_LINES, GRAY, thickness=1.0, thickness_units="screen", position=(0.4, 0.0, 0.0)
        )

    def _add_translucent_bodies(self, server: ViserServer, model: Any) -> None:
        """Add meshes of the hand and the objects, and hide these bodies in the ``mujoco.MjModel``."""
        bodies = object_bodies(model) | hand_bodies(model)
        parts = sorted((shape for shape in shapes(model) if bodies[shape.body]), key=_body_and_color)
        self._frames = {
            body: server.scene.add_frame(f"/bodies/{name or body}", show_axes=False)
            for body, name in {(part.body, part.name) for part in parts}
        }
        self._meshes: list[tuple[Any, RGB]] = []
        for i, ((body, rgba), group) in enumerate(groupby(parts, key=_body_and_color)):
            solids = [mesh_of(shape) for shape in group]
            offsets = np.cumsum([0, *(len(part.vertices) for part in solids)])
            red, green, blue = (round(255.0 * channel) for channel in rgba[:3])
            mesh = server.scene.add_mesh_simple(
                f"{self._frames[body].name}/{i}",
                np.concatenate([part.vertices for part in solids]),
                np.concatenate([part.faces + offset for part, offset in zip(solids, offsets, strict=False)]),
                color=(red, green, blue),
                cast_shadow=False,
            )
            self._meshes.append((mesh, (red, green, blue)))
        model.geom_rgba[bodies[model.geom_bodyid], 3] = 0.0

    def move(self, positions: Array, rotations: Array) -> None:
        """Move all bodies: (B, 3) m and (B, 3, 3), one step of ``Replay``."""
        self._robot.update_from_arrays(positions[None], rotations[None])
        for body, frame in self._frames.items():
            frame.position, frame.wxyz = positions[body], SO3.from_matrix(rotations[body]).wxyz

    def set_translucent(self, translucent: bool) -> None:
        """Make the hand and the objects translucent or opaque."""
        for mesh, color in self._meshes:
            mesh.opacity = TRANSLUCENT_OPACITY if translucent else None
            mesh.color = tuple(max(TRANSLUCENT_GRAY, channel) for channel in color) if translucent else color


def object_bodies(model: Any) -> NDArray[np.bool_]:
    """(B,) bodies of a ``mujoco.MjModel`` that belong neither to the robot nor to the world."""
    return ~_robot_bodies(model) & (np.arange(model.nbody) > 0)


def hand_bodies(model: Any) -> NDArray[np.bool_]:
    """(B,) end of a robot: bodies without children, such as fingers, and bodies with only such children."""
    children = np.bincount(model.body_parentid[1:], minlength=model.nbody)
    leaves = _robot_bodies(model) & (children == 0)
    leaf_children = np.bincount(model.body_parentid[leaves], minlength=model.nbody)
    return leaves | (_robot_bodies(model) & (leaf_children > 0) & (leaf_children == children))


def _robot_bodies(model: Any) -> NDArray[np.bool_]:
    """(B,) the kinematic tree with the most joints."""
    joints = np.bincount(model.body_rootid[model.jnt_bodyid], minlength=model.nbody)
    bodies: NDArray[np.bool_] = model.body_rootid == joints.argmax()
    return bodies


def _body_and_color(shape: Shape) -> tuple[int, tuple[float, ...]]:
    return shape.body, tuple(shape.rgba)


def add_grid(server: ViserServer, task: Task, trace: Trace) -> None:
    """For tasks without replay: a grid under the belief and the axes of the two map components."""
    low, high, cell = extent(task, trace)
    ticks = [np.arange(a, b + cell / 2, cell) for a, b in zip(low, high, strict=True)]
    lines = [((x, low[1], 0), (x, high[1], 0)) for x in ticks[0]]
    lines += [((low[0], y, 0), (high[0], y, 0)) for y in ticks[1]]
    server.scene.add_line_segments("/plane", np.array(lines, np.float32), GRAY, thickness=1.0, thickness_units="screen")
    ends = np.array([(high[0], low[1], 0.0), (low[0], high[1], 0.0)])
    axes = np.array([((*low, 0.0), end) for end in ends], np.float32)
    server.scene.add_line_segments("/plane/axes", axes, GRAY, thickness=3.0, thickness_units="screen")
    for name, end, edge in zip(task.map_components, ends, high, strict=True):
        text = f"{name.replace('_', ' ')} {100 * edge:.0f} cm"
        server.scene.add_label(f"/plane/{name}", text, position=end, **SMALL_LABEL)


def extent(task: Task, trace: Trace) -> tuple[Array, Array, float]:
    """Lower and upper corner (2,), m, of the grid cells that contain the truth and its maps; and the cell size, m."""
    truth = trace.anchors[:, list(task.map_indices)]
    low, high = truth.min(axis=0) - task.map_half_width, truth.max(axis=0) + task.map_half_width
    cell = next((size for size in GRID_CELLS if (high - low).max() <= MAX_GRID_CELLS * size), GRID_CELLS[-1])
    return np.floor(low / cell) * cell, np.ceil(high / cell) * cell, cell
