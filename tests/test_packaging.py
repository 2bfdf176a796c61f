"""What an installation brings: pinned with hashes, under licences that are allowed, from no place that is named."""

from __future__ import annotations

import importlib.metadata
import re
import runpy
import shutil
import subprocess
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
LICENCES = runpy.run_path(str(ROOT / "bench" / "licences.py"))
LOCK = (ROOT / "requirements.lock").read_text()


def locked() -> dict[str, list[tuple[str, str]]]:
    """Package -> its versions, each with the marker of the platforms that it is for."""
    found: dict[str, list[tuple[str, str]]] = {}
    for name, version, marker in re.findall(r"^([\w.-]+)==([\w.+]+)(?: ; (.*?))? \\$", LOCK, re.MULTILINE):
        found.setdefault(canonicalize_name(name), []).append((version, marker))
    return found


def test_everything_is_locked_with_hashes() -> None:
    entries = re.split(r"^(?=[\w.-]+==)", LOCK, flags=re.MULTILINE)[1:]
    assert len(entries) > 100
    for entry in entries:
        assert re.fullmatch(r"\S+(?: ; .*?)? (?:\\\n    --hash=sha256:[0-9a-f]{64} ?)+\n", entry), entry[:200]


def test_the_lock_names_no_host() -> None:
    assert "://" not in LOCK
    assert not re.search(r"^--|^-[ief] ", LOCK, re.MULTILINE)


def test_the_lock_has_the_versions_that_are_tested() -> None:
    text = (ROOT / "constraints.txt").read_text()
    pinned = {canonicalize_name(n): v for n, v in re.findall(r"^([\w.-]+)==([\w.]+)$", text, re.MULTILINE)}
    shared = locked().keys() & pinned.keys()
    assert len(shared) > 80
    # Where platforms differ, one of the versions is the one that is tested.
    assert not [name for name in shared if pinned[name] not in {version for version, _ in locked()[name]}]


def test_all_that_is_required_is_locked() -> None:
    needed = {name for name in LICENCES["closure"]() if name not in ("pip", "setuptools")}
    assert not needed - locked().keys()
    own = [Requirement(line) for line in importlib.metadata.requires("beliefscope") or ()]
    for one in own:
        if one.marker is None:
            assert any(one.specifier.contains(version) for version, _ in locked()[canonicalize_name(one.name)]), one


def test_every_licence_is_allowed() -> None:
    said = {name: LICENCES["licence_of"](name) for name in LICENCES["closure"]()}
    assert len(said) > 80
    refused = {name: text for name, text in said.items() if not LICENCES["is_allowed"](text)}
    assert refused.keys() <= LICENCES["EXCEPTIONS"].keys(), refused
    documented = (ROOT / "docs" / "dependencies.md").read_text().split("## Licences")[1]
    assert all(name in documented for name in (*LICENCES["ALLOWED"], *LICENCES["EXCEPTIONS"]))


@pytest.mark.parametrize(
    ("licence", "fits"),
    [
        ("MIT License", True),
        ("GPL-3.0-only", False),
        ("GPL-3.0-only OR MIT", True),
        ("MIT AND GPL-3.0-only", False),
        ("GNU Affero General Public License v3", False),
        ("", False),
        ("Proprietary", False),
        ("Permitted by nobody", False),
    ],
)
def test_what_is_no_such_licence_is_seen(licence: str, fits: bool) -> None:
    assert LICENCES["is_allowed"](licence) is fits


# As pip-audit speaks: of an index that knows of no advisories it says nothing bad, unless it is told to be strict.
SILENT = """#!/bin/sh
case "$*" in *--strict*)
  echo "ERROR:pip_audit._cli:numpy: Dependency not found on PyPI and could not be audited: numpy (2.0)" >&2; exit 1
esac
echo "No known vulnerabilities found" >&2
"""
UNREACHED = "#!/bin/sh\necho Traceback >&2; exit 1\n"
WEAK = "#!/bin/sh\necho 'Found 1 known vulnerability in 1 package' >&2; exit 1\n"


@pytest.mark.parametrize(
    ("auditor", "said"),
    [(SILENT, "nothing checked"), (UNREACHED, "nothing checked"), (WEAK, "Found 1 known vulnerability")],
)
@pytest.mark.skipif(shutil.which("make") is None, reason="there is no make")
def test_an_audit_that_learned_nothing_does_not_say_that_all_is_well(tmp_path: Path, auditor: str, said: str) -> None:
    shutil.copy(ROOT / "Makefile", tmp_path)
    tools = tmp_path / ".venv" / "tools" / "bin"
    tools.mkdir(parents=True)
    (tools / "pip-audit").write_text(auditor)
    (tools / "pip-audit").chmod(0o755)
    ran = subprocess.run(["make", "audit"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode != 0
    assert said in ran.stderr
    assert "No known vulnerabilities" not in ran.stderr
