"""Likelihood maps as Rerun columns: an image per layer, and the fused map in the 3D scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from beliefscope.datasets.task import Task
from beliefscope.inspect.likelihood import LikelihoodMap
from beliefscope.inspect.palette import colour
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.rerun_log.entities import rgba, series, sources

Array = NDArray[Any]
PLANE_CELLS = 80  # maximum per side of the map in the scene; the image view has the full resolution


def map_style(first: LikelihoodMap, trace: Trace) -> Iterator[tuple[str, Any]]:
    """Static properties of all maps of a recording: quantity, size, colour map, markers."""
    yield "maps/title", rr.TextDocument(first.title)
    side = len(first.offsets_x)
    depth = rr.components.ImageFormat(width=side, height=side, channel_datatype="U8")
    for layer in first.layers:
        yield (f"maps/{layer}", rr.DepthImage.from_fields(format=depth, colormap="Inferno", depth_range=[0.0, 255.0]))
        yield f"maps/{layer}/truth", _frame(colour("truth", trace.modalities), side / 18)
        yield f"maps/{layer}/estimate", _frame(colour(layer, trace.modalities), side / 30)
    cells = first.offsets_x[:: _stride(first)]
    gray = rr.components.ImageFormat(width=len(cells), height=len(cells), channel_datatype="U8", color_model="L")
    yield (
        "world/plane/map",
        rr.GridMap.from_fields(format=gray, cell_size=float(cells[1] - cells[0]), opacity=0.8, colormap="Inferno"),
    )


def map_columns(maps: Sequence[LikelihoodMap], trace: Trace, task: Task) -> Iterator[tuple[str, Any]]:
    """Columns of maps of one size, flipped so that y points up."""
    x, y = task.map_indices
    steps = [m.step for m in maps]
    shares = np.stack([m.normalised() for m in maps])
    pixels = shares[:, :, ::-1]
    peaks = np.stack([m.log_likelihood.max(axis=(1, 2)) for m in maps])
    means = np.concatenate([trace.estimate_mean[steps, None], trace.modality_mean[steps]], axis=1)[..., [x, y]]
    for index, layer in enumerate(maps[0].layers):
        yield f"maps/{layer}", rr.DepthImage.columns(buffer=list(pixels[:, index].reshape(len(maps), -1)))
        yield f"maps/{layer}/log_peak", series(peaks[:, index])
        mean = means[:, sources(trace).index(layer)]
        yield f"maps/{layer}/estimate", rr.Boxes2D.columns(centers=_cells(maps, mean))
        truth = trace.episode.states[steps][:, [x, y]]
        yield f"maps/{layer}/truth", rr.Boxes2D.columns(centers=_cells(maps, truth))
    first, stride = maps[0], _stride(maps[0])
    cells = shares[:, first.layers.index("fused"), ::stride, ::stride][:, ::-1].reshape(len(maps), -1)
    half_cell = (first.offsets_x[stride] - first.offsets_x[0]) / 2.0
    below = -0.002  # m below the contours, to avoid z-fighting
    corner = np.array([[m.centre[0] + m.offsets_x[0], m.centre[1] + m.offsets_y[0], below] for m in maps])
    corner[:, :2] -= half_cell
    yield "world/plane/map", rr.GridMap.columns(data=list(cells), translation=corner)


def _stride(map_: LikelihoodMap) -> int:
    """Stride at which cells are shown in the scene."""
    return -(-len(map_.offsets_x) // PLANE_CELLS)


def _cells(maps: Sequence[LikelihoodMap], points: Array) -> Array:
    """World points (B, 2) in image coordinates of their maps: cells from the upper left corner."""
    origin = np.array([[m.offsets_x[0], m.offsets_y[0]] for m in maps]) + np.array([m.centre for m in maps])
    spacing = np.array([[m.offsets_x[1] - m.offsets_x[0], m.offsets_y[1] - m.offsets_y[0]] for m in maps])
    cells = (points - origin) / spacing + 0.5
    cells[:, 1] = len(maps[0].offsets_y) - cells[:, 1]
    return cells.astype(np.float32)


def _frame(hue: str, half: float) -> rr.Boxes2D:
    """Hollow square around a position; a dot would hide the peak of a sharp map."""
    return rr.Boxes2D.from_fields(half_sizes=[[half, half]], colors=rgba(hue), radii=rr.Radius.ui_points(1.0))
