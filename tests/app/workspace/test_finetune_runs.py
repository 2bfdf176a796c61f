"""Fine-tuning runs of a workspace, including files of earlier versions."""

from __future__ import annotations

import json
from pathlib import Path

from beliefscope.app.workspace.finetune_runs import FineTuneRuns
from beliefscope.filters.finetuning.settings import FineTune


def test_runs_are_listed_newest_first(tmp_path: Path) -> None:
    runs = FineTuneRuns(tmp_path)
    records = [runs.add(name, "door", "crossmodal-ekf", "sample", FineTune()) for name in ("a", "b")]
    (tmp_path / "finetune" / "damaged").mkdir()
    (tmp_path / "finetune" / "damaged" / "run.json").write_text("{")
    assert runs.list_runs() == records[::-1]
    assert runs.get("a") == records[0]


def test_files_of_earlier_versions(tmp_path: Path) -> None:
    folder = tmp_path / "finetune" / "old"
    folder.mkdir(parents=True)
    settings = {"nominal": 0.25, "pull": 2.0, "moments": ["9:20-60"]}
    run = {"run": "old", "task": "door", "filter": "crossmodal-ekf", "data": "sample", "settings": settings}
    (folder / "run.json").write_text(json.dumps(run | {"asked": 5.0}))
    (folder / "child.safetensors").write_bytes(b"")
    (folder / "found.json").write_text(json.dumps({"child": {}, "change": {}, "frozen": [], "moments": []}))
    (folder / "progress.json").write_text(json.dumps({"steps": 4, "losses": [], "looks": []}))
    runs = FineTuneRuns(tmp_path)
    (record,) = runs.list_runs()
    assert record.submitted == 5.0
    assert (record.settings["clean_weight"], record.settings["l2_sp"], record.settings["events"]) == (
        0.25,
        2.0,
        ["9:20-60"],
    )
    assert runs.checkpoints() == [runs.file("old", "finetuned.safetensors")] == [folder / "child.safetensors"]
    assert runs.read("old", "result.json") == {"finetuned": {}, "comparison": {}, "frozen": [], "events": []}
    assert runs.read("old", "progress.json") == {"steps": 4, "losses": [], "validations": []}
