"""Layout of a recording: scene and observations on the left, time series on the right."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from beliefscope.datasets.point_clouds import extent_of, point_sensors, points_of
from beliefscope.datasets.task import Component, Task, display_name, with_unit
from beliefscope.inspect.diagnostics.base import Diagnostic
from beliefscope.inspect.maps.map_engine import LikelihoodMap
from beliefscope.inspect.statistics.measures import deviations
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.rerun_log.diagnostics import diagnostic_tab
from beliefscope.recordings.rerun_log.entities import SIGMAS, angles, plane_height, positions
from beliefscope.recordings.rerun_log.maps import STEP_LABEL
from beliefscope.recordings.rerun_log.stream import escaped_path
from beliefscope.recordings.schema import STEP

TRAIL_STEPS = 100
VIEWING_DISTANCE, REACHES = 1.2, 2.2
"""Distance of the eye from the centre of the scene: at least the first, m, so that the reach of the arm is in view, and
the second times the distance of the farthest true state or hand from the centre."""
EYE_HEIGHT = 2.2
"""Height of the eye above a point cloud, in extents, so that all of it is in view."""
COLOR_NAMES = {"image": "blue", "haptics": "amber"}
"""Modality -> name of its color in ``recordings.schema``."""
BACKGROUND = [16, 17, 24]
"""RGB, dark in every theme of the viewer, so that empty cells of a map look empty."""


def blueprint(
    trace: Trace,
    task: Task,
    first: LikelihoodMap | None = None,
    diagnostics: Mapping[str, Diagnostic] = MappingProxyType({}),
    growing: bool = False,
) -> rrb.Blueprint:
    """Layout of the recording of a trace.

    Args:
        first: first likelihood map; None for no maps.
        diagnostics: by name; each has a tab next to the time series.
        growing: whether the run is in progress: the cursor and axes follow its end.
    """
    observed: list[rrb.View] = [_camera(key) for key in task.observations if task.dtype(key) is np.uint8]
    observed += [_points(key, trace) for key in point_sensors(task) if key in trace.episode.observations]
    if first is not None:
        observed += [_map(layer, first) for layer in first.layers]
    scene = rrb.Vertical(
        _scene(trace, task),
        rrb.Horizontal(*observed) if observed else rrb.TextDocumentView(origin="about"),
        row_shares=[3, 2],
    )
    series = _time_series(trace, task, growing)
    if diagnostics:
        tabs = (diagnostic_tab(diagnostic, name) for name, diagnostic in diagnostics.items())
        series = rrb.Tabs(series, *tabs, active_tab=0)
    return rrb.Blueprint(
        rrb.Horizontal(scene, series, column_shares=[6, 5]),
        rrb.TimePanel(state="collapsed", timeline=STEP, play_state="following" if growing else "paused"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_layout=False,
        auto_views=False,
    )


def _scene(trace: Trace, task: Task) -> rrb.Container:
    """The scene from behind the robot, and the belief from above, as on the maps."""
    about = rrb.TextDocumentView(origin="about", name="About")
    if task.floor is None:
        return rrb.Tabs(about)
    x, y = task.floor
    anchor = np.array([*positions(trace)[:, [x, y]].mean(axis=0), plane_height(trace, task)])
    effector = trace.episode.observations.get("effector_position")
    middle = anchor if effector is None else 0.5 * (anchor + effector.mean(axis=0))
    reach = np.linalg.norm(positions(trace)[:, [x, y]] - middle[:2], axis=1).max()
    if effector is not None:
        reach = max(reach, np.linalg.norm(effector - middle, axis=1).max())
    distance = max(VIEWING_DISTANCE, REACHES * float(reach))
    spacing = 0.1 * 10.0 ** math.floor(math.log10(distance))
    trail = rr.VisibleTimeRange(
        STEP,
        start=rrb.TimeRangeBoundary.cursor_relative(seq=-TRAIL_STEPS),
        end=rrb.TimeRangeBoundary.cursor_relative(seq=0),
    )
    scene = rrb.Spatial3DView(
        origin="world",
        name="Scene",
        eye_controls=_eye(middle, middle + distance * np.array([-0.62, -0.12, 0.78]), (0, 0, 1)),
        background=rrb.Background(kind="SolidColor", color=BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=True, spacing=spacing, plane=rr.components.Plane3D.XY),
        overrides={"world/effector": rrb.VisibleTimeRanges(trail)},
    )
    above = rrb.Spatial3DView(
        origin="world",
        contents="world/plane/**",
        name=f"Belief: {', '.join(map(display_name, task.map_components))}",
        eye_controls=_eye(
            anchor, anchor + np.array([0.0, 0.0, 3.4 * task.map_half_width]), (0, 1, 0), "world/plane/fused/mean"
        ),
        background=rrb.Background(kind="SolidColor", color=BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=False),
    )
    return rrb.Horizontal(rrb.Tabs(scene, about, active_tab=0), above, column_shares=[5, 4])


def _eye(
    target: NDArray[np.float64], position: NDArray[np.float64], up: tuple[int, int, int], tracked: str | None = None
) -> rrb.EyeControls3D:
    """tracked: entity that the eye follows."""
    return rrb.EyeControls3D(position=position, look_target=target, eye_up=up, kind="Orbital", tracking_entity=tracked)


def _camera(key: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(origin=escaped_path(f"observations/{key}"), name="Camera")


def _points(key: str, trace: Trace) -> rrb.Spatial3DView:
    """A scan or point cloud from above, x upwards."""
    extent = extent_of(points_of(trace.task, key, trace.episode.observations[key]))
    return rrb.Spatial3DView(
        origin=escaped_path(f"points/{key}"),
        name=display_name(key),
        background=rrb.Background(kind="SolidColor", color=BACKGROUND),
        eye_controls=_eye(np.zeros(3), np.array([0.0, 0.0, EYE_HEIGHT * extent]), (1, 0, 0)),
    )


def _map(layer: str, first: LikelihoodMap) -> rrb.View:
    side = len(first.offsets_x)
    name = layer if first.quantity == "likelihood" else f"{layer} {first.quantity}"  # long titles are cut
    # Without bounds, the view would zoom out to include estimates outside the map.
    bounds = rrb.VisualBounds2D(x_range=[0, side], y_range=[0, side])
    contents = ["$origin/**", f"/{STEP_LABEL}"]
    return rrb.Spatial2DView(origin=escaped_path(f"maps/{layer}"), contents=contents, name=name, visual_bounds=bounds)


def _time_series(trace: Trace, task: Task, growing: bool) -> rrb.Container:
    rows: list[rrb.View | rrb.Container] = []
    shares: list[float] = []
    if "contact" in task.covariates:
        rows.append(rrb.StateTimelineView(origin="contact", name="Contact", time_view=_linked()))
        shares.append(2.2)  # title, axis and states have a fixed height
    titles = {"weights": "Beta", "effective_weights": "Effective weights"}
    # A legend would hide the lines of a low plot: the first title names the colors, if they have common names.
    named = set(trace.modalities) <= COLOR_NAMES.keys()
    colors = ", ".join(f"{name} {COLOR_NAMES[name]}" for name in trace.modalities if named)
    available = [name for name in titles if getattr(trace, name) is not None]
    if available and colors:
        titles[available[0]] += f": {colors}"
    fusion = [_plot(name, titles[name], (-0.05, 1.05), legend=not named) for name in available]
    if fusion:
        rows.append(rrb.Tabs(*fusion, active_tab=0))
        shares.append(2.5)
    # Tabs, because more rows than this have no height left for their lines on a laptop.
    rows.append(rrb.Tabs(*(_estimate(trace, task, component, growing) for component in task.components), active_tab=0))
    shares.append(2.5)
    main = task.main_error
    title = with_unit(f"{main.title} error", main.unit)
    errors = [_plot("errors/position", f"{title}: fused red" if named else title, legend=not named)]
    errors += [
        _plot(f"errors/{c.name}", f"Error of {c.name} (deg)")
        for c in angles(task)
        if (task.index(c.name),) != main.indices
    ]
    if trace.log_weights is not None:
        errors.append(_plot("diagnostics/effective_sample_size", "Effective sample size"))
    rows.append(rrb.Tabs(*errors, active_tab=0))
    shares.append(2.5)
    return rrb.Vertical(*rows, row_shares=shares, name="Run")


def _estimate(trace: Trace, task: Task, component: Component, growing: bool) -> rrb.TimeSeriesView:
    i, scale = task.index(component.name), component.conversion[1]
    limits = None
    if not growing:
        # Limits fit the true state and the fused 2 sigma band; diverging modalities may exceed them.
        sigma = np.nan_to_num(SIGMAS * deviations(trace.estimate_covariance)[:, i])
        mean = trace.estimate_mean[:, i]
        values = np.concatenate([trace.episode.states[:, i], mean - sigma, mean + sigma])
        low, high = (float(limit) * scale for limit in np.nanpercentile(values, [0.5, 99.5]))
        margin = 0.1 * (high - low) or 1.0
        limits = (low - margin, high + margin)
    name = with_unit(component.label, component.conversion[0])
    if i == 0:  # without a legend, as above
        name += ": truth green, fused red"
    return _plot(f"states/{component.name}", name, limits, legend=False)


def _linked() -> rrb.TimeAxis:
    """The axis of every time series. A function, as the first Arrow array of a process imports pandas, if installed."""
    return rrb.TimeAxis(link="LinkToGlobal")


def _plot(origin: str, name: str, limits: tuple[float, float] | None = None, legend: bool = True) -> rrb.TimeSeriesView:
    axis = None if limits is None else rrb.ScalarAxis(range=limits)
    return rrb.TimeSeriesView(
        origin=escaped_path(origin),
        name=name,
        axis_x=_linked(),
        axis_y=axis,
        plot_legend=rrb.PlotLegend(corner="LeftTop", visible=legend),
    )
