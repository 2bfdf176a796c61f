"""Experiments tab: results are sorted, filtered and opened at their worst step."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import pretrained_path
from beliefscope.inspect.sweep import Cell, Inputs
from beliefscope.recordings.experiments import Experiments
from beliefscope.recordings.sweep_table import run_sweep

READY = "() => document.querySelector('#experiments').dataset.state === 'ready'"


@pytest.mark.long
def test_from_a_sweep_to_its_worst_moment(open_page: Any, server: Any, tmp_path: Path) -> None:
    page = open_page("?tab=experiments&sweep=none", size=(1440, 900))
    page.until("() => document.querySelector('#experiments').dataset.state === 'empty'")
    assert "beliefscope serve --sweep" in page.page.locator("#experiments .note").text_content()

    paths = []
    for width, name in enumerate(("image-ekf", "haptics-ekf")):
        paths.append(Path(shutil.copy(pretrained_path("door", name), tmp_path / f"{name}.safetensors")))
        paths[-1].with_suffix(".json").write_text(
            json.dumps({"width": width, "run": f"https://tracker.example/{name}"})
        )
    with open_dataset(sample_path("door")) as sample:
        episodes = tuple(sample.held_out()[:3])
    cells = [
        Cell(**{**vars(cell), "episodes": episodes})
        for cell in Inputs(tuple(paths), faults=("", "blackout=0.8")).cells()
    ]
    folder = server.workspace / "sweep"
    run_sweep(cells, folder)
    worst = Experiments([folder]).overview("contact").to_pylist()
    try:
        page.page.reload()
        page.until(READY)
        panel = page.page.locator("#experiments")
        panel.locator("select.steps").select_option("contact")
        page.until("() => location.search.includes('steps=contact')")
        names = "() => [...document.querySelectorAll('#experiments tbody button')].map((b) => b.textContent)"
        page.until(f"() => ({names})().join() === '{','.join(row['name'] for row in worst)}'")
        assert panel.locator("circle").count() == 4
        panel.locator("thead button", has_text="NEES").click()
        order = ",".join(row["name"] for row in sorted(worst, key=lambda row: -row["nees"]))
        page.until(f"() => ({names})().join() === '{order}'")
        assert page.state["sort"] == "-nees"
        panel.locator("thead th", has_text="width").hover()
        panel.get_by_label("Pin width").click()
        page.until("() => document.querySelectorAll('#experiments thead th')[1].innerText.includes('width')")
        assert page.state["pinned"] == "width"
        assert panel.locator("tbody td a").first.get_attribute("href").startswith("https://tracker.example/")
        with page.page.expect_download() as saved:
            panel.locator(".csv").click()
        assert Path(saved.value.path()).read_text().startswith("checkpoint,width,")
        panel.locator("select.rows").select_option("seeds")
        assert panel.locator(".group-by").text_content() == "Group by 1 of 2 entries…"  # without addresses
        panel.locator(".group-by").click()
        panel.get_by_role("checkbox", name="width").uncheck()
        page.until("() => new URLSearchParams(location.search).get('groups') === ','")
        page.page.keyboard.press("Escape")
        assert "Sweep “none” does not exist here" in panel.locator(".problems").text_content()
        panel.locator("select.x").select_option("level:blackout")
        page.until("() => document.querySelectorAll('#experiments .curve').length === 2")  # one for each filter
        panel.locator("tbody button").first.click()
        page.until("() => document.querySelectorAll('#experiments .episodes li').length === 1")  # the only seed
        panel.locator(".episodes li button").click()
        page.until("() => document.querySelectorAll('#experiments .episodes li').length === 3")
        assert page.state["rows"] == "checkpoints"
        panel.locator("input.match").fill("haptics blackout")
        page.until("() => document.querySelectorAll('#experiments tbody tr').length === 1")
        panel.locator("tbody button").click()
        page.until("() => document.querySelectorAll('#experiments .episodes li').length === 3")
        page.screenshot("experiments")
        (row,) = (r for r in worst if r["name"].endswith("haptics-ekf") and r["faults"])
        episode = (
            Experiments([folder]).episodes(row["checkpoint"], row["data"], row["faults"], "contact").to_pylist()[0]
        )
        panel.locator(".episodes a").first.click()
        page.until("() => beliefscope.state().tab === 'scene'")
        selection = {"filter": "haptics-ekf", "faults": "blackout=0.8", "episode": episode["episode"]}
        assert page.state.items() >= {**selection, "step": episode["worst_step"]}.items()
    finally:
        shutil.rmtree(folder)


@pytest.mark.long
def test_a_slow_or_failed_load_is_reported(open_page: Any, server: Any) -> None:
    """Before the modules of the tabs arrive, while the sweeps load, and after an error."""
    waiting: list[Any] = []
    page = open_page()

    def answer(address: str) -> None:
        for _ in range(400):
            if waiting:
                break
            page.page.wait_for_timeout(50)
        waiting.pop().continue_()
        page.page.unroute(address)

    page.page.route("**/tabs/tabs.js", lambda route: waiting.append(route))
    page.page.goto(f"{server.url}?tab=experiments")
    page.page.locator("#tabs-state").filter(has_text="Loading …").wait_for()
    note = page.page.locator("#experiments .note")
    failure = {"status": 500, "json": {"error": "The table is on a broken disk"}}
    page.page.route("**/api/experiments", lambda route: route.fulfill(**failure))
    answer("**/tabs/tabs.js")
    page.until("() => document.querySelector('#experiments').dataset.state === 'error'")
    assert "The table is on a broken disk." in note.text_content()
    page.page.route("**/api/experiments", lambda route: waiting.append(route))
    note.get_by_role("button", name="Try again").click()
    page.until("() => document.querySelector('#experiments').dataset.state === 'loading'")
    assert note.text_content() == "Loading …"
    answer("**/api/experiments")
    page.until("() => document.querySelector('#experiments').dataset.state === 'empty'")
    page.errors = [error for error in page.errors if "500" not in error]
