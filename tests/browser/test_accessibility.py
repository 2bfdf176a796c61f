"""Accessibility of all tabs and dialogs in both themes, keyboard focus and layout shifts."""

from __future__ import annotations

from typing import Any

import pytest

TABS = "(all) => all.map((tab) => tab.id.replace('tab-', ''))"

FOCUSED = """() => {
  const at = document.activeElement;
  const { width, height } = at.getBoundingClientRect();
  const name = at.ariaLabel || at.title || at.labels?.length || at.textContent.trim();
  const left = at === document.body || at.tagName === 'IFRAME';
  const repeated = at.dataset.focused === 'yes';
  at.dataset.focused = 'yes';
  return [left, at.id || at.outerHTML.slice(0, 90), width * height > 0, Boolean(name), repeated];
}"""

LAYOUT_SHIFT = """() => new Promise((resolve) => {
  let sum = 0;
  const observer = new PerformanceObserver((list) => list.getEntries().forEach(({ value }) => (sum += value)));
  observer.observe({ type: 'layout-shift', buffered: true });
  setTimeout(() => resolve(sum), 300);
})"""


@pytest.mark.parametrize("theme", ["light", pytest.param("dark", marks=pytest.mark.long)])
def test_tabs_and_dialogs_are_accessible(open_page: Any, theme: str) -> None:
    page = open_page(theme=theme)
    violations = {"all": page.violations()}
    tabs = page.page.locator("[role=tab]").evaluate_all(TABS)
    for tab in tabs:
        if tab == "rerun":
            continue  # its viewer starts slowly; test_recordings.py checks it
        page.page.evaluate(f"() => document.querySelector('#tab-{tab}').click()")
        page.until(f"() => !document.querySelector('#{tab}').matches('[aria-busy=true], :has([aria-busy=true])')")
        violations[tab] = page.violations(f"#{tab}")
    dialogs = {"keys": "#help", "maps-options": "#maps-view", "jobs": "#jobs-button", "scene-options": "#scene-layers"}
    for dialog, button in dialogs.items():
        if dialog == "scene-options":
            page.page.evaluate("() => document.querySelector('#tab-scene').click()")
        page.page.evaluate(f"() => document.querySelector('{button}').click()")
        violations[dialog] = page.violations(f"#{dialog}")
        page.page.keyboard.press("Escape")
    assert {name: lines for name, lines in violations.items() if lines} == {}


@pytest.mark.long
def test_tab_key_visits_every_control_once(open_page: Any) -> None:
    page = open_page("?tab=failures")
    assert page.page.evaluate(LAYOUT_SHIFT) < 0.05
    stops: list[str] = []
    for _ in range(80):
        page.page.keyboard.press("Tab")
        left, control, visible, named, repeated = page.page.evaluate(FOCUSED)
        if left:
            break
        assert visible, f"{control} has the focus but is invisible"
        assert named, f"{control} has no accessible name"
        assert not repeated, f"{control} has the focus twice"
        stops.append(control)
    assert len(stops) < 80, "the focus does not leave the page"
    order = ["filter", "play", "save", "tab-failures", "maps-view", "tracks"]
    assert [stop for stop in stops if stop in order] == order
