"""Layers of the 3D scene: selection on the page, permalinks, per-view state (drawing: tests/app/views/)."""

from __future__ import annotations

from typing import Any

import pytest

pytestmark = pytest.mark.browser

# Each layer's checkbox, or null where the scene has no such layer.
BOXES = """() => Object.fromEntries([...document.querySelectorAll('#scene-options > div:not(.places)')].map((row) => {
  const box = row.querySelector('label > input[type=checkbox]');
  return [box.value, row.hidden ? null : box.checked];
}))"""
CHOSEN = "() => [...document.querySelectorAll('#scene-options input[type=radio]:checked')].map((one) => one.value)"


def press(page: Any, selector: str) -> None:
    page.page.evaluate("(selector) => document.querySelector(selector).click()", selector)


def test_layers_are_a_views_own_and_in_its_address(open_page: Any) -> None:
    # Behind another tab, where nothing is drawn: the sheet is the same.
    second = open_page("?filter=crossmodal-ekf&step=12&tab=diagnostics")
    first = open_page("?step=40&tint=share&hide=contours&tab=diagnostics")
    boxes = first.page.evaluate(BOXES)
    assert len(boxes) == 8
    assert [name for name, shown in boxes.items() if not shown] == ["contours"]
    press(first, "#scene-options [value=replay]")
    press(first, "#scene-options [value=haptics]")
    first.until("() => location.search.includes('hide=contours%2Creplay&ground=haptics&')")
    assert first.page.evaluate(CHOSEN) == ["share", "haptics", "floor"]
    assert not first.page.evaluate(BOXES)["replay"]
    second.settle(12)
    assert (second.state["hide"], second.state["ground"], second.state["step"]) == ("", "fused", 12)
    others = second.page.evaluate(BOXES)
    assert others.pop("particles") is None
    assert all(others.values())
    for page in (first, second):
        assert page.page.evaluate("() => document.querySelector('#messages').textContent") == ""
    press(first, "#tab-scene")
    press(first, "#scene-layers")
    press(first, "#scene-options .places button:nth-of-type(2)")
    first.picture("scene-layers")
