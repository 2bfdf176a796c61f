"""The page of filters from outside: what they say is shown, and what they do not say is said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.browser

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "04_own_filter.py"
MINE = """
import torch
from torch import nn


class Blind(nn.Module):
    task = "door"

    def forward(self, observations, controls):
        return observations["effector_position"]


class Weighs(Blind):
    def forward(self, observations, controls):
        share = 0.1 + 0.8 * observations["contact"]
        mean = observations["effector_position"]
        return {"estimate_mean": mean, "weights": torch.stack([1 - share, share], dim=2)}
"""


def test_filters_from_outside(open_page: Any, serve: Any, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(MINE)
    filters = [f"{EXAMPLE}:build", f"{tmp_path}/mine.py:Blind", f"{tmp_path}/mine.py:Weighs"]
    page = open_page(url=serve(0, *(part for one in filters for part in ("--filter", one))).url)
    text = page.page.locator

    # A covariance, and nothing that tells modalities apart: one map, the Gaussian of the estimate.
    assert page.state["filter"] == "04_own_filter-build"
    assert text("#heatmaps h3").all_text_contents() == ["estimate"]
    assert text("#step-table tbody th").all_text_contents() == ["estimate"]
    assert "\N{GREEK SMALL LETTER SIGMA}" in text("#step-table thead").text_content()
    assert "does not report its modalities" in text("#timeline .track-note").text_content()
    page.page.keyboard.press("ArrowRight")
    page.settle(1)
    page.picture("foreign")

    text("#filter").select_option("mine-Blind")
    page.until("() => document.querySelector('#heatmaps').dataset.state === 'empty'")
    assert "does not say how likely others are" in text("#heatmaps .note").text_content()
    assert text("#step-summary").text_content().endswith("no predicted standard deviation.")

    text("#filter").select_option("mine-Weighs")
    page.until("() => document.querySelector('#step-table tbody th')?.textContent === 'fused'")
    assert text("#timeline .track-note").count() == 0
    assert not text("#weights").is_visible()
    assert "\N{GREEK SMALL LETTER BETA}" not in text("#step-table thead").text_content()
    page.page.keyboard.press("ArrowRight")
    page.settle(2)
    page.picture("foreign-weights")
