"""``doctor`` reports the state of the installation."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from beliefscope.app.cli import checks
from beliefscope.app.cli.checks import CHECKS, Finding, Place, report, run_checks
from beliefscope.app.server import main
from beliefscope.datasets.io.checksums import changed_files, read_sums
from beliefscope.datasets.store import sample_path
from beliefscope.datasets.text import plural
from beliefscope.filters.checkpoint import PRETRAINED

pytestmark = pytest.mark.slow

Run = Callable[[str], tuple[int, str, str]]


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return Place(tmp_path / "workspace", "127.0.0.1", 0)


def test_no_check_fails(run: Run, tmp_path: Path) -> None:
    code, out, err = run(f"doctor --workspace {tmp_path / 'w'} --port 0 --json -")
    document = json.loads(out)
    failed = {n: finding["message"] for n, finding in document["checks"].items() if finding["state"] == "failed"}
    assert (code, failed, err) == (0, {}, "")
    assert list(document["checks"]) == [check.__name__ for check in CHECKS]
    assert document["packages"]["torch"]
    assert f", {plural(torch.get_num_threads(), 'thread')}, " in document["checks"]["torch"]["message"]
    assert not list(tmp_path.iterdir()), "temporary files remain"


def test_failure_exits_with_1_and_advice(run: Run, tmp_path: Path) -> None:
    code, out, _ = run(f"doctor --workspace {tmp_path / 'missing' / 'deep'} --port 0")
    assert code == 1
    assert re.search(r"^failed  workspace  .* does not exist\n +-> create it", out, re.MULTILINE)
    assert "1 of 10 checks failed" in out


def test_busy_port_is_a_warning(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        finding = checks.port(Place(tmp_path, "127.0.0.1", listener.getsockname()[1]))
    assert finding.state == "warning"
    assert "--port 0" in finding.advice
    assert checks.port(Place(tmp_path, "192.0.2.1", 0)).state == "failed", "address reserved for documentation"


def test_workspace_writable_by_others_is_a_warning(place: Place) -> None:
    place.workspace.mkdir(mode=0o700)
    assert checks.workspace(place).state == "ok"
    place.workspace.chmod(0o777)
    finding = checks.workspace(place)
    assert (finding.state, finding.advice.split()[0]) == ("warning", "chmod")


def test_full_disk_fails(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    for free, state in ((1e8, "failed"), (1e9, "warning"), (1e10, "ok")):
        usage = shutil._ntuple_diskusage(int(1e11), 0, int(free))  # type: ignore[attr-defined]
        monkeypatch.setattr(shutil, "disk_usage", lambda _, usage=usage: usage)
        assert checks.workspace(place).state == state


@pytest.mark.skipif(os.geteuid() == 0, reason="root can write everywhere")
def test_unwritable_workspace_fails(place: Place) -> None:
    place.workspace.mkdir(mode=0o500)
    assert checks.workspace(place).state == "failed"


@pytest.mark.parametrize("folder", [PRETRAINED, sample_path("door").parent], ids=["weights", "samples"])
def test_built_in_files_are_listed_with_their_hashes(folder: Path) -> None:
    files = {path.name for path in folder.iterdir() if path.suffix in (".safetensors", ".h5")}
    assert files == read_sums(folder).keys()
    assert changed_files(folder) == [], f"update the list: sha256sum * > {checks.SUMS}"


def test_modified_weights_are_listed(tmp_path: Path, place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(PRETRAINED, tmp_path / "pretrained")
    weight = tmp_path / "pretrained" / "door-crossmodal-ekf.safetensors"
    weight.write_bytes(weight.read_bytes()[:-1] + b"\0")
    (tmp_path / "pretrained" / "door-image-ekf.safetensors").unlink()
    monkeypatch.setattr("beliefscope.filters.checkpoint.PRETRAINED", tmp_path / "pretrained")
    finding = checks.weights(place)
    assert finding.state == "failed"
    assert "door-crossmodal-ekf.safetensors, door-image-ekf.safetensors missing or modified" in finding.message


@pytest.mark.parametrize("missing", ["maps/map_panel.js", "styles/maps.css", "index.html"])
def test_missing_page_file_fails(missing: str, tmp_path: Path, place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """For example, a wheel without package data: the server would start, but serve nothing."""
    shutil.copytree(main.PAGE, tmp_path / "page")
    monkeypatch.setattr(main, "PAGE", tmp_path / "page")
    monkeypatch.setattr(checks, "CHECKS", (checks.page,))
    assert run_checks(place)["page"].state == "ok"
    (tmp_path / "page" / missing).unlink()
    finding = run_checks(place)["page"]
    assert finding.state == "failed"
    assert Path(missing).name in finding.message


def test_unsupported_package_versions_are_listed(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    required = ["numpy>=2.0", "h5py>=99", "nothing-of-this-name>=1", 'ray>=99; extra == "ray"']
    monkeypatch.setattr(checks.importlib.metadata, "requires", lambda _: required)  # type: ignore[attr-defined]
    finding = checks.packages(place)
    assert finding.state == "failed"
    assert "h5py" in finding.message
    assert "nothing-of-this-name is missing" in finding.message
    assert "numpy" not in finding.message
    assert "ray" not in finding.message


def test_exception_in_a_check_is_a_failure(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: Place) -> Finding:
        raise ImportError("libGL.so.1: cannot open shared object file")

    monkeypatch.setattr(checks, "CHECKS", (fail, checks.python))
    findings = run_checks(place)
    assert findings["fail"].state == "failed"
    assert "libGL" in findings["fail"].message
    assert findings["python"].state == "ok"


def test_report_contains_no_user_names(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    findings = {"workspace": checks.workspace(Place(tmp_path / "runs", "127.0.0.1", 0))}
    assert str(tmp_path) not in json.dumps(report(findings))
    assert "~/runs" in json.dumps(report(findings))
