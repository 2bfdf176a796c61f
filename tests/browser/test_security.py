"""In a real browser: the link with the token, a server that only shows, and names that would be markup."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import h5py
import pytest

from beliefscope.datasets.store import sample_path
from beliefscope.filters.checkpoint import shipped

pytestmark = pytest.mark.browser

EVIL = "<img src=x onerror=window.hacked=1>"


def test_a_shared_page_lets_in_by_its_link_shows_names_as_text_and_changes_nothing(
    browser: Any, serve: Any, open_page: Any, tmp_path: Path
) -> None:
    data, checkpoint = tmp_path / f"{EVIL}.h5", tmp_path / f"{EVIL}.safetensors"
    shutil.copy(sample_path("door"), data)
    with h5py.File(data, "r+") as file:
        for group in file.values():
            group.attrs["provenance"] = group.attrs["provenance"].replace("push", "<b onload=hacked=1>")
    shutil.copy(shipped("door", "crossmodal-ekf"), checkpoint)
    server = serve(0, "--token", "--read-only", "--data", str(data), "--filter", str(checkpoint))
    address, _, token = server.url.partition("?token=")

    stranger = browser.new_page()
    assert stranger.goto(address).status == 401
    assert stranger.locator("input[name=token]").is_visible()
    stranger.fill("input[name=token]", "not the token at all")
    stranger.click("button")
    assert "is not right" in stranger.inner_text("body")
    stranger.goto(server.url)
    stranger.wait_for_url(lambda url: "token" not in url)
    signed_in = stranger.context.storage_state()
    stranger.close()

    page = open_page(url=address, storage_state=signed_in)
    assert page.page.url.partition("?")[0] == address
    assert token not in page.page.url
    assert token not in page.page.content()
    assert page.page.evaluate("document.cookie") == "", "no script can read the cookie"
    (cookie,) = page.page.context.cookies()
    assert (cookie["httpOnly"], cookie["sameSite"]) == (True, "Strict")
    assert cookie["value"] != token

    assert page.state["filter"] == EVIL
    assert page.state["data"] == EVIL
    assert EVIL in page.page.inner_text("#filter")
    for button in (*(f"#tab-{tab}" for tab in ("diagnostics", "compare", "recordings", "failures")), "#jobs-button"):
        page.page.evaluate("(button) => document.querySelector(button).click()", button)
        page.page.wait_for_timeout(500)
    assert page.page.evaluate("window.hacked") is None
    assert page.page.locator("img[src=x]").count() == 0

    assert page.page.inner_text("#read-only") == "read-only"
    for button in ("#save", "#report"):
        assert page.page.locator(button).is_disabled()
        assert "only shows" in page.page.get_attribute(button, "title")
    page.page.evaluate("document.querySelector('#tab-finetune').click()")
    page.until("() => document.querySelector('#finetune .start')?.disabled")
    page.page.keyboard.press("s")
    page.picture("security-read-only")
    assert not list((tmp_path / "workspace").glob("recordings/*.rrd"))
    assert not list((tmp_path / "workspace").glob("jobs/*"))
