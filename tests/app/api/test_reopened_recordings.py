"""Opening the run of a recording on a server without its filter."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qs

import numpy as np
import pytest
from starlette.testclient import TestClient

from beliefscope.app.runs.settings import Settings
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.checkpoint import load_checkpoint
from beliefscope.inspect.trace import trace
from beliefscope.recordings.write import write_recording

pytestmark = pytest.mark.slow

TIMEOUT = 120.0  # s, including the import of PyTorch by a job


@pytest.mark.long  # nine seconds
def test_run_equals_the_recorded_one(settings: Settings, open_client: Callable[..., TestClient]) -> None:
    checkpoint = load_checkpoint(Path(str(settings.checkpoints["crossmodal-pf"])))
    with open_dataset(settings.data["mine"], DOOR) as data:
        run = trace(checkpoint, data[1], episode_index=1, seed=5, particles=20)
    folder = settings.workspace / "recordings"
    folder.mkdir(parents=True)
    write_recording(run, folder / "best run (1).rrd")
    (folder / "no run.rrd").write_bytes(b"RRF2")
    url = "/api/recordings/best%20run%20(1).rrd/run"
    with open_client(replace(settings, checkpoints={}, data={})) as client:
        end = time.monotonic() + TIMEOUT
        while any(r["reading"] for r in client.get("/api/recordings").json()["recordings"]):
            assert time.monotonic() < end
            time.sleep(0.1)
        job = client.post(url).json()["job"]
        while (job := client.get(f"/api/jobs/{job['id']}").json())["state"] in ("waiting", "running"):
            assert time.monotonic() < end
            time.sleep(0.1)
        assert job["state"] == "done", job["error"]
        query = {key: value for key, (value,) in parse_qs(job["link"].removeprefix("?")).items()}
        path = f"/api/trace/{query['task']}/{query['filter']}/{query['episode']}"
        header = client.get(path, params={"data": query["data"]}).json()
        assert (header["steps"], header["seed"], header["checkpoint_hash"]) == (len(run), 5, checkpoint.hash)
        columns = client.get(f"{path}/columns", params={"data": query["data"]}).content
        (offset,) = (c["offset"] for c in header["columns"] if c["name"] == "estimate_mean")
        estimate = np.frombuffer(columns, "<f4", run.estimate_mean.size, offset)
        np.testing.assert_array_equal(estimate, run.estimate_mean.ravel())
        assert client.post(url).json()["job"]["state"] == "done", "the recording is read once"
        refused = client.post("/api/recordings/no%20run.rrd/run")
        assert (refused.status_code, "not a complete Rerun recording" in refused.json()["error"]) == (400, True)
        assert client.post("/api/recordings/none.rrd/run").status_code == 404
