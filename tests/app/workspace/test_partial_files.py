"""Partial files of interrupted writes: their names, and the deletion of old ones."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from beliefscope.app.runs.settings import Settings
from beliefscope.app.workspace.partial_files import FOLDERS, MAX_AGE, delete_abandoned_parts
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.trace import trace
from beliefscope.recordings.write import write_recording

pytestmark = pytest.mark.slow


def aged(path: Path, seconds: float) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"half")
    os.utime(path, (time.time() - seconds, time.time() - seconds))
    return path


def test_a_server_deletes_only_old_partial_files(
    settings: Settings, open_client: Callable[..., TestClient], tmp_path: Path
) -> None:
    workspace, outside = settings.workspace, tmp_path / "outside"
    old, young = 2 * MAX_AGE, MAX_AGE / 2
    deleted = [aged(workspace / name / "deep" / ".run.trace.1.part", old) for name in FOLDERS]
    deleted += [aged(workspace / "recordings" / ".a.rrd.2.part", old), aged(workspace / ".kept.json.3.part", old)]
    others = [
        aged(workspace / "traces" / ".run.trace.4.part", young),  # may still be written
        aged(workspace / "recordings" / "named.part", old),
        aged(workspace / "recordings" / ".hidden", old),
        aged(workspace / "theirs" / ".download.part", old),
        aged(outside / ".film.part", old),
    ]
    (workspace / "traces" / "link").symlink_to(outside)
    with open_client(settings):
        assert not [path for path in deleted if path.exists()]
    assert all(path.exists() for path in others)
    delete_abandoned_parts(workspace / "nowhere")


def test_writers_use_partial_file_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sources: list[str] = []
    replace = os.replace
    monkeypatch.setattr(
        os, "replace", lambda source, target: sources.append(Path(source).name) or replace(source, target)
    )
    with open_dataset(sample_path("door")) as data:
        episode: Episode = data[9]
    write_dataset(tmp_path / "a.h5", DOOR, [episode])
    write_atomically(tmp_path / "b.json", b"{}")
    write_recording(trace(load_checkpoint(pretrained_path("door", "haptics-ekf")), episode), tmp_path / "c.rrd")
    assert len(sources) == 3
    for name, target in zip(sources, ("a.h5", "b.json", "c.rrd"), strict=True):
        assert name.startswith(f".{target}.")
        assert name.endswith(".part")
