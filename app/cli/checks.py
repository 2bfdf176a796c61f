"""Whether this installation can do what it should: each part is tried, not only looked for.

A check is a function of the ``Place`` where a server would run, that says what it found. One that raises has failed.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import shutil
import socket
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

SUMS = "SHA256SUMS"  # as sha256sum writes it
ENOUGH, LITTLE = 2e9, 2e8  # bytes of free disk: below the first a warning, below the second nothing can be written
EXTRAS = {
    "ray": "a study on a cluster: pip install 'beliefscope[ray]'",
    "mcap": "export for Foxglove: pip install 'beliefscope[export]'",
}
"""Module that may be missing -> what it is for, and how to have it."""

State = Literal["ok", "warning", "failed"]


@dataclass(frozen=True)
class Place:
    """Where a server would keep things and listen."""

    workspace: Path
    host: str
    port: int


@dataclass(frozen=True)
class Finding:
    """What a check found. do: what helps, where it is not ok."""

    says: str
    state: State = "ok"
    do: str = ""


def python(_: Place) -> Finding:
    """Version, and where it runs."""
    says = f"{platform.python_version()} on {platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    wanted = SpecifierSet(importlib.metadata.metadata("beliefscope")["Requires-Python"])
    if platform.python_version() not in wanted:
        return Finding(says, "failed", f"install Python {wanted}")
    if platform.system() != "Linux":
        return Finding(says, "warning", "Linux is what Beliefscope is tested on")
    return Finding(says)


def packages(_: Place) -> Finding:
    """Every package that is required, at a version that is."""
    wrong = []
    wanted = [Requirement(line) for line in importlib.metadata.requires("beliefscope") or ()]
    needed = [one for one in wanted if one.marker is None or one.marker.evaluate({"extra": ""})]
    for one in needed:
        found = _version(one.name)
        if found is None or not one.specifier.contains(found, prereleases=True):
            wrong.append(f"{one.name} {found or 'is missing'}, wanted {one.specifier}")
    if wrong:
        return Finding("; ".join(wrong), "failed", "pip install -c constraints.txt -e . or reinstall beliefscope")
    return Finding(f"{len(needed)} required packages fit")


def torch(_: Place) -> Finding:
    """That it calculates, with how many threads, and on which devices."""
    import torch as library

    eye = library.eye(3, dtype=library.float64)
    if not library.equal(library.linalg.cholesky(4 * eye), 2 * eye):
        return Finding(f"PyTorch {library.__version__} calculates wrongly", "failed", "reinstall torch")
    devices = [library.cuda.get_device_name(i) for i in range(library.cuda.device_count())]
    on = f"CUDA {library.version.cuda}: {', '.join(devices)}" if devices else "no CUDA device, none is needed"
    return Finding(f"PyTorch {library.__version__}, {library.get_num_threads()} threads, {on}")


def camera(_: Place) -> Finding:
    """That the simulation runs and draws its pictures without a graphics library."""
    from beliefscope.datasets.simulation.door import DOOR

    assert DOOR.simulate is not None
    started = time.perf_counter()
    picture = DOOR.simulate(0, 0, 2).observations["image"]
    seconds = time.perf_counter() - started
    if picture.std() < 1.0:
        return Finding("the simulated camera's pictures are empty", "failed", "reinstall mujoco")
    version = importlib.metadata.version("mujoco")
    return Finding(f"MuJoCo {version} simulated and drew 2 steps in {seconds:.1f} s, without a display")


def weights(_: Place) -> Finding:
    """That the filters and episodes that ship are what was shipped."""
    from beliefscope.datasets.store import sample_path
    from beliefscope.filters.checkpoint import PRETRAINED

    folders = (PRETRAINED, sample_path("door").parent)
    wrong = [name for folder in folders for name in changed(folder)]
    if wrong:
        return Finding(
            f"{', '.join(wrong)} not as shipped", "failed", "reinstall beliefscope, or check the files out anew"
        )
    return Finding(f"{sum(len(sums(folder)) for folder in folders)} shipped files have their hashes")


def page(_: Place) -> Finding:
    """That the page is there, and the browser code which is served out of other packages."""
    from beliefscope.app.server.main import PAGE
    from beliefscope.app.server.static_files import named
    from beliefscope.app.server.vendor_files import UPLOT_FILES, installed
    from beliefscope.app.views.embedded_viser import client_page

    static = installed("rerun_notebook") / "static"
    files = [
        *(PAGE / name for name in named(PAGE) if name not in UPLOT_FILES),
        static / "widget.js",
        static / "re_viewer_bg.wasm",
        *(installed("uplot") / "static" / n for n in UPLOT_FILES),
    ]
    missing = [path.name for path in files if not path.is_file()]
    if missing:
        return Finding(
            f"{', '.join(missing)} missing", "failed", "reinstall beliefscope, rerun-notebook and uplot-python"
        )
    client_page("/static/scene/viser_frame_throttle.js")
    versions = (f"{name} {importlib.metadata.version(name)}" for name in ("rerun-notebook", "viser", "uplot-python"))
    return Finding(f"page complete: {', '.join(versions)}")


def port(place: Place) -> Finding:
    """That a server could listen where it is asked to."""
    family = socket.AF_INET6 if ":" in place.host else socket.AF_INET
    try:
        with socket.socket(family) as any_port:
            any_port.bind((place.host, 0))
    except OSError as error:
        return Finding(f"nothing can listen on {place.host}: {error.strerror}", "failed", "choose another --host")
    with socket.socket(family) as wanted:
        wanted.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            wanted.bind((place.host, place.port))
        except OSError as error:
            says = f"{place.host} port {place.port}: {error.strerror}"
            return Finding(says, "warning", "serve with --port 0, or end what listens there")
    return Finding(f"{place.host} port {place.port} is free")


def workspace(place: Place) -> Finding:
    """That files can be written and renamed there, by no other user, and the disk has room."""
    folder = place.workspace if place.workspace.is_dir() else place.workspace.absolute().parent
    if not folder.is_dir():
        return Finding(f"{_home(folder)} does not exist", "failed", "make it, or give another --workspace")
    try:
        with tempfile.TemporaryDirectory(prefix=".doctor-", dir=folder) as tried:
            path = Path(tried) / "file"
            path.write_bytes(b"written")
            os.replace(path, path.with_name("renamed"))
    except OSError as error:
        return Finding(f"{_home(folder)}: {error.strerror}", "failed", "give a --workspace that can be written to")
    free = shutil.disk_usage(folder).free
    says = f"{_home(place.workspace)} can be written to, {free / 1e9:.1f} GB free"
    if free < ENOUGH:
        return Finding(says, "failed" if free < LITTLE else "warning", "free some of the disk, or use another")
    if place.workspace.is_dir() and place.workspace.stat().st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return Finding(f"{says}; other users can write to it", "warning", f"chmod go-w {_home(place.workspace)}")
    return Finding(says)


def browser(_: Place) -> Finding:
    """Whether a Chromium is there for what needs one on this machine."""
    from beliefscope.recordings.report.pdf import browser as find

    try:
        return Finding(find())
    except BadInput:
        do = "install Chromium for report --pdf and the page's tests, or name it in BELIEFSCOPE_CHROMIUM"
        return Finding("no Chromium on this machine; any browser shows the page", "warning", do)


def extras(_: Place) -> Finding:
    """What may be installed beside."""
    found = [name for name in EXTRAS if find_spec(name) is not None]
    missing = [f"{name} not installed ({what})" for name, what in EXTRAS.items() if name not in found]
    return Finding("; ".join([*(f"{name} {_version(name)}" for name in found), *missing]))


CHECKS: tuple[Callable[[Place], Finding], ...] = (
    python,
    packages,
    torch,
    camera,
    weights,
    page,
    port,
    workspace,
    browser,
    extras,
)


def examined(place: Place, told: Callable[[str], None] = lambda name: None) -> dict[str, Finding]:
    """Every check by its name. told: called with each name before it is made."""
    found = {}
    for check in CHECKS:
        told(check.__name__)
        try:
            found[check.__name__] = check(place)
        except Exception as error:
            found[check.__name__] = Finding(f"{type(error).__name__}: {error}", "failed", "reinstall beliefscope")
    return found


def report(found: Mapping[str, Finding]) -> dict[str, Any]:
    """For bug reports: the findings, and every installed package. Of paths, the home folder is left out."""
    installed = {one.metadata["Name"]: one.version for one in importlib.metadata.distributions()}
    return {
        "beliefscope": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cores": os.cpu_count(),
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        "checks": {name: asdict(one) for name, one in found.items()},
        "packages": dict(sorted(installed.items(), key=lambda item: item[0].lower())),
    }


def sums(folder: Path) -> dict[str, str]:
    """File name -> SHA-256, from the folder's list."""
    lines = (folder / SUMS).read_text(encoding="utf-8").splitlines()
    return {name: digest for digest, name in (line.split(maxsplit=1) for line in lines)}


def changed(folder: Path) -> list[str]:
    """Names of the listed files that are missing or other than listed."""

    def digest(name: str) -> str:
        with suppress(OSError):
            return hashlib.sha256((folder / name).read_bytes()).hexdigest()
        return ""

    return [name for name, listed in sums(folder).items() if digest(name) != listed]


def _version(name: str) -> str | None:
    with suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(name)
    return None


def _home(path: Path) -> str:
    with suppress(ValueError, RuntimeError):
        return f"~/{path.absolute().relative_to(Path.home())}"
    return str(path)
