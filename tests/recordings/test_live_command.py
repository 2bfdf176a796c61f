"""``beliefscope live``: the run that ``trace`` makes, in files that grow."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.external.load import load_foreign
from beliefscope.inspect.trace import Trace, arrays_of, header_of, load_trace, trace
from beliefscope.inspect.traces.live_file import GrowingReader
from beliefscope.recordings.read import read_recording

Compare = Callable[[Trace, Trace], None]
Run = Callable[[str], tuple[int, str, str]]
EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "04_own_filter.py"


def test_it_runs_what_trace_does(run: Run, assert_same: Compare, tmp_path: Path) -> None:
    line = "door --filter crossmodal-ekf --faults blackout=0.4 --seed 5"
    code, out, err = run(f"live {line} --rate 0 --workspace {tmp_path} --json -")
    said = json.loads(out)
    assert code == 0, err
    assert f"beliefscope serve --workspace {tmp_path}" in err
    assert (said["steps"], said["stopped"], said["waited"]) == (100, False, 0)
    assert run(f"trace {line} -o {tmp_path}/run.trace")[0] == 0
    whole = load_trace(tmp_path / "run.trace")
    reader = GrowingReader(Path(said["path"]))
    assert reader.poll() == reader.expected == 100
    assert_same(reader.part(), whole)
    assert_same(read_recording(said["recording"]), whole)


def test_it_runs_a_filter_from_outside(run: Run, assert_same: Compare, tmp_path: Path) -> None:
    code, out, err = run(f"live door --filter {EXAMPLE}:build --rate 0 --workspace {tmp_path} --json -")
    assert code == 0, err
    with open_dataset(sample_path("door")) as data:
        whole = trace(load_foreign(f"{EXAMPLE}:build", "door"), data[9], 9)
    assert_same(read_recording(json.loads(out)["recording"]), whole)
    assert header_of(whole)["kind"] == "foreign"
    assert arrays_of(whole)


def test_ctrl_c_ends_a_run_and_leaves_it_whole(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "beliefscope", "live", "door", "--filter", "crossmodal-ekf", "--json", "-"]
    command += ["--rate", "2", "--workspace", str(tmp_path)]  # its end is far, however late the signal comes
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        begun = time.monotonic()
        while not (paths := list(tmp_path.glob("live/*.live"))) or GrowingReader(paths[0]).poll() < 3:
            assert time.monotonic() - begun < 60, "as long as a busy machine may take to begin"
            time.sleep(0.01)
        (path,) = paths
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    said = json.loads(out)
    reader = GrowingReader(path)
    assert (said["stopped"], reader.poll(), reader.finished) == (True, said["steps"], True)
    assert 2 < said["steps"] < 100
    assert len(read_recording(said["recording"])) == said["steps"]
