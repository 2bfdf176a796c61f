"""The two figures of the paper from any filter's own run: likelihood maps by contact, and fusion weights over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import patheffects, rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics import weight_audit
from beliefscope.inspect.diagnostics.plotting import STYLE, WIDTH, draw_bands
from beliefscope.inspect.likelihood import FINE, MapEngine
from beliefscope.inspect.palette import COLOURS, colour
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace

STATES = {False: "no contact", True: "contact"}
"""States of contact, in the order of their panels."""

A_ROW = 3
"""Maps side by side."""


@dataclass(frozen=True)
class Panel:
    """One map of the figure: of a modality at a step, which is in contact or not."""

    modality: str
    step: int
    contact: bool


def middle_of_longest(mask: NDArray[np.bool_]) -> int | None:
    """Middle of the longest stretch of True, the first of several, the earlier of two middles; None without any."""
    found = measures.stretches(mask)
    if not len(found):
        return None
    first, end = found[(found[:, 1] - found[:, 0]).argmax()]
    return int(first + end - 1) // 2


def steps_by_contact(trace: Trace, given: Sequence[int] = ()) -> dict[bool, int]:
    """A step without contact, where there is any, and one in contact: the given ones, else by rule.

    The rule: the middle of the longest stretch after the steps that metrics leave out; of all where there is none.

    Raises:
        BadInput: a given step is not in the episode, or two are in one state; the episode is never in contact.
    """
    contact = trace.episode.contact.astype(bool)
    steps: dict[bool, int] = {}
    for step in given:
        if not 0 <= step < len(trace):
            raise BadInput(f"step {step} is not in this episode: it has steps 0 to {len(trace) - 1}")
        state = bool(contact[step])
        if state in steps:
            raise BadInput(f"steps {steps[state]} and {step} are both in state {STATES[state]!r}: give one of each")
        steps[state] = step
    if not contact.any():
        raise BadInput(f"episode {trace.episode_index} is never in contact: choose another with --episode")
    for state in STATES:
        mask = contact == state
        found = middle_of_longest(mask & measures.counted(trace))
        found = middle_of_longest(mask) if found is None else found
        if found is not None:
            steps.setdefault(state, found)
    return dict(sorted(steps.items()))


def panels(task: Task, modalities: Sequence[str], steps: dict[bool, int]) -> list[Panel]:
    """What a picture shows does not hang on contact: its one map is in contact. Of any other modality: one a state."""
    shown = []
    for modality in modalities:
        keys = task.modalities.get(modality, ())
        picture = bool(keys) and all(len(task.observations[key]) > 1 for key in keys)
        shown += [Panel(modality, step, state) for state, step in steps.items() if state or not picture]
    return shown


def maps_figure(checkpoint: Checkpoint, trace: Trace, steps: dict[bool, int], size: int = FINE) -> Figure:
    """Each modality's likelihood over its maximum, ``size`` cells a side, about the truth; in contact with the line to
    the end effector. Raises BadInput where there are no maps.
    """
    engine = MapEngine(checkpoint, trace)
    maps = {state: engine.map(step, size=size) for state, step in steps.items()}
    shown = panels(checkpoint.task, trace.modalities, steps)
    if not shown:
        raise BadInput(f"filter {checkpoint.name!r} has no map of a modality: it does not tell modalities apart")
    columns = min(A_ROW, len(shown))
    rows = -(-len(shown) // columns)
    with rc_context(STYLE):
        width = WIDTH * (columns + 0.25) / (A_ROW + 0.25)
        figure = Figure(figsize=(width, 2.65 * rows), layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
        for i, (axes, panel) in enumerate(zip(grid.flat, shown, strict=False)):
            map_ = maps[panel.contact]
            log = map_.log_likelihood[map_.layers.index(panel.modality)]
            half = 100.0 * checkpoint.task.map_half_width
            drawn = axes.imshow(
                np.exp(log - log.max()),
                cmap="viridis",
                vmin=0.0,
                vmax=1.0,
                origin="lower",
                extent=(-half, half, -half, half),
                interpolation="nearest",
            )
            if panel.contact and panel.modality in _felt(checkpoint.task, trace.modalities):
                _line(axes, 100.0 * (_effector(checkpoint.task, trace, panel.step) - map_.centre))
            _truth(axes, half)
            axes.set(xlim=(-half, half), ylim=(-half, half))
            letter = f"({chr(ord('a') + i)}) " if len(shown) > 1 else ""
            axes.set_title(f"{letter}{panel.modality}\n{STATES[panel.contact]}, step {panel.step}", fontsize=7.5)
            if i + columns >= len(shown):
                axes.set_xlabel(f"{_spoken(checkpoint.task.map_components[0])} offset (cm)")
                axes.tick_params(labelbottom=True)
            if i % columns == 0:
                axes.set_ylabel(f"{_spoken(checkpoint.task.map_components[1])} offset (cm)")
        for axes in grid.flat[len(shown) :]:
            axes.set_visible(False)
        figure.colorbar(drawn, ax=list(grid.flat), label="likelihood / maximum", shrink=0.8, aspect=25)
    return figure


EDGE = [patheffects.withStroke(linewidth=2.0, foreground="black")]
"""Makes white lines show on the brightest colours as well."""


def _felt(task: Task, modalities: Sequence[str]) -> set[str]:
    """Modalities that know where the end effector is."""
    return {
        m
        for m in modalities
        if any(key in task.positions for part in m.split("+") for key in task.modalities.get(part, ()))
    }


def _effector(task: Task, trace: Trace, step: int) -> NDArray[np.float32]:
    """(2,) m, where the end effector is on the map, as it was reported."""
    key = next(key for key in task.positions if key in trace.episode.observations)
    return np.asarray(trace.episode.observations[key][step, list(task.positions[key])], dtype=np.float32)


def _truth(axes: Axes, half: float) -> None:
    """Cross hairs with a gap, which leaves the peak of a narrow map to be seen."""
    hair = [-half, -0.15 * half, np.nan, 0.15 * half, half]
    for x, y in ((hair, [0.0] * 5), ([0.0] * 5, hair)):
        axes.plot(x, y, color="white", lw=0.5, alpha=0.7)


def _line(axes: Axes, effector: NDArray[np.float32]) -> None:
    """From the truth to the end effector (2,) cm, which may lie off the map."""
    x, y = map(float, effector)
    look: dict[str, Any] = {"color": "white", "path_effects": EDGE}
    axes.plot([0.0, x], [0.0, y], lw=1.0, ls="--", label="to the end effector", **look)
    axes.plot(x, y, marker="o", ms=4, **look)
    axes.legend(loc="best", fontsize=6, labelcolor="white", facecolor="black", framealpha=0.5, edgecolor="none")


def _spoken(component: str) -> str:
    return component.replace("_", " ")


def weights_figure(trace: Trace) -> Figure:
    """Each map component's estimates over the weights, over steps, with contact behind. Raises BadInput where there are
    no weight_audit. Where each component has its own, those of the map's are drawn.
    """
    if why := weight_audit.why_not(trace):
        raise BadInput(f"no weights to draw: {why}")
    assert trace.acting is not None
    task = measures.task_of(trace)
    own = trace.acting.shape[-1] > 1
    columns = task.map_indices if own else (0,)
    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 1.35 * (2 + len(columns)) + 0.4), layout="constrained")
        FigureCanvasAgg(figure)
        charts = figure.subplots(2 + len(columns), 1, sharex=True)
        for axes, i in zip(charts, task.map_indices, strict=False):
            _estimates(axes, trace, i)
            axes.set_ylabel(f"{_spoken(task.components[i].name)} (cm)")
        for axes, i in zip(charts[2:], columns, strict=True):
            _weights(axes, trace, i)
            axes.set_ylabel(f"weight, {_spoken(task.components[i].name)}" if own else "weight")
        for axes in charts:
            _bands(axes, trace)
        charts[-1].set_xlabel("step")
        for axes in (charts[0], charts[2]):
            axes.legend(frameon=False, ncols=6, loc="lower right", bbox_to_anchor=(1.0, 0.98), borderaxespad=0.0)
    return figure


def _estimates(axes: Axes, trace: Trace, component: int) -> None:
    steps = np.arange(len(trace))
    *alone, fused = 100.0 * measures.means(trace)[..., component].T
    axes.plot(steps, fused, label="fused", color=COLOURS["fused"], lw=2.4)  # below: a modality that decides lies on it
    for modality, values in zip(trace.modalities, alone, strict=True):
        axes.plot(steps, values, label=modality, color=colour(modality, trace.modalities), lw=0.9)
    truth = 100.0 * trace.episode.states[:, component].astype(np.float64)
    axes.plot(steps, truth, label="truth", color=COLOURS["truth"], lw=1.4, ls="--")


def _weights(axes: Axes, trace: Trace, column: int) -> None:
    assert trace.acting is not None
    steps, given = np.arange(len(trace)), trace.weights
    as_given = given is not None and np.allclose(given, trace.acting, atol=1e-3)
    for k, modality in enumerate(trace.modalities):
        shade = colour(modality, trace.modalities)
        if given is not None:
            axes.plot(steps, given[:, k, column], label=f"{modality} beta", color=shade, lw=1.1)
        if not as_given:
            share = trace.acting[:, k, column]
            axes.plot(steps, share, label=f"{modality} acting", color=shade, lw=0.8, ls=(0, (2, 1.5)))
    low, high = float(trace.acting.min()), float(trace.acting.max())
    axes.set_ylim(min(low, 0.0) - 0.03, max(high, 1.0) + 0.03)  # shares of a product of experts may leave 0..1


def _bands(axes: Axes, trace: Trace) -> None:
    """Contact behind everything, and black pictures where there are any."""
    draw_bands(axes, {"contact": trace.episode.contact.astype(bool), "blackout": measures.blackout(trace)}, named=True)
    axes.set_xlim(-0.5, len(trace) - 0.5)
