"""Figures of the paper for any filter: likelihood maps by contact, and fusion weights over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import patheffects, rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task, with_unit
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics import weight_audit
from beliefscope.inspect.diagnostics.plotting import (
    STYLE,
    WIDTH,
    StepAxis,
    draw_bands,
    draw_legend,
    legend_height,
    new_figure,
)
from beliefscope.inspect.maps.map_engine import FINE, LikelihoodMap, MapEngine, Quantity
from beliefscope.inspect.maps.plane import axis_titles, plane_of
from beliefscope.inspect.palette import COLOURS, colour
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.data import check_step

STATES = {False: "free motion", True: "contact"}
"""Contact states in panel order."""

PER_ROW = 3
"""Maps per row."""


@dataclass(frozen=True)
class Panel:
    """One map of the figure: modality, step and contact state."""

    modality: str
    step: int
    contact: bool


def middle_of_longest(mask: NDArray[np.bool_]) -> int | None:
    """Middle of the first longest interval of True, rounded down; None if there is none."""
    spans = measures.intervals(mask)
    if not len(spans):
        return None
    first, end = spans[(spans[:, 1] - spans[:, 0]).argmax()]
    return int(first + end - 1) // 2


def steps_by_contact(episode: Episode, index: int, selection: Sequence[int] = ()) -> dict[bool, int]:
    """A step in free motion, if any, and a step in contact; one step, as if in free motion, of a task without contact.

    Steps that are not in ``selection`` are the middle of the longest interval after the warm-up steps, or of the whole
    episode if there is none.

    Args:
        index: of the episode in its data set.

    Raises:
        BadInput: a selected step is not in the episode, two are in the same state, or the episode has no contact.
    """
    with_contact = "contact" in episode.task.covariates
    contact = episode.contact.astype(bool) & with_contact
    counted = np.arange(len(episode)) >= episode.task.first_counted(len(episode))
    steps: dict[bool, int] = {}
    for step in selection:
        check_step(step, len(episode), "episode")
        state = bool(contact[step])
        if state in steps:
            where = f"are both in {STATES[state]!r}: select one per state" if with_contact else "are two: select one"
            raise BadInput(f"steps {steps[state]} and {step} {where}")
        steps[state] = step
    if with_contact and not contact.any():
        raise BadInput(f"episode {index} has no contact: select another one with --episode")
    for state in STATES:
        mask = contact == state
        middle = middle_of_longest(mask & counted)
        middle = middle_of_longest(mask) if middle is None else middle
        if middle is not None:
            steps.setdefault(state, middle)
    return dict(sorted(steps.items()))


def panels(task: Task, modalities: Sequence[str], steps: dict[bool, int]) -> list[Panel]:
    """Panels of the figure: images have one map, in contact if there is any; others have one per contact state."""
    layout = []
    for modality in modalities:
        keys = task.modalities.get(modality, ())
        is_image = bool(keys) and all(len(task.observations[key]) > 1 for key in keys)
        layout += [
            Panel(modality, step, state) for state, step in steps.items() if state or not is_image or True not in steps
        ]
    return layout


def maps_figure(
    checkpoint: Checkpoint,
    trace: Trace,
    steps: dict[bool, int],
    size: int = FINE,
    quantity: Quantity | None = None,
) -> Figure:
    """Maps of each modality relative to their maxima, centred on the true position; of one component, curves.

    Haptics maps in contact show the direction of the ridge that the task expects, and the end effector. A filter that
    reports only its fused belief has one map of it. Raises BadInput if the filter has no maps, or not those of the
    quantity.

    Args:
        size: cells per side.
        quantity: by default the first one that the filter has.
    """
    engine = MapEngine(checkpoint, trace, [*steps.values()])
    quantity = quantity or engine.quantities[0]
    maps = {state: engine.map(step, size=size, quantity=quantity) for state, step in steps.items()}
    titles = [title for title, _ in axis_titles(checkpoint.task, checkpoint.task.map_indices)]
    *modalities, fused = next(iter(maps.values())).layers
    layout = panels(checkpoint.task, modalities or (fused,), steps)
    columns = min(PER_ROW, len(layout))
    rows = -(-len(layout) // columns)
    with rc_context(STYLE):
        width = WIDTH * (columns + 0.25) / (PER_ROW + 0.25)
        figure = new_figure(figsize=(width, 2.65 * rows), layout="constrained")
        grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
        for i, (axes, panel) in enumerate(zip(grid.flat, layout, strict=False)):
            image = _draw_map(axes, checkpoint.task, trace, panel, maps[panel.contact])
            letter = f"({chr(ord('a') + i)}) " if len(layout) > 1 else ""
            state = f"{STATES[panel.contact]}, " if "contact" in checkpoint.task.covariates else ""
            axes.set_title(f"{letter}{panel.modality} {quantity}\n{state}step {panel.step}", fontsize=7.5)
            if i + columns >= len(layout):
                axes.set_xlabel(titles[0])
                axes.tick_params(labelbottom=True)
            if i % columns == 0:
                axes.set_ylabel(f"{quantity} / maximum" if image is None else titles[1])
        for axes in grid.flat[len(layout) :]:
            axes.set_visible(False)
        if image is not None:
            figure.colorbar(image, ax=list(grid.flat), label=f"{quantity} / maximum", shrink=0.8, aspect=25)
    return figure


def _draw_map(axes: Axes, task: Task, trace: Trace, panel: Panel, map_: LikelihoodMap) -> AxesImage | None:
    """Draw a map; None for a curve."""
    log = map_.log_likelihood[map_.layers.index(panel.modality)]
    if len(task.map_components) == 1:
        _draw_curve(axes, task, trace, map_, log[0], colour(panel.modality, trace.modalities))
        return None
    half_x, half_y = (
        factor * half
        for (_, factor), half in zip(axis_titles(task, task.map_indices), plane_of(trace).half_widths, strict=True)
    )
    image = axes.imshow(
        np.exp(log - log.max()),
        cmap="viridis",
        vmin=0.0,
        vmax=1.0,
        origin="lower",
        extent=(-half_x, half_x, -half_y, half_y),
        aspect="equal" if len(task.main_error.indices) == 2 else "auto",
        interpolation="nearest",
    )
    if panel.contact and panel.modality in _effector_modalities(task, trace.modalities):
        _draw_expected_ridge(axes, task, trace, panel.step)
        _draw_effector(axes, task.main_error.factor * (_effector(task, trace, panel.step) - map_.centre))
        style = {"labelcolor": "white", "facecolor": "black", "framealpha": 0.5, "edgecolor": "none"}
        axes.legend(loc="best", fontsize=6, **style)
    _draw_crosshairs(axes, half_x, half_y)
    axes.set(xlim=(-half_x, half_x), ylim=(-half_y, half_y))
    return image


def _draw_curve(axes: Axes, task: Task, trace: Trace, map_: LikelihoodMap, log: NDArray[Any], shade: str) -> None:
    """Draw a map (S,) of one component, with a line at the true value."""
    ((_, factor), *_) = axis_titles(task, task.map_indices)
    half = factor * plane_of(trace).half_widths[0]
    axes.plot(factor * map_.offsets_x, np.exp(log - log.max()), color=shade, lw=1.3)
    axes.axvline(0.0, color=COLOURS["truth"], lw=0.9, ls="--")
    axes.set(xlim=(-half, half), ylim=(0.0, 1.05))


EDGE = [patheffects.withStroke(linewidth=2.0, foreground="black")]
"""Black outline that keeps white lines visible on bright colours."""


def _effector_modalities(task: Task, modalities: Sequence[str]) -> set[str]:
    """Modalities that observe the end effector position."""
    return {
        m
        for m in modalities
        if any(key in task.positions for part in m.split("+") for key in task.modalities.get(part, ()))
    }


def _effector(task: Task, trace: Trace, step: int) -> NDArray[np.float32]:
    """(2,) m, observed end effector position on the map."""
    key = next(key for key in task.positions if key in trace.episode.observations)
    return np.asarray(trace.episode.observations[key][step, list(task.positions[key])], dtype=np.float32)


def _draw_crosshairs(axes: Axes, half_x: float, half_y: float) -> None:
    """Draw crosshairs at the true position with a gap that keeps narrow peaks visible."""
    hair = np.array([-1.0, -0.15, np.nan, 0.15, 1.0])
    for x, y in ((half_x * hair, [0.0] * 5), ([0.0] * 5, half_y * hair)):
        axes.plot(x, y, color="white", lw=0.5, alpha=0.7)


def _draw_expected_ridge(axes: Axes, task: Task, trace: Trace, step: int) -> None:
    """Draw the line through the true position along which the task expects a ridge, if any."""
    if task.ridge_direction is None:
        return
    direction = float(task.ridge_direction(trace.episode.states[step]))
    style: dict[str, Any] = {"color": "white", "path_effects": EDGE}
    axes.axline((0.0, 0.0), (np.cos(direction), np.sin(direction)), lw=1.0, ls="--", label="expected ridge", **style)


def _draw_effector(axes: Axes, effector: NDArray[np.float32]) -> None:
    """Mark the end effector (2,), in units for display, which may be outside of the map."""
    axes.plot(*map(float, effector), marker="o", ms=4, ls="", color="white", path_effects=EDGE, label="end effector")


def weights_figure(trace: Trace) -> Figure:
    """Estimates of the map components, and the weights below, over steps with shaded contact.

    Component-wise weights are drawn for the map components. Raises BadInput for a trace without weights; the network's
    output beta, or effective weights without updates by modality, suffice.
    """
    weights = trace.weights if trace.effective_weights is None else trace.effective_weights
    if weights is None:
        raise BadInput(
            f"no weights to draw: {weight_audit.why_not(trace)}", "the figure `timeline` draws the estimates"
        )
    task = trace.task
    component_wise = weights.shape[-1] > 1
    columns = task.map_indices if component_wise else (0,)
    with rc_context(STYLE):
        drawn = [*trace.modalities_with_posterior, "fused"]
        legends = 2.0 * legend_height([*map(measures.layer_label, drawn), "truth"])
        height = 1.35 * (len(task.map_indices) + len(columns)) + 0.4 + legends
        figure = new_figure(figsize=(WIDTH, height), layout="constrained")
        charts = figure.subplots(len(task.map_indices) + len(columns), 1, sharex=True)
        for axes, i in zip(charts, task.map_indices, strict=False):
            _draw_estimates(axes, trace, i)
            axes.set_ylabel(with_unit(task.components[i].label, task.components[i].conversion[0]))
        for axes, i in zip(charts[len(task.map_indices) :], columns, strict=True):
            _draw_weights(axes, trace, i)
            axes.set_ylabel(f"weight, {task.components[i].label}" if component_wise else "weight")
        for axes in charts:
            _shade_phases(axes, trace)
        axis = _step_axis(trace)
        charts[-1].set_xlabel(
            axis.label if trace.episode.time is not None else f"step, {trace.episode.duration_text} each"
        )
        for axes in (charts[0], charts[len(task.map_indices)]):
            draw_legend(axes)
    return figure


def _draw_estimates(axes: Axes, trace: Trace, component: int) -> None:
    steps = _step_axis(trace).positions
    factor = trace.task.components[component].conversion[1]
    means = trace.task.near(measures.means(trace), trace.episode.states[:, None])
    *unimodal, fused = factor * means[..., component].T
    axes.plot(
        steps, fused, label="fused", color=COLOURS["fused"], lw=2.4
    )  # wide, so that a dominant modality on top leaves it visible
    for modality, values in zip(trace.modalities, unimodal, strict=True):
        if modality in trace.modalities_with_posterior:
            label = measures.layer_label(modality)
            axes.plot(steps, values, label=label, color=colour(modality, trace.modalities), lw=0.9)
    truth = factor * trace.episode.states[:, component].astype(np.float64)
    axes.plot(steps, truth, label="truth", color=COLOURS["truth"], lw=1.4, ls="--")


def _draw_weights(axes: Axes, trace: Trace, column: int) -> None:
    steps, beta, effective = _step_axis(trace).positions, trace.weights, trace.effective_weights
    beta_is_effective = beta is not None and (effective is None or np.allclose(beta, effective, atol=1e-3))
    for k, modality in enumerate(trace.modalities):
        shade = colour(modality, trace.modalities)
        if beta is not None:
            axes.plot(steps, beta[:, k, column], label=f"{modality} beta", color=shade, lw=1.1)
        if not beta_is_effective and effective is not None:
            axes.plot(
                steps, effective[:, k, column], label=f"{modality} effective", color=shade, lw=0.8, ls=(0, (2, 1.5))
            )
    drawn = beta if effective is None else effective
    low, high = (0.0, 1.0) if drawn is None else (float(drawn.min()), float(drawn.max()))
    axes.set_ylim(
        min(low, 0.0) - 0.03, max(high, 1.0) + 0.03
    )  # effective weights of a product of experts may exceed 0..1


def _shade_phases(axes: Axes, trace: Trace) -> None:
    """Shade contact and image blackout."""
    axis = _step_axis(trace)
    bands = {"contact": trace.episode.contact.astype(bool), "blackout": measures.blackout(trace)}
    draw_bands(axes, bands, axis, labelled=True)
    axes.set_xlim(axis.edges[0], axis.edges[-1])


def _step_axis(trace: Trace) -> StepAxis:
    return StepAxis.from_times(len(trace), trace.episode.time)
