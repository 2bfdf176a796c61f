"""Recordings tab: upload, rename, search, delete, restore, compare, open in Rerun; and reports."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.trace import trace
from beliefscope.recordings.write import write_recording

READY = "() => document.querySelector('#recordings').dataset.state === 'ready'"
REPORT_TIMEOUT = 240.0  # s: several dozen figures
RECORDING_TIMEOUT = 180.0  # s: likelihood maps, next to a viewer with software rendering


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Recordings of two filters on one episode, outside the workspace."""
    folder = tmp_path_factory.mktemp("runs")
    with open_dataset(sample_path("push")) as data:
        episode = data[data.held_out()[0]]
        index = data.held_out()[0]
    paths = []
    for name in ("crossmodal-ekf", "image-ekf"):
        run = trace(load_checkpoint(pretrained_path("push", name)), episode, episode_index=index, seed=0)
        paths.append(write_recording(run, folder / f"{name} of mine.rrd"))
    return paths


class RecordingsTab:
    """Actions of a user in the tab."""

    def __init__(self, page: Any) -> None:
        self.page = page
        page.until(READY)

    @property
    def names(self) -> list[str]:
        return self.page.page.locator("#recordings .recordings .title").all_text_contents()

    def row(self, name: str) -> Any:
        button = self.page.page.get_by_role("button", name=name, exact=True)
        return self.page.page.locator("#recordings tbody tr").filter(has=button)

    def menu(self, name: str, item: str) -> None:
        self.row(name).get_by_role("button", name=f"Menu of {name}").click()
        self.page.page.get_by_role("menuitem", name=item).click()

    def edit(self, name: str, item: str, text: str) -> None:
        """Replaces a name through the menu."""
        self.menu(name, item)
        self.page.page.keyboard.press("Control+A")
        self.page.page.keyboard.type(text)
        self.page.page.keyboard.press("Enter")

    def add(self, paths: list[Path]) -> None:
        self.page.page.set_input_files("#recordings [type=file]", paths)
        self.wait_for(*(path.name for path in paths))

    def wait_for(self, *names: str) -> None:
        """Waits until the names are listed."""
        self.page.until(
            "() => { const titles = [...document.querySelectorAll('#recordings .recordings .title')];"
            f" return {list(names)}.every((name) => titles.some((n) => n.textContent === name)); }}"
        )


@pytest.mark.long
def test_recordings_are_renamed_searched_restored_and_compared(open_page: Callable[..., Any], runs: list[Path]) -> None:
    mine, other = (path.name for path in runs)
    tab = RecordingsTab(open_page(f"?tab=recordings&recording={mine}"))
    page = tab.page.page
    tab.add(runs)
    tab.edit(mine, "Rename", "best run")
    tab.wait_for("best run.rrd")
    assert tab.page.state["recording"] == "best run.rrd"
    assert page.evaluate("() => document.activeElement.textContent") == "best run.rrd", (
        "the focus does not return to the name"
    )
    page.get_by_role("searchbox").fill("push BEST")
    assert tab.names == ["best run.rrd"]
    page.get_by_role("searchbox").fill("")

    tab.row(other).get_by_role("button", name=other, exact=True).focus()
    page.keyboard.press("Delete")
    tab.page.until("() => document.activeElement.textContent === 'Undo'")
    assert other not in tab.names
    tab.page.screenshot("recordings")
    page.keyboard.press("Enter")
    tab.wait_for(other)

    for name in ("best run.rrd", other):
        tab.row(name).get_by_role("checkbox").check()
    page.get_by_role("button", name="Compare runs").click()
    tab.page.until("() => document.querySelector('#compare .verdict')?.textContent.includes('image-ekf')")
    state = tab.page.state
    assert (state["task"], state["filter"], state["against"]) == ("push", "crossmodal-ekf", "filter=image-ekf")

    page.keyboard.press("r")
    page.get_by_role("button", name="Open both in Rerun").click()
    tab.page.until("() => document.querySelector('#rerun').dataset.state === 'ready'")
    tab.page.until("async () => (await beliefscope.rerun.getState()).recordings.length === 2")
    for theme in ("light", "dark"):
        page.emulate_media(color_scheme=theme)
        assert tab.page.violations() == [], f"Rerun tab, {theme}"
    page.get_by_role("button", name="Back to the current run").click()
    tab.page.until("async () => (await beliefscope.rerun.getState()).recordings.length === 1", RECORDING_TIMEOUT)
    page.keyboard.press("r")
    tab.page.until(
        "() => [...document.querySelectorAll('#recordings .recordings .title')]"
        ".some((title) => title.textContent.startsWith('push-crossmodal-ekf-episode'))"
    )


@pytest.mark.long
def test_recording_opens_with_its_run(open_page: Callable[..., Any], tmp_path: Path) -> None:
    """A run that the server does not have keeps its own time."""
    checkpoint = load_checkpoint(pretrained_path("push", "image-ekf"))
    with open_dataset(sample_path("push")) as data:
        index = data.held_out()[1]
        runs = [trace(checkpoint, data[index], episode_index=index, seed=seed) for seed in (0, 1)]
        last = len(data[index].states) - 1
    paths = [write_recording(run, tmp_path / f"seed {run.seed}.rrd") for run in runs]
    tab = RecordingsTab(open_page("?tab=recordings&step=20", size=(600, 450)))
    page = tab.page.page
    tab.add(paths)
    viewer_time = (
        "(async () => { const state = await beliefscope.rerun.getState(), id = state?.active_store_id;"
        " return Number(state?.recordings.find((r) => r.store_id === id)?.current_time?.time); })"
    )
    ready = "() => document.querySelector('#rerun').dataset.state === 'ready'"

    tab.row("seed 1.rrd").get_by_role("button", name="seed 1.rrd", exact=True).click()
    tab.page.until(ready, RECORDING_TIMEOUT)
    assert tab.page.state["task"] == "door"
    assert "another run (push" in page.locator("#rerun .files").inner_text()
    page.locator("#tab-rerun").focus()
    page.keyboard.press("Home")
    page.keyboard.press("End")
    tab.page.until("() => beliefscope.state().step === 99")
    assert page.evaluate(f"{viewer_time}()") == 0

    page.keyboard.press("r")
    tab.row("seed 0.rrd").get_by_role("button", name="seed 0.rrd", exact=True).click()
    tab.page.until("() => document.querySelector('#rerun .files').textContent.includes('the run of this page')")
    tab.page.until(f"() => document.querySelector('#readout b').textContent === '0 / {last}'")
    state = tab.page.state
    assert (state["task"], state["filter"], state["episode"]) == ("push", "image-ekf", index)
    tab.page.until(ready, RECORDING_TIMEOUT)
    page.locator("#tab-rerun").focus()
    page.keyboard.press("End")
    tab.page.until(f"async () => await {viewer_time}() === {last}")
    page.reload()
    tab.page.until(f"async () => await {viewer_time}() === {last}", RECORDING_TIMEOUT)
    page.select_option("#episode", index=0)
    tab.page.until("() => document.querySelector('#rerun .files').hidden && !beliefscope.state().recording")


@pytest.mark.long
def test_changes_appear_in_other_browsers(open_page: Callable[..., Any], runs: list[Path]) -> None:
    first, second = (RecordingsTab(open_page("?tab=recordings")) for _ in range(2))
    first.add([runs[0]])
    second.wait_for(runs[0].name)
    first.menu(runs[0].name, "Delete")
    second.page.until(
        "() => ![...document.querySelectorAll('#recordings .recordings .title')]"
        f".some((n) => n.textContent === '{runs[0].name}')"
    )
    second.page.page.locator("#recordings .trash summary").click()
    second.page.page.get_by_role("button", name=f"Restore {runs[0].name}").first.click()
    first.wait_for(runs[0].name)


@pytest.mark.long
def test_report_is_created_and_opened(open_page: Callable[..., Any]) -> None:
    tab = RecordingsTab(open_page("?tab=recordings"))
    page = tab.page.page
    page.get_by_role("button", name="Report", exact=True).click()
    page.keyboard.press("Enter")
    tab.page.until("() => document.querySelector('#recordings .reports tbody tr')", REPORT_TIMEOUT)
    page.locator("#jobs").get_by_role("button", name="Close").click()
    with page.expect_popup() as opened:
        page.locator("#recordings .reports .title").first.click()
    report = opened.value
    report.wait_for_load_state()
    assert report.title() == "crossmodal-pf on door"
    report.get_by_role("link", name="Open this event in the dashboard").first.click()
    report.wait_for_url("**/?task=door&filter=crossmodal-pf*")
