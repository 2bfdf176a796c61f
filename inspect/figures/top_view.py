"""Vector drawing of one step of a run: the scene from above and the belief.

World axes as on the maps: x to the right, y upwards. Needs neither a GPU nor a browser.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon, Rectangle
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.outline import Outline
from beliefscope.datasets.simulation.replay import replay
from beliefscope.datasets.simulation.shapes import shapes
from beliefscope.datasets.task import Task, with_unit
from beliefscope.inspect.diagnostics.plotting import STYLE, WIDTH, new_figure
from beliefscope.inspect.maps.map_engine import LikelihoodMap
from beliefscope.inspect.palette import COLOURS, colour, colour_table
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace

Array = NDArray[Any]

HEIGHT = 2.9  # inches
SIGMAS = 2.0
FORCE_SCALE = 0.4  # cm per N, as in the 3D view
PALE = 0.55  # fraction of white in the colour of a shape
GRAY = np.full(3, 0.72)  # particle without weight
MARGIN = 6.0  # cm around the drawing
MIN_HALF_WIDTH = 1.5  # cm, half the side of the belief panel
CONTACT_TEXT = "#8a3d6b"  # dark variant of the contact colour
BOX_CORNERS = np.array([[bit >> axis & 1 for axis in range(3)] for bit in range(8)]) - 0.5
CIRCLE = np.stack([np.cos(np.arange(48) * np.pi / 24), np.sin(np.arange(48) * np.pi / 24)], axis=1) / 2.0


@dataclass(frozen=True)
class Footprint:
    """Footprint of a shape: outline (P, 2) cm, top height in m, colour (3,)."""

    outline: Array
    top: float
    rgb: Array


def draw_step(trace: Trace, step: int, map_: LikelihoodMap | None = None) -> Figure:
    """Draw the scene from above at a step, if the episode can be replayed, and the belief on the fused map.

    Shows robot and object, true and estimated object, estimates with 2 sigma contours, particles by weight, and the
    contact force. Only for tasks whose map is a position (``Task.floor``).
    """
    footprints = scene_footprints(trace, trace.task, step)
    with rc_context(STYLE):
        figure = new_figure(figsize=(WIDTH if footprints else HEIGHT + 0.9, HEIGHT), layout="constrained")
        if footprints:
            scene, belief = figure.subplots(1, 2, width_ratios=[1.5, 1.0])
            _draw_scene(scene, footprints, trace, step, map_)
        else:
            belief = figure.subplots()
        _draw_belief(belief, trace, step, map_)
        handles, names = belief.get_legend_handles_labels()
        figure.legend(handles, names, frameon=False, ncols=len(names), loc="outside lower center")
    return figure


def scene_footprints(trace: Trace, task: Task, step: int) -> list[Footprint]:
    """Footprints of all shapes at a step, lowest first; empty if the episode cannot be replayed."""
    try:
        replayed = replay(task, trace.episode)
    except BadInput:  # the recording does not describe its scene
        return []
    if replayed is None:
        return []
    footprints = []
    for shape in shapes(replayed.model, visual=False):
        rotation, position = replayed.rotations[step, shape.body], replayed.positions[step, shape.body]
        points = shape.points @ rotation.T + position
        footprints.append(Footprint(outline(100.0 * points[:, :2]), float(points[:, 2].max()), shape.rgba[:3]))
    return sorted(footprints, key=lambda shape: shape.top)


def outline(points: Array) -> Array:
    """(P, 2) corners of the convex hull of points (V, 2), counter-clockwise."""
    return points[ConvexHull(points).vertices]


def _draw_scene(axes: Axes, footprints: list[Footprint], trace: Trace, step: int, map_: LikelihoodMap | None) -> None:
    _draw_map(axes, map_)
    for shape in footprints:
        pale = shape.rgb + PALE * (1.0 - shape.rgb)
        # Translucent, because a door's frame covers its hinge.
        axes.add_patch(Polygon(shape.outline, fc=pale, ec=0.55 * pale, lw=0.5, alpha=0.75))
    _draw_object(axes, trace, step)
    _draw_positions(axes, trace, step, size=3.0)
    _draw_force(axes, trace, step)
    corners = np.concatenate([shape.outline for shape in footprints])
    if map_ is not None:
        half = 100.0 * trace.task.map_half_width
        square = 100.0 * map_.centre + np.array([[-half, -half], [half, half]])
        axes.add_patch(Rectangle(square[0], 2 * half, 2 * half, fill=False, ec="0.6", lw=0.5, zorder=0.5))
        corners = np.concatenate([corners, square])
    low, high = corners.min(axis=0) - MARGIN, corners.max(axis=0) + MARGIN
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    _label_axes(axes, trace.task, ["x", "y"])
    axes.set_title("from above", loc="left")


def _draw_belief(axes: Axes, trace: Trace, step: int, map_: LikelihoodMap | None) -> None:
    """Draw the part of the map square that contains the estimates and contours."""
    plane = list(trace.task.map_indices)
    centre, reach = 100.0 * trace.anchors[step][plane], MIN_HALF_WIDTH
    _draw_map(axes, map_)
    if trace.particles is not None and trace.log_weights is not None:
        weights = trace.log_weights[step]
        order = np.argsort(weights)  # largest weight on top
        strength = np.sqrt(np.exp(weights[order] - weights.max()))[:, None]
        shade = GRAY + strength * (np.array(to_rgb(colour("fused", trace.modalities))) - GRAY)
        x, y = 100.0 * trace.particles[step][order][:, plane].T
        axes.scatter(x, y, s=3.0, c=shade, lw=0, zorder=2)
    for name, mean, covariance in _estimates(trace, step):
        at, spread = 100.0 * mean[plane], 0.0
        if trace.has_covariance:
            ellipse = _contour(at, covariance[np.ix_(plane, plane)], colour(name, trace.modalities))
            axes.add_patch(ellipse)
            spread = max(ellipse.width, ellipse.height) / 2.0
        reach = max(reach, float(np.abs(at - centre).max()) + spread)
    _draw_positions(axes, trace, step, size=5.0)
    half = min(1.25 * reach, 100.0 * trace.task.map_half_width)
    axes.set(xlim=centre[0] + np.array([-half, half]), ylim=centre[1] + np.array([-half, half]), aspect="equal")
    _label_axes(axes, trace.task, [trace.task.components[i].label for i in plane])
    axes.set_title("belief" if map_ is None else f"belief, on the {map_.layers[-1]} {map_.quantity}", loc="left")


def _label_axes(axes: Axes, task: Task, names: list[str]) -> None:
    """Label axes in cm with the units for display of the map components."""
    for axis, name, i in zip((axes.xaxis, axes.yaxis), names, task.map_indices, strict=True):
        unit, factor = task.components[i].conversion
        axis.set_label_text(with_unit(name, unit))
        if factor != 100.0:
            axis.set_major_formatter(partial(_scaled, factor / 100.0))


def _scaled(factor: float, value: float, _: int | None = None) -> str:
    """Text of a tick whose value has another unit."""
    return f"{factor * value:.10g}".replace("-", "\N{MINUS SIGN}")


def _draw_map(axes: Axes, map_: LikelihoodMap | None) -> None:
    """Draw the fused map at its position; low likelihood is transparent."""
    if map_ is None:
        return
    log = map_.log_likelihood[-1]
    share = np.exp(log - log.max())
    side = 0.5 * (map_.offsets_x[1] - map_.offsets_x[0])
    edges = [
        100.0 * (c + np.array([-1.0, 1.0]) * (side - o[0]))
        for c, o in zip(map_.centre, (map_.offsets_x, map_.offsets_y), strict=True)
    ]
    rgba = np.dstack([colour_table("viridis")[np.rint(255 * share).astype(int)] / 255.0, share])
    axes.imshow(rgba, origin="lower", extent=(*edges[0], *edges[1]), interpolation="nearest", zorder=0)


def _draw_object(axes: Axes, trace: Trace, step: int) -> None:
    """Draw the true object, and the estimated object dashed."""
    outline_of = trace.task.outline
    if outline_of is None:
        return
    for name, states, style in (("truth", trace.episode.states, "-"), ("fused", trace.estimate_mean, (0, (3, 1.5)))):
        if np.isfinite(states[step]).all():
            shade = colour(name, trace.modalities)
            axes.add_patch(
                Polygon(footprint(outline_of(states[step])), fill=False, ec=shade, lw=1.3, ls=style, zorder=3)
            )


def footprint(ghost: Outline) -> Array:
    """(P, 2) cm: footprint of an upright object."""
    sides = np.asarray(ghost.size)[:2]
    flat = (CIRCLE if ghost.shape == "cylinder" else outline(BOX_CORNERS[:, :2])) * sides
    turn = 2.0 * np.arctan2(ghost.wxyz[3], ghost.wxyz[0])
    c, s = np.cos(turn), np.sin(turn)
    return 100.0 * (flat @ np.array([[c, s], [-s, c]]) + ghost.position[:2])


def _draw_positions(axes: Axes, trace: Trace, step: int, size: float) -> None:
    plane = list(trace.task.map_indices)
    style: dict[str, Any] = {"ls": "", "zorder": 4}
    ring: dict[str, Any] = {"mfc": "none", "mew": 1.2}
    for name, mean, _ in _estimates(trace, step):
        label = "estimate" if name == "fused" and len(trace.modalities) < 2 else measures.layer_label(name)
        marker, edge = "D" if name == "fused" else "o", colour(name, trace.modalities)
        x, y = 100.0 * mean[plane]
        axes.plot(x, y, ms=size, label=label, marker=marker, mec=edge, **ring, **style)
    truth = trace.episode.states[step][plane]
    if np.isfinite(truth).all():
        axes.plot(*100.0 * truth, marker="+", ms=1.6 * size, mew=1.4, color=COLOURS["truth"], label="truth", **style)


def draws_force(trace: Trace, step: int) -> bool:
    """Whether ``draw_step`` has an arrow: in contact, of a hand whose force and position are measured."""
    return bool(trace.episode.contact[step]) and {"effector_position", "force"} <= trace.episode.observations.keys()


def _draw_force(axes: Axes, trace: Trace, step: int) -> None:
    """Draw the horizontal part of the contact force, labelled with its norm in newtons."""
    if not draws_force(trace, step):
        return
    observations = trace.episode.observations
    start, force = 100.0 * observations["effector_position"][step][:2], observations["force"][step]
    end = start + FORCE_SCALE * force[:2]
    arrow = {"arrowstyle": "-|>", "color": COLOURS["contact"], "lw": 1.4, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, start, arrowprops=arrow, zorder=5)
    away = np.sign(force[:2]) + (force[:2] == 0.0)
    text = axes.annotate(f"{np.linalg.norm(force):.0f} N", end, 5 * away, textcoords="offset points", zorder=6)
    text.set(ha="left" if away[0] > 0 else "right", va="bottom" if away[1] > 0 else "top", color=CONTACT_TEXT)


def _estimates(trace: Trace, step: int) -> list[tuple[str, Array, Array]]:
    """(name, mean (n,), covariance (n, n)) of the single-modality updates, if several, and of the fused estimate."""
    modalities = enumerate(trace.modalities_with_posterior) if len(trace.modalities_with_posterior) > 1 else ()
    unimodal = [(name, trace.modality_mean[step, k], trace.modality_covariance[step, k]) for k, name in modalities]
    return [*unimodal, ("fused", trace.estimate_mean[step], trace.estimate_covariance[step])]


def _contour(centre: Array, covariance: Array, shade: str) -> Ellipse:
    """2 sigma contour of a covariance in m^2 around a centre in cm."""
    half, turn = measures.contours(covariance)
    width, height = 200.0 * SIGMAS * half
    angle = float(np.degrees(turn))
    return Ellipse((centre[0], centre[1]), width, height, angle=angle, fill=False, ec=shade, lw=1.2, zorder=3)
