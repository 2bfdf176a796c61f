"""What all tests share."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from beliefscope.app.cli.main import main
from beliefscope.datasets.store import sample_path
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import save_checkpoint

Run = Callable[[str], tuple[int, str, str]]

ROOT = Path(__file__).resolve().parents[1]
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="session")
def chromium() -> str:
    """Path of a Chromium: ``BELIEFSCOPE_CHROMIUM``, or one on the path. Skips the test where there is none."""
    named = os.environ.get("BELIEFSCOPE_CHROMIUM")
    found = named or next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.skip("no Chromium: install it, or give its path in BELIEFSCOPE_CHROMIUM")
    return found


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The browser's files first: they are the longest, and for one that came last the other processes would wait."""
    items.sort(key=lambda item: "browser" not in item.path.parts)


@pytest.fixture(scope="session", autouse=True)
def one_torch_thread() -> Iterator[None]:
    """Tensors are small here: more threads only wait for one another."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a command line in this process: (exit code, standard output, standard error)."""

    def run(line: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["beliefscope", *shlex.split(line)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            main()
        code = end.value.code or 0
        assert isinstance(code, int)
        return code, *capsys.readouterr()

    return run


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with files that can be used and files that cannot."""
    place = tmp_path_factory.mktemp("files")
    sample = sample_path("door").read_bytes()
    (place / "cut.h5").write_bytes(sample[: len(sample) // 2])
    (place / "foreign.h5").write_text("no HDF5 at all\n")
    with h5py.File(place / "other.h5", "w") as file:
        file["numbers"] = np.arange(3)
    (place / "shape.h5").write_bytes(sample)
    with h5py.File(place / "shape.h5", "r+") as file:
        group = file["trajectory9"]
        states = group["states"][()]
        del group["states"]
        group["states"] = states[:, :2]
    untrained = build(architecture("door", "crossmodal-ekf"))
    save_checkpoint(untrained, "crossmodal-ekf", {}, place / "ekf.safetensors")
    (place / "cut.safetensors").write_bytes((place / "ekf.safetensors").read_bytes()[:-1000])
    (place / "foreign.safetensors").write_bytes(b"\x80\x04" + bytes(100))
    save_file({"weight": torch.zeros(2)}, place / "other.safetensors")
    (place / "notes.txt").write_text("{not json")
    (place / "taken").mkdir()
    return place


@pytest.fixture
def folder(files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory: a copy of ``files``."""
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path
