"""Fixtures of all tests. Heavy packages are imported by the fixtures that need them."""

from __future__ import annotations

import gc
import os
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from beliefscope.datasets.episode import Episode

Run = Callable[..., tuple[int, str, str]]

# One thread of PyTorch and NumPy, also in started processes: threads of parallel tests wait for each other's cores.
os.environ["OMP_NUM_THREADS"] = "1"

gc.disable()  # until all tests are collected, which creates many objects and frees few

ROOT = Path(__file__).resolve().parents[1]
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="session")
def chromium() -> str:
    """Path of Chromium: ``BELIEFSCOPE_CHROMIUM`` or from ``PATH``. Tests are skipped without one."""
    path = os.environ.get("BELIEFSCOPE_CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip("Chromium not found: install it or set BELIEFSCOPE_CHROMIUM to its path")
    return path


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Gives all browser tests to one process, where they share a server and a browser, and other tests by file."""
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return "browser" if nodeid.startswith("tests/browser/") else super()._split_scope(nodeid)

    return Scheduling(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks tests, and orders the files: browser, slow, others. Parallel processes then finish together.

    Browser tests are marked as such, and variants of a test beyond the number in its marker ``first`` as ``long``.
    """
    variants: Counter[str] = Counter()
    for item in items:
        if item.path.parent.name == "browser":
            item.add_marker("browser")
        first = item.get_closest_marker("first")
        if first is not None and item.get_closest_marker("long") is None:
            function = item.nodeid.partition("[")[0]
            variants[function] += 1
            if variants[function] > first.args[0]:
                item.add_marker("long")
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: 0 if item.get_closest_marker("browser") else 1 if item.path in slow else 2)


def pytest_collection_finish() -> None:
    """Excludes the imported modules and the collected tests from garbage collections: 7 % of the CPU time."""
    gc.freeze()
    gc.enable()


def pytest_sessionfinish() -> None:
    if "duckdb" in sys.modules:
        gc.unfreeze()  # at exit, DuckDB reports objects that are never freed


@pytest.fixture(autouse=True)
def no_processes(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """In ``make test-fast``, fails a test that starts a process: such tests are marked slow."""
    if "not slow" not in request.config.getoption("-m"):
        return

    import mujoco  # noqa: F401  (starts a process when it is imported first)

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("this test starts a process: mark it slow")

    monkeypatch.setattr(subprocess.Popen, "__init__", refuse)
    monkeypatch.setattr(BaseProcess, "start", refuse)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a command line in this process, with further arguments. Returns exit code, standard output and error."""
    from beliefscope.app.cli.main import main

    def run(line: str, *arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["beliefscope", *shlex.split(line), *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            main()
        code = end.value.code or 0
        assert isinstance(code, int)
        return code, *capsys.readouterr()

    return run


@pytest.fixture(scope="session")
def short_episodes() -> Callable[[str, Sequence[int], int], list[Episode]]:
    """(task, indices, steps) -> the first steps of these episodes of the sample data set."""
    from dataclasses import replace

    from beliefscope.datasets.store import open_dataset, sample_path

    def shorten(episode: Episode, steps: int) -> Episode:
        arrays = {key: getattr(episode, key)[:steps] for key in ("states", "controls", "contact", "qpos")}
        observations = {key: value[:steps] for key, value in episode.observations.items()}
        return replace(episode, **arrays, observations=observations)

    def short_episodes(task: str, indices: Sequence[int], steps: int) -> list[Episode]:
        with open_dataset(sample_path(task)) as dataset:
            return [shorten(dataset[index], steps) for index in indices]

    return short_episodes


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with valid and invalid files."""
    import h5py
    import numpy as np
    import torch
    from safetensors.torch import save_file

    from beliefscope.datasets.store import sample_path
    from beliefscope.filters.catalog import architecture, build
    from beliefscope.filters.checkpoint import save_checkpoint

    folder = tmp_path_factory.mktemp("files")
    sample = sample_path("door").read_bytes()
    (folder / "cut.h5").write_bytes(sample[: len(sample) // 2])
    (folder / "foreign.h5").write_text("no HDF5 at all\n")
    with h5py.File(folder / "other.h5", "w") as file:
        file["numbers"] = np.arange(3)
    (folder / "shape.h5").write_bytes(sample)
    with h5py.File(folder / "shape.h5", "r+") as file:
        group = file["trajectory9"]
        states = group["states"][()]
        del group["states"]
        group["states"] = states[:, :2]
    untrained = build(architecture("door", "crossmodal-ekf"))
    save_checkpoint(untrained, "crossmodal-ekf", {}, folder / "ekf.safetensors")
    (folder / "cut.safetensors").write_bytes((folder / "ekf.safetensors").read_bytes()[:-1000])
    (folder / "foreign.safetensors").write_bytes(b"\x80\x04" + bytes(100))
    save_file({"weight": torch.zeros(2)}, folder / "other.safetensors")
    (folder / "notes.txt").write_text("{not json")
    (folder / "taken").mkdir()
    return folder


@pytest.fixture
def folder(files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory: a copy of ``files``."""
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path
