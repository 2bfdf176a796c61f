import math
import os
import shlex
from pathlib import Path

from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.text import plural


def live(
    run: opt.Run,
    rate: float | None = opt.option("HZ", "Steps per second; 0: as fast as possible. Default: the task's rate.", None),
    workspace: Path = Path("workspace"),
    name: str = opt.option("NAME", "Name of the run. Default: task, filter and episode.", ""),
) -> console.Result:
    """Run a filter in real time and stream it to the dashboard.

    Runs the filter over one episode step by step, at the robot's rate. The dashboard (beliefscope serve --workspace
    DIR) shows the steps as they arrive. They are also written to DIR/live/NAME.live and NAME.rrd; data survive any
    exit, including Ctrl-C and kill. To record a filter in your own loop, use beliefscope.LiveRecorder
    (docs/live.md).

    \b
    Examples:
      beliefscope live door --filter crossmodal-pf
      beliefscope live door --filter crossmodal-ekf --faults blackout=0.8 --rate 50 --workspace runs
      beliefscope live door --filter examples/04_own_filter.py:build --name mine
    """
    # Rerun reads it when it is imported: suppress its warning that a growing file has no index yet.
    os.environ.setdefault("RUST_LOG", "error")

    from beliefscope.app.protocol.permalinks import page_link
    from beliefscope.app.runs.live_runs import LIVE_PREFIX
    from beliefscope.recordings.live_episode import record_steps, run_steps

    if rate is not None and not (math.isfinite(rate) and rate >= 0):
        raise BadInput(f"--rate {rate:g} is not a number of steps per second, or 0 for as fast as possible")
    opt.check_workspace(workspace)
    checkpoint, faults = run.open()
    recorded, index = run.read_episode(checkpoint.task)
    name = name or f"{checkpoint.task.name}-{checkpoint.name}-episode{index}"
    arguments = checkpoint, recorded, index, run.seed, run.particles, faults
    recorder, steps = record_steps(*arguments, name, workspace / "live")
    watch = shlex.join(["beliefscope", "serve", "--workspace", str(workspace)])
    link = page_link(task=checkpoint.task.name, data=f"{LIVE_PREFIX}{recorder.path.stem}")  # of the run's only episode
    console.note(f"{recorder.path}: view it with {watch} at {opt.URL}/{link}")
    count = len(recorded)
    with console.bars() as update:
        timing = run_steps(
            recorder,
            steps,
            count,
            rate=1.0 / recorded.dt if rate is None else rate,
            on_step=lambda done, hz: update("Live", done / count, f"step {done - 1}, {hz:.1f} Hz"),
        )
    document = {
        "task": checkpoint.task.name,
        "filter": checkpoint.name,
        "episode": index,
        "steps": recorder.steps,
        "stopped": timing.stopped,
        "hz": recorder.steps / timing.total,
        "step_ms": 1e3 * sorted(timing.steps)[len(timing.steps) // 2] if timing.steps else None,
        "late": timing.late,
        "waited": recorder.waited,
        "behind": recorder.behind,
        "recording": str(recorder.path.with_suffix(".rrd")),
    }
    if not recorder.steps:
        return console.Result(document, "stopped before the first step; no file was written")
    summary = f"{plural(recorder.steps, 'step')} at {document['hz']:.1f} Hz, {timing.late} of them late"
    summary += ", stopped early" if timing.stopped else ""
    return console.Result(document, summary, recorder.path)
