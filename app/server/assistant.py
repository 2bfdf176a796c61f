"""A read-only server of the Model Context Protocol: assistants ask why a filter failed, and get numbers with links.

It answers about the filters and data that the command line names, writes nothing and opens no connection: an
assistant starts it and talks to it through standard input and output.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from functools import lru_cache, wraps
from typing import TYPE_CHECKING, Any

import numpy as np

from beliefscope import __version__
from beliefscope.app.protocol.permalinks import permalink
from beliefscope.app.runs.catalog import TaskCatalog
from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.faults.injection import read_faults
from beliefscope.inspect.diagnosis.diagnose import diagnose, preliminary
from beliefscope.inspect.diagnostics.views import as_json
from beliefscope.inspect.failures.events import find_failures
from beliefscope.inspect.figures.top_view import draw_step
from beliefscope.inspect.maps.map_engine import COARSE, MapEngine, no_maps
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.summaries import phase_summaries, step_values
from beliefscope.inspect.trace import Trace, trace

if TYPE_CHECKING:
    from mcp.server.mcpserver import MCPServer

MOST_EPISODES = 20
"""Episodes of one question; an answer must not take minutes."""

MOST_EVENTS = 50


class Assistant:
    """Answers about runs, as JSON values. All methods raise BadInput with the valid names for an unknown one."""

    def __init__(self, catalogs: Mapping[str, TaskCatalog], url: str = "", seed: int = 0, particles: int = 300) -> None:
        """url: address of a running dashboard; links in answers lead there."""
        self._catalogs, self._url, self._seed, self._particles = catalogs, url, seed, particles
        self._trace = lru_cache(maxsize=8)(self._run)

    def catalog(self) -> dict[str, Any]:
        """Tasks with their filters, data sets, numbers of episodes and state components."""
        return {
            name: {
                "filters": list(catalog.filters),
                "data": {key: len(data) for key, data in catalog.data.items()},
                "components": [component.key for component in catalog.task.components],
                "modalities": list(catalog.task.modalities),
            }
            for name, catalog in self._catalogs.items()
            if not catalog.problem
        }

    def explain_run(self, task: str, filter: str, episode: int, data: str = "", faults: str = "") -> dict[str, Any]:
        """Why a filter succeeds or fails in one episode: diagnosis, errors and weights by phase, and worst steps.

        faults: sensor faults to inject first, such as ``blackout=0.4``; usually empty.
        """
        run = self._trace(task, filter, episode, data, faults)
        checkpoint = self._catalog(task).filter(filter)
        try:
            diagnosis = as_json(preliminary(checkpoint, run).to_json())
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
        run = self._trace(task, filter, episode, data, faults)
        self._check_step(run, step)
        return as_json(step_values(run, step) | {"link": self._link(run, filter, data, step)})

    def diagnose(
        self, task: str, filter: str, data: str = "", faults: str = "", episodes: list[int] | None = None
    ) -> dict[str, Any]:
        """Probable causes of a fault over several episodes, confirmed by undoing them; default: the held-out ones."""
        catalog = self._catalog(task)
        source, checkpoint = catalog.dataset(data), catalog.filter(filter)
        indices = (source.held_out() if episodes is None else episodes)[:MOST_EPISODES]
        by_index = read_faults(faults, catalog.task).apply_all(source, indices, self._seed)
        result = diagnose(checkpoint, by_index, seed=self._seed, particles=self._particles)
        return as_json(result.to_json())

    def failures(
        self, task: str, filter: str, data: str = "", faults: str = "", by: str = "error", top: int = 10
    ) -> dict[str, Any]:
        """The worst events of a filter over the held-out episodes, and the phases in which they are more frequent.

        by: score that ranks them: error, nees, ess, disagreement or regret.
        """
        catalog = self._catalog(task)
        source = catalog.dataset(data)
        report = find_failures(
            catalog.filter(filter),
            source,
            source.held_out()[:MOST_EPISODES],
            by=by,
            faults=read_faults(faults, catalog.task),
            seed=self._seed,
            particles=self._particles,
        )
        name = data or next(iter(catalog.data))
        events = [
            {"episode": e.episode, "step": e.step, "value": report.format(e.score), "phase": e.phase}
            | {"link": self._url + permalink(catalog.task, filter, name, e.episode, e.step, faults, by)}
            for e in report.worst(max(1, min(top, MOST_EVENTS)))
        ]
        return as_json({"verdict": report.verdict, "events": events})

    def figure(self, task: str, filter: str, episode: int, step: int, data: str = "", faults: str = "") -> bytes:
        """PNG: scene from above and belief on the fused map at one step."""
        run, checkpoint = self._trace(task, filter, episode, data, faults), self._catalog(task).filter(filter)
        self._check_step(run, step)
        map_ = None if no_maps(checkpoint, run) else MapEngine(checkpoint, run).map(step, size=COARSE)
        png = io.BytesIO()
        draw_step(run, step, map_).savefig(png, format="png", dpi=150)
        return png.getvalue()

    def _catalog(self, task: str) -> TaskCatalog:
        if task not in self._catalogs:
            raise unknown_name("task", task, self.catalog())
        return self._catalogs[task]

    def _run(self, task: str, filter_: str, episode: int, data: str, faults: str) -> Trace:
        catalog = self._catalog(task)
        checkpoint, injected = catalog.filter(filter_), read_faults(faults, catalog.task)
        return trace(checkpoint, catalog.episode(data, episode), episode, self._seed, self._particles, injected)

    def _check_step(self, run: Trace, step: int) -> None:
        if not 0 <= step < len(run):
            raise BadInput(f"step {step} does not exist. Available: 0 to {len(run) - 1}.")

    def _link(self, run: Trace, filter_: str, data: str, step: int) -> str:
        name = data or next(iter(self._catalogs[run.task.name].data))
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
