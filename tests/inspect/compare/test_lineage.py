"""Lineage: trees from headers, and a copy that another machine can use; the two commands on it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import load_checkpoint, save_checkpoint, shipped
from beliefscope.inspect.compare.lineage import export, lineage_of

Run = Callable[[str], tuple[int, str, str]]
ROOT = shipped("door", "crossmodal-ekf")


def born(parent: Path, path: Path, nudge: float, **record: object) -> str:
    """A child of a checkpoint, its dynamics a little off; its hash."""
    of = load_checkpoint(parent)
    with torch.no_grad():
        of.filter.get_parameter("dynamics.log_noise").add_(nudge)
    settings = {"train": ["dynamics.log_noise"]}
    return save_checkpoint(of.filter, of.name, {"parent": {"hash": of.hash, "settings": settings}, **record}, path)


@pytest.fixture
def family(tmp_path: Path) -> Path:
    """A child of what ships, its two children, and one whose parent is lost."""
    place = tmp_path / "runs"
    (place / "deep").mkdir(parents=True)
    metrics = {"0": {"fused": {"rmse": {"position_cm": 0.5, "angle_deg": 1.25}}}}
    born(ROOT, place / "z-child.safetensors", 0.1, command="beliefscope finetune door", metrics=metrics)
    born(place / "z-child.safetensors", place / "deep" / "first.safetensors", 0.1)
    born(place / "z-child.safetensors", place / "deep" / "second.safetensors", 0.2)
    born(place / "deep" / "second.safetensors", place / "lost.safetensors", 0.1)
    born(place / "lost.safetensors", place / "orphan.safetensors", 0.1)
    (place / "lost.safetensors").unlink()
    (place / "cut.safetensors").write_bytes(ROOT.read_bytes()[:1000])
    return place


def test_the_tree_is_what_the_headers_say(family: Path) -> None:
    found = lineage_of([family])
    names = {hash: one.path.name for hash, one in found.members.items()}
    assert sorted(names.values()) == sorted(
        [ROOT.name, "z-child.safetensors", "first.safetensors", "second.safetensors", "orphan.safetensors"]
    )
    assert [one.path.name for one in found.roots] == [ROOT.name, "orphan.safetensors"]
    child = found.find("z-child.safetensors")
    assert {one.path.name for one in found.children(child.hash)} == {"first.safetensors", "second.safetensors"}
    second = found.find("second.safetensors")
    assert [one.path.name for one in found.line(second.hash)] == [
        ROOT.name,
        "z-child.safetensors",
        "second.safetensors",
    ]
    assert child.rmse == {"position_cm": 0.5, "angle_deg": 1.25}
    order = list(found.members)
    assert all(
        order.index(str(one.parent)) < order.index(hash) for hash, one in found.members.items() if one.parent in order
    )
    assert len(found.left_out) == 1
    assert "cut.safetensors" in found.left_out[0]


def test_a_checkpoint_is_named_by_file_or_hash(family: Path) -> None:
    found = lineage_of([family])
    child = found.find("z-child.safetensors")
    assert found.find(child.hash[:8]) == found.find(str(child.path)) == child
    with pytest.raises(BadInput, match=r"Available: .*z-child\.safetensors"):
        found.find("nothing")
    with pytest.raises(BadInput, match="no checkpoint is in"):
        lineage_of([family / "cut.safetensors"])
    with pytest.raises(BadInput, match="does not exist"):
        lineage_of([family / "nowhere"])


def test_an_export_is_whole_and_loads(family: Path, tmp_path: Path) -> None:
    found = lineage_of([family])
    one = found.find("second.safetensors")
    files = export(found, one.hash, tmp_path / "copy", "1.2.3")
    manifest = json.loads((tmp_path / "copy" / "lineage.json").read_text())
    assert len(manifest["members"]) == 3
    assert {p.name for p in files} == {m["file"] for m in manifest["members"]} | {"README.md", "lineage.json"}
    for member in manifest["members"]:
        path = tmp_path / "copy" / member["file"]
        assert hashlib.sha256(path.read_bytes()).hexdigest() == member["hash"] == load_checkpoint(path).hash
    readme = (tmp_path / "copy" / "README.md").read_text()
    assert manifest["checkpoint"] in readme
    assert "the 2 checkpoints that it was made from" in readme
    again = lineage_of([tmp_path / "copy"], shipped=tmp_path)
    assert set(again.members) == {m["hash"] for m in manifest["members"]}
    with pytest.raises(BadInput, match="is there already"):
        export(found, one.hash, tmp_path / "copy", "1.2.3")


def test_a_file_that_changed_meanwhile_is_not_handed_on(family: Path, tmp_path: Path) -> None:
    found = lineage_of([family])
    one = found.find("first.safetensors")
    one.path.write_bytes(b"other")
    with pytest.raises(BadInput, match="has changed"):
        export(found, one.hash, tmp_path / "copy", "1.2.3")
    assert not [path for path in tmp_path.iterdir() if "copy" in path.name]


def test_the_command_draws_the_tree_and_exports(run: Run, family: Path, tmp_path: Path) -> None:
    code, out, err = run(f"lineage {family}")
    assert code == 0
    assert "left out" in err
    lines = out.splitlines()
    assert "door crossmodal-ekf" in lines[0]
    assert next(line for line in lines if "z-child" in line).startswith("└── ")
    assert "RMSE position cm 0.5, angle deg 1.25" in out
    assert "which is not here" in out
    code, out, _ = run(f"lineage {family} --json -")
    document = json.loads(out)
    assert (code, len(document["members"]), len(document["roots"])) == (0, 5, 2)
    code, out, _ = run(f"lineage {family} --export first.safetensors -o {tmp_path / 'out'}")
    assert code == 0
    assert "README.md" in out
    assert run(f"lineage {family} --export first.safetensors")[0] == 2


def test_the_change_command_reports_and_links(run: Run, family: Path, tmp_path: Path) -> None:
    child = family / "z-child.safetensors"
    report = tmp_path / "report"
    code, out, err = run(f"change crossmodal-ekf {child} --slice late:faults=delay=image:steps=5 -o {report} --json -")
    assert code == 0, err
    document = json.loads(out)
    assert document["child"]
    assert set(document["frozen"]) >= {"virtual_sensors", "weight_model", "statistics"}
    assert "late" in {d["slice"] for d in document["differences"]}
    assert all(m["link"].startswith("?task=door&filter=z-child&data=sample") for m in document["moments"])
    assert json.loads((report / "change.json").read_text()) == document
    assert document["verdict"] in (report / "change.md").read_text()
    assert (report / "change.svg").read_text().startswith("<?xml")
    for line in (
        "change crossmodal-ekf crossmodal-pf",
        f"change crossmodal-ekf {child} -o {report}",
        f"change crossmodal-ekf {child} --slice nosuch",
        f"change {child} missing.safetensors",
    ):
        assert run(line)[0] == 2
