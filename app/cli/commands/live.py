"""``beliefscope live``"""

from __future__ import annotations

import math
import os
import shlex
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from beliefscope.app.cli import options as opt
from beliefscope.app.cli import output
from beliefscope.datasets.errors import BadInput

if TYPE_CHECKING:
    from beliefscope.datasets.episode import Episode
    from beliefscope.datasets.faults.injection import Faults
    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.recordings.live import LiveRecorder


def live(
    task: opt.TaskName,
    filter_: opt.FilterName,
    data: opt.DataPath = None,
    skip_bad: opt.SkipBad = False,
    episode: opt.EpisodeIndex = None,
    faults_: opt.FaultsText = "",
    particles: opt.Particles = 300,
    seed: opt.Seed = 0,
    rate: Annotated[
        float | None,
        typer.Option(metavar="HZ", help="Steps per second; 0: as fast as possible. Default: the task's rate."),
    ] = None,
    workspace: opt.Workspace = Path("workspace"),
    name: Annotated[str, typer.Option(help="Name of the run. Default: task, filter and episode.")] = "",
    json: opt.Json = None,
) -> None:
    """Run a filter in real time and stream it to the dashboard.

    Runs the filter over one episode step by step, at the robot's rate. The dashboard (beliefscope serve --workspace
    DIR) shows the steps as they arrive. They are also written to DIR/live/NAME.live and NAME.rrd; data survive any
    exit, including Ctrl-C and kill. To record a filter in your own loop, use beliefscope.recordings.live.LiveRecorder
    (docs/live.md).

    \b
    Examples:
      beliefscope live door --filter crossmodal-pf
      beliefscope live door --filter crossmodal-ekf --faults blackout=0.8 --rate 50 --workspace runs
      beliefscope live door --filter examples/04_own_filter.py:build --name mine
    """
    os.environ.setdefault("RUST_LOG", "error")  # suppress Rerun's warning that a growing file has no index yet
    if rate is not None and not (math.isfinite(rate) and rate >= 0):
        raise BadInput(f"--rate {rate:g} is not a number of steps per second, or 0 for as fast as possible")
    opt.check_workspace(workspace)
    checkpoint = opt.open_checkpoint(task, filter_)
    faults = opt.parse_faults(faults_, checkpoint.task)
    recorded, index = opt.select_episode(checkpoint.task, data, skip_bad, episode)
    name = name or f"{checkpoint.task.name}-{checkpoint.name}-episode{index}"
    recorder, steps = _start(checkpoint, recorded, index, seed, particles, faults, name, workspace / "live")
    watch = shlex.join(["beliefscope", "serve", "--workspace", str(workspace)])
    output.note(f"{recorder.path}: view it with {watch}")
    timing = _run(recorder, steps, len(recorded), 1.0 / recorded.dt if rate is None else rate)
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
        "path": str(recorder.path),
        "recording": str(recorder.path.with_suffix(".rrd")),
    }
    if not recorder.steps:
        output.result(document, "stopped before the first step; no file was written", json)
        return
    summary = f"{recorder.steps} steps at {document['hz']:.1f} Hz, {timing.late} of them late"
    summary += ", stopped early" if timing.stopped else ""
    output.result(document, f"{opt.path_and_size(recorder.path)}: {summary}", json)


@dataclass
class _Timing:
    """Durations of a run in s. late: steps that ended after their deadline. stopped: whether by Ctrl-C."""

    steps: list[float] = field(default_factory=list)
    total: float = 0.0
    late: int = 0
    stopped: bool = False


def _run(recorder: LiveRecorder, steps: Iterator[None], count: int, rate: float) -> _Timing:
    """Run all steps at a rate (Hz, 0: as fast as possible) until the end or Ctrl-C."""
    timing, start = _Timing(), time.perf_counter()
    try:
        with recorder, output.bars() as update:
            for t in range(count):
                due = start + t / rate if rate else 0.0
                time.sleep(max(0.0, due - time.perf_counter()))
                step_start = time.perf_counter()
                next(steps)
                end = time.perf_counter()
                timing.steps.append(end - step_start)
                timing.late += bool(rate) and end > due + 1 / rate
                update("Live", (t + 1) / count, f"step {t}, {len(timing.steps) / (end - start):.1f} Hz")
            timing.total = time.perf_counter() - start
    except KeyboardInterrupt:
        timing.stopped, timing.total = True, time.perf_counter() - start
    return timing


def _start(
    checkpoint: Checkpoint,
    episode: Episode,
    index: int,
    seed: int,
    particles: int,
    faults: Faults,
    name: str,
    folder: Path,
) -> tuple[LiveRecorder, Iterator[None]]:
    """The recorder, and an iterator that runs and records one step each. The steps equal those of ``trace``."""
    import torch

    from beliefscope.filters.external.load import ExternalFilter
    from beliefscope.inspect.traces.run import start_run
    from beliefscope.recordings.live import LiveRecorder

    options: dict[str, Any] = {"folder": folder, "like": episode, "expected": len(episode)}
    if isinstance(checkpoint, ExternalFilter):
        options |= {"filter": checkpoint.name, "checkpoint_hash": checkpoint.hash, "data_hash": episode.digest()}
        options |= {"faults": faults, "episode_index": index, "seed": seed}
        options |= {"settings": {"torch": torch.__version__, "source": checkpoint.source}}
        faulty = faults.apply(episode, seed)
        outputs = checkpoint.live(faulty, seed)
        first = next(outputs)  # has the names of the measurement models
        options |= {"task": checkpoint.task.name, "modalities": first[1], "start": checkpoint.start([faulty])}
        recorder = LiveRecorder(name, **options)

        def external_steps() -> Iterator[None]:
            for (values, _), row in zip(chain([first], outputs), _rows(faulty), strict=True):
                recorder.step(values, **row)
                yield

        return recorder, external_steps()
    run = start_run(checkpoint, episode, index, seed, particles, faults)
    recorder = LiveRecorder(name, checkpoint, start=run.start, **options, **run.provenance)

    @torch.no_grad()
    def steps() -> Iterator[None]:
        generator = run.generator()
        belief = checkpoint.filter.start(run.start, particles, generator)
        for t, row in enumerate(_rows(run.episode)):
            belief, values = checkpoint.filter.step(belief, run.evidence[t], generator)
            recorder.step(values, **row, evidence=run.evidence[t])
            yield

    return recorder, steps()


def _rows(episode: Episode) -> Iterator[dict[str, Any]]:
    """Arguments of ``LiveRecorder.step`` for each step of an episode."""
    for t in range(len(episode)):
        yield {
            "observations": {key: array[t] for key, array in episode.observations.items()},
            "control": episode.controls[t],
            "truth": episode.states[t],
            "contact": bool(episode.contact[t]),
            "qpos": episode.qpos[t],
        }
