"""Checks of the installation, run by ``beliefscope doctor``.

Each check is a function of the ``Place`` where a server would run, and returns a ``Finding``. A check that raises
has failed.
"""

import importlib.metadata
import os
import platform
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from beliefscope import __version__
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.checksums import changed_files, read_sums
from beliefscope.datasets.text import plural

DISK_WARNING, DISK_FAILURE = 2e9, 2e8  # bytes of free disk space
EXTRAS = {
    "ray": "studies on a cluster: pip install 'beliefscope[ray]'",
    "mcap": "export for Foxglove: pip install 'beliefscope[export]'",
    "tensorboardX": "TensorBoard logs: pip install 'beliefscope[tensorboard]'",
}
"""Optional module -> purpose, and how to install it."""

State = Literal["ok", "warning", "failed"]


@dataclass(frozen=True)
class Place:
    """Workspace and address of a server."""

    workspace: Path
    host: str
    port: int


@dataclass(frozen=True)
class Finding:
    """Result of a check, with advice if it is not ok."""

    message: str
    state: State = "ok"
    advice: str = ""


def python(_: Place) -> Finding:
    """Check the Python version and the operating system."""
    message = f"{platform.python_version()} on {platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    required = SpecifierSet(importlib.metadata.metadata("beliefscope")["Requires-Python"])
    if platform.python_version() not in required:
        return Finding(message, "failed", f"install Python {required}")
    if platform.system() != "Linux":
        return Finding(message, "warning", "Beliefscope is tested on Linux only")
    return Finding(message)


def packages(_: Place) -> Finding:
    """Check the versions of all required packages."""
    requirements = [Requirement(line) for line in importlib.metadata.requires("beliefscope") or ()]
    required = [r for r in requirements if r.marker is None or r.marker.evaluate({"extra": ""})]
    problems = []
    for requirement in required:
        version = _version(requirement.name)
        if version is None or not requirement.specifier.contains(version, prereleases=True):
            problems.append(f"{requirement.name} {version or 'is missing'}, required {requirement.specifier}")
    if problems:
        return Finding("; ".join(problems), "failed", "pip install -c constraints.txt -e . or reinstall beliefscope")
    return Finding(f"{len(required)} required packages have supported versions")


def torch(_: Place) -> Finding:
    """Check that PyTorch computes correctly; list its threads and devices."""
    import torch as library

    eye = library.eye(3, dtype=library.float64)
    if not library.equal(library.linalg.cholesky(4 * eye), 2 * eye):
        return Finding(f"PyTorch {library.__version__} computes wrong results", "failed", "reinstall torch")
    names = [library.cuda.get_device_name(i) for i in range(library.cuda.device_count())]
    devices = f"CUDA {library.version.cuda}: {', '.join(names)}" if names else "no CUDA device (not required)"
    return Finding(f"PyTorch {library.__version__}, {plural(library.get_num_threads(), 'thread')}, {devices}")


def camera(_: Place) -> Finding:
    """Check that the simulation runs and renders without a display."""
    from beliefscope.datasets.simulation.door import DOOR

    assert DOOR.simulate is not None
    start = time.perf_counter()
    image = DOOR.simulate(0, 0, 2).observations["image"]
    seconds = time.perf_counter() - start
    if image.std() < 1.0:
        return Finding("images of the simulated camera are empty", "failed", "reinstall mujoco")
    version = importlib.metadata.version("mujoco")
    return Finding(f"MuJoCo {version} simulated and rendered 2 steps in {seconds:.1f} s")


def weights(_: Place) -> Finding:
    """Check the hashes of the pretrained filters and the sample data."""
    from beliefscope.datasets.store import sample_path
    from beliefscope.filters.checkpoint import PRETRAINED

    folders = (PRETRAINED, sample_path("door").parent)
    changed = [name for folder in folders for name in changed_files(folder)]
    if changed:
        return Finding(f"{', '.join(changed)} missing or modified", "failed", "reinstall beliefscope")
    count = sum(len(read_sums(folder)) for folder in folders)
    return Finding(f"{count} files of pretrained filters and sample data have the expected hashes")


def page(_: Place) -> Finding:
    """Check that all files of the dashboard exist, including those of other packages."""
    from beliefscope.app.server.main import PAGE
    from beliefscope.app.server.static_files import page_files
    from beliefscope.app.server.vendor_files import UPLOT_FILES
    from beliefscope.app.views.embedded_viser import client_page
    from beliefscope.recordings.web_viewer import installed

    static = installed("rerun_notebook") / "static"
    files = [
        *(PAGE / name for name in page_files(PAGE) if name not in UPLOT_FILES),
        static / "widget.js",
        static / "re_viewer_bg.wasm",
        *(installed("uplot") / "static" / n for n in UPLOT_FILES),
    ]
    missing = [path.name for path in files if not path.is_file()]
    if missing:
        advice = "reinstall beliefscope, rerun-notebook and uplot-python"
        return Finding(f"{', '.join(missing)} missing", "failed", advice)
    client_page()
    versions = (f"{name} {importlib.metadata.version(name)}" for name in ("rerun-notebook", "viser", "uplot-python"))
    return Finding(f"all files present: {', '.join(versions)}")


def port(place: Place) -> Finding:
    """Check that the address is valid and the port is free."""
    from beliefscope.app.server.main import listen

    busy = "serve with --port 0, or stop the process that uses the port"
    trials: list[tuple[int, State, str]] = [(0, "failed", "choose another --host"), (place.port, "warning", busy)]
    for number, state, advice in trials:
        try:
            listen(place.host, number).close()
        except BadInput as error:
            return Finding(str(error), state, advice)
    return Finding(f"{place.host} port {place.port} is free")


def workspace(place: Place) -> Finding:
    """Check that the workspace is writable by this user only, and the free disk space."""
    folder = place.workspace if place.workspace.is_dir() else place.workspace.absolute().parent
    if not folder.is_dir():
        return Finding(f"{_home(folder)} does not exist", "failed", "create it, or choose another --workspace")
    try:
        with tempfile.TemporaryDirectory(prefix=".doctor-", dir=folder) as temporary:
            path = Path(temporary) / "file"
            path.write_bytes(b"test")
            os.replace(path, path.with_name("renamed"))
    except OSError as error:
        return Finding(f"{_home(folder)}: {error.strerror}", "failed", "choose a writable --workspace")
    free = shutil.disk_usage(folder).free
    message = f"{_home(place.workspace)} is writable, {free / 1e9:.1f} GB free"
    if free < DISK_WARNING:
        return Finding(message, "failed" if free < DISK_FAILURE else "warning", "free disk space, or use another disk")
    if place.workspace.is_dir() and place.workspace.stat().st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return Finding(f"{message}; writable by other users", "warning", f"chmod go-w {_home(place.workspace)}")
    return Finding(message)


def browser(_: Place) -> Finding:
    """Check for a Chromium to print reports."""
    from beliefscope.recordings.report.pdf import browser as find

    try:
        return Finding(find())
    except BadInput:
        advice = "install Chromium for report --pdf and the dashboard's tests, or set BELIEFSCOPE_CHROMIUM to its path"
        return Finding("no Chromium found; not required to view the dashboard", "warning", advice)


def extras(_: Place) -> Finding:
    """List the optional packages."""
    present = [name for name in EXTRAS if find_spec(name) is not None]
    missing = [f"{name} not installed ({purpose})" for name, purpose in EXTRAS.items() if name not in present]
    return Finding("; ".join([*(f"{name} {_version(name)}" for name in present), *missing]))


CHECKS: tuple[Callable[[Place], Finding], ...] = (
    *(python, packages, torch, camera, weights),
    *(page, port, workspace, browser, extras),
)


def run_checks(place: Place) -> dict[str, Finding]:
    """Run every check; returns findings by name."""
    findings = {}
    for check in CHECKS:
        try:
            findings[check.__name__] = check(place)
        except Exception as error:
            message = f"{type(error).__name__}: {error}"
            findings[check.__name__] = Finding(message, "failed", "reinstall beliefscope")
    return findings


def report(findings: Mapping[str, Finding]) -> dict[str, Any]:
    """Findings, system and installed packages for a bug report. Paths are relative to the home folder."""
    installed = {package.metadata["Name"]: package.version for package in importlib.metadata.distributions()}
    return {
        "beliefscope": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cores": os.cpu_count(),
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        "checks": {name: asdict(finding) for name, finding in findings.items()},
        "packages": dict(sorted(installed.items(), key=lambda item: item[0].lower())),
    }


def _version(name: str) -> str | None:
    with suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(name)
    return None


def _home(path: Path) -> str:
    with suppress(ValueError, RuntimeError):
        return f"~/{path.absolute().relative_to(Path.home())}"
    return str(path)
