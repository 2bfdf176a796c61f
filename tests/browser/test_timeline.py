"""Timeline: tracks, zoom, event marks and a comparison run."""

from __future__ import annotations

import csv
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

EPISODE = 9
LINK = f"?filter=crossmodal-ekf&episode={EPISODE}&step=40"
MINUS = "\N{MINUS SIGN}"

ADD_COMPARISON = """async () => {
  const api = await import('/static/data/api.js');
  const { task: name, data, episode } = beliefscope.state();
  const task = (await api.catalog()).tasks.find((t) => t.name === name);
  const selection = { task: name, filter: 'unimodal-ekf', data, episode, faults: '' };
  const other = await api.loadTrace(task, selection, () => {}, new AbortController().signal);
  beliefscope.timeline.compareWith(other, 'unimodal-ekf');
}"""
MARKS = "() => [...document.querySelectorAll('#marks button')].map((b) => b.getBoundingClientRect().x)"
LEGEND = """(track) => {
  const rows = [];
  for (const cell of document.querySelectorAll('#tracks .track')[track].querySelectorAll('dt, dd')) {
    if (cell.tagName === 'DT') rows.push([cell.title]);
    else rows.at(-1).push(cell.textContent);
  }
  return rows;
}"""


def column(page: Any, name: str, filter_: str = "crossmodal-ekf") -> np.ndarray[Any, Any]:
    """A column of a trace from the server."""
    url = f"{page.url}api/trace/door/{filter_}/{EPISODE}"
    entry = next(c for c in page.page.request.get(url).json()["columns"] if c["name"] == name)
    buffer = page.page.request.get(f"{url}/columns").body()
    return np.frombuffer(buffer, "<f4", int(np.prod(entry["shape"])), entry["offset"]).reshape(entry["shape"])


def legend(page: Any, track: int) -> dict[str, list[float | None]]:
    """Legend of a track: name -> value, and value of the comparison run."""
    rows = page.page.evaluate(LEGEND, track)
    return {name: [float(v.replace(MINUS, "-")) if v else None for v in values] for name, *values in rows}


def near(value: float) -> Any:
    """Within the rounding to one decimal."""
    return pytest.approx(value, abs=0.051)


def test_tracks_zoom_and_permalink(open_page: Any) -> None:
    page = open_page(LINK + "&track=nees&window=20-60")
    mouse, slider = page.page.mouse, page.page.locator("#tracks")
    nees = column(page, "nees")
    names = ("image-only update", "haptics-only update", "fused")
    assert page.page.evaluate("() => document.querySelector('#reset-zoom').disabled") is False
    assert {name: value for name, (value,) in legend(page, 2).items()} == {
        n: pytest.approx(v, rel=6e-3) for n, v in zip(names, nees[40], strict=True)
    }

    # The legend shows the values at the pointer; the layout stays.
    box, plot = slider.bounding_box(), page.page.locator("#tracks .u-over").first.bounding_box()

    def at(step: float, window: tuple[float, float]) -> float:
        return plot["x"] + plot["width"] * (step - window[0]) / (window[1] - window[0])

    rows = (
        "() => JSON.stringify([...document.querySelectorAll('#tracks .track')].map((r) => r.getBoundingClientRect()))"
    )
    before = page.page.evaluate(rows)
    mouse.move(at(30, (20, 60)), box["y"] + 100)
    assert page.page.locator("#timeline-readout").text_content() == "pointer 30 · 3.0 s"
    assert legend(page, 2)["fused"] == [pytest.approx(nees[30, 2], rel=6e-3)]
    values = page.page.locator(".hover-values")
    assert values.locator("p").text_content().startswith("step 30 \u00b7 3.0 s")
    fused = values.locator("tr", has=page.page.get_by_text("fused", exact=True)).locator("td").last
    assert float(fused.text_content()) == pytest.approx(nees[30, 2], rel=6e-3)
    assert page.page.evaluate(rows) == before
    mouse.move(box["x"] + 300, box["y"] - 200)
    assert page.page.locator("#timeline-readout").text_content() == "cursor 40 · 4.0 s"

    # Shift and drag zooms and keeps the cursor; so do keys; the permalink restores the window.
    page.page.keyboard.down("Shift")
    mouse.move(at(35, (20, 60)), box["y"] + 60)
    mouse.down()
    mouse.move(at(55, (20, 60)), box["y"] + 60)
    mouse.up()
    page.page.keyboard.up("Shift")
    assert [float(v) for v in page.state["window"].split("-")] == pytest.approx([35, 55], abs=0.2)
    assert page.state["step"] == 40
    page.page.keyboard.press("-")
    assert [float(v) for v in page.state["window"].split("-")] == pytest.approx([30, 70], abs=0.3)
    page.page.keyboard.press("PageUp")
    page.until("() => beliefscope.state().step === 44")
    page.until("() => location.search.includes('step=44') && location.search.includes('window=')")
    second = open_page("?" + page.page.url.partition("?")[2])
    assert second.state == page.state
    assert slider.get_attribute("aria-valuenow") == "44"
    assert re.fullmatch(r"step 44, 4\.4 s, error \d\.\d cm(, in contact)?", slider.get_attribute("aria-valuetext"))
    page.page.keyboard.press("0")
    assert page.state["window"] == ""

    # Pinch: each finger keeps its step.
    episode = (0, len(nees) - 1)
    touch = page.page.context.new_cdp_session(page.page)
    for kind, steps in (("touchStart", (40, 60)), ("touchMove", (20, 80)), ("touchEnd", ())):
        points = [{"x": at(step, episode), "y": box["y"] + 60, "id": i} for i, step in enumerate(steps)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    page.until("() => beliefscope.state().window.startsWith('33')")
    expected = [40 - 20 / 3, 40 - 20 / 3 + episode[1] / 3]
    assert [float(v) for v in page.state["window"].split("-")] == pytest.approx(expected, abs=0.3)
    page.page.keyboard.press("0")
    for _ in range(4):  # the first finger has set the cursor
        page.page.keyboard.press("ArrowRight")

    # Other tracks, and the reason where one is empty.
    page.page.locator("#track").select_option("innovation")
    page.until("() => document.querySelector('#tracks .track:last-of-type h3').textContent.startsWith('Innovation')")
    image, haptics = 100 * column(page, "innovation")[44, :, 0]
    assert legend(page, 2) == {"image": [near(image)], "haptics": [near(haptics)]}
    page.page.locator("#track").select_option("particles")
    page.until("() => document.querySelector('#tracks .track-note')?.textContent.includes('and no particles')")
    page.until("() => location.search.includes('track=particles')")
    page.screenshot("timeline-note")

    # Charts are added, moved and resized; the permalink keeps them, and the browser their heights.
    titles = "() => [...document.querySelectorAll('#tracks h3')].map((title) => title.textContent.split(/[ ,(]/)[0])"
    page.page.locator("#charts").click()
    page.page.get_by_label("NEES/n", exact=True).check()
    page.page.get_by_role("button", name="Move estimate up").click()
    assert page.page.evaluate("() => document.activeElement.ariaLabel") == "Move estimate down"
    assert not page.violations("#chart-menu")
    page.page.keyboard.press("Escape")
    page.until(f"() => ({titles})().join() === 'Hinge,Effective,Particles,NEES/n'")
    heights = "() => [...document.querySelectorAll('#tracks .track')].map((row) => row.offsetHeight)"
    before = page.page.evaluate(heights)
    page.page.locator(".track-splitter").nth(1).focus()
    page.page.keyboard.press("ArrowUp")
    after = page.page.evaluate(heights)
    assert np.allclose(np.subtract(after, before), [0, -10, 10, 0], atol=1)
    assert page.state["step"] == 44
    page.until("() => location.search.includes('charts=estimate')")
    third = open_page("?" + page.page.url.partition("?")[2])
    assert third.page.evaluate(titles) == ["Hinge", "Effective", "Particles", "NEES/n"]
    assert np.allclose(third.page.evaluate(heights), after, atol=1)
    third.page.locator("#charts").click()
    third.page.get_by_role("button", name="Reset charts and heights").click()
    third.until(f"() => ({titles})().join() === 'Effective,Hinge,Particles'")


@pytest.mark.long
def test_readings_are_charts_that_a_diagnosis_offers(open_page: Any) -> None:
    page = open_page(LINK + "&faults=force_bias%3D5&tab=diagnosis", size=(1280, 720))
    titles = "() => [...document.querySelectorAll('#tracks h3')].map((title) => title.textContent)"
    page.page.locator("#diagnosis").get_by_role("button", name="Show the readings of force").first.click()
    page.until(f"() => ({titles})().at(-1) === 'Force readings (N)'")
    clean = column(page, "readings/force")[40]  # of the run without faults
    assert legend(page, 3) == {"x": [near(clean[0] + 5)], "y": [near(clean[1])], "z": [near(clean[2])]}
    page.page.locator("#charts").click()
    page.page.get_by_label("readings of effector position", exact=True).check()
    page.page.get_by_label("readings of force", exact=True).uncheck()
    page.until(f"() => ({titles})().at(-1) === 'Effector position readings (cm)'")
    assert legend(page, 3)["z"] == [near(100 * column(page, "readings/effector_position")[40, 2])]
    page.until("() => location.search.includes('effector_position')")
    page.page.keyboard.press("Escape")
    assert not page.violations()
    page.screenshot("readings")
    again = open_page("?" + page.page.url.partition("?")[2])
    assert again.page.evaluate(titles)[-1] == "Effector position readings (cm)"


@pytest.mark.long
def test_event_marks_and_comparison_run(open_page: Any) -> None:
    page = open_page(LINK + "&track=signed", theme="dark")
    events = [{"step": s, "label": f"{s / 10} cm", "measure": "error"} for s in (70, 12, 55)]
    page.page.evaluate("(events) => beliefscope.timeline.mark(events)", events)
    marks = page.page.locator("#marks button")
    assert [m.get_attribute("aria-label") for m in marks.all()] == [
        f"Step {s}: error, {s / 10} cm" for s in (12, 55, 70)
    ]
    marks.nth(1).click()
    page.until("() => beliefscope.state().step === 55")
    centres = [page.page.locator(s).bounding_box() for s in ("#marks [aria-current]", "#tracks .cursor")]
    assert np.diff([c["x"] + c["width"] / 2 for c in centres]) == pytest.approx(0, abs=1)
    page.page.keyboard.press("ArrowRight")
    page.until("() => beliefscope.state().step === 56")
    marks.nth(1).focus()
    page.page.keyboard.press("ArrowRight")  # the next mark instead of the next step
    page.page.keyboard.press("Enter")
    page.until("() => beliefscope.state().step === 70")

    # The overview keeps the events of the whole episode; a drag in it, its handles and keys choose the visible steps.
    before = page.page.evaluate(MARKS)
    overview, mouse = page.page.locator("#overview canvas").bounding_box(), page.page.mouse

    def drag(first: float, last: float) -> list[float]:
        x, y = overview["x"], overview["y"] + overview["height"] / 2
        mouse.move(x + first / 99 * overview["width"], y)
        mouse.down()
        mouse.move(x + last / 99 * overview["width"], y, steps=4)
        mouse.up()
        return [float(v) for v in page.state["window"].split("-")]

    assert drag(25, 75) == pytest.approx([25, 75], abs=0.3)
    assert page.state["step"] == 70
    assert page.page.evaluate(MARKS) == before
    assert drag(75, 85) == pytest.approx([25, 85], abs=0.5), "the right handle"
    assert drag(50, 40) == pytest.approx([15, 75], abs=0.5), "the window"
    page.page.get_by_role("slider", name="First visible step").focus()
    page.page.keyboard.press("Shift+ArrowRight")
    assert [float(v) for v in page.state["window"].split("-")] == pytest.approx([25, 75], abs=0.5)
    page.page.locator("#overview").dblclick(position={"x": 60, "y": 8})
    assert page.state["window"] == ""
    marks.nth(2).click()
    page.until("() => beliefscope.state().step === 70")

    page.page.evaluate(ADD_COMPARISON)
    page.until("() => document.querySelector('#comparison-key').textContent === 'unimodal-ekf'")
    selected, comparison = (100 * column(page, "estimate_mean", f)[70, 0] for f in ("crossmodal-ekf", "unimodal-ekf"))
    assert legend(page, 1)["fused"] == [near(selected), near(comparison)]
    truth = 100 * column(page, "truth")[70, 0]
    assert legend(page, 2)["fused"] == [near(selected - truth), near(comparison - truth)]
    time.sleep(0.2)
    page.screenshot("timeline-comparison")
    assert (
        page.page.evaluate(
            "() => Math.max(...[...document.querySelectorAll('.bar')].map((e) => e.scrollWidth - e.clientWidth))"
        )
        <= 1
    )

    # A standalone filter is chosen beside the charts, and has a line of its own.
    page.page.locator("#standalone").select_option("haptics")
    page.until("() => document.querySelector('#comparison-key').textContent === 'haptics standalone'")
    assert page.state["against"] == "only=haptics"
    assert {"haptics-only update", "haptics standalone", "fused"} <= set(legend(page, 1))
    page.page.locator("#standalone").select_option("")
    page.until("() => document.querySelector('#comparison-key').hidden")
    page.page.evaluate(ADD_COMPARISON)
    page.until("() => document.querySelector('#comparison-key').textContent === 'unimodal-ekf'")

    # Another episode has neither these marks nor this comparison run.
    page.page.locator("#episode").select_option("8")
    page.until("() => document.querySelector('#comparison-key').hidden && !document.querySelector('#marks button')")
    assert len(legend(page, 1)["fused"]) == 1


@pytest.mark.long
def test_export_has_the_displayed_charts_steps_and_values(open_page: Any, tmp_path: Path) -> None:
    page = open_page(
        LINK + "&window=20-60&charts=estimate,track,readings/force&track=error&component=angle&time=seconds"
    )
    page.page.locator("#charts").click()
    files = {}
    for kind in ("SVG", "PDF", "CSV"):
        with page.page.expect_download() as download:
            page.page.locator("#chart-menu .export").get_by_text(kind).click()
        files[kind] = tmp_path / download.value.suggested_filename
        download.value.save_as(files[kind])
        page.until("() => document.querySelector('#chart-menu output').textContent === 'Saved.'")
    assert files["CSV"].name == f"door-crossmodal-ekf-episode{EPISODE}-timeline.csv"
    header, *rows = csv.reader(files["CSV"].read_text().splitlines())
    values = dict(zip(header, np.array(rows, dtype=float).T, strict=True))
    assert values["step"].tolist() == list(range(20, 61))
    for row, name in ((40, "fused"), (40, "haptics-only update")):
        key = name.replace(" ", "_").replace("-", "_")
        shown = [legend(page, track)[name][0] for track in (0, 1)]
        plotted = [values[f"{title}_{key}_deg"][row - 20] for title in ("angle", "angle_error")]
        assert shown == [near(value) for value in plotted]
    np.testing.assert_allclose(values["force_readings_x_N"], column(page, "readings/force")[20:61, 0], rtol=1e-6)
    assert files["PDF"].read_bytes().startswith(b"%PDF")
    assert "time (s)" in files["SVG"].read_text()

    page.page.evaluate("() => document.querySelector('#group').append(new Option('rain', 'rain', true, true))")
    page.page.locator("#chart-menu .export").get_by_text("CSV").click()
    page.until("() => document.querySelector('#chart-menu output').textContent.startsWith('Export failed: Group')")
    page.errors.clear()
