"""``beliefscope failures``"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beliefscope.app.cli import output
from beliefscope.app.cli.options import (
    DataPath,
    FaultsText,
    FilterName,
    Json,
    Particles,
    Seed,
    SkipBad,
    TaskName,
    check,
    checkpoint,
    dataset,
    faults,
    is_path,
    serving,
    whole,
)


def failures(
    task: TaskName,
    filter_: FilterName,
    data: DataPath = None,
    skip_bad: SkipBad = False,
    faults_: FaultsText = "",
    by: Annotated[
        str,
        typer.Option(
            "--by",
            metavar="SCORE",
            help="error (on the map), the name of an angle, nees, ess, disagreement (of the modalities), "
            "regret (of the weights).",
        ),
    ] = "error",
    top: Annotated[int, typer.Option("--top", parser=whole(1), metavar="N", help="So many of the worst.")] = 20,
    group: Annotated[
        str | None, typer.Option("--group", metavar="NAME", help="Only moments of this group: 'contact made'.")
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Every episode, not only those held out.")] = False,
    url: Annotated[
        str | None, typer.Option("--url", metavar="URL", help="Of a running page: print a whole link to each moment.")
    ] = None,
    particles: Particles = 300,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Find the moments at which a filter fails.

    Over all held-out episodes: stretches of steps whose score is among the worst tenth, one moment each, ranked by
    their peak; and what was happening there, with how much more often than chance. Groups: contact made, contact
    lost, blackout, fast motion, start, steady contact, free. A link opens a moment on the page (beliefscope serve).

    \b
    Examples:
      beliefscope failures door --filter crossmodal-ekf
      beliefscope failures push --filter crossmodal-pf --by disagreement --group "contact made"
      beliefscope failures push --filter crossmodal-pf --faults blackout=0.4 --url http://127.0.0.1:8000
      beliefscope failures door --filter mine.safetensors --data door.h5 --by angle --top 5 --json -
    """
    from beliefscope.app.protocol.permalinks import moment_link
    from beliefscope.app.runs.catalog import served_names
    from beliefscope.datasets.errors import one_of
    from beliefscope.inspect.diagnostics.base import as_json
    from beliefscope.inspect.failures.moments import find_failures
    from beliefscope.inspect.failures.step_scores import GROUPS

    check(None, json)
    if group is not None and group not in GROUPS:
        raise one_of("group", group, GROUPS)
    tested = checkpoint(task, filter_)
    broken = faults(faults_, tested.task)
    with dataset(tested.task, data, skip_bad) as episodes, output.progress("Filtering") as advance:
        indices = range(len(episodes)) if every else episodes.held_out()
        found = find_failures(
            tested, episodes, indices, by=by, faults=broken, seed=seed, particles=particles, progress=advance
        )
    files = [filter_] if is_path(filter_) else []
    named, data_name = served_names(files, data)
    filter_name = named.get(str(Path(filter_)), filter_)
    moments = found.worst(top, group)
    base = "" if url is None else url.rstrip("/") + "/"
    links = [
        base + moment_link(tested.task, filter_name, data_name, m.episode, m.step, str(broken), by) for m in moments
    ]
    document = found.to_dict() | {
        "moments": [as_json(m) | {"link": link} for m, link in zip(moments, links, strict=True)],
        "serve": serving(files, data, seed),
    }
    tables = (found.table_of_groups(), found.table_of(moments))
    lines = [found.verdict, *(output.grid(table.title, table.columns, table.rows) for table in tables)]
    if url is not None:
        lines += [f"Links, for {document['serve']}", *links]
    if particles != 300 and found.particles:
        output.say("note: the page filters with 300 particles, so its numbers at these moments are others")
    output.result(document, "\n\n".join(lines[:3]) + "".join(f"\n{line}" for line in lines[3:]), json)
