"""The command in odd surroundings: no UTF-8, names that are no text, a reader that has gone, no home."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from beliefscope.app.runs.catalog import short_names
from beliefscope.app.runs.settings import Settings
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import sample_path

COMMAND = [sys.executable, "-m", "beliefscope"]
NO_TEXT = os.fsdecode(b"d\xff")  # of no encoding that is text in UTF-8


@pytest.mark.parametrize("unbuffered", ["", "1"], ids=["at its end", "at once"])
def test_a_reader_that_has_gone_is_told_nothing(unbuffered: str) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    ran = subprocess.run([*COMMAND, "faults"], stdout=writing, stderr=subprocess.PIPE, env=environment, check=False)
    os.close(writing)
    assert (ran.returncode, ran.stderr) == (1, b"")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no disk here that is always full")
def test_a_result_that_cannot_be_written_is_one_line() -> None:
    with open("/dev/full", "w") as full:
        ran = subprocess.run([*COMMAND, "faults"], stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert ran.returncode == 1
    assert ran.stderr == "error: OSError: [Errno 28] No space left on device (beliefscope --debug ... shows where)\n"


# Python means UTF-8 in the C locale by itself; without that, it is as in an old one: letters beyond ASCII are none.
ASCII = {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
DRAWN = """
from pathlib import Path
from beliefscope.app.server import static_files
assert "\\u2026" in static_files._index(Path(static_files.__file__).parents[1] / "page", "version").decode()
"""


def test_the_page_needs_no_locale() -> None:
    ran = subprocess.run(
        [sys.executable, "-c", DRAWN], env=os.environ | ASCII, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr


def test_output_that_the_terminal_cannot_show_is_escaped(tmp_path: Path) -> None:
    """What is no text in UTF-8, and what no letter of ASCII is."""
    environment = os.environ | {"PYTHONIOENCODING": "ascii:strict", "HOME": str(tmp_path / "none")}
    place = tmp_path / f"w\u00f6rk sp\u00e4ce {NO_TEXT}"
    place.mkdir()
    asked = ["collect", "door", "--episodes", "1", "--steps", "2", "-o", place / "two.h5"]
    ran = subprocess.run([*COMMAND, *asked], env=environment, capture_output=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert b"w\\xf6rk sp\\xe4ce d\\udcff/two.h5" in ran.stdout


def test_files_whose_names_are_no_text_do_not_hide_the_others(
    settings: Settings, open_client: Callable[..., TestClient], tmp_path: Path
) -> None:
    given = tmp_path / f"{NO_TEXT}.h5"
    given.write_bytes(sample_path("door").read_bytes())
    for folder, ending in (("recordings", ".rrd"), ("live", ".live"), ("reports", "")):
        (settings.workspace / folder).mkdir(parents=True)
        for name in (NO_TEXT, "a"):
            (settings.workspace / folder / f"{name}{ending}").write_bytes(b"nothing")
    data = {**settings.data, **short_names([given]), "gone": tmp_path / NO_TEXT / "gone.h5"}
    with open_client(Settings(settings.workspace, data=data)) as client:
        said = {name: client.get(f"/api/{name}").json() for name in ("catalog", "recordings", "live", "reports")}
    assert "d\ufffd" in [one["name"] for one in said["catalog"]["tasks"][0]["data"]]
    assert "d\\udcff" in said["catalog"]["problems"][0]
    assert [one["name"] for one in said["recordings"]["recordings"]] == ["a.rrd"]
    assert [one["name"] for one in said["live"]["runs"]] == ["a"]
    json.dumps(said, ensure_ascii=False).encode()


def test_an_error_is_text_whatever_it_names() -> None:
    assert str(BadInput(f"{NO_TEXT} is no file")) == "d\\udcff is no file"
