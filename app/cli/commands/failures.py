from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.errors import check_name
from beliefscope.recordings.report.command_lines import serve_command


def failures(
    runs: opt.Runs,
    by: str = "error",
    top: int = opt.option("N", "Number of events.", 20, parser=opt.integer(1)),
    phase: str | None = opt.option("NAME", "Only events of this phase, such as 'contact made'.", None),
    every: bool = False,
    url: str | None = opt.option("URL", "Address of a running server; prints a full permalink per event.", None),
    engine: opt.Engine = "local",
    workers: int = 1,
) -> console.Result:
    """Find the events at which a filter fails.

    Searches the held-out episodes for stretches of steps with a score in the worst 10 %, and ranks these events by
    their peak. Reports the phase of each event and which phases are over-represented: contact made, contact lost,
    blackout, fast motion, start, steady contact, free motion; and groups of other covariates. A permalink opens an
    event in the dashboard.

    \b
    Examples:
      beliefscope failures door --filter crossmodal-ekf
      beliefscope failures push --filter crossmodal-pf --by disagreement --phase "contact made"
      beliefscope failures push --filter crossmodal-pf --faults blackout=0.4 --url http://127.0.0.1:8000
      beliefscope failures door --filter mine.safetensors --data door.h5 --by angle --top 5 --json -
      beliefscope failures door --filter mine.safetensors --data door.h5 --all --workers 8
    """
    opt.prepare_workers(engine, workers, "beliefscope.inspect.failures.survey")
    from beliefscope.app.protocol.permalinks import permalink
    from beliefscope.app.runs.catalog import served_names
    from beliefscope.filters.names import is_source
    from beliefscope.inspect.diagnostics.views import as_json
    from beliefscope.inspect.failures.events import find_failures
    from beliefscope.inspect.failures.step_scores import phases_of

    if url is not None:
        opt.check_url(url)
    checkpoint, faults = runs.open()
    if phase is not None:
        check_name("phase", phase, phases_of(checkpoint.task))
    with runs.episodes(checkpoint.task) as episodes, console.progress("Filtering") as advance:
        indices = range(len(episodes)) if every else episodes.held_out()
        report = find_failures(
            checkpoint,
            episodes,
            indices,
            by=by,
            **runs.settings(faults),
            engine=engine,
            workers=workers,
            progress=advance,
        )
    (name,), data_name = served_names([runs.filter], runs.data)
    events = report.worst(top, phase)
    base = "" if url is None else url.rstrip("/") + "/"
    links = [base + permalink(checkpoint.task, name, data_name, e.episode, e.step, str(faults), by) for e in events]
    document = report.to_dict() | {
        "events": [as_json(event) | {"link": link} for event, link in zip(events, links, strict=True)],
        "serve": serve_command([runs.filter] if is_source(runs.filter) else [], runs.data, runs.seed),
    }
    text = "\n\n".join([report.verdict, str(report.phase_table()), str(report.event_table(events))])
    if url is not None:
        text = "\n".join([text, f"Permalinks, for {document['serve']}", *links])
    if runs.particles != 300 and report.particles:
        console.note("note: the dashboard uses 300 particles, so its values at these events differ")
    return console.Result(document, text)
