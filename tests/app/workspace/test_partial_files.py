"""Files that were being written when their writer was killed: known by their names, and swept when they are old."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from beliefscope.app.runs.trace_store import Settings
from beliefscope.app.workspace.partial_files import ABANDONED, FOLDERS, sweep
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.trace import trace
from beliefscope.recordings.write import write_recording


def aged(path: Path, seconds: float) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"half")
    os.utime(path, (time.time() - seconds, time.time() - seconds))
    return path


def test_a_server_sweeps_what_is_old_and_ours_and_nothing_else(
    settings: Settings, open_client: Callable[..., TestClient], tmp_path: Path
) -> None:
    workspace, outside = settings.workspace, tmp_path / "outside"
    old, young = 2 * ABANDONED, ABANDONED / 2
    gone = [aged(workspace / name / "deep" / ".run.trace.1.part", old) for name in FOLDERS]
    gone += [aged(workspace / "recordings" / ".a.rrd.2.part", old), aged(workspace / ".children.json.3.part", old)]
    stay = [
        aged(workspace / "traces" / ".run.trace.4.part", young),  # somebody may be writing
        aged(workspace / "recordings" / "named.part", old),
        aged(workspace / "recordings" / ".hidden", old),
        aged(workspace / "theirs" / ".download.part", old),
        aged(outside / ".film.part", old),
    ]
    (workspace / "traces" / "link").symlink_to(outside)
    with open_client(settings):
        assert not [path for path in gone if path.exists()]
    assert all(path.exists() for path in stay)
    sweep(workspace / "nowhere")


def test_every_file_under_way_has_such_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As seen in the moment before it gets its own."""
    seen: list[str] = []
    replace = os.replace
    monkeypatch.setattr(os, "replace", lambda source, target: seen.append(Path(source).name) or replace(source, target))
    with open_dataset(sample_path("door")) as data:
        episode: Episode = data[9]
    write_dataset(tmp_path / "a.h5", DOOR, [episode])
    write_atomically(tmp_path / "b.json", b"{}")
    write_recording(trace(load_checkpoint(shipped("door", "haptics-ekf")), episode), tmp_path / "c.rrd")
    assert len(seen) == 3
    for name, whole in zip(seen, ("a.h5", "b.json", "c.rrd"), strict=True):
        assert name.startswith(f".{whole}.")
        assert name.endswith(".part")
