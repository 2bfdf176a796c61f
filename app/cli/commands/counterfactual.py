from pathlib import Path

from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.errors import BadInput


def counterfactual(
    run: opt.Run,
    first: int = opt.option("STEP", "First step of the intervention.", ..., "--from", parser=opt.integer(0)),
    to: int = opt.option("STEP", "First step after the intervention.", parser=opt.integer(1)),
    weights: str = opt.option(
        "MODALITY=BETA,...",
        "Manual fusion weights that replace the network's; other modalities share the remainder.",
        "",
    ),
    output: Path | None = opt.output_file("FIGURE", "Also draw a .svg, .pdf or .png figure."),
    trace_path: Path | None = opt.output_file(
        "RUN.trace", "Also write the trace of the modified run.", ".trace", names=("--trace",)
    ),
) -> console.Result:
    """Rerun a filter with a temporary intervention.

    Injects sensor faults or replaces fusion weights between two steps, starting from the belief before the first of
    them. Both runs use the same random numbers, so every difference results from the intervention. Reports how far
    the estimate moved, in its units and in standard deviations of the original run, when it recovered, and the dominant
    modality during the intervention. The faults must not have steps of their own (:from, :to).

    \b
    Examples:
      beliefscope counterfactual door --filter crossmodal-pf --faults blackout --from 40 --to 60
      beliefscope counterfactual door --filter crossmodal-ekf --weights image=0.1 --from 40 --to 60 -o weights.svg
      beliefscope counterfactual push --filter crossmodal-pf --faults force_bias=5 --from 20 --to 50 --trace b.trace
    """
    from beliefscope.inspect.compare.counterfactual import compare
    from beliefscope.inspect.diagnostics.plotting import figure_format, write_figure
    from beliefscope.inspect.trace import save_trace, trace
    from beliefscope.inspect.traces.external_replay import open_replay
    from beliefscope.inspect.traces.replay import Intervention, parse_weights

    if output is not None:
        figure_format(output)
    checkpoint, faults = run.open()
    intervention = Intervention(first, to, faults, parse_weights(weights))
    if not intervention.faults and not intervention.weights:
        raise BadInput("no intervention: give --faults, --weights or both")
    recorded, index = run.read_episode(checkpoint.task)
    intervention.check(checkpoint, len(recorded))
    with console.progress("Filtering") as advance:
        original = trace(checkpoint, recorded, index, run.seed, run.particles)
        replay = open_replay(checkpoint, original, progress=advance)
        counterfactual = replay.with_intervention(intervention)
    result = compare(replay.original, counterfactual, intervention)
    if output is not None:
        write_figure(result.plot(result.time), output)
    if trace_path is not None:
        save_trace(counterfactual, trace_path)
    document = {
        "task": checkpoint.task.name,
        "filter": checkpoint.name,
        "episode": index,
        "seed": run.seed,
        "checkpoint_hash": checkpoint.hash,
        "data_hash": original.data_hash,
        **result.to_dict(),
        "intervention": intervention.to_json(),
    }
    return console.Result(document, result.text)
