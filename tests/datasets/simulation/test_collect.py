"""Data collection: reproducibility, resuming after interruptions, and input validation."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.collect import collect
from beliefscope.datasets.store import open_dataset

pytestmark = pytest.mark.slow

COLLECT = """
import sys
from beliefscope.datasets.simulation.collect import collect
if __name__ == "__main__":
    collect("door", 400, 40, 11, 2, sys.argv[1])
"""


def sha(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize("task", ["door", "push"])
def test_number_of_workers_does_not_change_the_file(task: str, tmp_path: Path) -> None:
    for workers in (1, 2):
        collect(task, 3, 6, 5, workers, tmp_path / f"{workers}.h5")
    assert sha(tmp_path / "1.h5") == sha(tmp_path / "2.h5")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["1.h5", "2.h5"], "no other file remains"


def test_larger_collections_start_with_the_same_episodes(tmp_path: Path) -> None:
    for episodes in (2, 3):
        collect("door", episodes, 4, 5, 1, tmp_path / f"{episodes}.h5")
    with open_dataset(tmp_path / "2.h5") as two, open_dataset(tmp_path / "3.h5") as three:
        assert [e.digest() for e in two] == [three[i].digest() for i in range(2)]
        assert two.hash != three.hash


def test_progress_counts_all_episodes(tmp_path: Path) -> None:
    progress: list[tuple[int, int]] = []
    collect("door", 3, 2, 0, 1, tmp_path / "a.h5", lambda done, count: progress.append((done, count)))
    assert progress == [(0, 3), (1, 3), (2, 3), (3, 3)]


def child_processes(parent: int) -> list[int]:
    """Process ids of the children, from /proc."""
    children = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                stat = (entry / "stat").read_text()
            except OSError:
                continue
            if int(stat.rpartition(")")[2].split()[1]) == parent:
                children.append(int(entry.name))
    return children


def running(pid: int) -> bool:
    try:
        return "(zombie)" not in (Path("/proc") / str(pid) / "status").read_text()
    except OSError:
        return False


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_killed_collection_keeps_finished_episodes_and_no_worker(tmp_path: Path) -> None:
    path, folder = tmp_path / "door.h5", tmp_path / "door.h5.partial"
    process = subprocess.Popen([sys.executable, "-c", COLLECT, str(path)])
    try:
        deadline = time.monotonic() + 60
        while len(list(folder.glob("door-*.h5"))) < 3 and time.monotonic() < deadline:
            time.sleep(0.05)
        workers = child_processes(process.pid)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert not path.exists()
    assert len(workers) >= 2
    deadline = time.monotonic() + 20
    while any(map(running, workers)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(map(running, workers))

    finished = sorted(folder.glob("door-*.h5"), key=lambda p: p.stat().st_mtime_ns)
    assert len(finished) >= 3
    stamps = {p: p.stat().st_mtime_ns for p in finished}
    reusable = [i for i in range(6) if any(f"-steps40-{i}-" in p.name for p in finished)]
    progress: list[int] = []
    collect("door", 6, 40, 11, 1, path, lambda done, _: progress.append(done))
    assert progress[0] == len(reusable), "finished episodes are reused"
    assert all(not p.exists() or p.stat().st_mtime_ns == stamps[p] for p in finished)
    assert not folder.exists()

    collect("door", 6, 40, 11, 1, tmp_path / "uninterrupted.h5")
    assert sha(path) == sha(tmp_path / "uninterrupted.h5")


def test_interruption_cancels_pending_episodes(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        collect("door", 200, 10, 0, 2, tmp_path / "a.h5", stop_at(2))
    assert len(list((tmp_path / "a.h5.partial").iterdir())) < 40


def test_damaged_part_is_simulated_again(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with pytest.raises(KeyboardInterrupt):
        collect("door", 3, 3, 0, 1, path, stop_at(2))
    parts = sorted((tmp_path / "a.h5.partial").iterdir())
    assert len(parts) == 2
    parts[0].write_bytes(parts[0].read_bytes()[:1000])
    progress: list[int] = []
    collect("door", 3, 3, 0, 1, path, lambda done, _: progress.append(done))
    assert progress[0] == 1
    with open_dataset(path) as data:
        assert len(list(data)) == 3


def test_parts_of_another_length_are_ignored(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with pytest.raises(KeyboardInterrupt):
        collect("door", 3, 3, 0, 1, path, stop_at(2))
    progress: list[int] = []
    collect("door", 1, 4, 0, 1, path, lambda done, _: progress.append(done))
    assert progress[0] == 0
    with open_dataset(path) as data:
        assert [s.steps for s in data.summaries] == [4]


def stop_at(done: int):  # type: ignore[no-untyped-def]
    def interrupt(now: int, _: int) -> None:
        if now == done:
            raise KeyboardInterrupt

    return interrupt


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"task": "dor"}, r"task 'dor' does not exist\. Available: door"),
        ({"episodes": 0}, "episodes is 0, expected at least 1"),
        ({"steps": 1}, "steps is 1, expected at least 2"),
        ({"seed": -1}, "seed is -1, expected at least 0"),
        ({"workers": 0}, "workers is 0, expected at least 1"),
        ({"path": "nowhere/a.h5"}, "Folder .*nowhere does not exist"),
        ({"path": "."}, "is a folder"),
    ],
)
def test_invalid_arguments(change: dict[str, object], message: str, tmp_path: Path) -> None:
    arguments = {"task": "door", "episodes": 1, "steps": 2, "seed": 0, "workers": 1, "path": "a.h5"} | change
    with pytest.raises(BadInput, match=message) as error:
        collect(**(arguments | {"path": tmp_path / str(arguments["path"])}))  # type: ignore[arg-type]
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())
