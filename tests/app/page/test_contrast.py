"""Contrast of the page's text and line colours, light and dark (WCAG 2.2)."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

STYLE = (Path(__file__).resolve().parents[3] / "app" / "page" / "styles" / "page.css").read_text()
DEFINITIONS = re.findall(r"^  --([\w-]+): light-dark\((#\w+), (#\w+)\);", STYLE, re.MULTILINE)
COLOURS = {name: (light, dark) for name, light, dark in DEFINITIONS}
BACKGROUNDS = ("surface", "raised", "ground")
TEXTS = ("ink", "muted", "accent", "bad", "good")
LINES = ("truth", "image", "haptics", "fused", "spare-0", "spare-1", "spare-2")


def luminance(colour: str) -> float:
    """Relative luminance, 0..1."""
    digits = colour[1:] if len(colour) == 7 else "".join(2 * digit for digit in colour[1:])
    shares = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    linear = [s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4 for s in shares]
    return sum(weight * s for weight, s in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def contrast(colour: str, background: str) -> float:
    """Contrast ratio, 1..21."""
    dark, light = sorted((luminance(colour), luminance(background)))
    return (light + 0.05) / (dark + 0.05)


def test_contrast_of_reference_colours() -> None:
    assert contrast("#fff", "#000") == pytest.approx(21.0)
    assert contrast("#767676", "#ffffff") == pytest.approx(4.54, abs=0.005)  # the lightest gray with level AA on white


@pytest.mark.parametrize("theme", [0, 1], ids=["light", "dark"])
def test_contrast_meets_level_aa(theme: int) -> None:
    text = {(t, b): contrast(COLOURS[t][theme], COLOURS[b][theme]) for t in TEXTS for b in BACKGROUNDS}
    assert {pair: ratio for pair, ratio in text.items() if ratio < 4.5} == {}  # text
    lines = {line: contrast(COLOURS[line][theme], COLOURS["surface"][theme]) for line in LINES}
    lines |= {f"warn on {b}": contrast(COLOURS["warn"][theme], COLOURS[b][theme]) for b in BACKGROUNDS}
    assert {line: ratio for line, ratio in lines.items() if ratio < 3.0} == {}  # graphics
