from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.text import plural
from beliefscope.recordings.report.command_lines import serve_command

if TYPE_CHECKING:
    from beliefscope.datasets.task import Task
    from beliefscope.inspect.compare.checkpoints import CheckpointComparison


def change(
    before: str = opt.argument(
        "BEFORE",
        "Pretrained filter such as crossmodal-ekf, path of a .safetensors file, or external filter, FILE.py:FUNCTION.",
    ),
    after: str = opt.argument("AFTER", "As BEFORE."),
    task: str | None = opt.option("TASK", "Task of both filters. Required for two names.", None),
    data: Path | None = None,
    skip_bad: bool = False,
    every: bool = False,
    slices: list[str] | None = None,
    particles: int = 300,
    seed: int = 0,
    engine: opt.Engine = "local",
    workers: int = 1,
    fail_on_regression: bool = opt.flag(
        "Exit with 1 if a slice of all modalities, clean or with faults, has regressed.", "--fail-on-regression"
    ),
    output: Path | None = opt.option("DIR", "New folder for change.json, .svg, .pdf and .md.", None, "-o"),
) -> console.Result:
    """Report improvements and regressions between filters.

    Runs both filters over the held-out episodes with the same sensor faults and random numbers. Reports every
    error and covariance measure before and after, by data slice: clean, contact, free motion, 80 % image blackout,
    each modality only, and those of --slice; with 95 % intervals over episodes. A difference counts as improved or
    regressed if it is at least 2 % and its interval excludes zero. Also lists the events with the largest increase in
    error, and the change of each module of checkpoints. With --fail-on-regression, the exit code is 1 if clean data or
    data with faults have regressed; slices of some modalities only do not count.

    \b
    Examples:
      beliefscope change crossmodal-ekf finetuned.safetensors
      beliefscope change unimodal-ekf crossmodal-ekf --task push
      beliefscope change crossmodal-ekf my_filter.py:build --task door
      beliefscope change base.safetensors finetuned.safetensors --data door.h5 -o report
      beliefscope change base.safetensors finetuned.safetensors --fail-on-regression --json -
      beliefscope change crossmodal-pf finetuned.safetensors --slice blackout-in-contact:faults=blackout=1:contact=yes
    """
    opt.prepare_workers(engine, workers, "beliefscope.inspect.compare.checkpoints")
    from beliefscope.filters.finetuning.slices import parse_slices
    from beliefscope.filters.open_filter import open_filters
    from beliefscope.inspect.compare.checkpoints import compare_checkpoints, write_comparison
    from beliefscope.inspect.standalone import removal_note
    from beliefscope.inspect.statistics.intervals import too_few

    if output is not None and (output.exists() or not output.parent.is_dir()):
        raise BadInput(f"output {str(output)!r} exists, or its parent folder does not; give the name of a new folder")
    checkpoints = open_filters(None if task is None else opt.definition_of(task, data), before, after)
    target = checkpoints[0].task
    selection = parse_slices(slices or (), (), target)
    with opt.open_episodes(target, data, skip_bad) as episodes, console.progress("Comparing") as advance:
        indices = range(len(episodes)) if every else episodes.held_out()
        if fail_on_regression and (why := too_few(len(indices))):
            raise BadInput(f"--fail-on-regression: {why}")
        report = compare_checkpoints(
            *checkpoints,
            episodes,
            indices,
            slices=selection,
            particles=particles,
            seed=seed,
            engine=engine,
            workers=workers,
            progress=advance,
        )
        data_hash = episodes.hash
    document = {"data_hash": data_hash} | _document(report, target, (before, after), data, seed)
    first, second = (before, after) if len({*report.filters}) == 1 else report.filters
    heading = f"Before: {first}; after: {second}; {plural(len(report.episodes), 'episode')}"
    notes = dict.fromkeys(filter(None, map(removal_note, checkpoints)))
    text = "\n\n".join([heading, report.text, *notes])
    if output is not None:
        write_comparison(output, document, text, report.plot())
    failed = report.regressed_slices() if fail_on_regression else []
    if failed:
        console.note(f"regressed: {', '.join(failed)}")
    return console.Result(document, text, code=int(bool(failed)))


def _document(
    report: CheckpointComparison, task: Task, sources: tuple[str, str], data: Path | None, seed: int
) -> dict[str, Any]:
    """The report as JSON values, with a link to each event and the command that serves the filters."""
    from beliefscope.app.protocol.permalinks import comparison_permalink, permalink
    from beliefscope.app.runs.catalog import served_names
    from beliefscope.filters.names import is_source
    from beliefscope.inspect.diagnostics.views import as_json

    (first, second), data_name = served_names(sources, data)
    links = [
        comparison_permalink(permalink(task, second, data_name, m.episode, m.step, m.faults), m, first)
        for m in report.events
    ]
    return report.to_dict() | {
        "frozen": list(report.frozen),
        "improved": as_json(report.improvements()),
        "regressed": as_json(report.regressions()),
        "regressed_slices": report.regressed_slices(),
        "events": [as_json(m) | {"link": link} for m, link in zip(report.events, links, strict=True)],
        "serve": serve_command([*filter(is_source, sources)], data, seed),
    }
