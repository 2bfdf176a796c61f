"""Surroundings of the belief in the 3D scene: robot, floor map, camera, contact force."""

from collections.abc import Mapping
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from viser import ViserServer
from viser.transforms import SO3

from beliefscope.app.protocol.messages import SceneLayers
from beliefscope.datasets.simulation.replay import Replay
from beliefscope.datasets.simulation.shapes import hand_bodies, object_bodies
from beliefscope.datasets.task import Task, display_name
from beliefscope.inspect.figures.force_arrow import MAX_RINGS, DrawnForce
from beliefscope.inspect.figures.scene_belief import camera_axis, rgb
from beliefscope.inspect.figures.scene_shapes import (
    DISC,
    FAN,
    RGB,
    Array,
    ColoredMesh,
    body_meshes,
    framed,
    grid,
    map_pixels,
)
from beliefscope.inspect.figures.soft_shadows import SoftShadows
from beliefscope.inspect.maps.map_engine import LikelihoodMap
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.sensors import camera_images

# Three times as fast as viser's standard material where the browser renders in software.
SHADING: dict[str, Any] = {"material": "toon5", "cast_shadow": False, "receive_shadow": False}
SMALL_LABEL: dict[str, Any] = {"font_screen_scale": 0.7, "depth_test": False}
IMAGE_DISTANCE = 0.2  # of the way from the camera to its target
IMAGE_SCALE = 4  # enlargement, so that the browser's smoothing keeps pixels distinguishable
TRANSLUCENT_OPACITY = 0.35
TRANSLUCENT_GRAY = 150  # minimum of each color channel; darker surfaces would vanish against a dark background

GRAY = (125, 125, 125)
_TICKS = np.arange(-1.0, 1.01, 0.25)
FLOOR_LINES = np.array(
    [[(-1.0, a, 0.0), (1.0, a, 0.0)] for a in _TICKS] + [[(a, -1.0, 0.0), (a, 1.0, 0.0)] for a in _TICKS], np.float32
)
FLOOR_CENTRE = (0.4, 0.0)  # m
FLOOR_HALF_WIDTH = 1.0  # m
SHADOW_HEIGHT = -0.002  # m, below the lines of the floor


def set_png(handle: Any, prop: str, pixels: NDArray[np.uint8]) -> None:
    """Set the image of a viser handle to (H, W) gray, (H, W, 2) gray and opacity, or (H, W, 3) pixels.

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
        self._heights = heights
        self._colors = {layer: rgb(layer, trace) for layer in (*trace.modalities, "fused")}
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
        pixels = map_pixels(maps, layer, layers.colours, layers.scale == "log", layers.range == "same")
        cells = framed(pixels, self._colors[maps.layers[layer]])
        # viser's images have their top row at the smallest y, as maps have.
        set_png(self._image, "_data", cells)
        self._image.render_width = self._image.render_height = len(cells) * float(maps.offsets_x[1] - maps.offsets_x[0])
        self._image.position = (*map(float, maps.centre), self._heights[layers.height])


class CameraView:
    """The frustum of the task's camera, with the image that the filter received."""

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
        position, target = camera_axis(camera)
        size = self._frustum.compute_canonical_frustum_size()[2]
        self._frustum.scale = IMAGE_DISTANCE * float(np.linalg.norm(target - position)) / size

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
    """The measured contact force as an arrow with rings, labeled with the force and their spacing."""

    def __init__(self, server: ViserServer, trace: Trace) -> None:
        self.set_trace(trace)
        color = rgb("contact", trace)
        self._root: Any = server.scene.add_frame("/force/contact", show_axes=False, visible=False)
        self._arrow: Any = server.scene.add_arrows(
            "/force/contact/arrow", np.zeros((1, 2, 3), np.float32), color, shaft_radius=0.006, head_radius=0.016
        )
        # Seen from the side, the discs are rings around the shaft.
        self._rings: Any = server.scene.add_batched_meshes_simple(
            "/force/contact/rings",
            DISC,
            FAN,
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (MAX_RINGS, 1)),
            batched_positions=np.zeros((MAX_RINGS, 3)),
            batched_scales=np.zeros((MAX_RINGS, 3)),
            batched_colors=np.array(color, np.uint8) // 2,
            side="double",
            lod="off",
            **SHADING,
        )
        self._label: Any = server.scene.add_label("/force/contact/label", "", anchor="bottom-center", **SMALL_LABEL)

    def set_trace(self, trace: Trace) -> None:
        """Use the forces of this trace in ``show``."""
        self._force = DrawnForce(trace)

    def show(self, step: int) -> None:
        """Show the force of a step, if it is in contact."""
        drawn = self._force.at(step)
        self._root.visible = drawn is not None
        if drawn is None:
            return
        self._arrow.points, self._arrow.head_length = drawn.arrow[None].astype(np.float32), drawn.head_length
        self._rings.batched_positions, self._rings.batched_wxyzs, self._rings.batched_scales = drawn.rings
        self._label.text, self._label.position = drawn.text, drawn.label


class RobotScene:
    """The robot and its environment below ``/bodies``.

    The robot's hand and the objects can be translucent so that they do not hide the map.
    """

    def __init__(self, server: ViserServer, replay: Replay) -> None:
        model, parts = replay.model, body_meshes(replay.model)
        movable = hand_bodies(model) | object_bodies(model)
        self._frames = {
            body: server.scene.add_frame(f"/bodies/{model.body(body).name or body}", show_axes=False)
            for body in {part.body for part in parts}
        }
        self._movable: list[tuple[Any, ColoredMesh]] = []
        for i, part in enumerate(parts):
            path = f"{self._frames[part.body].name}/{i}"
            opacity = part.opacity if part.opacity < 1.0 else None
            mesh = server.scene.add_mesh_simple(
                path, part.vertices, part.faces, color=part.color, opacity=opacity, **SHADING
            )
            if movable[part.body]:
                self._movable.append((mesh, part))
        add_lines(server, "/floor", FLOOR_LINES + np.array([*FLOOR_CENTRE, 0.0]), GRAY, thickness=1.0)
        # The renderer's own shadows need the slow material and halve the frame rate again.
        self._shadows = SoftShadows(parts, FLOOR_CENTRE, FLOOR_HALF_WIDTH)
        self._shadow_image: Any = server.scene.add_image(
            "/bodies/shadows",
            np.zeros((1, 1, 3), np.uint8),
            1.0,
            1.0,
            format="png",
            cast_shadow=False,
            receive_shadow=False,
        )

    def move(self, positions: Array, rotations: Array) -> None:
        """Move all bodies: (B, 3) m and (B, 3, 3), one step of ``Replay``."""
        for body, frame in self._frames.items():
            frame.position, frame.wxyz = positions[body], SO3.from_matrix(rotations[body]).wxyz
        self._show_shadows(np.rint(255.0 * self._shadows.opacity(positions, rotations)).astype(np.uint8))

    def _show_shadows(self, opacity: NDArray[np.uint8]) -> None:
        """Show the part of the image with shadows: without a GPU, transparent pixels cost as much as others.

        A transparent pixel on each side keeps their edges soft.
        """
        rows, columns = (np.flatnonzero(opacity.max(axis=axis)) for axis in (1, 0))
        self._shadow_image.visible = bool(rows.size)
        if not rows.size:
            return
        first, last = np.array([columns[0], rows[0]]), np.array([columns[-1], rows[-1]]) + 1
        shadow = np.pad(opacity[first[1] : last[1], first[0] : last[0]], 1)
        set_png(self._shadow_image, "_data", np.stack([np.zeros_like(shadow), shadow], axis=-1))
        pixel = 2.0 * FLOOR_HALF_WIDTH / len(opacity)
        self._shadow_image.scale = (*(pixel * (last - first + 2)), 1.0)
        centre = FLOOR_CENTRE + pixel * (first + last) / 2.0 - FLOOR_HALF_WIDTH
        self._shadow_image.position = (*centre, SHADOW_HEIGHT)

    def set_translucent(self, translucent: bool) -> None:
        """Make the hand and the objects translucent, or as opaque as in the model."""
        for mesh, part in self._movable:
            opacity = min(part.opacity, TRANSLUCENT_OPACITY) if translucent else part.opacity
            mesh.opacity = opacity if opacity < 1.0 else None
            mesh.color = tuple(max(TRANSLUCENT_GRAY, channel) for channel in part.color) if translucent else part.color


def add_lines(server: ViserServer, path: str, lines: Array, color: RGB, thickness: float = 2.0) -> None:
    """Add line segments (N, 2, 3) in m. thickness: pixels."""
    server.scene.add_line_segments(path, lines.astype(np.float32), color, thickness=thickness, thickness_units="screen")


def add_grid(server: ViserServer, task: Task, trace: Trace) -> None:
    """For tasks without replay: a grid under the belief and the axes of the two map components."""
    floor = grid(task, trace)
    for path, lines, thickness in (("/plane", floor.lines, 1.0), ("/plane/axes", floor.axes, 3.0)):
        add_lines(server, path, lines, GRAY, thickness)
    unit, factor = task.main_error.conversion
    for name, axis, edge in zip(task.map_components, floor.axes, floor.high, strict=True):
        text = f"{display_name(name)} {round(factor * edge, 6):zg} {unit}"
        server.scene.add_label(f"/plane/{name}", text, position=axis[1], **SMALL_LABEL)
