"""A small part of ``python bench/fuzz.py``: the same inputs every time, of every reader, every route and the socket."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import http_fuzz as asked
import mutate
import readers

from beliefscope.datasets.readers import hdf5_guard

SLOW = ("study", "mit-hdf5", "mit-json", "recording")
"""Whose valid file takes a training to make, whose pictures are taken, or whose reader can end this process."""


@pytest.mark.parametrize("name", [name for name in readers.READERS if name not in SLOW])
def test_nothing_but_bad_input_comes_out_of_a_reader(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name in readers.HDF5:  # which another process goes over first: here they are only cut off, and edited
        monkeypatch.setattr(hdf5_guard, "is_foreign", lambda path: False)
        monkeypatch.setattr(mutate, "damaged", lambda data, rng: data[: rng.randrange(len(data))])
    readers.check_whole(name, tmp_path)
    came = [readers.attempt(name, seed=11, number=number, folder=tmp_path) for number in range(25)]
    assert came.count("refused") > 5, "the inputs are wrong enough"


@pytest.mark.long
@pytest.mark.parametrize("name", SLOW[:3])
def test_nothing_but_bad_input_comes_out_of_a_slow_reader(name: str, tmp_path: Path) -> None:
    readers.check_whole(name, tmp_path)
    for number in range(100):
        readers.attempt(name, seed=11, number=number, folder=tmp_path)


def test_no_route_and_no_message_fails_and_nothing_is_left(tmp_path: Path) -> None:
    before, given = threading.active_count(), readers.server(tmp_path)
    with asked.served(given) as (client, heard):
        http = asked.ask_http(client, heard, 250, 11)
        socket = asked.ask_socket(client, heard, 100, 11)
    assert not http.failures
    assert not socket.failures
    assert http.inputs > 100
    assert http.answers["2xx"] > 5
    assert socket.inputs >= 100
    assert not asked.left_over(given.workspace)
    assert asked.threads_after(before) <= 0
