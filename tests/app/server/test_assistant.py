"""Tools for assistants: answers agree with the functions behind them, through the protocol as well."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import anyio
import numpy as np
import pytest

from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.server.assistant import Assistant
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import trace

pytestmark = pytest.mark.slow

RUN = {"task": "door", "filter": "crossmodal-ekf", "episode": 9, "faults": "blackout=0.4"}


@pytest.fixture(scope="module")
def assistant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Assistant]:
    with closing(TraceStore(Settings(tmp_path_factory.mktemp("workspace")))) as store:
        yield Assistant(store, "http://127.0.0.1:8000/")


def test_answers_agree_with_the_trace(assistant: Assistant) -> None:
    with open_dataset(sample_path("door")) as data:
        filter_ = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
        run = trace(filter_, data[9], 9, faults=Faults.parse("blackout=0.4"))
    answer = assistant.explain_run(**RUN)
    error = 100.0 * measures.main_error(run)
    counted = measures.counted(run)
    rmse = answer["phases"]["all"]["rmse_position_cm"]
    assert rmse["fused"] == pytest.approx(np.sqrt(np.mean(error[counted, -1] ** 2)))
    assert answer["worst_steps"][0]["step"] == int(error[:, -1].argmax())
    assert "task=door" in answer["worst_steps"][0]["link"]
    assert sum(answer["phases"]["contact"]["effective_weights"].values()) == pytest.approx(1.0)
    assert answer["diagnosis"]["headline"]
    values = assistant.values(**RUN, step=50)
    assert values["truth"]["hinge_x_cm"] == pytest.approx(100.0 * run.episode.states[50, 0])
    assert values["estimates"]["fused"]["estimate"]["angle_deg"] == pytest.approx(np.degrees(run.estimate_mean[50, 2]))
    assert assistant.figure(**RUN, step=50).startswith(b"\x89PNG")


@pytest.mark.long
def test_failures_and_diagnosis(assistant: Assistant) -> None:
    answer = assistant.failures("door", "crossmodal-ekf", top=3)
    assert len(answer["events"]) == 3
    assert all(event["link"].startswith("http://127.0.0.1:8000/?task=door") for event in answer["events"])
    diagnosis = assistant.diagnose("door", "crossmodal-ekf", faults="image_frozen:from=40", episodes=[9, 19, 29])
    assert diagnosis["causes"][0]["cause"] == "image.frozen"
    json.dumps(diagnosis, allow_nan=False)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "dor"}, "task 'dor' does not exist"),
        ({"filter": "../../secret.safetensors"}, "does not exist"),
        ({"episode": 10_000}, "episode 10000 does not exist"),
        ({"data": "/etc/passwd"}, "does not exist"),
        ({"faults": "nothing=1"}, "fault 'nothing' does not exist"),
    ],
)
def test_names_that_do_not_exist(assistant: Assistant, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(BadInput, match=message):
        assistant.explain_run(**(RUN | arguments))


@pytest.mark.parametrize("top", [0, -3, 51])
def test_a_number_of_events_out_of_range_is_refused(assistant: Assistant, top: int) -> None:
    with pytest.raises(BadInput, match=f"top is 1 to 50 events, not {top}"):
        assistant.failures("door", "crossmodal-ekf", top=top)


def test_protocol() -> None:
    mcp = pytest.importorskip("mcp", reason="pip install 'beliefscope[mcp]'")

    async def ask() -> tuple[list[Any], Any, Any]:
        arguments = ["-m", "beliefscope", "mcp"]
        command = mcp.StdioServerParameters(command=sys.executable, args=arguments, env=dict(os.environ))
        async with mcp.stdio_client(command) as (read, write), mcp.ClientSession(read, write) as session:
            await session.initialize()
            tools = (await session.list_tools()).tools
            answer = await session.call_tool("values", RUN | {"step": 3})
            wrong = await session.call_tool("values", RUN | {"step": 3, "task": "dor"})
            return tools, answer, wrong

    tools, answer, wrong = anyio.run(ask)
    assert {tool.name for tool in tools} == {"catalog", "explain_run", "values", "diagnose", "failures", "figure"}
    assert all(tool.description for tool in tools)
    assert "hinge_x_cm" in answer.content[0].text
    assert "task 'dor' does not exist" in wrong.content[0].text
