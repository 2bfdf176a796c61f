"""Diagnostics tab, and the jobs of slow diagnostics."""

from __future__ import annotations

import json
from typing import Any

import pytest

EPISODE = 9
TAB = f"?tab=diagnostics&episode={EPISODE}"
READY = "() => document.querySelector('#diagnostics article').dataset.state === 'ready'"


def row(page: Any, title: str) -> Any:
    return page.page.locator("#diagnostics li").filter(has=page.page.get_by_role("button", name=title, exact=True))


def open_diagnostic(open_page: Any, name: str, parameters: str = "", **options: Any) -> Any:
    page = open_page(f"{TAB}&diagnostic={name}{parameters}", **options)
    page.until(READY)
    return page


def test_list_has_verdicts_and_reasons(open_page: Any) -> None:
    page = open_page(f"{TAB}&filter=crossmodal-ekf&step=40", size=(1024, 768), theme="dark")
    page.until(
        "() => [...document.querySelectorAll('#diagnostics li')].length"
        " && ![...document.querySelectorAll('#diagnostics li')].some((e) => e.dataset.state === 'loading')"
    )
    listed = page.page.request.get(f"{page.url}api/diagnostics").json()
    rows = page.page.evaluate(
        "() => [...document.querySelectorAll('#diagnostics li')]"
        ".map((e) => [e.dataset.state === 'refused', e.querySelector('.title').textContent])"
    )
    titles = [entry["title"] for entry in listed]
    slow = {entry["title"] for entry in listed if entry["slow"]}
    # Slow diagnostics come after the others, and those that do not apply last.
    order = sorted(rows, key=lambda entry: (entry[0], not entry[0] and entry[1] in slow, titles.index(entry[1])))
    assert rows == order
    assert sorted(title for _, title in rows) == sorted(titles)
    assert row(page, "Particle health").get_attribute("data-state") == "refused"
    assert row(page, "Particle health").locator(".verdict").text_content() == "Filter crossmodal-ekf has no particles."
    assert "NEES/n" in row(page, "Consistency").locator(".verdict").text_content()
    page.until("() => document.querySelector('#step-summary').textContent.includes('By source: ')")
    overflow = page.page.evaluate(
        "() => [...document.querySelectorAll('#diagnostics, #diagnostics .top, #diagnostics .list, .bar')]"
        ".map((e) => e.scrollWidth - e.clientWidth)"
    )
    assert max(overflow) <= 1
    page.screenshot("diagnostics")


def test_diagnostic_is_opened_by_keyboard_and_in_the_permalink_and_its_table_is_copied(open_page: Any) -> None:
    page = open_page(f"?episode={EPISODE}&step=40", clipboard=True)
    page.page.keyboard.press("3")
    page.until("() => document.querySelector('#diagnostics li[data-state=ready]')")
    row(page, "Consistency").get_by_role("button").first.focus()
    page.page.keyboard.press("Enter")
    page.until(READY)
    page.until(
        "() => location.search.includes('tab=diagnostics') && location.search.includes('diagnostic=consistency')"
    )
    second = open_page("?" + page.page.url.partition("?")[2])
    second.until(READY)
    assert second.state == page.state
    assert second.page.locator("#diagnostics article > .verdict").text_content().startswith("No alarm")
    page.page.keyboard.press("Enter")  # the back button has the focus
    page.until("() => beliefscope.state().diagnostic === ''")
    assert page.page.evaluate("() => document.activeElement.textContent") == "Consistency"
    second.page.bring_to_front()  # only the visible page may use the clipboard
    check_copied_table(second)


def check_copied_table(page: Any) -> None:
    """A table is copied as CSV, with all digits."""
    result = page.page.request.get(f"{page.url}api/diagnostics/consistency/door/crossmodal-pf/{EPISODE}").json()
    table = result["tables"][0]
    page.page.get_by_role("button", name=f"Copy {table['title']} as CSV").click()
    page.until("() => [...document.querySelectorAll('.table button')].some((b) => b.textContent === 'Copied')")
    lines = page.page.evaluate("() => navigator.clipboard.readText()").splitlines()
    assert lines[0].split(",") == table["columns"]
    assert len(lines) == 1 + len(table["rows"])
    assert float(lines[1].split(",")[table["columns"].index("NEES/n")]) == table["rows"][0][4]
    # The page shows three digits, aligned to the right.
    cell = page.page.locator(".figures tbody tr").first.locator("td").nth(4)
    assert float(cell.text_content()) == pytest.approx(table["rows"][0][4], rel=5e-3)
    assert cell.evaluate("(e) => getComputedStyle(e).textAlign") == "right"


@pytest.mark.long
def test_charts_and_cursor_are_synchronized(open_page: Any) -> None:
    page = open_diagnostic(open_page, "particles", "&step=40&faults=blackout%3D0.4", size=(1440, 900))
    plot = page.page.locator(".curves .u-over").first
    box = plot.bounding_box()
    mark = page.page.locator(".curves .mark.cursor").first
    steps = int(page.page.locator("#readout b").text_content().split("/")[1])

    def cursor_step() -> float:
        """Step of the cursor in the chart."""
        at = mark.bounding_box()
        return steps * (at["x"] + at["width"] / 2 - box["x"]) / box["width"]

    assert cursor_step() == pytest.approx(40, abs=0.5)
    value = page.page.locator(".curves .line b").first
    before = value.text_content()
    page.screenshot("diagnostic")
    page.page.mouse.move(box["x"] + 0.2 * box["width"], box["y"] + 30)
    page.page.mouse.down()
    page.page.mouse.move(box["x"] + 0.7 * box["width"], box["y"] + 30)
    page.page.mouse.up()
    page.until(f"() => Math.abs(beliefscope.state().step - {0.7 * steps}) <= 1")
    page.settle(page.state["step"])  # maps and scene follow
    assert cursor_step() == pytest.approx(page.state["step"], abs=0.5)
    assert value.text_content() != before
    page.page.locator("#tracks").focus()
    page.page.keyboard.press("Home")
    page.settle(0)
    assert cursor_step() == pytest.approx(0, abs=0.5)


@pytest.mark.long
def test_slow_diagnostic_survives_a_reload(open_page: Any) -> None:
    page = open_page(f"{TAB}&diagnostic=maps&filter=crossmodal-ekf")
    page.until("() => document.querySelector('#diagnostics article').dataset.state === 'absent'")
    page.page.locator(".options input[name=size]").fill("21")
    page.page.locator(".options input[name=size]").press("Enter")
    compute = page.page.locator("#diagnostics article").get_by_role("button", name="Compute: Likelihood maps")
    compute.click()
    page.until("() => document.querySelector('#diagnostics article').dataset.state !== 'absent'")
    page.until("() => location.search.includes('options=size%3D21')")
    page.page.reload()
    page.until("() => window.beliefscope?.stats.maps")
    page.page.keyboard.press("j")
    jobs = page.page.locator("#jobs li")
    page.until("() => document.querySelector('#jobs li[data-state=done]')")
    assert jobs.first.locator("h3").text_content() == f"Likelihood maps of crossmodal-ekf, door episode {EPISODE}"
    jobs.first.locator("summary").click()
    page.until("() => document.querySelector('#jobs pre').textContent")
    page.screenshot("jobs")
    link = jobs.first.get_by_role("link").get_attribute("href")
    for part in ("filter=crossmodal-ekf", "diagnostic=maps", "options=size%3D21"):
        assert part in link
    page.page.keyboard.press("Escape")
    assert not page.page.locator("#jobs").is_visible()
    page.page.keyboard.press("Space")  # plays, and does not press the button of the list again
    page.until("() => beliefscope.state().playing")
    assert not page.page.locator("#jobs").is_visible()
    page.page.keyboard.press("Space")
    page.until(READY)
    assert page.page.locator(".options input[name=size]").input_value() == "21"
    assert "the haptics likelihood is" in page.page.locator("#diagnostics article > .verdict").text_content()
    assert page.page.locator(".curves figure").count() >= 2


@pytest.mark.long
def test_held_out_diagnostic_is_a_job_that_can_be_cancelled(open_page: Any) -> None:
    page = open_page(f"{TAB}&diagnostic=weights")
    page.until(READY)
    assert page.page.locator(".curves figure").count() > 0
    page.page.get_by_text("all held-out").click()
    page.until("() => document.querySelector('#diagnostics article').dataset.state === 'absent'")
    page.until("() => location.search.includes('over=held-out')")
    article = page.page.locator("#diagnostics article")
    article.get_by_role("button", name="Compute").click()
    article.get_by_role("button", name="Cancel").click()
    page.until("() => document.querySelector('#diagnostics article').dataset.state === 'ended'")
    assert article.locator("> .verdict").text_content() == "Cancelled."
    article.get_by_role("button", name="Try again").click()
    page.until(READY, timeout=180.0)
    assert "oo few episodes" not in article.locator("> .verdict").text_content()  # a note of single episodes
    assert page.page.locator(".curves figure").count() == 0
    page.screenshot("held-out")


FIGURES = {
    "verdict": "All kinds of figures.",
    "trajectories": 1,
    "tables": [{"title": "Values", "columns": ["a", "b (cm)"], "rows": [["x, y", None], ['say "x"', 0.000123456]]}],
    "curves": [
        {"name": n, "values": [None, *range(99)], "chart": "Any", "unit": "cm", "layer": layer, "bounds": None}
        for n, layer in (("first", "image"), ("second", "image"), ("third", ""))
    ],
    "bands": {"contact": [False] * 50 + [True] * 50},
    "plots": [
        {
            "title": kind,
            "x_label": "x (cm)",
            "y_label": "y",
            "kind": kind,
            "diagonal": kind == "line",
            "lines": [{"name": "", "layer": "haptics", "x": [0, 1, 2], "y": [-1.0, None, 2.0]}],
        }
        for kind in ("line", "points", "bars")
    ],
    "images": [
        {"title": "signed", "values": [[-2.0, 0.0], [1.0, None]], "unit": "cm", "signed": True},
        {"title": "unsigned", "values": [[0.0, 4.0], [1.0, 2.0]], "unit": "", "signed": False},
    ],
}


def test_every_kind_of_figure_is_drawn(open_page: Any) -> None:
    page = open_page(f"?episode={EPISODE}&step=40")
    page.page.route(
        "**/api/diagnostics/weights/**",
        lambda route: route.fulfill(status=200, content_type="application/json", body=json.dumps(FIGURES)),
    )
    page.page.keyboard.press("3")
    page.until("() => document.querySelector('#diagnostics li')")
    row(page, "Weight audit").click()
    page.until("() => document.querySelectorAll('.panels figure').length === 5")
    pixels = page.page.evaluate(
        "() => [...document.querySelectorAll('.pixel-map > canvas')]"
        ".map((c) => [...c.getContext('2d').getImageData(0, 0, 2, 2).data])"
    )
    signed, unsigned = ([tuple(p[4 * i : 4 * i + 4]) for i in range(4)] for p in pixels)
    assert signed[0] == (0x05, 0x30, 0x61, 255)  # the lowest value is dark blue, as the scale is symmetric
    assert min(signed[1][:3]) > 240  # zero is white
    assert signed[2][0] > signed[2][2]  # positive values are red
    assert signed[3][3] == 0  # missing values are transparent
    assert unsigned[0] == (0x44, 0x01, 0x54, 255)
    assert unsigned[1] == (0xFD, 0xE7, 0x25, 255)
    for kind in ("line", "points", "bars"):
        figure = page.page.locator(".panels figure").filter(has_text=kind).first
        colours = figure.locator("canvas").first.evaluate(
            "(c) => [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data].filter((_, i) => i % 4 === 0)"
        )
        assert len(set(colours)) > 2
    dashes = page.page.locator(".curves .swatch path").evaluate_all(
        "(all) => all.map((p) => p.getAttribute('stroke-dasharray'))"
    )
    assert len(set(dashes)) == 3  # lines also differ without colour
    assert page.page.locator(".figures tbody td").all_text_contents() == ["x, y", "\N{EN DASH}", 'say "x"', "0.000123"]
    page.screenshot("diagnostic-figures")
