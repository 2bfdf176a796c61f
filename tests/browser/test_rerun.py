"""Recordings saved by the page, and its Rerun tab."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def test_recording_is_saved_and_synchronized_with_rerun(open_page: Any, tmp_path: Path) -> None:
    page = open_page("?step=12&filter=crossmodal-ekf")
    with page.page.expect_download(timeout=120_000) as download:
        page.page.keyboard.press("s")
        page.until("() => document.querySelector('#save-status progress:not([hidden])')")
        page.page.reload()  # the job continues and the page waits for it again
    download.value.save_as(tmp_path / "run.rrd")
    assert (tmp_path / "run.rrd").read_bytes()[:3] == b"RRF"
    edges = (  # the status covers no control
        "() => ['#save-status', '#finding .links'].map((part) => document.querySelector(part).getBoundingClientRect())"
    )
    status, links = page.page.evaluate(f"() => JSON.parse(JSON.stringify(({edges})()))")
    assert status["right"] <= links["left"]
    page.page.set_viewport_size({"width": 600, "height": 450})  # the viewer is rendered by software
    page.page.get_by_role("button", name="Open in Rerun tab").click()
    page.until("() => document.querySelector('#rerun').dataset.state === 'ready'", 120)
    cursor = (
        "async () => { const state = await beliefscope.rerun.getState();"
        " return state.recordings.find((r) => r.store_id === state.active_store_id)?.current_time; }"
    )

    def viewer_reaches(step: int) -> None:
        page.until(f"async () => Number((await ({cursor})())?.time) === {step}")  # a BigInt

    viewer_reaches(12)
    assert page.page.evaluate(cursor)["timeline"] == "step"
    page.page.keyboard.press("Shift+ArrowRight")
    viewer_reaches(22)
    assert page.state["step"] == 22
    # Keys pressed in the viewer move its cursor; the page follows.
    page.page.locator("#rerun canvas").focus()
    page.page.keyboard.press("ArrowRight")
    page.until("() => beliefscope.state().step === 23")
    page.settle(23)
    page.screenshot("rerun")
