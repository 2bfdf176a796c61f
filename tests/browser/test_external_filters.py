"""External filters: the page shows the values that they report and explains missing ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from tests.app.api.test_diagnosis import BOATS
from tests.inspect.diagnosis.checks.test_innovations import sail, task

from beliefscope.datasets.store import write_dataset

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "04_own_filter.py"
FILTERS = """
import torch
from torch import nn


class EstimateOnly(nn.Module):
    task = "door"

    def forward(self, observations, controls):
        return observations["effector_position"]


class Weighted(EstimateOnly):
    def forward(self, observations, controls):
        share = 0.1 + 0.8 * observations["contact"]
        mean = observations["effector_position"]
        return {"estimate_mean": mean, "weights": torch.stack([1 - share, share], dim=2)}
"""


@pytest.mark.long
def test_missing_outputs_are_explained(open_page: Any, start_server: Any, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(FILTERS)
    filters = [f"{EXAMPLE}:build", f"{tmp_path}/mine.py:EstimateOnly", f"{tmp_path}/mine.py:Weighted"]
    page = open_page(url=start_server(*(part for name in filters for part in ("--filter", name))).url, scene=True)
    text = page.page.locator

    # With a covariance but no modalities: one map, the Gaussian of the estimate.
    assert page.state["filter"] == "04_own_filter-build"
    assert text("#heatmaps h3").all_text_contents() == ["estimate"]
    assert text("#step-table tbody th").all_text_contents() == ["estimate"]
    assert "\N{GREEK SMALL LETTER SIGMA}" in text("#step-table thead").text_content()
    assert "does not report its modalities" in text("#timeline .track-note").text_content()
    page.page.keyboard.press("ArrowRight")
    page.settle(1)
    page.screenshot("external-filter")

    text("#filter").select_option("mine-EstimateOnly")
    page.until("() => document.querySelector('#heatmaps').dataset.state === 'empty'")
    assert "reports no covariance" in text("#heatmaps .note").text_content()
    assert text("#step-summary").text_content().endswith("no predicted standard deviation.")

    text("#filter").select_option("mine-Weighted")
    page.until("() => document.querySelector('#step-table tbody th')?.textContent === 'fused'")
    assert text("#timeline .track-note").count() == 0
    assert not text("#weights").is_visible()
    assert "\N{GREEK SMALL LETTER BETA}" not in text("#step-table thead").text_content()
    page.page.keyboard.press("ArrowRight")
    page.settle(2)
    page.screenshot("external-filter-weights")


def serve_boats(start_server: Any, folder: Path, name: str, steps: int = 1000) -> str:
    """Address of a server with a filter of boats, by its name, and at most this many steps of three episodes."""
    (folder / "boats.py").write_text(BOATS)
    write_dataset(folder / "boats.h5", task(4), [sail(seed).part(0, steps) for seed in range(3)])
    options = ["--task", f"{folder}/boats.py:TASK", "--data", str(folder / "boats.h5")]
    return str(start_server(*options, "--filter", f"{folder}/boats.py:{name}").url)


@pytest.mark.long
def test_reported_innovations_are_charts_and_rows_of_the_step(
    open_page: Any, start_server: Any, tmp_path: Path
) -> None:
    url = serve_boats(start_server, tmp_path, "right")
    page = open_page("?episode=0&step=40&track=innovation&charts=track,readings/radar", url=url)
    names = ["radar x", "radar y", "compass"]
    legends = "() => [...document.querySelectorAll('#tracks .track')].map((t) => [...t.querySelectorAll('dt')]"
    legends += ".map((name) => name.textContent))"
    assert page.page.evaluate(legends) == [names, ["x", "y"]]
    rows = page.page.locator("#step-table tr.measured")
    assert rows.locator("th:first-child").all_text_contents() == ["measurement", *names]
    values = rows.nth(1).locator("td").all_text_contents()
    innovation, sigma, ratio = (float(value.replace("\N{MINUS SIGN}", "-")) for value in values)
    assert ratio == pytest.approx(innovation / sigma, abs=0.1)
    page.page.keyboard.press("ArrowRight")  # the radar has no reading
    page.until("() => document.querySelector('#step-table tr.measured td').textContent === '\N{EN DASH}'")
    assert "\N{EN DASH}" not in rows.nth(3).text_content()
    page.page.locator("#charts").click()
    page.page.get_by_label("innovation of compass", exact=True).check()
    page.until(f"() => ({legends})().at(-1).join() === 'compass'")
    page.page.keyboard.press("Escape")
    assert not page.violations()
    page.screenshot("reported-innovations")


@pytest.mark.long
def test_wrong_equations_are_the_finding_of_a_filter_without_a_record(
    open_page: Any, start_server: Any, tmp_path: Path
) -> None:
    page = open_page(url=serve_boats(start_server, tmp_path, "wrong"))
    finding = page.page.locator("#finding")
    assert finding.locator("strong").text_content().startswith("The Jacobian of radar differs from finite differences")
    finding.get_by_role("button", name="Equations").click()
    page.until("() => document.querySelector('#diagnostics').textContent.includes('Updates against')")
    assert (page.state["tab"], page.state["diagnostic"]) == ("diagnostics", "equations")
    page.screenshot("wrong-equations")


@pytest.mark.long
def test_restarts_of_a_failing_filter_are_marked_in_the_timeline(
    open_page: Any, start_server: Any, tmp_path: Path
) -> None:
    page = open_page(url=serve_boats(start_server, tmp_path, "failing", steps=40))
    marks = page.page.locator("#marks button")
    assert marks.count() == 2
    label = "Step 15 (1.50 s): the filter is restarted at the true state"
    assert marks.first.get_attribute("aria-label") == label
    marks.first.click()
    page.settle(15)
    page.screenshot("restarts")
