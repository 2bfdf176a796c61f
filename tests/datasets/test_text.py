"""Numbers in sentences."""

from __future__ import annotations

import re
from pathlib import Path

from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.text import percent, plural, typeset
from beliefscope.inspect.diagnostics.views import format_table


def test_nouns_have_a_singular() -> None:
    assert [plural(count, "step") for count in (0, 1, 2)] == ["0 steps", "1 step", "2 steps"]


def test_shares_are_given_in_percent() -> None:
    assert (percent(0.376), percent(0.376, ".1f"), percent(-0.02, "+.1f")) == ("38 %", "37.6 %", "-2.0 %")


def test_numbers_are_typeset_as_on_the_page() -> None:
    assert typeset("dynamics -0.20 cm, angle 1.67 -> 1.95 deg") == "dynamics \N{MINUS SIGN}0.20 cm, angle 1.67 → 1.95°"
    assert typeset("angle error (deg)") == "angle error (°)"
    for text in ("steps 3-5", "image-only", "2026-11-25", "1e-05", "force_bias:x=-3", "--seed"):
        assert typeset(text) == text


def test_zero_has_no_minus_sign() -> None:
    assert (percent(-0.001), percent(-0.001, "+.0f"), percent(-0.0, ".2g")) == ("0 %", "+0 %", "0 %")
    assert DOOR.main_error.text(-1e-9) == "0.00 cm"
    table = format_table("", ["x"], [[-0.0]])
    assert "-0" not in table
    assert "0" in table


def test_signed_numbers_in_the_sources_have_no_negative_zero() -> None:
    """Formats with a sign contain z, such as +z.2f."""
    folders = ("app", "datasets", "filters", "inspect", "recordings")
    root = Path(__file__).parents[2]
    wrong = [
        f"{path}: {match}"
        for folder in folders
        for path in (root / folder).rglob("*.py")
        for match in re.findall(r"\{[^{}\"]*:\+\.\d[fg]\}", path.read_text(encoding="utf-8"))
    ]
    assert wrong == []
