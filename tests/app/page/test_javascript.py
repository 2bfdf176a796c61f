"""The page's JavaScript: unit tests, and values shared with Python."""

from __future__ import annotations

import re
import runpy
import shutil
import subprocess
from pathlib import Path

import pytest

from beliefscope.inspect.palette import COLOURS, SPARE_COLOURS

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[3]
NODE = shutil.which("node")


@pytest.mark.skipif(NODE is None, reason="Node.js is not installed")
def test_unit_tests_pass() -> None:
    files = sorted((ROOT / "tests" / "page").glob("*.test.js"))
    result = subprocess.run([str(NODE), "--test", *map(str, files)], capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stdout


def test_constants_are_current() -> None:
    constants = runpy.run_path(str(ROOT / "tools" / "page_constants.py"))
    assert constants["PATH"].read_text() == constants["source"](), "run `make api-types`"


def test_style_sheet_has_the_palette() -> None:
    """The initial values of the custom properties are the colours of figures and recordings."""
    style = (ROOT / "app" / "page" / "styles" / "page.css").read_text()
    initial = dict(re.findall(r"@property --([\w-]+) \{.*initial-value: (#\w+);", style))
    palette = {name: COLOURS[name] for name in ("truth", "image", "haptics", "fused")}
    palette |= {"contact-band": COLOURS["contact"]}
    palette |= {f"spare-{i}": colour for i, colour in enumerate(SPARE_COLOURS)}
    assert {name: initial[name].lower() for name in palette} == {n: c.lower() for n, c in palette.items()}
