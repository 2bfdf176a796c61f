"""``beliefscope failures``"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beliefscope.app.cli import options as opt
from beliefscope.app.cli import output
from beliefscope.app.runs.command_lines import is_path, serve_command
from beliefscope.datasets.errors import unknown_name


def failures(
    task: opt.TaskName,
    filter_: opt.FilterName,
    data: opt.DataPath = None,
    skip_bad: opt.SkipBad = False,
    faults_: opt.FaultsText = "",
    by: Annotated[
        str,
        typer.Option(
            metavar="SCORE",
            help="Score that ranks the events: error (position), the name of an angle, nees, ess (effective sample "
            "size), disagreement (of the modalities) or regret (of the fusion weights).",
        ),
    ] = "error",
    top: Annotated[int, typer.Option(parser=opt.integer(1), metavar="N", help="Number of events.")] = 20,
    phase: Annotated[
        str | None, typer.Option(metavar="NAME", help="Only events of this phase, such as 'contact made'.")
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Search all episodes, not only the held-out ones.")] = False,
    url: Annotated[
        str | None, typer.Option(metavar="URL", help="Address of a running server; prints a full permalink per event.")
    ] = None,
    particles: opt.Particles = 300,
    seed: opt.Seed = 0,
    json: opt.Json = None,
) -> None:
    """Find the events at which a filter fails.

    Searches the held-out episodes for stretches of steps with a score in the worst 10 %, and ranks these events by
    their peak. Reports the phase of each event and which phases are over-represented: contact made, contact lost,
    blackout, fast motion, start, steady contact, free motion. A permalink opens an event in the dashboard.

    \b
    Examples:
      beliefscope failures door --filter crossmodal-ekf
      beliefscope failures push --filter crossmodal-pf --by disagreement --phase "contact made"
      beliefscope failures push --filter crossmodal-pf --faults blackout=0.4 --url http://127.0.0.1:8000
      beliefscope failures door --filter mine.safetensors --data door.h5 --by angle --top 5 --json -
    """
    from beliefscope.app.protocol.permalinks import permalink
    from beliefscope.app.runs.catalog import served_names
    from beliefscope.inspect.diagnostics.views import as_json
    from beliefscope.inspect.failures.events import find_failures
    from beliefscope.inspect.failures.step_scores import PHASES

    if phase is not None and phase not in PHASES:
        raise unknown_name("phase", phase, PHASES)
    checkpoint = opt.open_checkpoint(task, filter_)
    faults = opt.parse_faults(faults_, checkpoint.task)
    with opt.open_episodes(checkpoint.task, data, skip_bad) as episodes, output.progress("Filtering") as advance:
        indices = range(len(episodes)) if every else episodes.held_out()
        report = find_failures(
            checkpoint, episodes, indices, by=by, faults=faults, seed=seed, particles=particles, progress=advance
        )
    files = [filter_] if is_path(filter_) else []
    names, data_name = served_names(files, data)
    name = names.get(str(Path(filter_)), filter_)
    events = report.worst(top, phase)
    base = "" if url is None else url.rstrip("/") + "/"
    links = [base + permalink(checkpoint.task, name, data_name, e.episode, e.step, str(faults), by) for e in events]
    document = report.to_dict() | {
        "events": [as_json(event) | {"link": link} for event, link in zip(events, links, strict=True)],
        "serve": serve_command(files, data, seed),
    }
    text = "\n\n".join([report.verdict, *output.grids([report.phase_table(), report.event_table(events)])])
    if url is not None:
        text = "\n".join([text, f"Permalinks, for {document['serve']}", *links])
    if particles != 300 and report.particles:
        output.note("note: the dashboard uses 300 particles, so its values at these events differ")
    output.result(document, text, json)
