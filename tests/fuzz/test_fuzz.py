"""A short run of ``tools/stress/fuzz.py`` with fixed inputs: all readers, routes and the view's WebSocket."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import file_readers
import mutate

from beliefscope.datasets.readers import hdf5_guard

pytestmark = pytest.mark.slow

SLOW = ("study", "mit-hdf5", "mit-json", "recording", "log-rerun")
"""Readers whose files need a training or rendering, or that can crash the process."""


@pytest.mark.first(10)
@pytest.mark.parametrize("name", [name for name in file_readers.READERS if name not in SLOW])
def test_reader_raises_only_bad_input(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if name in file_readers.HDF5:  # without the probe, only truncated and edited files are safe to read
        monkeypatch.setattr(hdf5_guard, "needs_probe", lambda path: False)
        monkeypatch.setattr(mutate, "corrupt_bytes", lambda data, rng: data[: rng.randrange(len(data))])
    file_readers.check_valid(name, tmp_path)
    results = [file_readers.attempt(name, seed=11, number=number, folder=tmp_path) for number in range(15)]
    assert results.count("refused") > 3, "enough inputs are invalid"


@pytest.mark.long
@pytest.mark.parametrize("name", SLOW[:3])
def test_slow_reader_raises_only_bad_input(name: str, tmp_path: Path) -> None:
    file_readers.check_valid(name, tmp_path)
    for number in range(100):
        file_readers.attempt(name, seed=11, number=number, folder=tmp_path)


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name in file_readers.LOG_READERS if name not in SLOW])
def test_readers_of_logs_raise_only_bad_input(name: str, tmp_path: Path) -> None:
    for number in range(10_000):
        file_readers.attempt(name, seed=12, number=number, folder=tmp_path)


@pytest.mark.long
def test_server_survives_invalid_requests_and_messages(tmp_path: Path) -> None:
    import http_fuzz  # its packages are slow to import

    threads, settings = threading.active_count(), file_readers.server_settings(tmp_path)
    with http_fuzz.running_server(settings) as (client, log):
        http = http_fuzz.fuzz_http(client, log, 40, 11)
        socket = http_fuzz.fuzz_socket(client, log, 25, 11)
    assert not http.failures
    assert not socket.failures
    assert http.inputs > 15
    assert http.answers["2xx"] > 5
    assert socket.inputs >= 25
    assert not http_fuzz.temporary_files(settings.workspace)
    assert http_fuzz.extra_threads(threads) <= 0
