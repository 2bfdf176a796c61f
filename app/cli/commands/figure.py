from pathlib import Path
from typing import Any, Literal

from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.errors import BadInput


def figure(
    *,
    kind: Literal["maps", "weights"] = opt.argument("maps|weights", "Kind of figure."),
    run: opt.Run,
    output: Path = opt.output_file("FIGURE", "Output figure: .svg, .pdf or .png.", default=...),
    steps: list[int] | None = opt.option(
        "T",
        "Step of a map: one in contact, one in free motion, or both (repeat the option). Default: the middle of the "
        "longest stretch of each, or of the episode for a task without contact.",
        None,
        "--step",
        parser=opt.integer(0),
    ),
    quantity: opt.Quantity | None = None,
) -> console.Result:
    """Draw a figure of the paper from a filter run.

    maps: likelihood or posterior of each modality around the true position, in free motion and in contact. For a task
    without contact, the maps are at one step; for a state with one map component, they are curves.
    weights: estimates of each modality and of the fused filter over time, with the fusion weights below and contact
    shaded.

    \b
    Examples:
      beliefscope figure maps door --filter crossmodal-pf -o maps.svg
      beliefscope figure maps door --filter crossmodal-ekf --map posterior -o posterior.svg
      beliefscope figure weights push --filter crossmodal-ekf --episode 9 -o weights.pdf
    """
    from beliefscope.inspect.diagnostics.plotting import figure_format, write_figure
    from beliefscope.inspect.figures import paper
    from beliefscope.inspect.maps.map_engine import no_maps
    from beliefscope.inspect.maps.plane import is_outside

    figure_format(output)
    if kind == "weights" and steps:
        raise BadInput(f"--step {steps[0]}: the figure of weights covers all steps; only maps have a step")
    if kind == "weights" and quantity:
        raise BadInput(f"--map {quantity}: only the figure maps has a quantity")
    checkpoint, faults = run.open()
    episode, index = run.read_episode(checkpoint.task)
    selection = paper.steps_by_contact(episode, index, steps or ()) if kind == "maps" else {}
    trace = run.over(checkpoint, episode, index, faults)
    extra: dict[str, Any] = {}
    if kind == "maps":
        if reason := no_maps(checkpoint, trace, quantity):
            raise BadInput(reason)
        with_contact = "contact" in trace.task.covariates
        if with_contact and False not in selection:
            console.note(f"episode {trace.episode_index} is in contact at every step: no map of free motion")
        for step in selection.values():
            if is_outside(trace, step):
                console.note(f"Warning: at step {step}, the fused estimate is outside of the map")
        write_figure(paper.maps_figure(checkpoint, trace, selection, quantity=quantity), output)
        extra["map_steps"] = {paper.STATES[state] if with_contact else "all": step for state, step in selection.items()}
    else:
        write_figure(paper.weights_figure(trace), output)
    return opt.trace_result(trace, output, figure=kind, **extra)
