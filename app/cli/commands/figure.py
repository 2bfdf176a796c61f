from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from beliefscope.app.cli import console, options as opt
from beliefscope.app.cli.recorded_runs import FORMS, TaskOrRecordedRuns
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import write_atomically

if TYPE_CHECKING:
    from beliefscope.datasets.episode import Episode
    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.inspect.trace import Trace


@dataclass(frozen=True)
class DrawnRun(TaskOrRecordedRuns, opt.Run):
    """Options of the run that a figure shows: of a filter over an episode, or a recorded one."""

    task: Annotated[
        str,
        opt.argument(
            "TASK|RUN",
            "Task: a built-in one such as door, or your own as FILE.py:NAME; the name is enough if --data or a "
            f"checkpoint contains the definition. Or {FORMS}.",
        ),
    ]
    filter: str = ""

    def traced(self, check: Callable[[Episode, int], object]) -> tuple[Checkpoint, Trace]:
        """The filter, which may be unavailable if the run is recorded, and the trace of the run.

        check: called with the episode and its index, before the filter runs.
        """
        from beliefscope.inspect.traces.provenance import checkpoint_of, unavailable_filter
        from beliefscope.recordings.open_trace import open_trace

        if not self.is_recorded:
            checkpoint, faults = self.open()
            episode, index = self.read_episode(checkpoint.task)
            check(episode, index)
            return checkpoint, self.over(checkpoint, episode, index, faults)
        if self.faults or self.episode is not None:
            raise BadInput("a recorded run is drawn as it is, without --faults and --episode")
        if Path(self.task).is_dir():
            raise BadInput(f"{self.task} is a folder; give one of its runs")
        trace = open_trace(Path(self.task))
        check(trace.episode, trace.episode_index)
        recorded = checkpoint_of([trace], [Path(self.task)], self.filter)
        return recorded or unavailable_filter(trace), trace


@dataclass(frozen=True)
class TimelineOptions:
    """Options of the figure of a timeline, see ``inspect.figures.timeline.View``."""

    charts: Annotated[
        list[str] | None,
        opt.option(
            "NAME",
            "Chart of a timeline, from top to bottom: weights, estimate, error, signed, nees, innovation, particles, "
            "readings/SENSOR, readings/control, residual/SENSOR, innovation/MODALITY or extra/NAME. Repeatable. "
            "Default: weights, estimate and error.",
            ...,
            "--chart",
        ),
    ] = None
    component: Annotated[
        str, opt.option("NAME", "State component of a timeline's charts. Default: the first one of the map.")
    ] = ""
    beta: Annotated[bool, opt.flag("Fusion weights beta in place of effective weights.", "--beta", default=...)] = False
    window: Annotated[str, opt.option("FIRST-LAST", "Visible steps of a timeline, such as 20-60. Default: all.")] = ""
    seconds: Annotated[bool, opt.flag("Time in s in place of the step.", "--seconds", default=...)] = False
    group: Annotated[
        str, opt.option("NAME", "Group of steps that a timeline shades. Default: the first one, such as contact.")
    ] = ""


def figure(
    *,
    kind: Literal["maps", "weights", "timeline"] = opt.argument("maps|weights|timeline", "Kind of figure."),
    run: DrawnRun,
    output: Path = opt.output_file(
        "FIGURE", "Output figure: .svg, .pdf or .png; of a timeline also its values, .csv.", default=...
    ),
    steps: list[int] | None = opt.option(
        "T",
        "Step of a map: one in contact, one in free motion, or both (repeat the option). Default: the middle of the "
        "longest stretch of each, or of the episode for a task without contact.",
        None,
        "--step",
        parser=opt.integer(0),
    ),
    quantity: opt.Quantity | None = None,
    view: TimelineOptions,
) -> console.Result:
    """Draw a figure for a paper from a filter run.

    The run is over an episode of a task, or a recorded one, such as that of an imported log.

    maps: likelihood or posterior of each modality around the true position, in free motion and in contact. For a task
    without contact, the maps are at one step; for a state with one map component, they are curves.
    weights: estimates of each modality and of the fused filter over time, with the fusion weights below and contact
    shaded.
    timeline: charts of the page's timeline in the width of one column, 8.5 cm, or their values as CSV.

    \b
    Examples:
      beliefscope figure maps door --filter crossmodal-pf -o maps.svg
      beliefscope figure maps door --filter crossmodal-ekf --map posterior -o posterior.svg
      beliefscope figure weights push --filter crossmodal-ekf --episode 9 -o weights.pdf
      beliefscope figure timeline door --filter crossmodal-ekf --faults blackout=0.4 --window 20-60 -o timeline.pdf
      beliefscope figure timeline door --filter crossmodal-pf --chart error --chart particles -o timeline.csv
      beliefscope figure timeline traces/today/run_0.trace --chart estimate --chart innovation -o timeline.pdf
    """
    from beliefscope.inspect.diagnostics import plotting
    from beliefscope.inspect.diagnostics.plotting import figure_format, write_figure
    from beliefscope.inspect.figures import paper
    from beliefscope.inspect.figures.timeline import DEFAULT_CHARTS, View, timeline
    from beliefscope.inspect.figures.timeline_figure import FORMATS, encoded_timeline
    from beliefscope.inspect.maps.availability import no_maps
    from beliefscope.inspect.maps.plane import is_outside

    format = figure_format(output, FORMATS if kind == "timeline" else plotting.FORMATS)
    if kind != "maps":
        _refuse("maps", {"step": steps, "map": quantity})
    if kind != "timeline":
        _refuse("timeline", {"chart": view.charts} | {k: v for k, v in vars(view).items() if k != "charts"})
    shown = View(**vars(view) | {"charts": tuple(view.charts or DEFAULT_CHARTS)})

    def map_steps(episode: Episode, index: int) -> dict[bool, int]:
        if view.component:
            episode.task.index(view.component)
        return paper.steps_by_contact(episode, index, steps or ()) if kind == "maps" else {}

    checkpoint, trace = run.traced(map_steps)
    selection = map_steps(trace.episode, trace.episode_index)
    extra: dict[str, Any] = {}
    if kind == "maps":
        if reason := no_maps(checkpoint, trace, quantity, [*selection.values()]):
            raise BadInput(reason)
        with_contact = "contact" in trace.task.covariates
        if with_contact and False not in selection:
            console.note(f"episode {trace.episode_index} is in contact at every step: no map of free motion")
        for step in selection.values():
            if is_outside(trace, step):
                console.note(f"Warning: at step {step}, the fused estimate is outside of the map")
        write_figure(paper.maps_figure(checkpoint, trace, selection, quantity=quantity), output)
        extra["map_steps"] = {paper.STATES[state] if with_contact else "all": step for state, step in selection.items()}
    elif kind == "weights":
        write_figure(paper.weights_figure(trace), output)
    else:
        drawn = timeline(trace, shown)
        for name, reason in drawn.missing.items():
            console.note(f"no chart {name}: {reason}")
        write_atomically(output, encoded_timeline(drawn, format))
    return opt.trace_result(trace, output, figure=kind, **extra)


def _refuse(kind: str, values: Mapping[str, Any]) -> None:
    """Raise BadInput for a value of an option that only another kind of figure has."""
    for option, value in values.items():
        if value:
            words = value if isinstance(value, list) else [] if value is True else [value]
            raise BadInput(f"{' '.join(map(str, ['--' + option, *words]))}: only the figure {kind} has this option")
