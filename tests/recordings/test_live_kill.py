"""LiveRecorder in a process that is killed: every complete step stays readable."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.trace import load_trace
from beliefscope.inspect.traces.live_file import LiveFileReader
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.rerun_log import live_views

pytestmark = pytest.mark.slow

Run = Callable[[str], tuple[int, str, str]]


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 120
    while time.monotonic() < end:
        if condition():
            return
        time.sleep(0.01)
    pytest.fail("timeout")


KILLED = """
import os, signal, sys, time
import numpy as np
from pathlib import Path
from beliefscope.recordings.live import LiveRecorder
folder, last, pause = Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
with LiveRecorder("run", task="door", folder=folder) as recorder:
    for t in range(last):
        recorder.step((np.full(3, t, float), (1 + t) * np.eye(3)), {"image": np.full((32, 32), t % 256, np.uint8)})
        time.sleep(pause)
    if sys.argv[4] == "immediately":
        os.kill(os.getpid(), signal.SIGKILL)
    print("ready", flush=True)
    time.sleep(600)
"""


def complete_steps(recording: Path) -> int:
    """Number of complete steps of a growing recording."""
    with suppress(BadInput):
        return len(read_recording(recording))
    return 0


def record_and_kill(folder: Path, last: int, pause: float, when: str) -> int:
    """Number of steps in the file of a killed run, after checking their values."""
    command = [sys.executable, "-c", KILLED, str(folder), str(last), str(pause), when]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        if when == "later":
            assert process.stdout.readline() == "ready\n"
            until(lambda: LiveFileReader(folder / "run.live").poll() == last)
            until(lambda: complete_steps(folder / "run.rrd") == last)
            process.kill()
        assert process.wait(120) == -signal.SIGKILL
    reader = LiveFileReader(folder / "run.live")
    steps = reader.poll()
    assert (reader.finished, reader.alive) == (False, False)
    np.testing.assert_array_equal(reader.part().estimate_mean[:, 0], np.arange(steps))
    np.testing.assert_array_equal(reader.part().episode.observations["image"][:, 3, 3], np.arange(steps) % 256)
    return steps


@pytest.mark.long
def test_kill_keeps_every_written_step(run: Run, tmp_path: Path) -> None:
    assert record_and_kill(tmp_path, 47, 0.002, "later") == 47
    recording = tmp_path / "run.rrd"
    recorded = read_recording(recording)
    np.testing.assert_array_equal(recorded.estimate_mean[:, 0], np.arange(47))
    assert run(f"import {tmp_path}/run.live -o {tmp_path}/run.trace")[0] == 0
    assert len(load_trace(tmp_path / "run.trace")) == 47
    live_views.write_live_recording(tmp_path / "run.live", recording)
    assert len(read_recording(recording)) == 47, "the complete recording can be restored"


@pytest.mark.long
@pytest.mark.parametrize("seed", range(12))
def test_kill_at_a_random_time(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    last = int(rng.integers(1, 400))
    steps = record_and_kill(tmp_path, last, float(rng.choice([0.0, 0.0005, 0.003])), "immediately")
    assert 1 <= steps <= last
    recording = tmp_path / "run.rrd"
    if recording.exists() and recording.stat().st_size:
        rerun = Path(sys.executable).with_name("rerun")
        done = subprocess.run([rerun, "rrd", "stats", recording], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
