"""Jobs that diagnose a filter over episodes, find the smallest repair of a run, and measure a healthy record."""

from collections.abc import Mapping
from typing import Any

from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.trace_store import store_of_job
from beliefscope.app.runs.worker import Report
from beliefscope.app.workspace.healthy_records import with_record
from beliefscope.datasets.faults.injection import Faults
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.inspect.diagnosis.diagnose import diagnose, diagnose_traces, required_profile
from beliefscope.inspect.diagnosis.undo.repair import healthy_bound, smallest_repair
from beliefscope.inspect.diagnostics.healthy_profile import pretrained_reference
from beliefscope.inspect.diagnostics.views import as_json
from beliefscope.inspect.healthy import profile_of
from beliefscope.inspect.traces.provenance import unavailable_filter
from beliefscope.recordings.open_trace import of_one_task, with_distinct_indices


def run(arguments: Mapping[str, Any], report: Report) -> Any:
    """Compute the diagnosis; no traces are stored."""
    if "selections" in arguments:
        return _diagnosis_of_runs(arguments, report)
    with store_of_job(arguments) as store:
        data = store.dataset(arguments["task"], arguments["data"])[1]
        faults, seed = Faults.parse(arguments["faults"]), store.settings.seed
        report(0.0, "reading the episodes")
        result = diagnose(
            store.checkpoint(arguments["task"], arguments["filter"]),
            faults.apply_all(data, arguments["episodes"], seed),
            seed=seed,
            particles=store.settings.particles,
            progress=lambda share: report(share, "comparing with the healthy record"),
        )
    return as_json(result.to_json())


def _diagnosis_of_runs(arguments: Mapping[str, Any], report: Report) -> Any:
    """The diagnosis of live runs as they are, with the data set of each run by the index of its episode."""
    selections = [Selection.from_json(values) for values in arguments["selections"]]
    names = [selection.data for selection in selections]
    with store_of_job(arguments) as store:
        report(0.0, "reading the runs")
        runs = [store.request(selection) for selection in selections]
        traces = with_distinct_indices(of_one_task([run.trace for run in runs], names))
        checkpoint = runs[0].checkpoint
        if isinstance(checkpoint, UnavailableFilter) and checkpoint.healthy_profile:  # of the task of all runs
            checkpoint = with_record(unavailable_filter(traces[0]), dict(checkpoint.healthy_profile))
        result = diagnose_traces(
            checkpoint,
            traces,
            seed=store.settings.seed,
            particles=store.settings.particles,
            progress=lambda share: report(share, "comparing with the healthy record"),
        )
    indices = [trace.episode_index for trace in traces]
    return as_json(result.to_json()) | {"runs": dict(zip(map(str, indices), names, strict=True))}


def search_repair(arguments: Mapping[str, Any], report: Report) -> Any:
    """Find the smallest repair of the largest failure of a run; its stored trace is reused."""
    selection = Selection.from_json(arguments["selection"])
    with store_of_job(arguments) as store:
        report(0.0, "running the filter")
        run = store.request(selection)
        bound = healthy_bound(required_profile(run.checkpoint).statistics)
        data = store.dataset(selection.task, selection.data)[1]
        clean = data[selection.episode] if selection.faults else None
        report(0.5, "replaying repairs")
        repair = smallest_repair(run.checkpoint, run.trace, bound, clean)
    if repair is None:
        text = f"Episode {selection.episode} has no failure: its errors are within twice the healthy ones"
        none = dict.fromkeys(("failure", "error", "repaired", "repair"))
        limit = run.checkpoint.task.main_error.text(bound)
        return {"sentence": f"{text}, {limit}.", "bound": bound, "replays": 0, **none}
    return as_json({"sentence": repair.sentence, **repair.to_json()})


def measure_record(arguments: Mapping[str, Any], report: Report) -> Any:
    """Measure the healthy record of a filter over clean episodes, run by it or another one; kept in the workspace."""
    with store_of_job(arguments) as store:
        names = arguments["filter"], arguments["healthy_filter"]
        checkpoint, healthy_filter = (store.checkpoint(arguments["task"], name) for name in names)
        by = "" if names[0] == names[1] else f", run by {names[1]}"
        data = store.dataset(arguments["task"], arguments["data"])[1]
        is_sample = arguments["data"] not in store.settings.data
        message = "measuring the healthy record"
        report(0.0, message)
        profile = profile_of(
            healthy_filter,
            [data[index] for index in arguments["episodes"]],
            f"{len(arguments['episodes'])} held-out episodes of {arguments['data']}{by}",
            progress=lambda share: report(share, message),
            indices=arguments["episodes"],
            reference=pretrained_reference(checkpoint.task) if is_sample else None,  # of the same camera
        )
        store.write_record(checkpoint, profile.to_json())
    return {"data": profile.data}
