from pathlib import Path

from beliefscope.app.cli import console, options as opt


def trace(
    run: opt.Run,
    output: Path = opt.output_file("RUN.trace", "Output trace file.", ".trace", default=...),
    align: bool = False,
    particles_kept: int = 10_000,
) -> console.Result:
    """Save all internal quantities of a filter run.

    A trace contains, for every step, the beliefs before and after the observation, each modality's own update, fusion
    weights as output by the network and effective weights, particles and their ancestors. Estimates are bit-identical
    to those of a run without tracing. To limit memory, at most --particles-kept particles are stored in each step, and
    episodes of more than 4096 steps are read and written in parts (but not with --faults, --align or an external
    filter). Read a trace in Python with beliefscope.load_trace.

    \b
    Examples:
      beliefscope trace door --filter crossmodal-pf --episode 9 -o run.trace
      beliefscope trace door --filter crossmodal-pf --faults force_bias:x=5:from=20 -o biased.trace
    """
    from beliefscope.datasets.episode import Episode
    from beliefscope.datasets.episode_parts import STEPS_PER_PART
    from beliefscope.filters.external.load import ExternalFilter
    from beliefscope.inspect.trace import save_trace, save_trace_parts, trace_parts

    checkpoint, faults = run.open()
    with run.episodes(checkpoint.task) as data:
        index = run.index(data)
        needs_whole = align or faults or isinstance(checkpoint, ExternalFilter)
        episode = data[index] if needs_whole else data.in_parts(index)
        if isinstance(episode, Episode):
            trace = run.over(checkpoint, episode, index, faults, align, particles_kept=particles_kept)
            save_trace(trace, output)
        else:
            run.check(checkpoint, [episode.part(0, STEPS_PER_PART)], align)
            with console.progress("Filtering") as advance:
                parts = trace_parts(checkpoint, episode, index, run.seed, run.particles, advance, particles_kept)
                trace = save_trace_parts(parts, len(episode), output)
    return opt.trace_result(trace, output, steps=len(episode))
