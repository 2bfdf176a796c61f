"""Failures tab: search, events, permalinks and the table of episodes."""

from __future__ import annotations

from typing import Any
from urllib.parse import parse_qsl

import pytest

TAB = "?tab=failures&filter=crossmodal-ekf"
API = "api/failures/door/crossmodal-ekf"
READY = "() => document.querySelector('#failures').dataset.state === 'ready'"


def open_results(open_page: Any, parameters: str = "", **options: Any) -> Any:
    """The tab with results. The search is started unless an earlier test has done it."""
    page = open_page(TAB + parameters, **options)
    page.until("() => ['absent', 'ready'].includes(document.querySelector('#failures').dataset.state)")
    if page.page.locator("#failures").get_attribute("data-state") == "absent":
        page.page.get_by_role("button", name="Search for failures").click()
    page.until(READY, 240)  # 64 held-out episodes
    return page


def wait_for_step(page: Any, episode: int, step: int) -> None:
    """Waits until the page shows a step of an episode."""
    page.until(f"() => beliefscope.state().episode === {episode} && beliefscope.state().step === {step}")


def test_event_is_opened_and_shared_by_permalink(open_page: Any) -> None:
    page = open_results(open_page, "&step=40", clipboard=True)
    scores = {score["name"]: score for score in page.page.request.get(page.url + API).json()["scores"]}
    worst, second, *_ = events = scores["error"]["events"]
    rows = page.page.locator("#failures .events tbody tr")
    assert rows.count() == len(events)
    rows.first.click()
    wait_for_step(page, worst["episode"], worst["step"])
    page.settle(worst["step"])
    assert page.state["tab"] == "failures"
    assert rows.first.get_attribute("class") == "here"
    marked = page.page.locator("#marks button")
    assert marked.count() == sum(m["episode"] == worst["episode"] for m in events)
    assert f"{100 * worst['value']:.2f} cm" in marked.first.get_attribute("aria-label")
    rows.first.get_by_role("button", name="Copy link").click()
    page.until("() => document.querySelector('#failures .link').textContent === '✓'")
    copied = page.page.evaluate("() => navigator.clipboard.readText()")
    page.screenshot("failures")

    page.page.keyboard.press("n")
    wait_for_step(page, second["episode"], second["step"])
    moved = f"is in episode {second['episode']}, step {second['step']}" if second["episode"] != worst["episode"] else ""
    assert moved in page.page.locator("#messages").text_content()
    page.page.keyboard.press("b")
    wait_for_step(page, worst["episode"], worst["step"])
    page.page.get_by_text("angle", exact=True).first.click()  # another score, which the timeline shows as well
    page.until("() => location.search.includes('by=angle')")
    assert page.state["component"] == "angle"
    assert rows.count() == scores["angle"]["total"]
    page.page.get_by_text("ESS", exact=True).click()
    page.until("() => document.querySelector('#failures .verdict').textContent.includes('has no particles')")

    other = open_page("?" + copied.partition("?")[2])
    wait_for_step(other, worst["episode"], worst["step"])
    other.settle(worst["step"])
    assert dict(parse_qsl(copied.partition("?")[2]))["step"] == str(worst["step"])
    assert other.state["filter"] == "crossmodal-ekf"


@pytest.mark.long
def test_worst_step_of_a_slice_is_opened(open_page: Any) -> None:
    page = open_page("?tab=failures&list=slices&task=push-field&filter=information-ekf", size=(1280, 720))
    page.page.get_by_role("button", name="Search for failures").click()
    page.until(READY, 240)
    result = page.page.request.get(page.url + "api/failures/push-field/information-ekf").json()
    slices = result["scores"][0]["slices"]
    assert page.page.locator("#failures .verdict").text_content() == slices["summary"]
    rows = page.page.locator("#failures .slices tbody tr")
    assert rows.count() == len(slices["rows"]) > 0
    first = slices["rows"][0]
    texts = rows.first.locator("td").all_text_contents()
    assert first["conditions"][0]["covariate"] in texts[0]  # as it is written, without a capital
    assert texts[1] == f"{100 * first['inside']:.3g}"
    assert texts[3] == f"{first['ratio']:.2g} \N{MULTIPLICATION SIGN} ({first['low']:.2g} to {first['high']:.2g})"
    assert texts[4] == f"{len(first['episodes'])} of {len(result['episodes'])}"
    rows.first.get_by_role("button").click()
    wait_for_step(page, *first["worst"])
    page.settle(first["worst"][1])
    assert rows.first.get_attribute("class") == "here"
    page.screenshot("slices")


def column(page: Any, name: str) -> list[str]:
    """Cells of a column of the table of episodes."""
    table = page.page.locator("#failures .episodes")
    position = table.locator("thead th").all_text_contents().index(name)
    return table.locator(f"tbody tr td:nth-child({position + 1})").all_text_contents()


def test_episodes_are_sorted_and_opened(open_page: Any) -> None:
    page = open_results(open_page, "&list=episodes", size=(1440, 900), theme="dark")
    episodes = page.page.request.get(page.url + API).json()["episodes"]
    by_worst = sorted(episodes, key=lambda episode: -episode["worst"])
    scored = [str(episode["index"]) for episode in by_worst]
    listed = column(page, "episode")
    assert listed[: len(scored)] == scored  # largest error first, training episodes without results last
    assert len(listed) == len(set(listed)) > len(scored)
    assert column(page, "RMSE cm")[-1] == "\N{EN DASH}"
    page.page.get_by_role("button", name="RMSE cm").click()
    rmse = [float(text) for text in column(page, "RMSE cm")[: len(scored)]]
    assert rmse == sorted(rmse, reverse=True)
    assert rmse[0] == pytest.approx(100 * max(episode["rmse"] for episode in episodes), abs=0.005)
    page.page.get_by_role("button", name="RMSE cm").click()
    assert [float(text) for text in column(page, "RMSE cm")[: len(scored)]] == rmse[::-1]
    page.page.get_by_role("button", name="contact", exact=True).focus()
    page.page.keyboard.press("Enter")
    shares = [int(text.removesuffix(" %")) for text in column(page, "contact")]
    assert shares == sorted(shares)
    assert (
        page.page.evaluate("() => document.activeElement.textContent") == "contact"
    )  # the focus stays for the reverse order
    page.screenshot("episodes")

    worst = by_worst[0]
    row = page.page.locator("#failures .episodes tbody tr").filter(
        has=page.page.get_by_role("button", name=f"Episode {worst['index']}", exact=True)
    )
    row.get_by_role("button").click()
    wait_for_step(page, worst["index"], 0)
    box = row.locator("svg").bounding_box()
    page.page.mouse.click(box["x"] + 0.6 * box["width"], box["y"] + 5)
    page.until(f"() => Math.abs(beliefscope.state().step - {0.6 * worst['steps']}) <= 1")  # steps are thin
    assert row.get_attribute("class") == "here"


@pytest.mark.long
def test_episodes_are_listed_before_the_search(open_page: Any) -> None:
    page = open_page("?tab=failures&list=episodes&filter=image-ekf&among=all")
    page.until("() => document.querySelector('#failures').dataset.state === 'absent'")
    catalog = page.page.request.get(f"{page.url}api/catalog").json()
    (door,) = (task for task in catalog["tasks"] if task["name"] == "door")
    assert column(page, "episode") == [str(episode["index"]) for episode in door["data"][0]["episodes"]]
    assert set(column(page, "worst cm")) == {"\N{EN DASH}"}
    page.page.keyboard.press("n")  # without events the key opens the search
    assert page.page.get_by_role("button", name="Search for failures").is_visible()
