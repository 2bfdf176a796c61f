"""Layers of the 3D scene: selection on the page, permalinks, per-view state (drawing: tests/app/views/)."""

from __future__ import annotations

from typing import Any

# Each layer's checkbox, or null where the scene has no such layer.
BOXES = """() => Object.fromEntries([...document.querySelectorAll('#scene-options input[type=checkbox]')].map((box) => {
  return [box.value, box.closest('div').hidden ? null : box.checked];
}))"""
SELECTED = "() => [...document.querySelectorAll('#scene-options input[type=radio]:checked')].map((e) => e.value)"


def click(page: Any, selector: str) -> None:
    page.page.evaluate("(selector) => document.querySelector(selector).click()", selector)


def test_layers_belong_to_a_view_and_its_permalink(open_page: Any) -> None:
    # Another tab is open, so that the scene is not drawn; the dialog works nevertheless.
    second = open_page("?filter=crossmodal-ekf&step=12&tab=diagnostics")
    first = open_page("?step=40&tint=share&hide=contours&tab=diagnostics")
    boxes = first.page.evaluate(BOXES)
    assert len(boxes) == 8
    assert [name for name, visible in boxes.items() if not visible] == ["contours"]
    click(first, "#scene-options [value=replay]")
    click(first, "#scene-options [value=haptics]")
    first.until("() => location.search.includes('hide=contours%2Creplay&ground=haptics&')")
    assert first.page.evaluate(SELECTED) == ["share", "haptics", "floor"]
    assert not first.page.evaluate(BOXES)["replay"]
    second.settle(12)
    assert (second.state["hide"], second.state["ground"], second.state["step"]) == ("", "fused", 12)
    others = second.page.evaluate(BOXES)
    assert others.pop("particles") is None
    assert all(others.values())
    for page in (first, second):
        assert page.page.evaluate("() => document.querySelector('#messages').textContent") == ""


SCHEME = "() => getComputedStyle(document.querySelector('#scene iframe').contentDocument.documentElement).colorScheme"


def test_the_scene_has_the_theme_of_the_page_not_of_the_system(open_page: Any) -> None:
    page = open_page("?filter=crossmodal-ekf&step=12", scene=True, theme="dark")
    for theme in ("light", "dark"):
        page.page.keyboard.press("d")
        assert page.page.evaluate("() => document.documentElement.dataset.theme") == theme
        page.until(f"() => ({SCHEME})() === '{theme}'")
