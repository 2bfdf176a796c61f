"""The whole page's craft: every tab accessible in light and dark, a focus that is seen and comes round, no jumps."""

from __future__ import annotations

from typing import Any

import pytest

pytestmark = pytest.mark.browser

TABS = "(all) => all.map((tab) => tab.id.replace('tab-', ''))"

FOCUSED = """() => {
  const at = document.activeElement;
  const { width, height } = at.getBoundingClientRect();
  const name = at.ariaLabel || at.title || at.labels?.length || at.textContent.trim();
  const left = at === document.body || at.tagName === 'IFRAME';
  const again = at.dataset.stop === 'seen';
  at.dataset.stop = 'seen';
  return [left, at.id || at.outerHTML.slice(0, 90), width * height > 0, Boolean(name), again];
}"""

JUMPS = """() => new Promise((done) => {
  const observer = new PerformanceObserver((list) => sum += list.getEntries().reduce((all, one) => all + one.value, 0));
  let sum = 0;
  observer.observe({ type: 'layout-shift', buffered: true });
  setTimeout(() => done(sum), 300);
})"""


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_every_tab_and_sheet_is_accessible(open_page: Any, theme: str) -> None:
    page = open_page(color_scheme=theme)
    found: dict[str, list[str]] = {}
    tabs = page.page.locator("[role=tab]").evaluate_all(TABS)
    for tab in tabs:
        if tab == "rerun":
            continue  # it starts its viewer, which takes long: test_recordings looks at it
        page.page.evaluate(f"() => document.querySelector('#tab-{tab}').click()")
        page.until(f"() => !document.querySelector('#{tab}').matches('[aria-busy=true], :has([aria-busy=true])')")
        found[tab] = page.violations()
    sheets = {"keys": "#help", "maps-options": "#maps-view", "jobs": "#jobs-button", "layers": "#scene-layers"}
    for sheet, button in sheets.items():
        if sheet == "layers":
            page.page.evaluate("() => document.querySelector('#tab-scene').click()")
        page.page.evaluate(f"() => document.querySelector('{button}').click()")
        found[sheet] = page.violations()
        page.page.keyboard.press("Escape")
    assert {name: lines for name, lines in found.items() if lines} == {}


def test_the_tab_key_goes_once_through_all_that_can_be_used(open_page: Any) -> None:
    page = open_page("?tab=failures")
    assert page.page.evaluate(JUMPS) < 0.05
    stops: list[str] = []
    for _ in range(80):
        page.page.keyboard.press("Tab")
        left, what, seen, named, again = page.page.evaluate(FOCUSED)
        if left:
            break
        assert seen, f"{what} has the focus and cannot be seen"
        assert named, f"{what} has no name"
        assert not again, f"{what} has the focus twice"
        stops.append(what)
    assert len(stops) < 80, "the focus never comes back"
    order = ["filter", "play", "save", "tab-failures", "maps-view", "tracks"]
    assert [stop for stop in stops if stop in order] == order
