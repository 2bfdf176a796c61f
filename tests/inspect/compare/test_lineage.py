"""Lineage: trees from headers, export, and the commands ``lineage`` and ``change``."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path, save_checkpoint
from beliefscope.inspect.compare.lineage import export, lineage_of

pytestmark = pytest.mark.slow

Run = Callable[[str], tuple[int, str, str]]
ROOT = pretrained_path("door", "crossmodal-ekf")


def finetune(base_path: Path, path: Path, nudge: float, **record: object) -> str:
    """Save a checkpoint with modified dynamics as fine-tuned from another; returns its hash."""
    base = load_checkpoint(base_path)
    with torch.no_grad():
        base.filter.get_parameter("dynamics.log_noise").add_(nudge)
    settings = {"train": ["dynamics.log_noise"]}
    return save_checkpoint(base.filter, base.name, {"base": {"hash": base.hash, "settings": settings}, **record}, path)


@pytest.fixture
def family(tmp_path: Path) -> Path:
    """Fine-tuned checkpoints in two generations, and one whose base is missing."""
    folder = tmp_path / "runs"
    (folder / "deep").mkdir(parents=True)
    metrics = {"0": {"fused": {"rmse": {"position_cm": 0.5, "angle_deg": 1.25}}}}
    finetune(ROOT, folder / "finetuned.safetensors", 0.1, command="beliefscope finetune door", metrics=metrics)
    finetune(folder / "finetuned.safetensors", folder / "deep" / "first.safetensors", 0.1)
    finetune(folder / "finetuned.safetensors", folder / "deep" / "second.safetensors", 0.2)
    finetune(folder / "deep" / "second.safetensors", folder / "lost.safetensors", 0.1)
    finetune(folder / "lost.safetensors", folder / "orphan.safetensors", 0.1)
    (folder / "lost.safetensors").unlink()
    (folder / "cut.safetensors").write_bytes(ROOT.read_bytes()[:1000])
    return folder


def test_tree_matches_the_headers(family: Path) -> None:
    lineage = lineage_of([family])
    names = {hash: member.path.name for hash, member in lineage.members.items()}
    assert sorted(names.values()) == sorted(
        [ROOT.name, "finetuned.safetensors", "first.safetensors", "second.safetensors", "orphan.safetensors"]
    )
    assert [member.path.name for member in lineage.roots] == [ROOT.name, "orphan.safetensors"]
    finetuned = lineage.find("finetuned.safetensors")
    assert {member.path.name for member in lineage.finetuned(finetuned.hash)} == {
        "first.safetensors",
        "second.safetensors",
    }
    second = lineage.find("second.safetensors")
    assert [member.path.name for member in lineage.line(second.hash)] == [
        ROOT.name,
        "finetuned.safetensors",
        "second.safetensors",
    ]
    assert finetuned.rmse == {"position_cm": 0.5, "angle_deg": 1.25}
    order = list(lineage.members)
    assert all(
        order.index(str(member.base)) < order.index(hash)
        for hash, member in lineage.members.items()
        if member.base in order
    )
    assert len(lineage.left_out) == 1
    assert "cut.safetensors" in lineage.left_out[0]


@pytest.mark.long
def test_commands_have_the_paths_of_the_base_checkpoints(family: Path) -> None:
    """In any folder, such as an exported one with other names of the files."""
    base = family / "finetuned.safetensors"
    command = "beliefscope finetune finetuned.safetensors --slice 'blackout 0.8' --data door.h5"
    digest = finetune(base, family / "deep" / "third.safetensors", 0.3, command=command)
    assert f"  {command.replace('finetuned.safetensors', str(base))}\n" in f"{lineage_of([family])}\n"
    folder = family.parent / "shared"
    export(lineage_of([family]), digest, folder, "0")
    (exported,) = (line for line in str(lineage_of([folder])).splitlines() if "--slice" in line)
    assert Path(exported.split()[2]).is_file()
    broken = finetune(base, family / "broken.safetensors", 0.4, command="from 'a.safetensors")
    assert lineage_of([family]).members[broken].command in str(lineage_of([family]))


def test_find_by_file_or_hash(family: Path) -> None:
    lineage = lineage_of([family])
    finetuned = lineage.find("finetuned.safetensors")
    assert lineage.find(finetuned.hash[:8]) == lineage.find(str(finetuned.path)) == finetuned
    with pytest.raises(BadInput, match=r"Available: .*finetuned\.safetensors"):
        lineage.find("nothing")
    with pytest.raises(BadInput, match="no checkpoint in"):
        lineage_of([family / "cut.safetensors"])
    with pytest.raises(BadInput, match="does not exist"):
        lineage_of([family / "nowhere"])


def test_export_is_complete(family: Path, tmp_path: Path) -> None:
    lineage = lineage_of([family])
    member = lineage.find("second.safetensors")
    files = export(lineage, member.hash, tmp_path / "copy", "1.2.3")
    manifest = json.loads((tmp_path / "copy" / "lineage.json").read_text())
    assert len(manifest["members"]) == 3
    assert {p.name for p in files} == {m["file"] for m in manifest["members"]} | {"README.md", "lineage.json"}
    for entry in manifest["members"]:
        path = tmp_path / "copy" / entry["file"]
        assert hashlib.sha256(path.read_bytes()).hexdigest() == entry["hash"] == load_checkpoint(path).hash
    readme = (tmp_path / "copy" / "README.md").read_text()
    assert manifest["checkpoint"] in readme
    assert "with its 2 ancestors" in readme
    again = lineage_of([tmp_path / "copy"], pretrained=tmp_path)
    assert set(again.members) == {m["hash"] for m in manifest["members"]}
    with pytest.raises(BadInput, match="exists; give the name of a new folder"):
        export(lineage, member.hash, tmp_path / "copy", "1.2.3")


def test_modified_file_is_not_exported(family: Path, tmp_path: Path) -> None:
    lineage = lineage_of([family])
    member = lineage.find("first.safetensors")
    member.path.write_bytes(b"other")
    with pytest.raises(BadInput, match="has changed"):
        export(lineage, member.hash, tmp_path / "copy", "1.2.3")
    assert not [path for path in tmp_path.iterdir() if "copy" in path.name]


def test_lineage_command(run: Run, family: Path, tmp_path: Path) -> None:
    code, out, err = run(f"lineage {family}")
    assert code == 0
    assert "cut.safetensors" in err
    lines = out.splitlines()
    assert "door crossmodal-ekf" in lines[0]
    # Each generation is indented below its base.
    assert not lines[0].startswith(" ")
    assert any(line.startswith(f"    {family / 'finetuned.safetensors'} ") for line in lines)
    assert any(line.startswith(f"        {family / 'deep' / 'first.safetensors'} ") for line in lines)
    assert "RMSE position cm 0.5, angle deg 1.25" in out
    assert "which is not in these folders" in out
    code, out, _ = run(f"lineage {family} --json -")
    document = json.loads(out)
    assert (code, len(document["members"]), len(document["roots"])) == (0, 5, 2)
    code, out, _ = run(f"lineage {family} --export first.safetensors -o {tmp_path / 'out'}")
    assert code == 0
    assert "README.md" in out
    assert run(f"lineage {family} --export first.safetensors")[0] == 2


@pytest.mark.long
def test_change_command(run: Run, family: Path, tmp_path: Path) -> None:
    finetuned = family / "finetuned.safetensors"
    report, data = tmp_path / "report", tmp_path / "small.h5"
    with open_dataset(sample_path("door")) as episodes:
        write_dataset(data, DOOR, [episodes[index] for index in episodes.held_out()[:5]])
    code, out, err = run(
        f"change crossmodal-ekf {finetuned} --slice late:faults=delay=image:steps=5 --data {data} -o {report} --json -"
    )
    assert code == 0, err
    document = json.loads(out)
    assert document["finetuned"]
    assert set(document["frozen"]) >= {"virtual_sensors", "weight_model", "statistics"}
    assert "late" in {d["slice"] for d in document["differences"]}
    assert all(m["link"].startswith("?task=door&filter=finetuned&data=small") for m in document["events"])
    assert json.loads((report / "change.json").read_text()) == document
    assert document["verdict"] in (report / "change.md").read_text()
    assert (report / "change.svg").read_text().startswith("<?xml")
    assert (report / "change.pdf").read_bytes().startswith(b"%PDF")
    for line in (
        "change crossmodal-ekf crossmodal-pf",
        f"change crossmodal-ekf {finetuned} -o {report}",
        f"change crossmodal-ekf {finetuned} --slice nosuch",
        f"change {finetuned} missing.safetensors",
    ):
        assert run(line)[0] == 2


def test_record_of_an_earlier_version(tmp_path: Path) -> None:
    checkpoint = load_checkpoint(ROOT)
    path = tmp_path / "old.safetensors"
    save_checkpoint(checkpoint.filter, "old", {"parent": {"hash": checkpoint.hash, "settings": {}}}, path)
    lineage = lineage_of([path])
    assert lineage.find("old.safetensors").base == checkpoint.hash
