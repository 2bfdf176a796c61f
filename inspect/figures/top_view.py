"""One moment of a run as a drawing for paper: the scene from above, and the belief beside it, all in vectors.

World axes as on the maps: x to the right, y upwards. No graphics card and no browser is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon, Rectangle
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.replay import replay
from beliefscope.datasets.simulation.shapes import shapes
from beliefscope.datasets.task import Ghost, Task
from beliefscope.inspect.diagnostics.plotting import STYLE, WIDTH, colour_table
from beliefscope.inspect.likelihood import LikelihoodMap
from beliefscope.inspect.palette import COLOURS, colour
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace

Array = NDArray[Any]

HEIGHT = 2.9  # inches
SIGMAS = 2.0
FORCE_SCALE = 0.4  # cm a N, as in the page's scene
PALE = 0.55  # of the way from a shape's colour to white
GRAY = np.full(3, 0.72)  # of a particle without weight
MARGIN = 6.0  # cm around all that is drawn
NARROWEST = 1.5  # cm, half the side of the belief's panel at least
DEEP = "#8a3d6b"  # contact's colour, dark enough for text
BOX = np.array([[bit >> axis & 1 for axis in range(3)] for bit in range(8)]) - 0.5
RIM = np.stack([np.cos(np.arange(48) * np.pi / 24), np.sin(np.arange(48) * np.pi / 24)], axis=1) / 2.0


@dataclass(frozen=True)
class Seen:
    """What a shape covers from above: its outline (P, 2) cm, how high it ends (m), its colour (3,)."""

    outline: Array
    top: float
    rgb: Array


def snapshot(trace: Trace, step: int, map_: LikelihoodMap | None = None) -> Figure:
    """The scene from above at a step, where the trace can be replayed, and the belief in the square of its maps.

    Robot and object as they were, true and estimated object, each estimate with its 2 sigma contour, particles darker
    the more they weigh, the force where there is contact; and the fused map beneath.
    """
    task = measures.task_of(trace)
    around = seen(trace, task, step)
    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH if around else HEIGHT + 0.9, HEIGHT), layout="constrained")
        FigureCanvasAgg(figure)
        if around:
            scene, belief = figure.subplots(1, 2, width_ratios=[1.5, 1.0])
            _scene(scene, around, trace, task, step, map_)
        else:
            belief = figure.subplots()
        _belief(belief, trace, task, step, map_)
        handles, names = belief.get_legend_handles_labels()
        figure.legend(handles, names, frameon=False, ncols=len(names), loc="outside lower center")
    return figure


def seen(trace: Trace, task: Task, step: int) -> list[Seen]:
    """What covers the ground at a step, the lowest first. Nothing where the episode cannot be replayed."""
    try:
        replayed = replay(task, trace.episode)
    except BadInput:  # a recording of others, or cut short, may not say what its world was like
        return []
    if replayed is None:
        return []
    found = []
    for shape in shapes(replayed.model, looks=False):
        turn, at = replayed.rotations[step, shape.body], replayed.positions[step, shape.body]
        points = shape.points @ turn.T + at
        found.append(Seen(outline(100.0 * points[:, :2]), float(points[:, 2].max()), shape.rgba[:3]))
    return sorted(found, key=lambda one: one.top)


def outline(points: Array) -> Array:
    """(P, 2) corners of the convex hull of points (V, 2), counter-clockwise."""
    return points[ConvexHull(points).vertices]


def _scene(axes: Axes, around: list[Seen], trace: Trace, task: Task, step: int, map_: LikelihoodMap | None) -> None:
    _lay(axes, map_)
    for one in around:
        pale = one.rgb + PALE * (1.0 - one.rgb)
        # What is high lets see what lies beneath it: a door's frame covers its hinge.
        axes.add_patch(Polygon(one.outline, fc=pale, ec=0.55 * pale, lw=0.5, alpha=0.75))
    _objects(axes, trace, task, step)
    _positions(axes, trace, task, step, size=3.0)
    _force(axes, trace, step)
    corners = np.concatenate([one.outline for one in around])
    if map_ is not None:
        half = 100.0 * task.map_half_width
        square = 100.0 * map_.centre + np.array([[-half, -half], [half, half]])
        axes.add_patch(Rectangle(square[0], 2 * half, 2 * half, fill=False, ec="0.6", lw=0.5, zorder=0.5))
        corners = np.concatenate([corners, square])
    low, high = corners.min(axis=0) - MARGIN, corners.max(axis=0) + MARGIN
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x (cm)", ylabel="y (cm)")
    axes.set_title("from above", loc="left")


def _belief(axes: Axes, trace: Trace, task: Task, step: int, map_: LikelihoodMap | None) -> None:
    """The middle of the map's square, as much of it as estimates and contours need."""
    plane = list(task.map_indices)
    centre, reach = 100.0 * trace.anchors[step][plane], NARROWEST
    _lay(axes, map_)
    if trace.particles is not None and trace.log_weights is not None:
        weights = trace.log_weights[step]
        order = np.argsort(weights)  # the heaviest on top
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
    _positions(axes, trace, task, step, size=5.0)
    half = min(1.25 * reach, 100.0 * task.map_half_width)
    x_name, y_name = (f"{name.replace('_', ' ')} (cm)" for name in task.map_components)
    axes.set(xlim=centre[0] + np.array([-half, half]), ylim=centre[1] + np.array([-half, half]), aspect="equal")
    axes.set(xlabel=x_name, ylabel=y_name)
    axes.set_title("belief" if map_ is None else f"belief, on the {map_.layers[-1]} likelihood", loc="left")


def _lay(axes: Axes, map_: LikelihoodMap | None) -> None:
    """The fused map, or that of the only layer, where it belongs; what is unlikely stays white."""
    if map_ is None:
        return
    log = map_.log_likelihood[-1]
    share = np.exp(log - log.max())
    side = 0.5 * (map_.offsets_x[1] - map_.offsets_x[0])
    edges = [
        100.0 * (c + np.array([-1.0, 1.0]) * (side - o[0]))
        for c, o in zip(map_.centre, (map_.offsets_x, map_.offsets_y), strict=True)
    ]
    painted = np.dstack([colour_table("viridis")[np.rint(255 * share).astype(int)] / 255.0, share])
    axes.imshow(painted, origin="lower", extent=(*edges[0], *edges[1]), interpolation="nearest", zorder=0)


def _objects(axes: Axes, trace: Trace, task: Task, step: int) -> None:
    """The object where it was, and dashed where it is believed to be."""
    if task.ghost is None:
        return
    for name, states, style in (("truth", trace.episode.states, "-"), ("fused", trace.estimate_mean, (0, (3, 1.5)))):
        if np.isfinite(states[step]).all():
            shade = colour(name, trace.modalities)
            axes.add_patch(
                Polygon(footprint(task.ghost(states[step])), fill=False, ec=shade, lw=1.3, ls=style, zorder=3)
            )


def footprint(ghost: Ghost) -> Array:
    """(P, 2) cm: what an object that stands upright covers from above."""
    sides = np.asarray(ghost.size)[:2]
    flat = (RIM if ghost.shape == "cylinder" else outline(BOX[:, :2])) * sides
    turn = 2.0 * np.arctan2(ghost.wxyz[3], ghost.wxyz[0])
    c, s = np.cos(turn), np.sin(turn)
    return 100.0 * (flat @ np.array([[c, s], [-s, c]]) + ghost.position[:2])


def _positions(axes: Axes, trace: Trace, task: Task, step: int, size: float) -> None:
    plane = list(task.map_indices)
    look: dict[str, Any] = {"ls": "", "zorder": 4}
    ring: dict[str, Any] = {"mfc": "none", "mew": 1.2}
    for name, mean, _ in _estimates(trace, step):
        called = "estimate" if name == "fused" and len(trace.modalities) < 2 else name
        marker, edge = "D" if name == "fused" else "o", colour(name, trace.modalities)
        x, y = 100.0 * mean[plane]
        axes.plot(x, y, ms=size, label=called, marker=marker, mec=edge, **ring, **look)
    truth = trace.episode.states[step][plane]
    if np.isfinite(truth).all():
        axes.plot(*100.0 * truth, marker="+", ms=1.6 * size, mew=1.4, color=COLOURS["truth"], label="truth", **look)


def _force(axes: Axes, trace: Trace, step: int) -> None:
    """The part of the force on the hand that is seen from above, and all of it in newtons."""
    said = trace.episode.observations
    if not trace.episode.contact[step] or not {"effector_position", "force"} <= said.keys():
        return
    start, force = 100.0 * said["effector_position"][step][:2], said["force"][step]
    end = start + FORCE_SCALE * force[:2]
    look = {"arrowstyle": "-|>", "color": COLOURS["contact"], "lw": 1.4, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, start, arrowprops=look, zorder=5)
    away = np.sign(force[:2]) + (force[:2] == 0.0)
    text = axes.annotate(f"{np.linalg.norm(force):.0f} N", end, 5 * away, textcoords="offset points", zorder=6)
    text.set(ha="left" if away[0] > 0 else "right", va="bottom" if away[1] > 0 else "top", color=DEEP)


def _estimates(trace: Trace, step: int) -> list[tuple[str, Array, Array]]:
    """(name, mean (n,), covariance (n, n)) of each modality where it is another than the fused one, then of that."""
    alone = enumerate(trace.alone) if len(trace.alone) > 1 else ()
    found = [(name, trace.modality_mean[step, k], trace.modality_covariance[step, k]) for k, name in alone]
    return [*found, ("fused", trace.estimate_mean[step], trace.estimate_covariance[step])]


def _contour(centre: Array, covariance: Array, shade: str) -> Ellipse:
    """2 sigma around a centre in cm, of a covariance in m^2."""
    half, turn = measures.contours(covariance)
    width, height = 200.0 * SIGMAS * half
    angle = float(np.degrees(turn))
    return Ellipse((centre[0], centre[1]), width, height, angle=angle, fill=False, ec=shade, lw=1.2, zorder=3)
