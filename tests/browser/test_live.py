"""Live runs: the page follows the newest step, can leave and rejoin it, and reports an interrupted run."""

from __future__ import annotations

import subprocess
import sysconfig
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.trace import trace
from beliefscope.inspect.traces.live_file import write_live

NEWEST = "Number(document.querySelector('#tracks').getAttribute('aria-valuemax'))"


@pytest.fixture
def running(server: Any) -> Iterator[subprocess.Popen[bytes]]:
    """A run of 100 steps at one step per second, which outlasts the test."""
    command = Path(sysconfig.get_path("scripts")) / "beliefscope"
    options = ["--filter", "crossmodal-ekf", "--rate", "1", "--name", "go", "--workspace", str(server.workspace)]
    process = subprocess.Popen([str(command), "live", "door", *options], stderr=subprocess.DEVNULL)
    folder = server.workspace / "live"
    while not (folder / "go.live").exists():
        assert process.poll() is None
        time.sleep(0.1)
    yield process
    process.kill()
    process.wait()
    for file in folder.glob("go.*"):
        file.unlink()


def test_page_follows_a_live_run(open_page: Any, running: Any) -> None:
    page = open_page("?data=live:go")
    assert page.page.evaluate("() => document.querySelector('#live').className") == "on"
    first = page.page.evaluate(f"() => {NEWEST}")
    page.until(f"() => {NEWEST} > {first} + 1 && beliefscope.state().step === {NEWEST}")
    assert page.state["follow"]
    assert page.page.locator("#heatmaps figure").count() == 3
    page.screenshot("live")

    page.page.keyboard.press("Home")
    page.until("() => !beliefscope.state().follow")
    left = page.page.evaluate(f"() => {NEWEST}")
    page.until(f"() => {NEWEST} > {left} + 1 && beliefscope.stats.maps.step === 0")
    assert page.state["step"] == 0
    page.until("() => /step=0/.test(location.search) && /data=live/.test(location.search)")
    assert "behind" in page.page.inner_text("#follow")

    page.page.keyboard.press("l")
    page.until(f"() => beliefscope.state().follow && beliefscope.state().step === {NEWEST} && {NEWEST} > {left}")
    page.page.click("#tab-diagnostics")
    page.until("() => /when it has ended/.test(document.querySelector('#diagnostics .note').textContent)")
    page.page.click("#tab-diagnosis")
    page.until("() => /when it has ended/.test(document.querySelector('#diagnosis .headline').textContent)")
    page.page.click("#tab-failures")
    page.until("() => document.querySelector('#failures').dataset.state === 'live'")
    assert page.page.locator("#failures .doing button").count() == 0

    running.kill()
    page.until("() => /stopped at step [0-9]+/.test(document.querySelector('#messages').textContent)")
    message = page.page.inner_text("#messages")
    assert f"at step {page.page.evaluate(f'() => {NEWEST}')}:" in message
    assert page.page.locator("#follow").is_hidden()
    page.until("() => document.querySelectorAll('#failures .events tbody tr').length > 0")
    page.page.click("#tab-diagnostics")
    page.until("() => document.querySelectorAll('#diagnostics .list li').length > 3")
    page.page.click("#tab-diagnosis")
    for _ in range(2):
        page.until("() => /this run alone/.test(document.querySelector('#diagnosis .status').textContent)")
        assert page.page.locator("#diagnosis .doing button:visible").count() == 0
        page.page.reload()  # the run is then no longer followed


@pytest.mark.long
def test_link_to_a_live_run_opens_it_when_it_starts(open_page: Any, request: pytest.FixtureRequest) -> None:
    page = open_page("?task=door&data=live:go")
    page.until(
        "() => /“go” does not exist. It opens when it starts/.test(document.querySelector('#messages').textContent)"
    )
    request.getfixturevalue("running")
    page.until(f"() => beliefscope.state().data === 'live:go' && beliefscope.state().follow && {NEWEST} > 0")
    page.until("() => !document.querySelector('#messages').textContent")


def test_page_leaves_a_run_whose_file_is_deleted(open_page: Any, server: Any) -> None:
    with open_dataset(sample_path("door")) as data:
        run = trace(load_checkpoint(pretrained_path("door", "image-ekf")), data[9], 9)
    file = server.workspace / "live" / "gone.live"
    file.parent.mkdir(exist_ok=True)
    write_live(run, file)
    page = open_page("?task=door&data=live:gone")
    page.until("() => beliefscope.state().data === 'live:gone' && document.querySelector('#data').value")
    file.unlink()
    page.until("() => beliefscope.state().data === 'sample' && document.querySelector('#data').value === 'sample'")
    assert "'gone' does not exist" in (message := page.page.inner_text("#messages"))
    assert "Its file was deleted or moved; restore it to display the run. The page now shows sample." in message
    page.errors.clear()  # the refused request for the run


def test_long_names_of_runs_leave_room_for_their_filters(open_page: Any, server: Any) -> None:
    with open_dataset(sample_path("door")) as data:
        run = trace(load_checkpoint(pretrained_path("door", "image-ekf")), data[9], 9)
    file = server.workspace / "live" / f"{'long' * 30}.live"
    file.parent.mkdir(exist_ok=True)
    write_live(run, file)
    try:
        page = open_page("?task=door")
        page.page.click("#live")
        name, owner = (page.page.locator(f"#live-runs li button > {tag}").first for tag in ("b", "span"))
        assert name.get_attribute("title") == file.stem
        assert owner.bounding_box()["width"] > 80
        assert name.bounding_box()["x"] + name.bounding_box()["width"] <= owner.bounding_box()["x"]
    finally:
        file.unlink()
