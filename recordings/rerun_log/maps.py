"""Likelihood maps as Rerun columns: pictures of their own, and the fused one where it belongs in the scene."""

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
PLANE_CELLS = 80  # a side at most in the scene: there the map is a carpet, and seen next to it in full


def map_style(first: LikelihoodMap, trace: Trace) -> Iterator[tuple[str, Any]]:
    """What all maps of a recording have in common: size, colour table, markers."""
    side = len(first.offsets_x)
    depth = rr.components.ImageFormat(width=side, height=side, channel_datatype="U8")
    for layer in first.layers:
        yield (
            f"maps/{layer}",
            rr.DepthImage.from_fields(format=depth, colormap="Inferno", depth_range=[0.0, 255.0]),
        )
        yield f"maps/{layer}/truth", _frame(colour("truth", trace.modalities), side / 18)
        yield f"maps/{layer}/estimate", _frame(colour(layer, trace.modalities), side / 30)
    laid = first.offsets_x[:: _thinning(first)]
    gray = rr.components.ImageFormat(width=len(laid), height=len(laid), channel_datatype="U8", color_model="L")
    yield (
        "world/plane/map",
        rr.GridMap.from_fields(format=gray, cell_size=float(laid[1] - laid[0]), opacity=0.8, colormap="Inferno"),
    )


def map_columns(maps: Sequence[LikelihoodMap], trace: Trace, task: Task) -> Iterator[tuple[str, Any]]:
    """A block of maps of one size, rows turned so that y grows upwards as on a chart."""
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
    first, thin = maps[0], _thinning(maps[0])
    laid = shares[:, first.layers.index("fused"), ::thin, ::thin][:, ::-1].reshape(len(maps), -1)
    half_cell = (first.offsets_x[thin] - first.offsets_x[0]) / 2.0
    below = -0.002  # or the map and the contours drawn on it would flicker through each other
    corner = np.array([[m.centre[0] + m.offsets_x[0], m.centre[1] + m.offsets_y[0], below] for m in maps])
    corner[:, :2] -= half_cell
    yield "world/plane/map", rr.GridMap.columns(data=list(laid), translation=corner)


def _thinning(one: LikelihoodMap) -> int:
    """Of how many cells in a row one is laid in the scene."""
    return -(-len(one.offsets_x) // PLANE_CELLS)


def _cells(maps: Sequence[LikelihoodMap], points: Array) -> Array:
    """World points (B, 2) as picture coordinates of their maps: cells from the upper left corner."""
    origin = np.array([[m.offsets_x[0], m.offsets_y[0]] for m in maps]) + np.array([m.centre for m in maps])
    spacing = np.array([[m.offsets_x[1] - m.offsets_x[0], m.offsets_y[1] - m.offsets_y[0]] for m in maps])
    cells = (points - origin) / spacing + 0.5
    cells[:, 1] = len(maps[0].offsets_y) - cells[:, 1]
    return cells.astype(np.float32)


def _frame(hue: str, half: float) -> rr.Boxes2D:
    """A hollow square about a position: a dot would hide the peak of a sharp map."""
    return rr.Boxes2D.from_fields(half_sizes=[[half, half]], colors=rgba(hue), radii=rr.Radius.ui_points(1.0))
