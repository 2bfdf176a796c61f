"""The library of recordings on the page: added, named, tagged, deleted, had back, opened, compared; and reports."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.trace import trace
from beliefscope.recordings.write import write_recording

pytestmark = pytest.mark.browser

READY = "() => document.querySelector('#recordings').dataset.state === 'ready'"
REPORT = 240.0  # s: a job that draws some dozen figures
WRITTEN = 180.0  # s: a job that makes likelihood maps, beside a viewer that draws on the processor


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Recordings of two filters' runs of one episode, made elsewhere."""
    folder = tmp_path_factory.mktemp("runs")
    with open_dataset(sample_path("push")) as data:
        episode = data[data.held_out()[0]]
        index = data.held_out()[0]
    found = []
    for name in ("crossmodal-ekf", "image-ekf"):
        run = trace(load_checkpoint(shipped("push", name)), episode, episode_index=index, seed=0)
        found.append(write_recording(run, folder / f"{name} of mine.rrd"))
    return found


class Shelf:
    """The tab, as its user sees it."""

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

    def write(self, name: str, item: str, text: str) -> None:
        """Into the field that takes the place of a name."""
        self.menu(name, item)
        self.page.page.keyboard.press("Control+A")
        self.page.page.keyboard.type(text)
        self.page.page.keyboard.press("Enter")

    def add(self, paths: list[Path]) -> None:
        self.page.page.set_input_files("#recordings [type=file]", paths)
        self.shows(*(path.name for path in paths))

    def shows(self, *names: str) -> None:
        """Waits until these are among those that are listed."""
        self.page.until(
            "() => { const there = [...document.querySelectorAll('#recordings .recordings .title')];"
            f" return {list(names)}.every((name) => there.some((n) => n.textContent === name)); }}"
        )


def test_ones_own_files_are_kept_found_and_compared(open_page: Callable[..., Any], runs: list[Path]) -> None:
    shelf = Shelf(open_page("?tab=recordings"))
    page = shelf.page.page
    shelf.add(runs)
    mine, other = (path.name for path in runs)
    shelf.write(mine, "Tags", "paper, fig 3")
    shelf.page.until("() => document.querySelectorAll('#recordings .tag').length === 2")
    shelf.write(mine, "Rename", "best run")
    shelf.shows("best run.rrd")
    assert page.evaluate("() => document.activeElement.textContent") == "best run.rrd", (
        "the keyboard goes on from there"
    )
    page.get_by_role("searchbox").fill("push FIG")
    assert shelf.names == ["best run.rrd"]
    page.get_by_role("searchbox").fill("")

    shelf.row(other).get_by_role("button", name=other, exact=True).focus()
    page.keyboard.press("Delete")
    shelf.page.until("() => document.activeElement.textContent === 'Undo'")
    assert other not in shelf.names
    shelf.page.picture("recordings")
    page.keyboard.press("Enter")
    shelf.shows(other)

    for name in ("best run.rrd", other):
        shelf.row(name).get_by_role("checkbox").check()
    page.get_by_role("button", name="Compare the runs").click()
    shelf.page.until("() => document.querySelector('#compare .verdict')?.textContent.includes('image-ekf')")
    state = shelf.page.state
    assert (state["task"], state["filter"], state["against"]) == ("push", "crossmodal-ekf", "filter=image-ekf")

    page.keyboard.press("r")
    page.get_by_role("button", name="Both in Rerun").click()
    shelf.page.until("() => document.querySelector('#rerun').dataset.state === 'ready'")
    shelf.page.until("async () => (await beliefscope.rerun.getState()).recordings.length === 2")
    for theme in ("light", "dark"):
        page.emulate_media(color_scheme=theme)
        assert shelf.page.violations() == [], f"the tab of Rerun, {theme}"
    page.get_by_role("button", name="Back to the run").click()
    shelf.page.until("async () => (await beliefscope.rerun.getState()).recordings.length === 1", WRITTEN)
    page.keyboard.press("r")
    page.locator("#recordings .automatic").wait_for()
    looked_at = "push-crossmodal-ekf-episode"
    assert not any(name.startswith(looked_at) for name in shelf.names), "nobody asked for it to be kept"
    page.locator("#recordings .automatic button").click()
    assert any(name.startswith(looked_at) for name in shelf.names)


def test_two_browsers_see_what_either_does(open_page: Callable[..., Any], runs: list[Path]) -> None:
    one, other = (Shelf(open_page("?tab=recordings")) for _ in range(2))
    one.add([runs[0]])
    other.shows(runs[0].name)
    one.menu(runs[0].name, "Delete")
    other.page.until(
        "() => ![...document.querySelectorAll('#recordings .recordings .title')]"
        f".some((n) => n.textContent === '{runs[0].name}')"
    )
    other.page.page.locator("#recordings .trash summary").click()
    other.page.page.get_by_role("button", name=f"Restore {runs[0].name}").first.click()
    one.shows(runs[0].name)


@pytest.mark.long
def test_a_report_is_made_and_opened(open_page: Callable[..., Any]) -> None:
    shelf = Shelf(open_page("?tab=recordings"))
    page = shelf.page.page
    page.get_by_role("button", name="Report", exact=True).click()
    page.keyboard.press("Enter")
    shelf.page.until("() => document.querySelector('#recordings .reports tbody tr')", REPORT)
    page.locator("#jobs").get_by_role("button", name="Close").click()
    with page.expect_popup() as opened:
        page.locator("#recordings .reports .title").first.click()
    report = opened.value
    report.wait_for_load_state()
    assert report.title() == "crossmodal-pf on door"
    report.get_by_role("link", name="Open this moment in the dashboard").first.click()
    report.wait_for_url("**/?task=door&filter=crossmodal-pf*")
