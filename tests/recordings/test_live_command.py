"""``beliefscope live`` records the same run as ``beliefscope trace``."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.external.load import load_external
from beliefscope.inspect.trace import Trace, arrays_of, header_of, load_trace, trace
from beliefscope.inspect.traces.live_file import LiveFileReader
from beliefscope.recordings.read import read_recording

pytestmark = pytest.mark.slow

Compare = Callable[[Trace, Trace], None]
Run = Callable[[str], tuple[int, str, str]]
EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "04_own_filter.py"


def test_run_equals_trace(run: Run, assert_same: Compare, tmp_path: Path) -> None:
    line = "door --filter crossmodal-ekf --faults blackout=0.4 --seed 5"
    code, out, err = run(f"live {line} --rate 0 --workspace {tmp_path} --json -")
    document = json.loads(out)
    assert code == 0, err
    assert f"beliefscope serve --workspace {tmp_path}" in err
    (name,) = (path.stem for path in (tmp_path / "live").glob("*.live"))
    assert f"/?task=door&data=live%3A{name}" in err, "the page's link of the run"
    assert (document["steps"], document["stopped"], document["waited"]) == (100, False, 0)
    assert run(f"trace {line} -o {tmp_path}/run.trace")[0] == 0
    expected = load_trace(tmp_path / "run.trace")
    reader = LiveFileReader(Path(document["path"]))
    assert reader.poll() == reader.expected == 100
    assert_same(reader.part(), expected)
    assert_same(read_recording(document["recording"]), expected)


def test_external_filter(run: Run, assert_same: Compare, tmp_path: Path) -> None:
    code, out, err = run(f"live door --filter {EXAMPLE}:build --rate 0 --workspace {tmp_path} --json -")
    assert code == 0, err
    with open_dataset(sample_path("door")) as data:
        expected = trace(load_external(f"{EXAMPLE}:build", "door"), data[9], 9)
    assert_same(read_recording(json.loads(out)["recording"]), expected)
    assert header_of(expected)["kind"] == "external"
    assert arrays_of(expected)


@pytest.mark.long
def test_ctrl_c_leaves_complete_files(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "beliefscope", "live", "door", "--filter", "crossmodal-ekf", "--json", "-"]
    command += ["--rate", "1", "--workspace", str(tmp_path)]  # the run lasts much longer than the test
    # A shell that runs the tests in the background lets them ignore the signal.
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=heed) as process:
        start = time.monotonic()
        while True:
            paths = [path for path in tmp_path.glob("live/*.live") if path.stat().st_size]  # with a header
            if paths and LiveFileReader(paths[0]).poll() >= 3:
                break
            assert time.monotonic() - start < 180
            time.sleep(0.01)
        (path,) = paths
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    document = json.loads(out)
    reader = LiveFileReader(path)
    assert (document["stopped"], reader.poll(), reader.finished) == (True, document["steps"], True)
    assert 2 < document["steps"] < 100
    assert len(read_recording(document["recording"])) == document["steps"]
