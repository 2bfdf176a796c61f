from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from beliefscope.app.cli import console, options as opt
from beliefscope.app.cli.healthy_records import record_for_runs, record_of_data
from beliefscope.app.cli.recorded_runs import FORMS, TaskOrRecordedRuns
from beliefscope.datasets.errors import BadInput

if TYPE_CHECKING:
    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile


@dataclass(frozen=True)
class Options(TaskOrRecordedRuns):
    """Options of a diagnosis, which also takes recorded runs, by their path in place of the task."""

    task: Annotated[
        str,
        opt.argument(
            "TASK|RUN.trace|DIR",
            "Task: a built-in one such as door, or your own as FILE.py:NAME; the name is enough if --data or a "
            f"checkpoint contains the definition. Or {FORMS}, or a folder of them.",
        ),
    ]
    filter: str = ""
    episode: int | None = opt.option(
        "I", "Diagnose only this episode. Default: the held-out ones.", None, parser=opt.integer(0)
    )
    base: Path | None = opt.option(
        "NAME|CHECKPOINT", "Checkpoint whose modules are tried in place of the filter's.", None
    )
    alarm_rate: float | None = opt.option(
        "P",
        "Probability that a healthy filter raises an alarm. Default: 0.02; for one episode and a healthy record of "
        "n < 49 episodes, 1 / (n + 1).",
        None,
    )
    profile_from: Path | None = opt.option(
        "DATA|DIR",
        "Clean data; the healthy record is measured on their held-out episodes. For recorded runs: a folder of healthy "
        "runs.",
        None,
    )
    profile_filter: str | None = opt.option(
        "NAME|CHECKPOINT|FILE.py:FUNCTION", "Filter that runs over --profile-from. Default: --filter.", None
    )
    repair: int | None = opt.option(
        "I",
        "Also find the smallest repair of the largest failure of this episode; not of external filters.",
        None,
        parser=opt.integer(0),
    )
    workspace: Path | None = opt.option(
        "DIR",
        "Workspace that keeps the healthy record of --profile-from: later diagnoses of the filter and the page use it.",
        None,
    )
    workers: int = 1
    engine: opt.Engine = "local"

    def keep_record(self, checkpoint: Checkpoint, profile: HealthyProfile) -> None:
        """Keep a measured record in the workspace, where the page finds it."""
        from beliefscope.app.workspace.healthy_records import record_path
        from beliefscope.app.workspace.json_files import write_record

        if self.workspace is not None and self.profile_from is not None:
            write_record(profile.to_json(), record_path(self.workspace, checkpoint))


def diagnose(options: Options) -> console.Result:
    """Name the probable cause of a filter's fault.

    Compares statistics of sensors, labels, modules and the filter with the filter's healthy record (the same statistics
    on clean episodes), ranks the causes that explain all deviations, and confirms them by undoing them. Details:
    docs/diagnose.md.

    In place of the task, a recorded run, or a folder of them, is diagnosed as it is; without its filter, no cause is
    undone.

    --repair finds the shortest interval in which to drop sensors, or with --faults to restore them, so that the
    episode's largest failure disappears.

    \b
    Examples:
      beliefscope diagnose door --filter crossmodal-ekf
      beliefscope diagnose push --filter crossmodal-pf --data push.h5 --json -
      beliefscope diagnose door --filter mine.safetensors --data door.h5 --base crossmodal-ekf --episode 3
      beliefscope diagnose push --filter crossmodal-pf --faults image_occluded=14:from=40:to=60 --repair 142
      beliefscope diagnose door --filter examples/04_own_filter.py:build --profile-from clean.h5
      beliefscope diagnose door --filter new.py:build --profile-from clean.h5 --profile-filter old.py:build
      beliefscope diagnose traces/today --profile-from traces/healthy
      beliefscope diagnose workspace/live --profile-from traces/healthy --workspace workspace
    """
    opt.prepare_workers(options.engine, options.workers, "beliefscope.inspect.diagnosis.diagnose")
    if options.alarm_rate is not None and not 0.0 < options.alarm_rate < 1.0:
        raise BadInput(f"--alarm-rate is {options.alarm_rate:g}, not a probability between 0 and 1")
    if options.profile_filter is not None and options.profile_from is None:
        raise BadInput("--profile-filter needs --profile-from, the clean episodes that it runs over")
    if options.workspace is not None:
        opt.check_workspace(options.workspace)
    if options.is_recorded:
        if options.faults or options.base or options.profile_filter or options.repair is not None:
            raise BadInput(
                "recorded runs are diagnosed as they are, without --faults, --base, --profile-filter, --repair"
            )
        return _of_recordings(options)
    return _of_filter(options)


def _of_filter(options: Options) -> console.Result:
    """The diagnosis of a filter that runs over episodes."""
    from beliefscope.app.workspace.healthy_records import with_kept_record
    from beliefscope.filters.open_filter import open_filter
    from beliefscope.inspect.diagnosis.diagnose import diagnose as run
    from beliefscope.inspect.diagnosis.undo.repair import check_repairable, healthy_bound, smallest_repair
    from beliefscope.inspect.trace import trace

    checkpoint, faults = options.open()
    if options.workspace is not None and options.profile_from is None:
        checkpoint = with_kept_record(checkpoint, options.workspace)
    if options.repair is not None:
        check_repairable(checkpoint)
    correct = checkpoint if options.profile_filter is None else open_filter(checkpoint.task, options.profile_filter)
    base = None if options.base is None else open_filter(checkpoint.task, str(options.base))
    with options.episodes(checkpoint.task) as data:
        held_out = len(data.held_out())
        indices = data.held_out() if options.episode is None else [options.episode]
        episodes = faults.apply_all(data, indices, options.seed)
        failed = None if options.repair is None else data[options.repair]
    if options.profile_from is None:
        _check_record(correct, options.data, held_out if faults else 0)
    profile = record_of_data(
        correct, options.profile_from, episodes.values(), options.alarm_rate, injected=bool(options.faults)
    )
    options.keep_record(checkpoint, profile)
    with console.progress("Diagnosing") as advance:
        result = run(
            checkpoint,
            episodes,
            seed=options.seed,
            particles=options.particles,
            alarm_rate=options.alarm_rate,
            base=base,
            profile=profile,
            engine=options.engine,
            workers=options.workers,
            progress=advance,
        )
    document, parts = result.to_json(), [result.headline, *map(str, result.tables())]
    if failed is not None:
        run_ = trace(checkpoint, failed, options.repair or 0, options.seed, options.particles, faults)
        smallest = smallest_repair(checkpoint, run_, healthy_bound(profile.statistics), failed if faults else None)
        document["repair"] = None if smallest is None else smallest.to_json()
        parts.append(f"Episode {options.repair} has no failure." if smallest is None else smallest.sentence)
    return console.Result(document, "\n\n".join(parts))


def _of_recordings(options: Options) -> console.Result:
    """The diagnosis of recorded runs, with a healthy record of other ones or of the filter, which may run for it."""
    from beliefscope.inspect.diagnosis.diagnose import diagnose_traces
    from beliefscope.inspect.diagnostics.views import Table
    from beliefscope.recordings.open_trace import runs_by_file

    opened = runs_by_file(Path(options.task))
    files, traces = {trace.episode_index: file for file, trace in opened.items()}, list(opened.values())
    if options.episode is not None:
        traces = [trace for trace in traces if trace.episode_index == options.episode]
        if not traces:
            raise BadInput(f"{options.task} has no run of episode {options.episode}")
    places = [options.task] * len(traces)
    traces, checkpoint, profile = record_for_runs(
        traces, places, options.filter, options.profile_from, options.alarm_rate, options.workspace
    )
    options.keep_record(checkpoint, profile)
    with console.progress("Diagnosing") as advance:
        result = diagnose_traces(
            checkpoint,
            traces,
            seed=options.seed,
            particles=options.particles,
            alarm_rate=options.alarm_rate,
            profile=profile,
            progress=advance,
        )
    used = {trace.episode_index: files[trace.episode_index] for trace in traces}
    listed = Table("Runs", ("episode", "file"), tuple((str(index), file.name) for index, file in used.items()))
    document = result.to_json() | {"runs": [{"episode": i, "path": str(file)} for i, file in used.items()]}
    parts = [result.headline, *map(str, result.tables()), *([str(listed)] if len(used) > 1 else [])]
    return console.Result(document, "\n\n".join(parts))


def _check_record(checkpoint: Checkpoint, data: Path | None, clean: int) -> None:
    """Raise BadInput for a filter without a healthy record, with the command that measures it.

    clean: number of held-out episodes that are known to be clean.
    """
    from beliefscope.datasets.store import sample_path
    from beliefscope.inspect.diagnostics.healthy_comparison import MIN_HEALTHY, no_diagnosis

    if reason := no_diagnosis(checkpoint):
        source = str(data or sample_path(checkpoint.task)) if clean >= MIN_HEALTHY else "CLEAN.h5"
        command = shlex.join(["beliefscope", *sys.argv[1:], "--profile-from", source])
        needed = f"on clean data with {MIN_HEALTHY} or more held-out episodes"
        earlier = "add --profile-filter OLD for that of an earlier version"
        raise BadInput(f"{reason}; measure it {needed} ({earlier}): {command}")
