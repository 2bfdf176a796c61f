"""The layout that every recording carries: the scene and what the robot senses left, the story over time right."""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from beliefscope.datasets.task import Component, Task
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.drawing import SHOWN_SCALE, SHOWN_UNIT, SIGMAS, angles, plane_height
from beliefscope.recordings.schema import STEP

TRAIL_STEPS = 100
VIEWING_DISTANCE = 1.0
"""m from the scene's middle: an arm's reach is in view."""
LINKED = rrb.TimeAxis(link="LinkToGlobal")


def blueprint(trace: Trace, task: Task, layers: tuple[str, ...] = ()) -> rrb.Blueprint:
    """The layout for a trace whose recording has maps of these layers (none: the maps' views are left out)."""
    sensed = [_picture(key) for key, shape in task.observations.items() if len(shape) == 2]
    sensed += [_map(layer) for layer in layers]
    scene = rrb.Vertical(
        _scene(trace, task),
        rrb.Horizontal(*sensed) if sensed else rrb.TextDocumentView(origin="about"),
        row_shares=[3, 2] if len(sensed) < 4 else [5, 2],
    )
    story = _story(trace, task)
    return rrb.Blueprint(
        rrb.Horizontal(scene, story, column_shares=[1, 1]),
        rrb.TimePanel(state="collapsed", timeline=STEP, play_state="paused"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_layout=False,
        auto_views=False,
    )


def _scene(trace: Trace, task: Task) -> rrb.Container:
    x, y = task.map_indices
    height = plane_height(trace, task)
    middle = np.array([*trace.episode.states[:, [x, y]].mean(axis=0), height])
    effector = trace.episode.observations.get("effector_position")
    if effector is not None:
        middle = 0.5 * (middle + effector.mean(axis=0))
    # From behind the robot and above, so that the map's axes run as on paper: x away, y to the left.
    eye = middle + VIEWING_DISTANCE * np.array([-0.62, -0.12, 0.78])
    trail = rr.VisibleTimeRange(
        STEP,
        start=rrb.TimeRangeBoundary.cursor_relative(seq=-TRAIL_STEPS),
        end=rrb.TimeRangeBoundary.cursor_relative(seq=0),
    )
    name = f"{task.map_components[0]}, {task.map_components[1]}: truth, belief, end effector"
    world = rrb.Spatial3DView(
        origin="world",
        name=name,
        eye_controls=rrb.EyeControls3D(position=eye, look_target=middle, eye_up=[0, 0, 1], kind="Orbital"),
        # Dark whatever the viewer's theme, so that a map's empty cells look empty.
        background=rrb.Background(kind="SolidColor", color=[16, 17, 24]),
        line_grid=rrb.LineGrid3D(visible=True, spacing=0.05, plane=rr.components.Plane3D.XY),
        overrides={"world/effector": rrb.VisibleTimeRanges(trail)},
    )
    return rrb.Tabs(world, rrb.TextDocumentView(origin="about", name="About"), active_tab=0)


def _picture(key: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(origin=f"observations/{key}", name="Camera")


def _map(layer: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(origin=f"maps/{layer}", name=layer)


def _story(trace: Trace, task: Task) -> rrb.Container:
    rows: list[rrb.View | rrb.Container] = []
    rows.append(rrb.StateTimelineView(origin="contact", name="Contact", time_view=LINKED))
    shares = [1.6]
    shown = {"weights": "Fusion weights beta", "acting": "Share as it acted"}
    fusion = [_plot(name, title, (-0.05, 1.05)) for name, title in shown.items() if getattr(trace, name) is not None]
    if fusion:
        rows.append(rrb.Tabs(*fusion, active_tab=0))
        shares.append(2.5)
    for component in task.components:
        rows.append(_estimate(trace, task, component))
        shares.append(2.5)
    errors = [_plot("errors/position", "Position error (cm)")]
    errors += [_plot(f"errors/{c.name}", f"Error of {c.name} (deg)") for c in angles(task)]
    rows.append(rrb.Tabs(*errors, active_tab=0))
    shares.append(2.5)
    if trace.log_weights is not None:
        rows.append(_plot("diagnostics/effective_sample_size", "Effective sample size"))
        shares.append(2.0)
    return rrb.Vertical(*rows, row_shares=shares)


def _estimate(trace: Trace, task: Task, component: Component) -> rrb.TimeSeriesView:
    i, scale = task.index(component.name), SHOWN_SCALE[component.unit]
    # The axis fits the truth and the fused band; a modality that runs away may leave it.
    sigma = SIGMAS * np.sqrt(trace.estimate_covariance[:, i, i])
    mean = trace.estimate_mean[:, i]
    values = np.concatenate([trace.episode.states[:, i], mean - sigma, mean + sigma])
    low, high = (float(limit) * scale for limit in np.nanpercentile(values, [0.5, 99.5]))
    margin = 0.1 * (high - low)
    name = f"{component.name} ({SHOWN_UNIT[component.unit]}): truth green, fused red, thin lines 2 sigma"
    return _plot(f"states/{component.name}", name, (low - margin, high + margin), legend=False)


def _plot(origin: str, name: str, limits: tuple[float, float] | None = None, legend: bool = True) -> rrb.TimeSeriesView:
    axis = None if limits is None else rrb.ScalarAxis(range=limits)
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        axis_x=LINKED,
        axis_y=axis,
        plot_legend=rrb.PlotLegend(corner="LeftTop", visible=legend),
    )
