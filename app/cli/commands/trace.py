from pathlib import Path

from beliefscope.app.cli import console, options as opt


@opt.with_options(output=opt.TRACE)
def trace(run: opt.Run, output: Path, align: bool = False, particles_kept: int = 10_000) -> console.Result:
    """Save all internal quantities of a filter run.

    A trace contains, for every step, the beliefs before and after the observation, each modality's own update, fusion
    weights as output by the network and effective weights, particles and their ancestors. Estimates are bit-identical
    to those of a run without tracing. Memory does not grow with particles times steps: of more than --particles-kept
    particles, that many are stored in each step. Read it in Python with beliefscope.inspect.trace.load_trace.

    \b
    Examples:
      beliefscope trace door --filter crossmodal-pf --episode 9 -o run.trace
      beliefscope trace door --filter crossmodal-pf --faults force_bias:x=5:from=20 -o biased.trace
    """
    from beliefscope.inspect.trace import save_trace

    _, trace = run.trace(align, particles_kept=particles_kept)
    save_trace(trace, output)
    return opt.trace_result(trace, output)
