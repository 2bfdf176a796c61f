from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.errors import BadInput


def slices(
    runs: opt.Runs,
    by: str = "error",
    alpha: float = opt.option("P", "Probability of reporting any slice if the errors depend on no condition.", 0.05),
    every: bool = False,
) -> console.Result:
    """Find data slices in which a filter is worse.

    Runs the filter over the held-out episodes and searches for conditions on phase, speed, force, image outages, true
    state and the recorded parameters of each episode under which the score is larger. Tests treat the episode as the
    unit and account for all conditions that are searched. Details: docs/slices.md.

    \b
    Examples:
      beliefscope slices push-field --filter information-ekf
      beliefscope slices door --filter crossmodal-pf --by angle --data door.h5
      beliefscope slices push --filter crossmodal-ekf --faults blackout=0.4 --json -
    """
    from beliefscope.inspect.slices.report import find_slices

    if not 0.0 < alpha < 1.0:
        raise BadInput(f"--alpha is {alpha:g}, not a probability between 0 and 1")
    checkpoint, faults = runs.open()
    with runs.episodes(checkpoint.task) as episodes, console.progress("Searching") as advance:
        report = find_slices(
            checkpoint,
            episodes,
            range(len(episodes)) if every else episodes.held_out(),
            by=by,
            alpha=alpha,
            **runs.settings(faults),
            progress=advance,
        )
    return console.Result(report.to_dict(), report.text)
