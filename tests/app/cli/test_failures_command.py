"""The command ``failures`` and its permalinks."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from urllib.parse import parse_qs

import pytest

from beliefscope.app.protocol.permalinks import permalink
from beliefscope.app.runs.settings import Settings
from beliefscope.datasets.simulation.door import DOOR

pytestmark = pytest.mark.slow

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def line(base_settings: Settings) -> list[object]:
    """The command on the small dataset."""
    checkpoint, data = base_settings.checkpoints["crossmodal-pf"], base_settings.data["mine"]
    return ["failures", "door", "--filter", checkpoint, "--data", data, "--particles", 30]


def test_json_document_with_permalinks(run: Run, line: list[object], base_settings: Settings) -> None:
    folder = base_settings.checkpoints["crossmodal-pf"].parent.name
    code, out, _ = run(*line, "--all", "--by", "angle", "--faults", "blackout=0.4", "--top", 2, "--json", "-")
    assert code == 0
    document = json.loads(out)
    assert document["episodes"] == 2
    assert 1 <= len(document["events"]) <= 2
    event = document["events"][0]
    query = {key: value for key, (value,) in parse_qs(event["link"].removeprefix("?")).items()}
    assert query == {
        "task": "door",
        "filter": f"{folder}-crossmodal-pf",  # the bare name is the pretrained filter
        "data": "door",
        "episode": str(event["episode"]),
        "step": str(event["step"]),
        "component": "angle",
        "weights": "raw",
        "track": "error",
        "tab": "scene",
        "faults": "blackout=0.4",
        "by": "angle",
    }
    assert "--data" in document["serve"]


def test_permalinks_of_an_external_filter(run: Run, base_settings: Settings) -> None:
    code = "examples/04_own_filter.py:build"
    line = ["failures", "door", "--filter", code, "--data", base_settings.data["mine"], "--top", 1, "--json", "-"]
    status, out, _ = run(*line)
    document = json.loads(out)
    assert (status, parse_qs(document["events"][0]["link"])["filter"]) == (0, ["04_own_filter-build"])
    assert f"--filter {code}" in document["serve"]


def test_tables_and_full_permalinks(run: Run, line: list[object]) -> None:
    code, out, err = run(*line, "--url", "http://127.0.0.1:9000/", "--by", "ess")
    assert code == 0
    assert "Events by phase: particles / effective sample size (x)" in out
    assert "http://127.0.0.1:9000/?task=door&" in out
    assert "track=particles" in out
    assert "the dashboard uses 300 particles" in err


def test_events_of_one_phase(run: Run, line: list[object]) -> None:
    events = json.loads(run(*line, "--all", "--by", "ess", "--json", "-")[1])["events"]
    name = events[-1]["phase"]
    selection = json.loads(run(*line, "--all", "--by", "ess", "--phase", name, "--json", "-")[1])["events"]
    assert selection == [event for event in events if event["phase"] == name]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--by", "eror"], "score 'eror' of task 'door' does not exist. Available: error, angle, nees, ess"),
        (["--phase", "contact"], "phase 'contact' does not exist. Available: contact made"),
        (["--top", "0"], "'0' is not an integer of at least 1"),
    ],
)
def test_invalid_options(run: Run, line: list[object], options: list[str], message: str) -> None:
    code, out, err = run(*line, *options)
    assert (code, out) == (2, "")
    assert message in " ".join(err.split())


def test_permalink_escapes_names() -> None:
    link = permalink(DOOR, "my filter*~", "a&b=ü", 3, 4, "blackout=1:from=2,delay=image:steps=3", "regret")
    query = {key: value for key, (value,) in parse_qs(link.removeprefix("?")).items()}
    assert (query["filter"], query["data"]) == ("my filter*~", "a&b=ü")
    assert query["faults"] == "blackout=1:from=2,delay=image:steps=3"
    assert query["weights"] == "effective"


FAILING = """
class Failing:
    task = "door"
    def initialize_beliefs(self, *, mean, covariance): self.mean, self.steps = mean, 0
    def __call__(self, *, observations, controls):
        self.steps += 1
        if self.steps > {steps}:
            raise ValueError("not positive definite")
        return self.mean
"""
"""A filter that fails in a step."""


@pytest.mark.parametrize(("steps", "workers"), [(20, 1), (3, 1), pytest.param(20, 2, marks=pytest.mark.long)])
def test_an_error_of_a_failing_filter_names_the_command_that_finds_its_cause(
    run: Run, tmp_path: Path, steps: int, workers: int
) -> None:
    (tmp_path / "failing.py").write_text(FAILING.format(steps=steps))
    code, _, error = run("failures", "door", "--filter", f"{tmp_path}/failing.py:Failing", "--workers", workers)
    assert code == 2
    failure = f"error: {tmp_path}/failing.py:Failing fails at step {steps}: ValueError: not positive definite"
    advice = "; `beliefscope diagnose` restarts it at the true state and names the cause" if steps == 20 else ""
    assert error.splitlines()[-1] == failure + advice
