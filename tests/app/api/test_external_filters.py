"""External filters in commands and on the server; only the command line can name code."""

from __future__ import annotations

import contextlib
import io
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from beliefscope.app.cli.main import main
from beliefscope.app.runs.settings import Settings
from beliefscope.datasets.catalog import load_task
from beliefscope.filters.external.load import load_external
from beliefscope.inspect.trace import load_trace
from beliefscope.recordings.read import read_recording

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "04_own_filter.py"
SPEC = f"{EXAMPLE}:build"
FAILS = """
from torch import nn
class Fails(nn.Module):
    def initialize_beliefs(self, mean, covariance): pass
    def forward(self, observations, controls): return observations["touch"]
"""


def run(*arguments: object) -> tuple[int, str, str]:
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["beliefscope", *map(str, arguments)])
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), pytest.raises(SystemExit) as end:
            main()
    return int(end.value.code or 0), out.getvalue(), err.getvalue()


def result(*arguments: object) -> Any:
    code, out, err = run(*arguments, "--json", "-")
    assert code == 0, err
    return json.loads(out)


@pytest.mark.long
def test_example_is_short_and_calibrated() -> None:
    assert len(EXAMPLE.read_text().splitlines()) < 60
    metrics = result("evaluate", "door", "--filter", SPEC)
    assert metrics["filter"] == "04_own_filter-build"
    assert 0.5 < metrics["nees"] < 2.0
    assert metrics["coverage95"] > 0.85
    assert metrics["particles"] is None


def test_trace_and_recording_are_equal(tmp_path: Path) -> None:
    summary = result("trace", "door", "--filter", SPEC, "-o", tmp_path / "own.trace")
    result("record", "door", "--filter", SPEC, "--maps", 50, "-o", tmp_path / "own.rrd")
    traced, recorded = load_trace(tmp_path / "own.trace"), read_recording(tmp_path / "own.rrd")
    assert traced.checkpoint_hash == recorded.checkpoint_hash == summary["checkpoint_hash"]
    assert (traced.kind, traced.modalities) == (recorded.kind, recorded.modalities) == ("external", ())
    for name in ("estimate_mean", "estimate_covariance", "modality_mean"):
        np.testing.assert_array_equal(getattr(recorded, name), getattr(traced, name))


@pytest.mark.parametrize(("command", "name"), [("trace", "new.trace"), ("record", "new.rrd"), ("evaluate", "")])
def test_error_is_one_line_and_leaves_no_file(command: str, name: str, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(FAILS)
    output = ("-o", tmp_path / name) if name else ()
    code, out, err = run(command, "door", "--filter", f"{tmp_path}/own.py:Fails", *output)
    assert (code, out) == (2, "")
    assert err.splitlines()[-1] == (
        f"error: {tmp_path}/own.py:Fails fails at step 0: KeyError: 'touch'; "
        f"the observations are {', '.join(load_task('door').observations)}"
    )
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["own.py"]


def test_module_in_the_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_own_filters.py").write_text(EXAMPLE.read_text())
    monkeypatch.chdir(tmp_path)
    assert result("evaluate", "door", "--filter", "my_own_filters:build")["filter"] == "my_own_filters-build"
    sys.modules.pop("my_own_filters")


def test_server_needs_the_task(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(FAILS)
    code, _, err = run("serve", "--filter", f"{tmp_path}/own.py:Fails", "--workspace", tmp_path / "w")
    assert code == 2
    assert err.endswith("does not name its task: give it an attribute task, or use --task\n")


@pytest.fixture
def client(base_settings: Settings, tmp_path: Path, open_client: Callable[..., TestClient]) -> TestClient:
    filter_ = load_external(SPEC)
    return open_client(Settings(tmp_path / "workspace", base_settings.data, {filter_.name: filter_}))


def test_page_shows_available_values(client: TestClient) -> None:
    with client:
        entry = client.get("/api/catalog").json()["tasks"][0]["filters"][0]
        assert (entry["name"], entry["kind"]) == ("04_own_filter-build", "external")
        while (answer := client.get("/api/trace/door/04_own_filter-build/0")).status_code == 202:
            pass
        header = answer.json()
        columns = {column["name"] for column in header["columns"]}
        assert {"estimate_mean", "estimate_sigma"} <= columns
        assert (
            not {"modality_mean", "modality_sigma", "weights", "effective_weights", "effective_sample_size"} & columns
        )
        assert header["no_maps"] is None


def test_repairs_and_weaknesses_of_an_external_filter_are_refused_at_once(client: TestClient) -> None:
    with client:
        answer = client.post("/api/repair/door/04_own_filter-build/0")
        assert (answer.status_code, client.get("/api/jobs").json()) == (400, [])
        assert "external filter '04_own_filter-build' has no smallest repair" in answer.json()["error"]
        answer = client.get("/api/weaknesses/door/04_own_filter-build/0")
        assert (answer.status_code, answer.json()) == (200, [])
        assert client.get("/api/finetune/door/04_own_filter-build").json()["why_not"]


def test_page_cannot_name_code(client: TestClient, tmp_path: Path) -> None:
    trap = tmp_path / "trap.py"
    trap.write_text(f"open({str(tmp_path / 'sprung')!r}, 'w')\n" + EXAMPLE.read_text())
    with client:
        for name in (f"{trap}:build", "trap:build", "json:loads"):
            answer = client.get("/api/trace/door/" + name.replace("/", "%2F") + "/0")
            assert answer.status_code in (400, 404)
            answer = client.post("/api/recordings", json={"task": "door", "filter": name, "episode": 0})
            assert answer.status_code == 400
            assert f"filter '{name}' does not exist. Available: " in answer.json()["error"]
    assert not (tmp_path / "sprung").exists()
