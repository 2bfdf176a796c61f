"""A filter that runs now fills the page: its newest step is followed, left and come back to; its death is told."""

from __future__ import annotations

import subprocess
import sysconfig
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.browser

NEWEST = "Number(document.querySelector('#tracks').getAttribute('aria-valuemax'))"


@pytest.fixture
def running(served: Any) -> Iterator[subprocess.Popen[bytes]]:
    """A run that is slow enough not to end by itself: 100 steps, one a second."""
    command = Path(sysconfig.get_path("scripts")) / "beliefscope"
    options = ["--filter", "crossmodal-ekf", "--rate", "1", "--name", "go", "--workspace", str(served.workspace)]
    process = subprocess.Popen([str(command), "live", "door", *options], stderr=subprocess.DEVNULL)
    folder = served.workspace / "live"
    while not (folder / "go.live").exists():
        assert process.poll() is None
        time.sleep(0.1)
    yield process
    process.kill()
    process.wait()
    for file in folder.glob("go.*"):
        file.unlink()


def test_a_run_fills_the_page_as_it_goes(open_page: Any, running: Any) -> None:
    page = open_page("?data=live:go")
    assert page.page.evaluate("() => document.querySelector('#live').className") == "on"
    first = page.page.evaluate(f"() => {NEWEST}")
    page.until(f"() => {NEWEST} > {first} + 1 && beliefscope.state().step === {NEWEST}")
    assert page.state["follow"]
    assert page.page.locator("#heatmaps figure").count() == 3
    page.picture("live")

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
    page.until("() => /once it has ended/.test(document.querySelector('#diagnostics .note').textContent)")
    page.page.click("#tab-failures")
    page.until("() => document.querySelector('#failures').dataset.state === 'waits'")
    assert page.page.locator("#failures .doing button").count() == 0

    running.kill()
    page.until("() => /stopped at step [0-9]+/.test(document.querySelector('#messages').textContent)")
    said = page.page.inner_text("#messages")
    assert f"at step {page.page.evaluate(f'() => {NEWEST}')}:" in said
    assert page.page.locator("#follow").is_hidden()
    page.until("() => document.querySelectorAll('#failures .events tbody tr').length > 0")
    page.page.click("#tab-diagnostics")
    page.until("() => document.querySelectorAll('#diagnostics .list li').length > 3")
