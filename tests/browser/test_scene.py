"""The 3D scene's layers: chosen on the page, in its address, each view's own."""

from __future__ import annotations

from typing import Any

import pytest

pytestmark = pytest.mark.browser

READY = "() => document.querySelector('#scene').dataset.state === 'ready'"


def press(page: Any, selector: str) -> None:
    """Clicks at once: where 3D is drawn slowly, a pointer would wait for a still page."""
    page.page.locator(selector).evaluate("(element) => element.click()")


def test_layers_are_a_views_own_and_in_its_address(open_page: Any) -> None:
    second = open_page("?filter=crossmodal-ekf&step=12&tab=diagnostics")  # where nothing is drawn
    first = open_page("?step=40&tint=share&hide=contours")
    first.until(READY)
    press(first, "#scene-layers")
    assert not first.page.locator("#scene-options [value=contours]").is_checked()
    press(first, "#scene-options [value=replay]")
    press(first, "#scene-options [value=haptics]")
    press(first, "#scene-options .places button:nth-of-type(2)")
    first.until("() => location.search.includes('hide=contours%2Creplay&ground=haptics&')")
    assert first.state["tint"] == "share"
    assert first.page.locator("#scene-tint :checked").input_value() == "share"
    first.picture("scene-layers")
    assert (second.state["hide"], second.state["ground"], second.state["step"]) == ("", "fused", 12)
    assert second.page.locator("#scene-options [value=replay]").is_checked()
    rows = [page.page.locator("#scene-options > div:has([value=particles])") for page in (first, second)]
    assert [row.evaluate("(row) => row.hidden") for row in rows] == [False, True]
    second.settle(12)
    assert first.state["step"] == 40
    assert first.page.locator("#messages").text_content() == ""
