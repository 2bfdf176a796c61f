from __future__ import annotations

from pathlib import Path

from beliefscope.app.cli import console
from beliefscope.app.cli import options as opt
from beliefscope.datasets.errors import BadInput


@opt.with_options(
    episode=opt.option("I", "Diagnose only this episode. Default: the held-out ones.", parser=opt.integer(0)),
    base=opt.option("CHECKPOINT", "Checkpoint whose modules are tried in place of the filter's."),
    alarm_rate=opt.option("P", "Probability that a healthy filter raises an alarm."),
)
def diagnose(
    runs: opt.Runs,
    episode: int | None = None,
    base: Path | None = None,
    alarm_rate: float = 0.05,
) -> console.Result:
    """Name the probable cause of a filter's fault.

    Compares sensors, labels, modules and the filter with its healthy record, ranks the causes that explain all
    deviations, and confirms them by undoing them. Details: docs/diagnose.md.

    \b
    Examples:
      beliefscope diagnose door --filter crossmodal-ekf
      beliefscope diagnose push --filter crossmodal-pf --data push.h5 --json -
      beliefscope diagnose door --filter mine.safetensors --data door.h5 --base crossmodal-ekf --episode 3
    """
    from beliefscope.filters.open_filter import open_filter
    from beliefscope.inspect.diagnosis.diagnose import diagnose as run

    if not 0.0 < alarm_rate < 1.0:
        raise BadInput(f"--alarm-rate is {alarm_rate:g}, not a probability between 0 and 1")
    checkpoint, faults = runs.open()
    other = None if base is None else open_filter(checkpoint.task.name, str(base))
    with runs.episodes(checkpoint.task) as data:
        indices = data.held_out() if episode is None else [episode]
        episodes = {index: faults.apply(data[index], runs.seed) for index in indices}
    with console.progress("Diagnosing") as advance:
        result = run(
            checkpoint,
            episodes,
            seed=runs.seed,
            particles=runs.particles,
            alarm_rate=alarm_rate,
            base=other,
            progress=advance,
        )
    return console.Result(result.to_json(), "\n\n".join([result.headline, *console.grids(result.tables())]))
