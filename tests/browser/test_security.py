"""Access link, read-only server and names that contain markup, in Chromium."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import h5py
import pytest

from beliefscope.datasets.store import sample_path
from beliefscope.filters.checkpoint import pretrained_path

MARKUP = "<img src=x onerror=window.hacked=1>"


@pytest.mark.long
def test_access_link_opens_a_read_only_page_with_names_as_text(
    context: Any, start_server: Any, open_page: Any, tmp_path: Path
) -> None:
    data, checkpoint = tmp_path / f"{MARKUP}.h5", tmp_path / f"{MARKUP}.safetensors"
    shutil.copy(sample_path("door"), data)
    with h5py.File(data, "r+") as file:
        for group in file.values():
            group.attrs["provenance"] = group.attrs["provenance"].replace("push", "<b onload=hacked=1>")
    shutil.copy(pretrained_path("door", "crossmodal-ekf"), checkpoint)
    server = start_server("--token", "--read-only", "--data", str(data), "--filter", str(checkpoint))
    address, _, token = server.url.partition("?token=")

    visitor = context.new_page()
    assert visitor.goto(address).status == 401
    assert visitor.locator("input[name=token]").is_visible()
    visitor.fill("input[name=token]", "a wrong token")
    visitor.click("button")
    assert "The token is wrong" in visitor.inner_text("body")
    visitor.goto(server.url)
    visitor.wait_for_url(lambda url: "token" not in url)
    visitor.close()

    page = open_page(url=address, scene=True)
    assert page.page.url.partition("?")[0] == address
    assert token not in page.page.url
    assert token not in page.page.content()
    assert page.page.evaluate("document.cookie") == "", "scripts can read the cookie"
    (cookie,) = page.page.context.cookies()
    assert (cookie["httpOnly"], cookie["sameSite"]) == (True, "Strict")
    assert cookie["value"] != token

    assert page.state["filter"] == MARKUP
    assert page.state["data"] == MARKUP
    assert MARKUP in page.page.inner_text("#filter")
    for button in (*(f"#tab-{tab}" for tab in ("diagnostics", "compare", "recordings", "failures")), "#jobs-button"):
        page.page.evaluate("(button) => document.querySelector(button).click()", button)
        page.page.wait_for_timeout(500)
    assert page.page.evaluate("window.hacked") is None
    assert page.page.locator("img[src=x]").count() == 0

    assert page.page.text_content("#read-only") == "read-only"
    for button in ("#save", "#report"):
        assert page.page.locator(button).is_disabled()
        assert "Read-only server" in page.page.get_attribute(button, "title")
    page.page.evaluate("document.querySelector('#tab-finetune').click()")
    page.until("() => document.querySelector('#finetune .start')?.disabled")
    page.page.keyboard.press("s")
    page.screenshot("security-read-only")
    assert not list((tmp_path / "workspace").glob("recordings/*.rrd"))
    assert not list((tmp_path / "workspace").glob("jobs/*"))
