"""What stands around the belief in the 3D scene: the replay, the map on the floor, the camera, the force felt."""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from itertools import groupby
from typing import Any

import numpy as np
from mjviser import ViserMujocoScene
from numpy.typing import NDArray
from PIL import Image
from viser import ViserServer
from viser.transforms import SO3

from beliefscope.app.protocol.messages import Look, pictures
from beliefscope.datasets.simulation.replay import Replay
from beliefscope.datasets.simulation.shapes import Shape, shapes
from beliefscope.datasets.task import Task
from beliefscope.inspect.diagnostics.plotting import colour_table
from beliefscope.inspect.figures.meshes import solid
from beliefscope.inspect.likelihood import COARSE, LikelihoodMap
from beliefscope.inspect.palette import colour
from beliefscope.inspect.trace import Trace

Array = NDArray[Any]
RGB = tuple[int, int, int]

UP = np.array([0.0, 0.0, 1.0])
SMALL: dict[str, Any] = {"font_screen_scale": 0.7, "depth_test": False}
"""How labels are written."""
FORCE_SCALE = 0.004  # m an N
FORCE_LENGTH = 0.30  # m, the longest arrow
LOG_SHOWN = 40.0  # nats below the peak at the lower end of a map's colours, as on the page
SIGHT = 0.2  # of the way from the camera to what it looks at: where its picture hangs
ENLARGED = 4  # times, so that the browser's smoothing leaves a picture's pixels apart
GLASS = 0.35  # opacity of what the map on the floor is seen through
GLASS_GRAY = 150  # of each colour of it, at least: darker glass would not be seen before a dark ground
CELLS = (0.05, 0.1, 0.25, 1.0)  # m between the lines of a bare plane, of which it has MOST_CELLS along a side
MOST_CELLS = 14

MUJOCO_PLANE = 0  # mjtGeom.mjGEOM_PLANE
FLOOR_GRAY = (125, 125, 125)
LINES = np.arange(-1.0, 1.01, 0.25)
FLOOR = np.array(
    [[(-1.0, a, 0.0), (1.0, a, 0.0)] for a in LINES] + [[(a, -1.0, 0.0), (a, 1.0, 0.0)] for a in LINES], np.float32
)


def rgb(source: str, trace: Trace) -> RGB:
    """Of ``truth``, ``fused``, ``contact`` or a modality."""
    hue = colour(source, trace.modalities)
    return int(hue[1:3], 16), int(hue[3:5], 16), int(hue[5:7], 16)


def show_png(handle: Any, prop: str, pixels: NDArray[np.uint8]) -> None:
    """Have a handle of viser's show these pixels, (H, W) gray or (H, W, 3).

    Its own ``image`` takes five times as long, and no gray: that was most of what it takes to move a scene. So this
    sets the property, other than public, that ``image`` sets.
    """
    file = BytesIO()
    Image.fromarray(pixels).save(file, "png", compress_level=1)
    setattr(handle, prop, file.getvalue())


class Ground:
    """A likelihood map on the floor, about the true position; its rim has the colour of its layer."""

    def __init__(self, server: ViserServer, trace: Trace, levels: Mapping[str, float]) -> None:
        """levels: m, by a look's ``height``."""
        self._trace, self._levels = trace, levels
        self._drawn: tuple[LikelihoodMap, Look] | None = None
        self._image: Any = server.scene.add_image(
            "/map", np.zeros((1, 1, 3), np.uint8), 0.1, 0.1, format="png", receive_shadow=False, visible=False
        )

    def show(self, maps: LikelihoodMap | None, look: Look) -> None:
        """Lay it down, unless it is there already. Without maps, or where it is hidden, there is none."""
        wanted = maps is not None and "map" not in look.hidden
        self._image.visible = wanted
        if maps is None or not wanted:
            return
        if self._drawn is not None and self._drawn[0] is maps and self._drawn[1] == look:
            return
        self._drawn = maps, look
        layer = maps.layers.index(look.ground) if look.ground in maps.layers else len(maps.layers) - 1
        size = len(maps.offsets_x)
        rim = max(1, size // COARSE)
        cells = np.full((size + 2 * rim, size + 2 * rim, 3), rgb(maps.layers[layer], self._trace), np.uint8)
        cells[rim:-rim, rim:-rim] = paint(maps, layer, look)
        # viser's pictures have their top row at the smallest y, as maps have.
        show_png(self._image, "_data", cells)
        self._image.render_width = self._image.render_height = len(cells) * float(maps.offsets_x[1] - maps.offsets_x[0])
        self._image.position = (*map(float, maps.centre), self._levels[look.height])


def paint(maps: LikelihoodMap, layer: int, look: Look) -> NDArray[np.uint8]:
    """(S, S, 3) one layer in the colours that the page shows it in, row 0 the smallest y offset."""
    log = maps.log_likelihood
    of = log if look.range == "same" else log[layer]
    top = of.max()
    if look.scale == "normalised":
        share = np.exp(log[layer] - top)
    else:
        low = max(of.min(), top - LOG_SHOWN)
        share = np.clip((log[layer] - low) / max(top - low, 1e-6), 0.0, 1.0)
    return colour_table(look.colours)[np.rint(255.0 * share).astype(np.uint8)]


class Sight:
    """The camera that took the pictures, and the picture as the filter saw it.

    Attributes:
        position, target: (3,) m: where it is, and what it looks at.
    """

    def __init__(self, server: ViserServer, task: Task, trace: Trace) -> None:
        camera = task.camera
        assert camera is not None
        self.take(trace)
        seen = self._seen
        forward, up = np.array(camera.forward), np.array(camera.up)
        turn = np.stack([np.cross(forward, up), -up, forward], axis=1)
        self._frustum: Any = server.scene.add_camera_frustum(
            "/camera",
            camera.field_of_view,
            seen.shape[2] / seen.shape[1],
            thickness=1.5,
            thickness_units="screen",
            color=FLOOR_GRAY,
            image=np.repeat(self._picture(0)[..., None], 3, axis=2),
            format="png",
            wxyz=SO3.from_matrix(turn).wxyz,
            position=camera.position,
            cast_shadow=False,
            receive_shadow=False,
        )
        # Down to the ground, where a camera looks down; else to what lies a meter before it.
        far = camera.position[2] / -forward[2] if forward[2] < -0.1 else 1.0
        self._frustum.scale = SIGHT * far / self._frustum.compute_canonical_frustum_size()[2]
        self.position, self.target = np.array(camera.position), camera.position + far * forward

    def take(self, trace: Trace) -> None:
        """The steps that ``show`` counts."""
        seen = pictures(trace)
        assert seen is not None
        self._seen = seen

    def show(self, step: int, look: Look) -> None:
        """The picture of a step."""
        self._frustum.visible = "camera" not in look.hidden
        if self._frustum.visible:
            show_png(self._frustum, "_image_data", self._picture(step))

    def _picture(self, step: int) -> NDArray[np.uint8]:
        return self._seen[step].repeat(ENLARGED, axis=0).repeat(ENLARGED, axis=1)


class Force:
    """What the hand feels where it touches, as an arrow of 4 cm for 10 N, with its newtons."""

    def __init__(self, server: ViserServer, trace: Trace) -> None:
        self.take(trace)
        self._arrow: Any = server.scene.add_arrows(
            "/force/arrow",
            np.zeros((1, 2, 3), np.float32),
            rgb("contact", trace),
            shaft_radius=0.008,
            head_radius=0.02,
            head_length=0.05,
            visible=False,
        )
        self._label: Any = server.scene.add_label("/force/label", "", anchor="bottom-center", visible=False, **SMALL)

    def take(self, trace: Trace) -> None:
        """The steps that ``show`` counts."""
        episode = trace.episode
        self._contact = episode.contact.astype(bool)
        self._at, self._force = episode.observations["effector_position"], episode.observations["force"]

    def show(self, step: int) -> None:
        """The force of a step: none but in contact."""
        touching = bool(self._contact[step])
        self._arrow.visible = self._label.visible = touching
        if touching:
            start, force = self._at[step], self._force[step]
            newtons = float(np.linalg.norm(force))
            end = start + force * min(FORCE_SCALE, FORCE_LENGTH / max(newtons, 1e-9))
            self._arrow.points = np.stack([start, end])[None].astype(np.float32)
            self._label.text, self._label.position = f"{newtons:.0f} N", end


class Stage:
    """What the robot works on and its hand, below ``/bodies``: where the map lies, which is seen through them."""

    def __init__(self, server: ViserServer, model: Any) -> None:
        """Model: a ``mujoco.MjModel``, in which these shapes are hidden from now on."""
        bodies = around(model) | hand(model)
        parts = sorted((shape for shape in shapes(model) if bodies[shape.body]), key=_body_and_colour)
        self._frames = {
            body: server.scene.add_frame(f"/bodies/{name or body}", show_axes=False)
            for body, name in {(p.body, p.name) for p in parts}
        }
        self._meshes: list[tuple[Any, RGB]] = []
        for i, ((body, rgba), group) in enumerate(groupby(parts, key=_body_and_colour)):
            solids = [solid(shape) for shape in group]
            first = np.cumsum([0, *(len(one.vertices) for one in solids)])
            red, green, blue = (round(255.0 * part) for part in rgba[:3])
            mesh = server.scene.add_mesh_simple(
                f"{self._frames[body].name}/{i}",
                np.concatenate([one.vertices for one in solids]),
                np.concatenate([one.faces + at for one, at in zip(solids, first, strict=False)]),
                color=(red, green, blue),
                cast_shadow=False,
            )
            self._meshes.append((mesh, (red, green, blue)))
        model.geom_rgba[bodies[model.geom_bodyid], 3] = 0.0

    def move(self, positions: Array, rotations: Array) -> None:
        """Where each body is: (B, 3) m and (B, 3, 3), as a step of ``Replay`` has them."""
        for body, frame in self._frames.items():
            frame.position, frame.wxyz = positions[body], SO3.from_matrix(rotations[body]).wxyz

    def see_through(self, through: bool) -> None:
        """Make glass of it, or what it was."""
        for mesh, own in self._meshes:
            mesh.opacity = GLASS if through else None
            mesh.color = (*(max(GLASS_GRAY, part) for part in own),) if through else own


def around(model: Any) -> NDArray[np.bool_]:
    """(B,) which bodies of a ``mujoco.MjModel`` are not the robot's, whose tree has the most joints, nor the world."""
    return ~_robot(model) & (np.arange(model.nbody) > 0)


def hand(model: Any) -> NDArray[np.bool_]:
    """(B,) the end of a robot: what nothing hangs on, as fingers, and what only such hang on."""
    children = np.bincount(model.body_parentid[1:], minlength=model.nbody)
    last = _robot(model) & (children == 0)
    held = np.bincount(model.body_parentid[last], minlength=model.nbody)
    return last | (_robot(model) & (held > 0) & (held == children))


def _robot(model: Any) -> NDArray[np.bool_]:
    joints = np.bincount(model.body_rootid[model.jnt_bodyid], minlength=model.nbody)
    found: NDArray[np.bool_] = model.body_rootid == joints.argmax()
    return found


def _body_and_colour(shape: Shape) -> tuple[int, tuple[float, ...]]:
    return shape.body, tuple(shape.rgba)


def add_replay(server: ViserServer, replayed: Replay) -> ViserMujocoScene:
    """The robot as it was, and its world, below ``/bodies`` and ``/fixed_bodies``."""
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


def add_plane(server: ViserServer, task: Task, trace: Trace) -> None:
    """Where there is no replay: a grid under the belief, and the axes of the two components that span it."""
    low, high, cell = extent(task, trace)
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
        server.scene.add_label(f"/plane/{name}", text, position=end, **SMALL)


def extent(task: Task, trace: Trace) -> tuple[Array, Array, float]:
    """Lower and upper corner (2,), m, of the whole cells in which the truth and its maps lie, and a cell's side, m."""
    truth = trace.anchors[:, list(task.map_indices)]
    low, high = truth.min(axis=0) - task.map_half_width, truth.max(axis=0) + task.map_half_width
    cell = next((side for side in CELLS if (high - low).max() <= MOST_CELLS * side), CELLS[-1])
    return np.floor(low / cell) * cell, np.ceil(high / cell) * cell, cell
