"""Job that runs a filter over a data set, ranks its failure events by every score and searches for slices."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from beliefscope.app.protocol.permalinks import permalink
from beliefscope.app.runs.trace_store import store_of_job
from beliefscope.app.runs.worker import Report
from beliefscope.datasets.faults.injection import Faults
from beliefscope.inspect.failures.step_scores import EpisodeScores, Survey
from beliefscope.inspect.failures.survey_json import survey_document
from beliefscope.inspect.slices.covariates import EpisodeCovariates
from beliefscope.inspect.slices.report import describe_slices
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all
from beliefscope.inspect.traces.restarts import RESTARTS, restarted_runs_text


def run(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Compute the failure document; no traces are stored."""
    episodes = arguments["episodes"]

    def progress(share: float) -> None:
        at = min(int(share * len(episodes)), len(episodes) - 1)
        report(0.95 * share, f"running the filter over episode {episodes[at]}, {at + 1} of {len(episodes)}")

    with store_of_job(arguments) as store:
        traces = trace_all(
            store.checkpoint(arguments["task"], arguments["filter"]),
            store.dataset(arguments["task"], arguments["data"])[1],
            episodes,
            faults=Faults.parse(arguments["faults"]),
            seed=store.settings.seed,
            particles=store.settings.particles,
            progress=progress,
            restart=True,
        )
        return failure_document(traces, arguments, lambda: report(0.95, "searching for slices"))


def failure_document(
    traces: Iterable[Trace], selection: Mapping[str, Any], traced: Callable[[], None] = lambda: None
) -> dict[str, Any]:
    """Failures and slices of traces, which are not kept, with permalinks.

    selection: ``filter``, ``data``, ``faults`` and ``among``, as text. traced: called after the last trace.
    """
    parts, restarted = [], 0
    for trace in traces:
        parts.append((EpisodeScores.from_trace(trace), EpisodeCovariates.from_trace(trace)))
        restarted += RESTARTS in trace.settings
    traced()
    survey = Survey.from_episodes(scores for scores, _ in parts)

    def link(episode: int, step: int, by: str) -> str:
        return permalink(survey.task, selection["filter"], selection["data"], episode, step, survey.faults, by)

    document = {name: selection[name] for name in ("filter", "data", "faults", "among")}
    document |= survey_document(survey, lambda event, by: link(event.episode, event.step, by))
    covariates = [covariates for _, covariates in parts]
    for score in document["scores"]:
        if not score["why_not"]:
            if restarted:
                score["verdict"] = f"{restarted_runs_text(restarted, len(parts))} {score['verdict']}"
            score["slices"] = describe_slices(survey, covariates, score["name"])
    return document
