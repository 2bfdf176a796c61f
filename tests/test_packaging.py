"""Dependencies: the lock file, licences and the audit for vulnerabilities."""

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
    """Package -> locked versions, each with the marker of its platforms."""
    versions: dict[str, list[tuple[str, str]]] = {}
    for name, version, marker in re.findall(r"^([\w.-]+)==([\w.+]+)(?: ; (.*?))? \\$", LOCK, re.MULTILINE):
        versions.setdefault(canonicalize_name(name), []).append((version, marker))
    return versions


def test_lock_entries_have_hashes() -> None:
    entries = re.split(r"^(?=[\w.-]+==)", LOCK, flags=re.MULTILINE)[1:]
    assert len(entries) > 100
    for entry in entries:
        assert re.fullmatch(r"\S+(?: ; .*?)? (?:\\\n    --hash=sha256:[0-9a-f]{64} ?)+\n", entry), entry[:200]


def test_lock_contains_no_host() -> None:
    assert "://" not in LOCK
    assert not re.search(r"^--|^-[ief] ", LOCK, re.MULTILINE)


def test_locked_versions_are_the_tested_versions() -> None:
    text = (ROOT / "constraints.txt").read_text()
    pinned = {canonicalize_name(n): v for n, v in re.findall(r"^([\w.-]+)==([\w.]+)$", text, re.MULTILINE)}
    shared = locked().keys() & pinned.keys()
    assert len(shared) > 80
    # A package may have several versions, for different platforms.
    assert not [name for name in shared if pinned[name] not in {version for version, _ in locked()[name]}]


def test_all_requirements_are_locked() -> None:
    required = {name for name in LICENCES["closure"]() if name not in ("pip", "setuptools")}
    assert not required - locked().keys()
    for requirement in map(Requirement, importlib.metadata.requires("beliefscope") or ()):
        if requirement.marker is None:
            versions = [version for version, _ in locked()[canonicalize_name(requirement.name)]]
            assert any(map(requirement.specifier.contains, versions)), requirement


def test_every_licence_is_allowed() -> None:
    licences = {name: LICENCES["licence_of"](name) for name in LICENCES["closure"]()}
    assert len(licences) > 80
    violations = {name: text for name, text in licences.items() if not LICENCES["is_allowed"](text)}
    assert violations.keys() <= LICENCES["EXCEPTIONS"].keys(), violations
    documented = (ROOT / "docs" / "dependencies.md").read_text().split("## Licences")[1]
    assert all(name in documented for name in (*LICENCES["ALLOWED"], *LICENCES["EXCEPTIONS"]))


@pytest.mark.parametrize(
    ("licence", "allowed"),
    [
        ("MIT License", True),
        ("GPL-3.0-only", False),
        ("GPL-3.0-only OR MIT", True),
        ("MIT AND GPL-3.0-only", False),
        ("GNU Affero General Public License v3", False),
        ("", False),
        ("Proprietary", False),
        ("Other", False),
    ],
)
def test_licence_expressions(licence: str, allowed: bool) -> None:
    assert LICENCES["is_allowed"](licence) is allowed


# Replacements of pip-audit. Without --strict, it reports success for an index without advisories.
NO_ADVISORIES = """#!/bin/sh
case "$*" in *--strict*)
  echo "ERROR:pip_audit._cli:numpy: Dependency not found on PyPI and could not be audited: numpy (2.0)" >&2; exit 1
esac
echo "No known vulnerabilities found" >&2
"""
UNREACHABLE = "#!/bin/sh\necho Traceback >&2; exit 1\n"
VULNERABLE = "#!/bin/sh\necho 'Found 1 known vulnerability in 1 package' >&2; exit 1\n"


@pytest.mark.parametrize(
    ("auditor", "message"),
    [(NO_ADVISORIES, "nothing checked"), (UNREACHABLE, "nothing checked"), (VULNERABLE, "Found 1 known vulnerability")],
)
@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_failed_audits_are_reported(tmp_path: Path, auditor: str, message: str) -> None:
    shutil.copy(ROOT / "Makefile", tmp_path)
    tools = tmp_path / ".venv" / "tools" / "bin"
    tools.mkdir(parents=True)
    (tools / "pip-audit").write_text(auditor)
    (tools / "pip-audit").chmod(0o755)
    result = subprocess.run(["make", "audit"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode != 0
    assert message in result.stderr
    assert "No known vulnerabilities" not in result.stderr
