"""``doctor``: what it says is so, and what is broken is found."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from beliefscope.app.cli import checks as doctor
from beliefscope.app.cli.checks import CHECKS, Finding, Place, changed, examined, report, sums
from beliefscope.app.server import main
from beliefscope.datasets.store import sample_path
from beliefscope.filters.checkpoint import PRETRAINED

Run = Callable[[str], tuple[int, str, str]]


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return Place(tmp_path / "workspace", "127.0.0.1", 0)


def test_here_all_is_well(run: Run, tmp_path: Path) -> None:
    code, out, err = run(f"doctor --workspace {tmp_path / 'w'} --port 0 --json -")
    found = json.loads(out)
    failed = {name: one["says"] for name, one in found["checks"].items() if one["state"] == "failed"}
    assert (code, failed, err) == (0, {}, "")
    assert list(found["checks"]) == [check.__name__ for check in CHECKS]
    assert found["packages"]["torch"]
    assert not list(tmp_path.iterdir()), "nothing stays behind"


def test_a_failure_is_code_1_with_what_helps(run: Run, tmp_path: Path) -> None:
    code, out, _ = run(f"doctor --workspace {tmp_path / 'missing' / 'deep'} --port 0")
    assert code == 1
    assert re.search(r"^failed  workspace  .* does not exist\n +-> make it", out, re.MULTILINE)
    assert "1 of 10 failed" in out


def test_a_busy_port_is_a_warning(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        found = doctor.port(Place(tmp_path, "127.0.0.1", taken.getsockname()[1]))
    assert found.state == "warning"
    assert "--port 0" in found.do
    assert doctor.port(Place(tmp_path, "192.0.2.1", 0)).state == "failed", "an address of documentation, of no machine"


def test_a_workspace_for_everyone_is_a_warning(place: Place) -> None:
    place.workspace.mkdir(mode=0o700)
    assert doctor.workspace(place).state == "ok"
    place.workspace.chmod(0o777)
    found = doctor.workspace(place)
    assert (found.state, found.do.split()[0]) == ("warning", "chmod")


def test_a_full_disk_fails(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    for free, state in ((1e8, "failed"), (1e9, "warning"), (1e10, "ok")):
        usage = shutil._ntuple_diskusage(int(1e11), 0, int(free))  # type: ignore[attr-defined]
        monkeypatch.setattr(shutil, "disk_usage", lambda _, usage=usage: usage)
        assert doctor.workspace(place).state == state


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_workspace_that_cannot_be_written_to_fails(place: Place) -> None:
    place.workspace.mkdir(mode=0o500)
    assert doctor.workspace(place).state == "failed"


@pytest.mark.parametrize("folder", [PRETRAINED, sample_path("door").parent], ids=["weights", "samples"])
def test_what_ships_is_listed_with_its_hash(folder: Path) -> None:
    shipped = {path.name for path in folder.iterdir() if path.suffix in (".safetensors", ".h5")}
    assert shipped == sums(folder).keys()
    assert changed(folder) == [], f"renew the list: sha256sum * > {doctor.SUMS}"


def test_a_damaged_weight_is_named(tmp_path: Path, place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(PRETRAINED, tmp_path / "pretrained")
    weight = tmp_path / "pretrained" / "door-crossmodal-ekf.safetensors"
    weight.write_bytes(weight.read_bytes()[:-1] + b"\0")
    (tmp_path / "pretrained" / "door-image-ekf.safetensors").unlink()
    monkeypatch.setattr("beliefscope.filters.checkpoint.PRETRAINED", tmp_path / "pretrained")
    found = doctor.weights(place)
    assert found.state == "failed"
    assert "door-crossmodal-ekf.safetensors, door-image-ekf.safetensors not as shipped" in found.says


@pytest.mark.parametrize("gone", ["maps/map_panel.js", "styles/maps.css", "index.html"])
def test_a_page_that_lacks_a_file_is_seen(
    gone: str, tmp_path: Path, place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a wheel whose page was left out: the server starts, and has nothing to show."""
    shutil.copytree(main.PAGE, tmp_path / "page")
    monkeypatch.setattr(main, "PAGE", tmp_path / "page")
    monkeypatch.setattr(doctor, "CHECKS", (doctor.page,))
    assert examined(place)["page"].state == "ok"
    (tmp_path / "page" / gone).unlink()
    found = examined(place)["page"]
    assert found.state == "failed"
    assert Path(gone).name in found.says


def test_a_package_of_another_version_is_named(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = ["numpy>=2.0", "h5py>=99", "nothing-of-this-name>=1", 'ray>=99; extra == "ray"']
    monkeypatch.setattr(doctor.importlib.metadata, "requires", lambda _: wanted)  # type: ignore[attr-defined]
    found = doctor.packages(place)
    assert found.state == "failed"
    assert "h5py" in found.says
    assert "nothing-of-this-name is missing" in found.says
    assert "numpy" not in found.says
    assert "ray" not in found.says


def test_a_check_that_raises_has_failed(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: Place) -> Finding:
        raise ImportError("libGL.so.1: cannot open shared object file")

    monkeypatch.setattr(doctor, "CHECKS", (broken, doctor.python))
    found = examined(place)
    assert found["broken"].state == "failed"
    assert "libGL" in found["broken"].says
    assert found["python"].state == "ok"


def test_a_report_names_no_user(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    found = {"workspace": doctor.workspace(Place(tmp_path / "runs", "127.0.0.1", 0))}
    assert str(tmp_path) not in json.dumps(report(found))
    assert "~/runs" in json.dumps(report(found))
