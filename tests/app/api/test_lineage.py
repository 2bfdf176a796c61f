"""Which filters were made from which, over HTTP, and one packed with its ancestors."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from beliefscope.app.api.finetune import offered
from beliefscope.app.runs.kept_filters import Child, keep
from beliefscope.app.runs.trace_store import Library
from beliefscope.app.server.main import Settings
from beliefscope.filters.checkpoint import load_checkpoint, save_checkpoint, shipped

MIX = [{"slice": {"name": "haptics alone"}, "share": 1.0}]
ERRORS = {"haptics alone": {"rmse": {"position_cm": 2.0}, "nll": 1.0}}


def child_of(parent: Path, workspace: Path, run: str, seed: int) -> str:
    """Writes what a fine-tuning of no steps would have left; returns its hash."""
    checkpoint = load_checkpoint(parent)
    record = {
        "command": "none",
        "seed": seed,
        "parent": {"hash": checkpoint.hash, "name": checkpoint.name, "settings": {"train": ["all"], "mix": MIX}},
        "held_out": {"before": ERRORS, "after": ERRORS},
    }
    path = workspace / "finetune" / run / "child.safetensors"
    path.parent.mkdir(parents=True)
    return save_checkpoint(checkpoint.filter, checkpoint.name, record, path)


def test_children_stand_behind_their_parents_and_can_be_taken_along(client: TestClient, settings: Settings) -> None:
    url = "/api/lineage/door"
    parent = Path(str(settings.checkpoints["crossmodal-ekf"]))
    alone = {one["hash"] for one in client.get(url).json()["members"]}
    child = child_of(parent, settings.workspace, "first", 1)
    grandchild = child_of(settings.workspace / "finetune/first/child.safetensors", settings.workspace, "another", 2)
    members = client.get(url).json()["members"]
    by_hash = {one["hash"]: one for one in members}
    assert by_hash.keys() == alone | {child, grandchild}
    line = [by_hash[grandchild]["parent"], by_hash[child]["parent"]]
    assert line == [child, hashlib.sha256(parent.read_bytes()).hexdigest()]
    order = [one["hash"] for one in members]
    assert order.index(line[1]) < order.index(child) < order.index(grandchild)
    assert [by_hash[one]["run"] for one in (line[1], child, grandchild)] == [None, "first", "another"]
    assert [by_hash[one]["shelf"] for one in (line[1], child)] == ["crossmodal-ekf", None]
    assert by_hash[child]["learned"] == ["haptics alone"]
    assert by_hash[child]["after"] == {"haptics alone": {"position_cm": 2.0}}

    answer = client.get(f"{url}/{grandchild}.zip")
    with zipfile.ZipFile(io.BytesIO(answer.content)) as packed:
        files = {Path(name).name: packed.read(name) for name in packed.namelist()}
    hashes = {hashlib.sha256(data).hexdigest() for name, data in files.items() if name.endswith(".safetensors")}
    assert hashes == {*line, grandchild}
    assert len(json.loads(files["lineage.json"])["members"]) == 3
    assert client.get(f"{url}/{'0' * 64}.zip").status_code == 404
    assert client.get("/api/lineage/dor").status_code == 400


def test_a_child_that_was_kept_is_called_as_on_the_shelf(settings: Settings, client: TestClient) -> None:
    child = child_of(Path(str(settings.checkpoints["crossmodal-pf"])), settings.workspace, "only", 3)
    path = settings.workspace / "finetune/only/child.safetensors"
    library: Library = client.app.state.library  # type: ignore[attr-defined]
    keep(library, Child("door", "crossmodal-pf-c0ffee", str(path), default=False))
    shown = {one["hash"]: one["shelf"] for one in client.get("/api/lineage/door").json()["members"]}
    assert shown[child] == "crossmodal-pf-c0ffee"


def test_the_tree_of_modules_tells_what_its_fine_tuning_moved() -> None:
    checkpoint = load_checkpoint(shipped("door", "crossmodal-ekf"))
    names = [name for name, _ in checkpoint.filter.named_parameters() if name.startswith("weight_model")]
    ran = {name: [0.5, 0.1, 2.0] for name in names}
    told = offered(replace(checkpoint, record={**checkpoint.record, "parts": ran}))
    moved = {one["name"]: (one["gradient"], one["change"]) for one in told["modules"] if "gradient" in one}
    assert moved["weight_model"] == pytest.approx((0.5 * len(names) ** 0.5, 0.05))
    assert all(name.startswith("weight_model") for name in moved), "what was frozen tells nothing"


def test_without_any_there_is_nothing_to_tell(settings: Settings, open_client: type[TestClient]) -> None:
    with open_client(replace(settings, checkpoints={})) as client:
        assert client.get("/api/lineage/door").json() == {"members": []}
