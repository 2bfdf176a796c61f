"""The page's colours by their numbers: what is read and what is drawn stands out, light and dark."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

STYLE = (Path(__file__).resolve().parents[3] / "app" / "page" / "styles" / "page.css").read_text()
FOUND = re.findall(r"^  --([\w-]+): light-dark\((#\w+), (#\w+)\);", STYLE, re.MULTILINE)
COLOURS = {name: (light, dark) for name, light, dark in FOUND}
GROUNDS = ("surface", "raised", "ground")
TEXTS = ("ink", "muted", "accent", "bad", "good")
LINES = ("truth", "image", "haptics", "fused", "spare-0", "spare-1", "spare-2")


def luminance(colour: str) -> float:
    """Relative, 0 to 1: WCAG 2.2's definition."""
    digits = colour[1:] if len(colour) == 7 else "".join(2 * one for one in colour[1:])
    shares = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    linear = [s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4 for s in shares]
    return sum(weight * s for weight, s in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def contrast(one: str, other: str) -> float:
    """Of two colours, 1 to 21: WCAG 2.2's definition."""
    dark, light = sorted((luminance(one), luminance(other)))
    return (light + 0.05) / (dark + 0.05)


def test_contrast_is_what_the_standard_says() -> None:
    assert contrast("#fff", "#000") == pytest.approx(21.0)
    assert contrast("#767676", "#ffffff") == pytest.approx(4.54, abs=0.005)  # the lightest gray that is AA on white


@pytest.mark.parametrize("theme", [0, 1], ids=["light", "dark"])
def test_what_is_read_and_drawn_stands_out(theme: int) -> None:
    read = {(t, g): contrast(COLOURS[t][theme], COLOURS[g][theme]) for t in TEXTS for g in GROUNDS}
    assert {pair: ratio for pair, ratio in read.items() if ratio < 4.5} == {}  # AA for text
    drawn = {line: contrast(COLOURS[line][theme], COLOURS["surface"][theme]) for line in LINES}
    assert {line: ratio for line, ratio in drawn.items() if ratio < 3.0} == {}  # AA for what is drawn
