"""Figures and values of the timeline over HTTP."""

from __future__ import annotations

import csv
import subprocess
import sys

import numpy as np
import pytest
from starlette.testclient import TestClient
from tests.app.api.test_traces import columns

pytestmark = pytest.mark.slow

STARTS = {"svg": b"<?xml", "pdf": b"%PDF", "png": b"\x89PNG"}


@pytest.mark.long
def test_files_of_the_timeline(shared_client: TestClient, shared_trace_url: str) -> None:
    for format, start in STARTS.items():
        response = shared_client.get(f"{shared_trace_url}/timeline.{format}", params={"chart": "error"})
        assert response.content.startswith(start)
        assert response.headers["content-disposition"].endswith(f'-timeline.{format}"')
    query = {"chart": ["estimate", "readings/force"], "component": "angle", "window": "2-6"}
    response = shared_client.get(f"{shared_trace_url}/timeline.csv", params=query)
    header, *rows = csv.reader(response.text.splitlines())
    assert [row[0] for row in rows] == ["2", "3", "4", "5", "6"]
    values = columns(shared_client, shared_trace_url)
    for name, expected in (
        ("angle_fused_deg", np.degrees(values["estimate_mean"][2:7, 2])),
        ("angle_fused_sigma_deg", np.degrees(values["estimate_sigma"][2:7, 2])),
        ("force_readings_y_N", values["readings/force"][2:7, 1]),
    ):
        np.testing.assert_allclose([float(row[header.index(name)]) for row in rows], expected, rtol=1e-5)


def test_comparison_run_of_the_timeline(shared_client: TestClient, shared_trace_url: str) -> None:
    query = {"chart": "error", "against": "filter=crossmodal-ekf"}
    while (response := shared_client.get(f"{shared_trace_url}/timeline.csv", params=query)).status_code == 202:
        pass
    assert "position_error_fused_comparison_cm" in response.text.splitlines()[0]


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ("timeline.csv?chart=bars", "chart 'bars' does not exist"),
        ("timeline.csv?window=abc", "window 'abc' is not FIRST-LAST, such as 20-60"),
        ("timeline.csv?component=z", "component 'z' of task 'door' does not exist"),
        ("timeline.gif", "'svg', 'pdf', 'png' or 'csv'"),
        ("timeline.csv?time=hours", "'steps' or 'seconds'"),
    ],
)
def test_invalid_requests(shared_client: TestClient, shared_trace_url: str, part: str, message: str) -> None:
    response = shared_client.get(f"{shared_trace_url}/{part}")
    assert response.status_code in (400, 422)
    assert message in response.json()["error"]


@pytest.mark.long
def test_the_server_loads_matplotlib_only_to_draw() -> None:
    """In a process of its own: this one may have drawn before."""
    code = "import sys, beliefscope.app.server.main; assert 'matplotlib' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
