"""Settings of a server as JSON, for other processes."""

from __future__ import annotations

from pathlib import Path

from beliefscope.app.runs.settings import Settings, origin
from beliefscope.datasets.simulation.push import PUSH
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.filters.external.load import as_external, load_external


def test_filter_objects_stay_in_their_process(tmp_path: Path) -> None:
    path = pretrained_path(PUSH, "image-ekf")
    given = as_external(lambda *, observations, controls: controls[..., :2], "still", PUSH)
    code = load_external("examples/04_own_filter.py:build", "door")
    checkpoints = {"file": path, "given": given, "code": code, "loaded": load_checkpoint(path)}
    settings = Settings(tmp_path, {"mine": path}, checkpoints, sweeps={"s": tmp_path}, seed=3)
    assert origin(given) is None
    copy = Settings.from_json(settings.to_json())
    assert [*copy.checkpoints] == ["file", "code", "loaded"]
    assert copy.checkpoints["loaded"] == path
    assert (copy.data, copy.sweeps, copy.seed) == (settings.data, settings.sweeps, 3)
