"""Shapes of a 3D scene: unit disc, outlines of objects, grid, and maps as images."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.simulation.shapes import Shape, shapes
from beliefscope.datasets.task import Task
from beliefscope.inspect.figures.meshes import mesh_of
from beliefscope.inspect.maps.map_engine import COARSE, LikelihoodMap
from beliefscope.inspect.maps.plane import plane_of
from beliefscope.inspect.palette import colour_table
from beliefscope.inspect.trace import Trace

Array = NDArray[Any]
RGB = tuple[int, int, int]

UP = np.array([0.0, 0.0, 1.0])
DASHES = 5  # per edge, with gaps of the same length
SHORT_EDGE = 0.03  # m: of shorter edges, every second one is drawn without gaps
LOG_RANGE = 40.0  # nats below the peak at the lower end of a map's colors, as on the page
GRID_CELLS = (0.002, 0.005, 0.01, 0.05, 0.1, 0.25, *np.outer(10.0 ** np.arange(6), (1.0, 5.0)).ravel())
"""Candidate cell sizes of the grid, m."""

MAX_GRID_CELLS = 14  # per side

# A unit disc in the plane z = 0: vertices on its rim, then its center; and the triangles between them.
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
DISC = np.append(np.stack([np.cos(_ANGLES), np.sin(_ANGLES), 0.0 * _ANGLES], axis=1), [[0.0, 0.0, 0.0]], axis=0)
FAN = np.array([(64, i, (i + 1) % 64) for i in range(64)])
# The bits of a corner's number are its coordinates in the unit box; an edge joins two corners that differ in one bit.
_BOX = np.array([[bit >> axis & 1 for axis in range(3)] for bit in range(8)], np.float32) - 0.5
_EDGES = np.array([(a, a | 1 << axis) for a in range(8) for axis in range(3) if not a >> axis & 1])
_RIM = np.stack([DISC[:-1], np.roll(DISC[:-1], -1, axis=0)], axis=1) / 2.0
OUTLINE_EDGES = {
    "box": _BOX[_EDGES],
    "cylinder": np.concatenate([_RIM + 0.5 * UP, _RIM - 0.5 * UP, _RIM[::16, :1] + np.array([0.5 * UP, -0.5 * UP])]),
}
"""Shape of an outline -> (E, 2, 3) its edges, at size 1."""


def dashed(edges: Array) -> Array:
    """Edges (E, 2, 3) in m as dashes (D, 2, 3)."""
    start, along = edges[:, :1], edges[:, 1:] - edges[:, :1]
    short = np.linalg.norm(along[:, 0], axis=-1) < SHORT_EDGE
    fractions = (np.arange(2 * DASHES) / (2 * DASHES - 1)).reshape(1, DASHES, 2, 1)
    dashes = start[~short, None] + fractions * along[~short, None]
    return np.concatenate([dashes.reshape(-1, 2, 3), edges[short][::2]])


def map_pixels(maps: LikelihoodMap, layer: int, palette: str, log_scale: bool, same_range: bool) -> NDArray[np.uint8]:
    """(S, S, 3) one map layer in the page's colors; row 0 has the smallest y offset.

    Args:
        palette: name of a color table. log_scale: linear in the log-likelihood instead of the likelihood.
        same_range: one color range for all layers.
    """
    log = maps.log_likelihood
    color_range = log if same_range else log[layer]
    peak = color_range.max()
    if log_scale:
        low = max(color_range.min(), peak - LOG_RANGE)
        intensity = np.clip((log[layer] - low) / max(peak - low, 1e-6), 0.0, 1.0)
    else:
        intensity = np.exp(log[layer] - peak)
    return colour_table(palette)[np.rint(255.0 * intensity).astype(np.uint8)]


def framed(pixels: NDArray[np.uint8], color: RGB) -> NDArray[np.uint8]:
    """A map's pixels (S, S, 3) with a rim, as wide as a cell of a coarse map."""
    rim = max(1, len(pixels) // COARSE)
    frame = np.full((len(pixels) + 2 * rim, len(pixels) + 2 * rim, 3), color, np.uint8)
    frame[rim:-rim, rim:-rim] = pixels
    return frame


@dataclass(frozen=True)
class Grid:
    """Grid below the belief of a task without replay.

    Attributes:
        low, high: (2,) m, corners. lines: (N, 2, 3) m. axes: (2, 2, 3) m, from the lower corner along x and along y.
    """

    low: Array
    high: Array
    lines: Array
    axes: Array


def on_floor(task: Task, values: Array) -> Array:
    """(..., 2) m: x and y of values (..., n); zeros for a task whose map is no position (``Task.floor``)."""
    return np.zeros((*values.shape[:-1], 2)) if task.floor is None else values[..., list(task.floor)]


def grid(task: Task, trace: Trace) -> Grid:
    """The grid of whole cells that contains the truth and its maps."""
    truth, margin = on_floor(task, trace.anchors), 1.0 if task.floor is None else plane_of(trace).half_widths[0]
    low, high = truth.min(axis=0) - margin, truth.max(axis=0) + margin
    cell = next((size for size in GRID_CELLS if (high - low).max() <= MAX_GRID_CELLS * size), GRID_CELLS[-1])
    low, high = np.floor(low / cell) * cell, np.ceil(high / cell) * cell
    x, y = (np.arange(a, b + cell / 2, cell) for a, b in zip(low, high, strict=True))
    lines = [((at, low[1], 0), (at, high[1], 0)) for at in x] + [((low[0], at, 0), (high[0], at, 0)) for at in y]
    axes = [((*low, 0.0), (high[0], low[1], 0.0)), ((*low, 0.0), (low[0], high[1], 0.0))]
    return Grid(low, high, np.array(lines, np.float32), np.array(axes, np.float32))


@dataclass(frozen=True)
class ColoredMesh:
    """Shapes of one color of a body, in the body's frame. vertices: (V, 3) m. faces: (F, 3). opacity: 0..1."""

    body: int
    color: RGB
    opacity: float
    vertices: Array
    faces: Array


def body_meshes(model: Any) -> list[ColoredMesh]:
    """Meshes of all bodies of a ``mujoco.MjModel``, one for each body and color."""
    meshes = []
    for (body, rgba), group in groupby(sorted(shapes(model), key=_body_and_color), key=_body_and_color):
        solids = [mesh_of(shape) for shape in group]
        offsets = np.cumsum([0, *(len(part.vertices) for part in solids)])
        faces = np.concatenate([part.faces + offset for part, offset in zip(solids, offsets, strict=False)])
        red, green, blue = (round(255.0 * channel) for channel in rgba[:3])
        vertices = np.concatenate([part.vertices for part in solids])
        meshes.append(ColoredMesh(body, (red, green, blue), rgba[3], vertices, faces))
    return meshes


def _body_and_color(shape: Shape) -> tuple[int, tuple[float, ...]]:
    return shape.body, tuple(shape.rgba)
