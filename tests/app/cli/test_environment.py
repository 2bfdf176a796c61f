"""The command in unusual environments: other encodings, invalid file names, closed pipes, full disks."""

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

pytestmark = pytest.mark.slow

COMMAND = [sys.executable, "-m", "beliefscope"]
INVALID_NAME = os.fsdecode(b"d\xff")  # not valid UTF-8


@pytest.mark.first(1)
@pytest.mark.parametrize("unbuffered", ["", "1"], ids=["buffered", "unbuffered"])
def test_closed_pipe_prints_nothing(unbuffered: str) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    ran = subprocess.run([*COMMAND, "faults"], stdout=writing, stderr=subprocess.PIPE, env=environment, check=False)
    os.close(writing)
    assert (ran.returncode, ran.stderr) == (1, b"")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_unwritable_output_prints_one_line() -> None:
    with open("/dev/full", "w") as full:
        ran = subprocess.run([*COMMAND, "faults"], stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert ran.returncode == 1
    assert (
        ran.stderr
        == "error: OSError: [Errno 28] No space left on device (run beliefscope --debug ... for a traceback)\n"
    )


def test_live_runs_print_no_warning_of_rerun(tmp_path: Path) -> None:
    """Of the growing recording, which has no index."""
    line = ["live", "push", "--filter", "image-ekf", "--rate", "0", "--workspace", str(tmp_path)]
    environment = {name: value for name, value in os.environ.items() if name != "RUST_LOG"}
    ran = subprocess.run([*COMMAND, *line], capture_output=True, text=True, env=environment, check=False)
    assert ran.returncode == 0
    assert "WARN" not in ran.stderr


# The command itself and a command's import of PyTorch; `doctor` takes as long again for its other checks.
THREADS = """
import os, sys
from beliefscope.__main__ import main
sys.argv = ["beliefscope", "faults"]
try:
    main()
except SystemExit:
    print({threads}, "threads")
"""


@pytest.mark.parametrize(
    ("given", "threads", "used"),
    [
        pytest.param(None, "__import__('torch').get_num_threads()", 1, marks=pytest.mark.long),
        ("2", "os.environ['OMP_NUM_THREADS']", 2),  # PyTorch reads it
    ],
    ids=["default", "set by the user"],
)
def test_torch_uses_one_thread_unless_the_user_sets_a_number(given: str | None, threads: str, used: int) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    if given is not None:
        environment["OMP_NUM_THREADS"] = given
    command = [sys.executable, "-c", THREADS.format(threads=threads)]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert ran.stdout.splitlines()[-1] == f"{used} threads"


# Python uses UTF-8 in the C locale by default; these settings restore plain ASCII.
ASCII = {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
RENDER = """
from pathlib import Path
from beliefscope.app.server import static_files
assert "\\u2026" in static_files.page_index(Path(static_files.__file__).parents[1] / "page", "version").decode()
"""


def test_page_is_independent_of_the_locale() -> None:
    ran = subprocess.run(
        [sys.executable, "-c", RENDER], env=os.environ | ASCII, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr


def test_unencodable_output_is_escaped(tmp_path: Path) -> None:
    """Invalid UTF-8 and non-ASCII characters on an ASCII terminal."""
    environment = os.environ | {"PYTHONIOENCODING": "ascii:strict", "HOME": str(tmp_path / "none")}
    place = tmp_path / f"w\u00f6rk sp\u00e4ce {INVALID_NAME}"
    place.mkdir()
    arguments = ["collect", "door", "--episodes", "1", "--steps", "2", "-o", place / "two.h5"]
    ran = subprocess.run([*COMMAND, *arguments], env=environment, capture_output=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert b"w\\xf6rk sp\\xe4ce d\\udcff/two.h5" in ran.stdout


@pytest.mark.long
def test_files_with_invalid_names_do_not_hide_others(
    settings: Settings, open_client: Callable[..., TestClient], tmp_path: Path
) -> None:
    copy = tmp_path / f"{INVALID_NAME}.h5"
    copy.write_bytes(sample_path("door").read_bytes())
    for folder, ending in (("recordings", ".rrd"), ("live", ".live"), ("reports", "")):
        (settings.workspace / folder).mkdir(parents=True)
        for name in (INVALID_NAME, "a"):
            (settings.workspace / folder / f"{name}{ending}").write_bytes(b"nothing")
    data = {**settings.data, **short_names([copy]), "missing": tmp_path / INVALID_NAME / "missing.h5"}
    with open_client(Settings(settings.workspace, data=data)) as client:
        responses = {name: client.get(f"/api/{name}").json() for name in ("catalog", "recordings", "live", "reports")}
    assert "d\ufffd" in [item["name"] for item in responses["catalog"]["tasks"][0]["data"]]
    assert "d\\udcff" in responses["catalog"]["problems"][0]
    assert [item["name"] for item in responses["recordings"]["recordings"]] == ["a.rrd"]
    assert [item["name"] for item in responses["live"]["runs"]] == ["a"]
    json.dumps(responses, ensure_ascii=False).encode()


def test_error_messages_are_valid_text() -> None:
    assert str(BadInput(f"{INVALID_NAME} does not exist")) == "d\\udcff does not exist"
