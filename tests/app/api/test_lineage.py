"""Lineage of checkpoints over HTTP, and export of a checkpoint with its ancestors."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.workspace.saved_filters import SavedFilter
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path, save_checkpoint
from beliefscope.filters.finetuning.choices import choices

pytestmark = pytest.mark.slow

MIX = [{"slice": {"name": "haptics only"}, "share": 1.0}]
ERRORS = {"haptics only": {"rmse": {"position_cm": 2.0}, "nll": 1.0}}


def finetune(base: Path, workspace: Path, run: str, seed: int) -> str:
    """Write the checkpoint of a fine-tuning run without steps; returns its hash."""
    checkpoint = load_checkpoint(base)
    record = {
        "command": "none",
        "seed": seed,
        "base": {"hash": checkpoint.hash, "name": checkpoint.name, "settings": {"train": ["all"], "mix": MIX}},
        "held_out": {"before": ERRORS, "after": ERRORS},
    }
    path = workspace / "finetune" / run / "finetuned.safetensors"
    path.parent.mkdir(parents=True)
    return save_checkpoint(checkpoint.filter, checkpoint.name, record, path)


def test_bases_come_first_and_export_contains_ancestors(client: TestClient, settings: Settings) -> None:
    url = "/api/lineage/door"
    base = Path(str(settings.checkpoints["crossmodal-ekf"]))
    before = {m["hash"] for m in client.get(url).json()["members"]}
    first = finetune(base, settings.workspace, "first", 1)
    second = finetune(settings.workspace / "finetune/first/finetuned.safetensors", settings.workspace, "another", 2)
    members = client.get(url).json()["members"]
    by_hash = {m["hash"]: m for m in members}
    assert by_hash.keys() == before | {first, second}
    line = [by_hash[second]["base"], by_hash[first]["base"]]
    assert line == [first, hashlib.sha256(base.read_bytes()).hexdigest()]
    order = [m["hash"] for m in members]
    assert order.index(line[1]) < order.index(first) < order.index(second)
    assert [by_hash[hash_]["run"] for hash_ in (line[1], first, second)] == [None, "first", "another"]
    assert [by_hash[hash_]["catalog_name"] for hash_ in (line[1], first)] == ["crossmodal-ekf", None]
    assert by_hash[first]["learned"] == ["haptics only"]
    assert by_hash[first]["after"] == {"haptics only": {"position_cm": 2.0}}

    answer = client.get(f"{url}/{second}.zip")
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        files = {Path(name).name: archive.read(name) for name in archive.namelist()}
    hashes = {hashlib.sha256(data).hexdigest() for name, data in files.items() if name.endswith(".safetensors")}
    assert hashes == {*line, second}
    assert len(json.loads(files["lineage.json"])["members"]) == 3
    assert client.get(f"{url}/{'0' * 64}.zip").status_code == 404
    assert client.get(f"/api/lineage/push/{second}.zip").status_code == 404, "a checkpoint of another task"
    assert client.get("/api/lineage/dor").status_code == 400


def test_saved_filter_has_its_catalog_name(settings: Settings, client: TestClient) -> None:
    hash_ = finetune(Path(str(settings.checkpoints["crossmodal-pf"])), settings.workspace, "only", 3)
    path = settings.workspace / "finetune/only/finetuned.safetensors"
    store: TraceStore = client.app.state.store  # type: ignore[attr-defined]
    store.saved.save(SavedFilter("door", "crossmodal-pf-c0ffee", str(path), default=False))
    names = {m["hash"]: m["catalog_name"] for m in client.get("/api/lineage/door").json()["members"]}
    assert names[hash_] == "crossmodal-pf-c0ffee"


def test_module_tree_shows_changes_of_fine_tuning() -> None:
    checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
    names = [name for name, _ in checkpoint.filter.named_parameters() if name.startswith("weight_model")]
    changes = {name: [0.5, 0.1, 2.0] for name in names}
    options = choices(replace(checkpoint, record={**checkpoint.record, "parts": changes}))
    changed = {m.name: (m.gradient, m.change) for m in options.modules if m.gradient is not None}
    assert changed["weight_model"] == pytest.approx((0.5 * len(names) ** 0.5, 0.05))
    assert all(name.startswith("weight_model") for name in changed), "frozen modules have no change"


def test_lineage_without_checkpoints_is_empty(settings: Settings, open_client: type[TestClient]) -> None:
    with open_client(replace(settings, checkpoints={})) as client:
        assert client.get("/api/lineage/door").json() == {"members": []}
