"""Fine-tuning on the page, in miniature: a run is made and judged, its child accepted and taken back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

pytestmark = pytest.mark.browser

STATE = "document.querySelector('#finetune article')?.dataset.state"
SHOWN = f"() => window.beliefscope && {STATE} === 'ready' && beliefscope.state().filter"
FILTERS = "() => [...document.querySelector('#filter').options].map((one) => one.value)"


def test_a_filter_is_tuned_judged_accepted_and_rolled_back(open_page: Any, serve: Callable[..., Any]) -> None:
    page = open_page("?tab=finetune&filter=crossmodal-ekf", serve().url)  # of its own: it changes what is shown first
    panel = page.page.locator("#finetune")
    page.until("() => document.querySelectorAll('#finetune .tree li').length > 20")
    assert "26,054 of 449,097" in panel.locator(".count").text_content()
    panel.get_by_label("Train virtual_sensors.haptics", exact=True).uncheck()
    assert panel.locator("select[name=preset]").input_value() == "own"
    panel.get_by_role("button", name="Fine-tune").click()
    assert "nothing to train" in panel.locator(".error").text_content()
    panel.get_by_label("Show what is in virtual_sensors.haptics", exact=True).click()
    panel.get_by_label("Train virtual_sensors.haptics.state", exact=True).check()
    panel.locator("select[name=slice]").select_option("haptics alone")
    for name, value in (("steps", "3"), ("length", "8")):
        panel.locator(f"input[name={name}]").fill(value)
    page.picture("finetune-form")
    panel.get_by_role("button", name="Fine-tune").click()
    page.until(f"() => {STATE} === 'ready'", 180.0)  # PyTorch, training, and both filters over all held-out episodes
    assert page.state["run"]
    assert "; damages " in panel.locator(".verdict").text_content()
    assert panel.locator("h3").text_content() == "crossmodal-ekf: virtual_sensors.haptics.state on haptics alone"
    assert "virtual sensors.image" in panel.get_by_label("Modules", exact=True).last.text_content()
    page.until("() => document.querySelectorAll('#finetune .live canvas').length === 2")
    page.picture("finetune")

    before = page.page.evaluate(FILTERS)
    with page.page.expect_navigation():
        panel.get_by_role("button", name="Accept").click()
    page.until(f"{SHOWN} !== 'crossmodal-ekf'")
    child = page.state["filter"]
    assert page.page.evaluate(FILTERS) == [child, *before]
    with page.page.expect_navigation():
        panel.get_by_role("button", name="Roll back").click()
    page.until(f"{SHOWN} === 'crossmodal-ekf'")
    assert page.page.evaluate(FILTERS) == before
