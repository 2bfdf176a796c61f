"""Likelihood maps as Rerun columns: an image per layer, and the fused map in the 3D scene."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from PIL import Image

from beliefscope.datasets.task import Task
from beliefscope.inspect.maps.map_engine import LikelihoodMap
from beliefscope.inspect.palette import colour
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.rerun_log.entities import rgba, series, sources

Array = NDArray[Any]
PLANE_CELLS = 60  # maximum per side of the map in the scene; the image view has the full resolution
STEP_LABEL = "maps/step"
"""Path of the label in all views of maps: at the steps without maps, a viewer shows the latest ones."""
PNG_LEVEL = 6  # of zlib; a higher one takes several times as long for 3 % less


def map_style(first: LikelihoodMap, trace: Trace) -> Iterator[tuple[str, Any]]:
    """Static properties of all maps of a recording: quantity, size, colour map, markers."""
    yield "maps/title", rr.TextDocument(first.title)
    side = len(first.offsets_x)
    # The label is at the upper edge of every map.
    yield STEP_LABEL, rr.Points2D.from_fields(positions=[[side / 2, 0.0]], radii=0.0, show_labels=True)
    if first.is_curve:
        for layer in first.layers:
            for path, source in (("", layer), ("/estimate", layer), ("/truth", "truth")):
                hue = rgba(colour(source, trace.modalities), 1.0 if path != "/estimate" else 0.6)
                yield f"maps/{layer}{path}", rr.LineStrips2D.from_fields(colors=hue, radii=rr.Radius.ui_points(1.2))
        return
    pixels = rr.EncodedDepthImage.from_fields(media_type="image/png", colormap="Viridis", depth_range=[0.0, 255.0])
    for layer in first.layers:
        yield f"maps/{layer}", pixels
        yield f"maps/{layer}/truth", _frame(colour("truth", trace.modalities), side / 18)
        yield f"maps/{layer}/estimate", _frame(colour(layer, trace.modalities), side / 30)
    if first.components != trace.task.floor:
        return
    cells = first.offsets_x[:: _stride(first)]
    gray = rr.components.ImageFormat(width=len(cells), height=len(cells), channel_datatype="U8", color_model="L")
    yield (
        "world/plane/map",
        rr.GridMap.from_fields(format=gray, cell_size=float(cells[1] - cells[0]), opacity=0.8, colormap="Viridis"),
    )


def map_columns(maps: Sequence[LikelihoodMap], trace: Trace, task: Task) -> Iterator[tuple[str, Any]]:
    """Columns of maps of one size, flipped so that y points up."""
    steps = [m.step for m in maps]
    yield STEP_LABEL, rr.Points2D.columns(labels=[f"step {step}" for step in steps])
    shares = np.stack([m.normalised() for m in maps])
    peaks = np.stack([m.log_likelihood.max(axis=(1, 2)) for m in maps])
    for index, layer in enumerate(maps[0].layers):
        yield f"maps/{layer}/log_peak", series(peaks[:, index])
    means = np.concatenate([trace.estimate_mean[steps, None], trace.modality_mean[steps]], axis=1)
    if maps[0].is_curve:
        yield from _curve_columns(maps, shares, means, trace)
        return
    x, y = task.map_indices
    pixels = shares[:, :, ::-1]
    for index, layer in enumerate(maps[0].layers):
        yield f"maps/{layer}", rr.EncodedDepthImage.columns(blob=[_png(image) for image in pixels[:, index]])
        mean = means[:, sources(trace).index(layer)][:, [x, y]]
        yield f"maps/{layer}/estimate", rr.Boxes2D.columns(centers=_cells(maps, mean))
        truth = trace.episode.states[steps][:, [x, y]]
        yield f"maps/{layer}/truth", rr.Boxes2D.columns(centers=_cells(maps, truth))
    if maps[0].components != task.floor:
        return
    first, stride = maps[0], _stride(maps[0])
    cells = shares[:, first.layers.index("fused"), ::stride, ::stride][:, ::-1].reshape(len(maps), -1)
    half_cell = (first.offsets_x[stride] - first.offsets_x[0]) / 2.0
    below = -0.002  # m below the contours, to avoid z-fighting
    corner = np.array([[m.centre[0] + m.offsets_x[0], m.centre[1] + m.offsets_y[0], below] for m in maps])
    corner[:, :2] -= half_cell
    yield "world/plane/map", rr.GridMap.columns(data=list(cells), translation=corner)


def _png(pixels: NDArray[np.uint8]) -> bytes:
    """Gray image (S, S) as PNG of 16 bits; Rerun 0.41 draws those of 8 bits black.

    Rerun's files only have LZ4, which leaves twice the size.
    """
    file = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint16)).save(file, "png", compress_level=PNG_LEVEL)
    return file.getvalue()


def _curve_columns(
    maps: Sequence[LikelihoodMap], shares: Array, means: Array, trace: Trace
) -> Iterator[tuple[str, Any]]:
    """Columns of maps over one component: a curve in the coordinates of an image of S x S cells, and upright lines."""
    side, component = len(maps[0].offsets_x), maps[0].components[0]
    steps = [m.step for m in maps]
    x = np.arange(side) + 0.5
    for index, layer in enumerate(maps[0].layers):
        heights = side * (1.0 - 0.95 * shares[:, index, 0] / 255.0)
        strips = [np.stack([x, height], axis=1) for height in heights]
        yield f"maps/{layer}", rr.LineStrips2D.columns(strips=strips)
        for name, values in (
            ("estimate", means[:, sources(trace).index(layer), component]),
            ("truth", trace.episode.states[steps][:, component]),
        ):
            places = [_column(m, value) for m, value in zip(maps, values, strict=True)]
            lines = [np.array([[at, 0.0], [at, side]]) for at in places]
            yield f"maps/{layer}/{name}", rr.LineStrips2D.columns(strips=lines)


def _column(map_: LikelihoodMap, value: float) -> float:
    """A value of the component in columns of its map."""
    spacing = map_.offsets_x[1] - map_.offsets_x[0]
    return float((value - map_.centre[0] - map_.offsets_x[0]) / spacing + 0.5)


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
