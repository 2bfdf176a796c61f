"""A read-only server of the Model Context Protocol: assistants ask why a filter failed, and get numbers with links.

It answers about the filters and data that the command line names, changes nothing and opens no connection: an
assistant starts it and talks to it through standard input and output.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any

import numpy as np

from beliefscope import __version__
from beliefscope.app.protocol.permalinks import permalink
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.runs.traced_run import TracedRun
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.inspect.diagnosis.diagnose import diagnose, preliminary
from beliefscope.inspect.diagnostics.views import as_json
from beliefscope.inspect.failures.events import find_failures
from beliefscope.inspect.figures.top_view import draw_step
from beliefscope.inspect.maps.map_engine import COARSE
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.summaries import phase_summaries, step_values
from beliefscope.inspect.trace import Trace

if TYPE_CHECKING:
    from mcp.server.mcpserver import MCPServer

MOST_EPISODES = 20
"""Episodes of one question; an answer must not take minutes."""

MOST_EVENTS = 50


class Assistant:
    """Answers about runs, as JSON values. All methods raise BadInput with the valid names for an unknown one."""

    def __init__(self, store: TraceStore, url: str = "") -> None:
        """url: address of a running dashboard; links in answers lead there."""
        self._store, self._url = store, url
        self._settings: Any = {"seed": store.settings.seed, "particles": store.settings.particles}

    def catalog(self) -> dict[str, Any]:
        """Tasks with their filters, data sets, numbers of episodes and state components."""
        catalog: dict[str, Any] = {}
        for name in self._store.tasks():
            datasets = self._store.datasets(name)
            task = next(iter(datasets.values())).task
            catalog[name] = {
                "filters": list(self._store.filters(name)),
                "data": {key: len(data) for key, data in datasets.items()},
                "components": [component.key for component in task.components],
                "modalities": list(task.modalities),
            }
        return catalog

    def explain_run(self, task: str, filter: str, episode: int, data: str = "", faults: str = "") -> dict[str, Any]:
        """Why a filter succeeds or fails in one episode: diagnosis, errors and weights by phase, and worst steps.

        faults: sensor faults to inject first, such as ``blackout=0.4``; usually empty.
        """
        traced = self._run(task, filter, episode, data, faults)
        run = traced.trace
        try:
            diagnosis = as_json(preliminary(traced.checkpoint, run).to_json())
        except BadInput as reason:
            diagnosis = {"state": "unknown", "headline": str(reason)}
        main, error = run.task.main_error, measures.main_error(run)
        worst = np.argsort(-np.nan_to_num(error[:, -1]))[:3].tolist()
        steps = [
            {"step": step, main.key: main.factor * error[step, -1], "link": self._link(run, filter, data, step)}
            for step in worst
        ]
        return as_json({"run": repr(run), "diagnosis": diagnosis, "phases": phase_summaries(run), "worst_steps": steps})

    def values(
        self, task: str, filter: str, episode: int, step: int, data: str = "", faults: str = ""
    ) -> dict[str, Any]:
        """All estimates with standard deviations, truth, errors and weights at one step, in units for display."""
        run = self._run(task, filter, episode, data, faults, step).trace
        return as_json(step_values(run, step) | {"link": self._link(run, filter, data, step)})

    def diagnose(
        self, task: str, filter: str, data: str = "", faults: str = "", episodes: list[int] | None = None
    ) -> dict[str, Any]:
        """Probable causes of a fault over several episodes, confirmed by undoing them; default: the held-out ones."""
        source = self._store.dataset(task, data)[1]
        indices = (source.held_out() if episodes is None else episodes)[:MOST_EPISODES]
        by_index = Faults.parse(faults).apply_all(source, indices, self._store.settings.seed)
        result = diagnose(self._store.checkpoint(task, filter), by_index, **self._settings)
        return as_json(result.to_json())

    def failures(
        self, task: str, filter: str, data: str = "", faults: str = "", by: str = "error", top: int = 10
    ) -> dict[str, Any]:
        """The worst events of a filter over the held-out episodes, and the phases in which they are more frequent.

        by: score that ranks them: error, nees, ess, disagreement or regret. top: number of events, 1 to 50.
        """
        if not 1 <= top <= MOST_EVENTS:
            raise BadInput(f"top is 1 to {MOST_EVENTS} events, not {top}")
        name, source = self._store.dataset(task, data)
        report = find_failures(
            self._store.checkpoint(task, filter),
            source,
            source.held_out()[:MOST_EPISODES],
            by=by,
            faults=Faults.parse(faults),
            **self._settings,
        )
        events = [
            {"episode": e.episode, "step": e.step, "value": report.format(e.score), "phase": e.phase}
            | {"link": self._url + permalink(source.task, filter, name, e.episode, e.step, faults, by)}
            for e in report.worst(top)
        ]
        return as_json({"verdict": report.verdict, "events": events})

    def figure(self, task: str, filter: str, episode: int, step: int, data: str = "", faults: str = "") -> bytes:
        """PNG: scene from above and belief on the fused map at one step."""
        traced = self._run(task, filter, episode, data, faults, step)
        run = traced.trace
        map_ = None if traced.no_maps_at(step) else traced.map(step, COARSE)
        png = io.BytesIO()
        draw_step(run, step, map_).savefig(png, format="png", dpi=150)
        return png.getvalue()

    def _run(self, task: str, filter_: str, episode: int, data: str, faults: str, step: int = 0) -> TracedRun:
        """The run. Raises BadInput if it does not have the step."""
        run = self._store.request(Selection(task, filter_, episode, Faults.parse(faults), data))
        if not 0 <= step < len(run):
            raise BadInput(f"step {step} does not exist. Available: 0 to {len(run) - 1}.")
        return run

    def _link(self, run: Trace, filter_: str, data: str, step: int) -> str:
        name = self._store.dataset(run.task.name, data)[0]
        return self._url + permalink(run.task, filter_, name, run.episode_index, step, str(run.faults))


def build_server(assistant: Assistant) -> MCPServer:
    """The server with a read-only tool for each question. Raises BadInput if the SDK is not installed."""
    try:
        from mcp.server.mcpserver import Image, MCPServer
        from mcp.server.mcpserver.exceptions import ToolError
        from mcp.types import ToolAnnotations
    except ImportError:
        raise BadInput("beliefscope mcp needs the package mcp: pip install 'beliefscope[mcp]'") from None

    def explained(question: Callable[..., Any]) -> Callable[..., Any]:
        """The question, with the message of a BadInput as its answer; other exceptions are hidden from the client."""

        @wraps(question)
        def ask(**arguments: Any) -> Any:
            try:
                return question(**arguments)
            except BadInput as error:
                raise ToolError(str(error)) from None

        return ask

    def figure(task: str, filter: str, episode: int, step: int, data: str = "", faults: str = "") -> Any:
        return Image(data=assistant.figure(task, filter, episode, step, data, faults), format="png")

    figure.__doc__ = assistant.figure.__doc__
    server: MCPServer = MCPServer("beliefscope", version=__version__, instructions=__doc__)
    read_only = ToolAnnotations(read_only_hint=True, destructive_hint=False, open_world_hint=False)
    answers = (assistant.explain_run, assistant.values, assistant.diagnose, assistant.failures)
    for question in (assistant.catalog, *answers, figure):
        server.add_tool(explained(question), annotations=read_only)
    return server
