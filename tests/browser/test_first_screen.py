"""First visit: the finding, examples and tour; separators and layouts of the panels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

EXAMPLES = 5

VISIBLE = """(selectors) => selectors.filter((selector) => {
  const { left, top, right, bottom } = document.querySelector(selector).getBoundingClientRect();
  return !(right > left && bottom > top && left >= 0 && top >= 0 && right <= innerWidth && bottom <= innerHeight);
})"""


TAB_SPACE = """() => {
  const bar = document.querySelector('#views .tabs');
  const spaces = [...bar.children].map((tab) => {
    const range = document.createRange();
    range.selectNodeContents(tab);
    const [outer, inner] = [tab.getBoundingClientRect(), range.getBoundingClientRect()];
    return [Math.min(inner.left - outer.left, outer.right - inner.right), range.getClientRects().length];
  });
  const [least, lines] = [Math.min(...spaces.map(([s]) => s)), Math.max(...spaces.map(([, n]) => n))];
  return [least, lines, bar.scrollWidth - bar.clientWidth];
}"""
"""px beside the name of a tab, number of its lines, and px of the bar that are scrolled out of view."""


def test_a_first_visit_shows_a_finding_with_its_moment_and_evidence(open_page: Any) -> None:
    page = open_page(scene=True, size=(1280, 720))
    assert (page.state["task"], page.state["weights"]) == ("push-field", "effective")
    step = page.state["step"]
    finding = page.page.locator("#finding .sentence")
    assert f"goes dark at step {step + 1}, in contact; haptics takes over" in finding.text_content()
    assert "The mean effective weight of haptics in x rises" in finding.text_content()
    parts = ["#finding strong", "#finding span", "#heatmaps canvas", "#step-table", "#tracks .cursor", "#intro .chip"]
    assert page.page.evaluate(VISIBLE, parts) == []
    assert not page.violations()
    labels = page.page.locator(".pickers label:not([hidden]) span")
    assert labels.all_text_contents() == ["Task", "Filter", "Episode", "Faults"]
    clipping = "(spans) => spans.map((span) => getComputedStyle(span).clipPath)"
    assert set(labels.evaluate_all(clipping)) == {"none"}
    assert page.page.locator("#episode").get_attribute("title").startswith("Episode: 13 · pushed")
    assert "brackets: end effector" in page.page.locator(".marks .key-marks").get_attribute("title")

    # Long evidence has two lines; on focus, the complete text is below it.
    page.page.evaluate("(text) => (document.querySelector('#finding .sentence span').textContent = text)", "word " * 60)
    lines = "({ scrollHeight, clientHeight }) => [scrollHeight - clientHeight, clientHeight]"
    assert page.page.locator("#finding .sentence span").evaluate(lines)[1] == 2 * 15
    page.page.locator("#find").focus()
    page.page.keyboard.press("Shift+Tab")
    finding.focus()
    full = page.page.locator("#finding .full-text")
    page.until("() => document.querySelector('#finding .full-text').matches(':popover-open')")
    assert full.text_content() == finding.get_attribute("title")
    page.page.keyboard.press("Escape")
    assert not full.is_visible()
    page.page.locator("#finding .go-to-step").click()
    page.until(f"() => beliefscope.state().step === {step + 1}")

    # The tour explains six parts and returns the focus.
    start = page.page.locator("#intro .start-tour")
    start.click()
    box = page.page.locator("#tour")
    for number in range(1, 7):
        assert box.locator("span").text_content() == f"{number} of 6"
        assert page.page.locator(".toured").count() == 1
        assert page.page.evaluate(VISIBLE, ["#tour"]) == []
        if number == 2:
            assert not page.violations("#tour")
            page.screenshot("tour")
        page.page.keyboard.press("Enter")
    assert not box.is_visible()
    assert page.page.evaluate("() => document.activeElement.className").endswith("start-tour")
    assert page.page.locator(".toured").count() == 0

    chips = page.page.locator("#intro .chip")
    assert chips.count() == EXAMPLES
    chips.filter(has_text="Real push").click()
    setup = page.page.get_by_role("dialog", name="Real push")
    assert setup.locator("pre").text_content() == "beliefscope serve --data mit_push"
    page.page.keyboard.press("Escape")
    assert not setup.is_visible()
    chips.filter(has_text="Frozen image").click()
    page.until("() => document.querySelector('#finding').dataset.source === 'fault'")
    assert page.state["faults"].startswith("image_frozen")
    assert finding.text_content().startswith("Image frozen from step 3")
    page.until("() => document.querySelector('#diagnosis').dataset.finding === 'fault'")
    page.page.get_by_role("button", name="Close the introduction").click()
    assert page.page.locator("#intro").is_hidden()
    again = open_page()
    assert again.page.locator("#intro").is_hidden(), "closing the introduction is not remembered"


@pytest.mark.long
def test_separators_and_layouts_resize_the_panels(open_page: Any) -> None:
    page = open_page("?step=20", size=(1280, 720))

    def size(selector: str) -> dict[str, float]:
        return page.page.locator(selector).bounding_box() or {"width": 0.0, "height": 0.0}

    default = size("#maps")
    handle = size("#split-side")
    mouse = page.page.mouse
    mouse.move(handle["x"] + 3, handle["y"] + 200)
    mouse.down()
    mouse.move(handle["x"] - 117, handle["y"] + 200)
    mouse.up()
    wider = size("#maps")["width"]
    assert abs(wider - default["width"] - 120) < 10
    separator = page.page.locator("#split-side")
    assert abs(int(separator.get_attribute("aria-valuenow")) - 100 * wider / 1268) < 1.5
    page.page.keyboard.press("ArrowRight")  # the separator has the focus
    assert size("#maps")["width"] < wider - 15
    assert page.state["step"] == 20
    page.page.keyboard.press("Enter")
    assert not page.page.locator("#maps").is_visible()
    assert not page.violations("main")
    page.page.keyboard.press("Enter")
    narrower = size("#maps")["width"]
    assert narrower > 500

    page.page.locator("#split-timeline").focus()
    before = size("#timeline")["height"]
    page.page.keyboard.press("Shift+ArrowUp")
    assert abs(size("#timeline")["height"] - before - 72) < 3
    chosen = size("#timeline")["height"]
    page.page.keyboard.press("2")  # Rerun, whose smaller timeline yields to the chosen height
    page.until("() => beliefscope.state().tab === 'rerun'")
    assert size("#timeline")["height"] == chosen
    page.page.keyboard.press("1")
    page.until("() => beliefscope.state().tab === 'scene'")
    second = open_page("?step=20", size=(1280, 720))
    assert second.page.locator("#maps").bounding_box()["width"] == narrower, "sizes are not remembered"

    # Tabs without the run fill the page; one key returns to it.
    page.page.evaluate("() => localStorage.removeItem('beliefscope.sizes')")
    page.page.reload()
    page.until("() => window.beliefscope?.stats.maps?.size === 135")
    page.page.keyboard.press("u")
    page.until("() => !document.querySelector('#study').hidden")
    assert size("#views")["width"] > 1260
    assert not page.page.locator("#timeline").is_visible()
    page.page.keyboard.press("g")
    page.until("() => document.querySelectorAll('#tracks .track').length === 3")
    assert size("#maps") == default

    # Layouts: from the menu at its button; the first one has the default sizes.
    page.page.locator("#layout").click()
    assert not page.violations("#layouts")
    menu, button = size("#layouts"), size("#layout")
    assert 0 <= menu["y"] - button["y"] - button["height"] < 10
    page.page.get_by_role("button", name="Compare two runs").click()
    page.until("() => beliefscope.state().tab === 'compare'")
    assert size("#timeline")["height"] > 0.45 * 720
    page.page.locator("#layout").click()
    page.page.get_by_role("button", name="Maps large").click()
    assert size("#maps")["width"] > 1.5 * default["width"]
    page.screenshot("layout-maps")
    page.page.locator("#layout").click()
    page.page.get_by_role("button", name="Explore").click()
    assert size("#maps") == default


def check_names_of_tabs(page: Any) -> None:
    """In the narrow panel, with the widest selected name and a running job, without wrapping or scrolling."""
    assert page.state["tab"] == "diagnostics"
    page.page.set_viewport_size({"width": 1024, "height": 768})
    page.page.evaluate("document.querySelector('#jobs-button').dataset.active = '1'")
    space, lines, hidden = page.page.evaluate(TAB_SPACE)
    assert space >= 4.0
    assert lines == 1
    assert hidden == 0


@pytest.mark.long
def test_names_of_tabs_have_space_beside_their_dividers(start_server: Callable[..., Any], open_page: Any) -> None:
    """On a read-only server; test_tabs_that_fail_to_load checks them on another one."""
    check_names_of_tabs(open_page("?task=door&tab=diagnostics", url=start_server("--read-only").url))


@pytest.mark.long
def test_tabs_that_fail_to_load_say_so_and_are_tried_again(open_page: Any, server: Any) -> None:
    """Of a server that fails while the run is displayed; the run and the scene stay usable."""
    page = open_page("?tab=diagnostics")
    check_names_of_tabs(page)
    for module in ("tabs", "scatter"):
        page.page.route(f"**/tabs/{module}.js", lambda route: route.abort())
        page.page.goto(f"{server.url}?tab=study")
        note = page.page.locator("#tabs-state > .note")
        note.filter(has_text="The tabs cannot be loaded").wait_for()
        for tab in ("Recordings", "Diagnosis"):
            page.page.get_by_role("tab", name=tab).click()
            note.wait_for(state="visible")
        page.page.get_by_role("tab", name="Scene").click()
        note.wait_for(state="hidden")
        page.page.get_by_role("tab", name="Study").click()
        page.page.unroute(f"**/tabs/{module}.js")
        note.get_by_role("button", name="Try again").click()
        page.page.locator("#study .top, #study .note").first.wait_for()
        page.until("() => document.documentElement.classList.contains('with-tabs')")
        assert note.is_hidden()
    page.errors[:] = [line for line in page.errors if "ERR_FAILED" not in line]
