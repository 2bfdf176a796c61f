"""Windows smaller than a laptop's screen, also by zooming the page: names are whole, and all panels can be reached."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

CUT = """(selects) => selects.filter((select) => {
  const width = select.offsetWidth;
  Object.assign(select.style, { flex: 'none', maxWidth: 'none' });
  const isCut = select.offsetWidth > width + 1;
  Object.assign(select.style, { flex: '', maxWidth: '' });
  return isCut;
}).map((select) => select.id)"""
"""Returns the names of the select elements that are narrower than their selected names."""


SMALLEST_GAP = """(tabs) => {
  const names = [...tabs.children].map((tab) => {
    const range = document.createRange();
    range.selectNodeContents(tab);
    return range.getBoundingClientRect();
  });
  return Math.min(...names.slice(1).map(({ left }, i) => left - names[i].right));
}"""
"""Returns the smallest distance between the names of two tabs, px."""


def test_names_are_whole_or_cut_last(open_page: Any) -> None:
    page = open_page(size=(1280, 720))
    names = page.page.locator(".pickers select:visible")
    assert [name.input_value() for name in names.all()][:2] == ["door", "crossmodal-pf"]
    assert names.evaluate_all(CUT) == []
    page.page.set_viewport_size({"width": 1024, "height": 768})
    assert names.evaluate_all(CUT) == ["episode"], "the episode's properties are cut first"
    tabs = page.page.locator("#views .tabs")
    assert tabs.evaluate("(tabs) => tabs.scrollWidth <= tabs.clientWidth")
    assert tabs.evaluate(SMALLEST_GAP) >= 4.0, "names run together"


def test_the_legend_of_the_maps_names_the_end_effector_in_small_windows(open_page: Any) -> None:
    page = open_page("?task=push&filter=crossmodal-ekf&episode=9", size=(1024, 768))
    marks, name = page.page.locator("#maps .marks"), page.page.locator(".marks .if-effector")
    for size in ((1024, 768), (1280, 720)):
        page.page.set_viewport_size(dict(zip(("width", "height"), size, strict=True)))
        box, inner = marks.bounding_box(), name.bounding_box()
        assert inner is not None
        assert inner["y"] + inner["height"] <= box["y"] + box["height"]


def test_a_page_at_200_percent_scrolls_and_cuts_no_name(open_page: Any) -> None:
    """In a window of 1280 x 800, the page then has 640 x 400 px."""
    page = open_page("?task=push&filter=crossmodal-ekf&episode=9", size=(640, 400))
    assert page.page.locator(".pickers select:visible").evaluate_all(CUT) == []
    finding = page.page.locator("#finding .sentence > :not([hidden])")
    assert finding.evaluate_all("(texts) => texts.filter((e) => e.scrollHeight > e.clientHeight + 1).length") == 0
    assert page.page.locator(".pickers label span").first.bounding_box()["y"] >= 0
    panels = [page.page.locator(panel).bounding_box() for panel in ("#views", "#maps", "#step", "#timeline")]
    for upper, lower in pairwise(panels):
        assert upper["y"] + upper["height"] <= lower["y"], "panels overlap"
    page.page.locator("#timeline .bar").scroll_into_view_if_needed()
    page.page.mouse.move(320, 200)
    window = page.page.evaluate("() => beliefscope.state().window")
    page.page.mouse.wheel(0, 5000)  # with any panel under the pointer
    page.until("() => innerHeight - document.querySelector('#timeline').getBoundingClientRect().bottom > 0")
    assert page.page.evaluate("() => beliefscope.state().window") == window
    bar = page.page.locator("#timeline > .bar > :visible")
    assert bar.evaluate_all("(items) => items.every((e) => e.getBoundingClientRect().right <= innerWidth)")
