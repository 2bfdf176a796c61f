"""``beliefscope live``"""

from __future__ import annotations

import math
import os
import shlex
import time
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from beliefscope.app.cli import output
from beliefscope.app.cli.commands.serve import check_workspace
from beliefscope.app.cli.options import (
    DataPath,
    EpisodeIndex,
    FaultsText,
    FilterName,
    Json,
    Particles,
    Seed,
    SkipBad,
    TaskName,
    check,
    checkpoint,
    faults,
    one_episode,
    size,
)
from beliefscope.datasets.errors import BadInput

if TYPE_CHECKING:
    from beliefscope.datasets.episode import Episode
    from beliefscope.datasets.faults.injection import Faults
    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.recordings.live import LiveRecorder


def live(
    task: TaskName,
    filter_: FilterName,
    data: DataPath = None,
    skip_bad: SkipBad = False,
    episode: EpisodeIndex = None,
    faults_: FaultsText = "",
    particles: Particles = 300,
    seed: Seed = 0,
    rate: Annotated[
        float | None,
        typer.Option("--rate", metavar="HZ", help="Steps a second; without it the task's own, 0: as fast as it can."),
    ] = None,
    workspace: Annotated[
        Path, typer.Option("--workspace", metavar="DIR", help="Folder of the page that shows it; made if missing.")
    ] = Path("workspace"),
    name: Annotated[str, typer.Option("--name", help="Of the run; without it, made of task, filter and episode.")] = "",
    json: Json = None,
) -> None:
    """Run a filter live, for the page to watch.

    The filter goes through one episode as if on the robot: a step at a time, at the robot's rate. Its steps are on the
    page of beliefscope serve --workspace DIR as they come, and in two files, DIR/live/NAME.live and NAME.rrd, which
    are good however the run ends: by itself, by Ctrl-C or by a kill. For a filter in a loop of your own take
    beliefscope.recordings.live.LiveRecorder: three lines, in docs/live.md.

    \b
    Examples:
      beliefscope live door --filter crossmodal-pf
      beliefscope live door --filter crossmodal-ekf --faults blackout=0.8 --rate 50 --workspace runs
      beliefscope live door --filter examples/04_own_filter.py:build --name mine
    """
    check(None, json)
    os.environ.setdefault("RUST_LOG", "error")  # else Rerun warns that a file that grows has no index yet
    if rate is not None and not (math.isfinite(rate) and rate >= 0):
        raise BadInput(f"--rate {rate:g}: steps a second, or 0 for as fast as it can")
    check_workspace(workspace)
    loaded = checkpoint(task, filter_)
    broken = faults(faults_, loaded.task)
    shown, index = one_episode(loaded.task, data, skip_bad, episode)
    name = name or f"{loaded.task.name}-{loaded.name}-episode{index}"
    every = 1.0 / shown.dt if rate is None else rate
    watch = shlex.join(["beliefscope", "serve", "--workspace", str(workspace)])
    recorder, steps = _begun(loaded, shown, index, seed, particles, broken, name, workspace / "live")
    output.say(f"{recorder.path}: watch it with {watch}")
    taken: list[float] = []
    late, stopped, began = 0, False, time.perf_counter()
    try:
        with recorder, output.bars() as move:
            for t in range(len(shown)):
                due = began + t / every if every else 0.0
                time.sleep(max(0.0, due - time.perf_counter()))
                start = time.perf_counter()
                next(steps)
                taken.append(time.perf_counter() - start)
                late += bool(every) and time.perf_counter() > due + 1 / every
                move("Live", (t + 1) / len(shown), f"step {t}, {len(taken) / (time.perf_counter() - began):.1f} Hz")
            took = time.perf_counter() - began
    except KeyboardInterrupt:
        stopped, took = True, time.perf_counter() - began
    document = {
        "task": loaded.task.name,
        "filter": loaded.name,
        "episode": index,
        "steps": recorder.steps,
        "stopped": stopped,
        "hz": recorder.steps / took,
        "step_ms": 1e3 * sorted(taken)[len(taken) // 2] if taken else None,
        "late": late,
        "waited": recorder.waited,
        "behind": recorder.behind,
        "path": str(recorder.path),
        "recording": str(recorder.path.with_suffix(".rrd")),
    }
    if not recorder.steps:
        output.result(document, "stopped before its first step; nothing is written", json)
        return
    said = f"{size(recorder.path)}: {recorder.steps} steps at {document['hz']:.1f} Hz, {late} of them late"
    output.result(document, said + (", then stopped" if stopped else ""), json)


def _begun(
    loaded: Checkpoint,
    episode: Episode,
    index: int,
    seed: int,
    particles: int,
    broken: Faults,
    name: str,
    folder: Path,
) -> tuple[LiveRecorder, Iterator[None]]:
    """The recorder, and the run: each ``next`` takes a step and hands it over. Its steps are those of ``trace``."""
    import torch

    from beliefscope.filters.external.load import Foreign
    from beliefscope.inspect.trace import begin
    from beliefscope.recordings.live import LiveRecorder

    where: dict[str, Any] = {"folder": folder, "like": episode, "expected": len(episode)}

    def rows(seen: Episode) -> Iterator[dict[str, Any]]:
        for t in range(len(seen)):
            yield {
                "observations": {key: array[t] for key, array in seen.observations.items()},
                "control": seen.controls[t],
                "truth": seen.states[t],
                "contact": bool(seen.contact[t]),
                "qpos": seen.qpos[t],
            }

    if isinstance(loaded, Foreign):
        where |= {"filter": loaded.name, "checkpoint_hash": loaded.hash, "data_hash": episode.digest(), "seed": seed}
        where |= {"faults": broken, "episode_index": index}
        where |= {"settings": {"torch": torch.__version__, "source": loaded.source}}
        seen = broken.apply(episode, seed)
        taken = loaded.live(seen, seed)
        first = next(taken)  # which tells the names of its models
        recorder = LiveRecorder(name, task=loaded.task.name, modalities=first[1], start=loaded.start([seen]), **where)

        def own() -> Iterator[None]:
            for (known, _), row in zip(chain([first], taken), rows(seen), strict=True):
                recorder.step(known, **row)
                yield

        return recorder, own()
    run = begin(loaded, episode, index, seed, particles, broken)
    recorder = LiveRecorder(name, loaded, start=run.start, **where, **run.given)

    @torch.no_grad()
    def ours() -> Iterator[None]:
        generator = run.generator()
        belief = loaded.filter.start(run.start, particles, generator)
        for t, row in enumerate(rows(run.episode)):
            belief, known = loaded.filter.step(belief, run.evidence[t], generator)
            recorder.step(known, **row, evidence=run.evidence[t])
            yield

    return recorder, ours()
