"""Diagnosis tab: from the key to the causes, and the links to their steps."""

from __future__ import annotations

from typing import Any

import pytest

READY = "() => document.querySelector('#diagnosis').dataset.state === 'ready'"


def test_diagnosis_names_causes_and_opens_their_moments(open_page: Any) -> None:
    page = open_page("?task=door&filter=crossmodal-ekf&faults=image_frozen%3Afrom%3D10&tab=scene", size=(1280, 720))
    page.page.keyboard.press("g")
    tab = page.page.locator("#diagnosis")
    page.until("() => document.querySelector('#diagnosis').dataset.finding === 'fault'")
    assert page.page.evaluate("document.querySelector('#diagnosis').dataset.state") != "ready"
    assert "Preliminary" in tab.locator(".status").text_content()
    page.until(READY)  # the job starts by itself and replaces the preliminary diagnosis
    assert tab.locator(".status").text_content() == ""
    headline = tab.locator(".headline").text_content()
    assert "Image frozen" in headline
    assert not page.violations()
    causes = page.page.evaluate("() => document.querySelectorAll('#diagnosis .causes > li').length")
    assert causes >= 1
    values = page.page.evaluate("() => [...document.querySelectorAll('#diagnosis meter')].map((m) => m.value)")
    assert values == sorted(values, reverse=True)
    tab.locator(".details ul button").first.click()
    assert page.state["tab"] == "diagnosis"
    page.screenshot("diagnosis")

    again = open_page("?" + page.page.url.partition("?")[2])  # the result is stored
    again.until(READY)
    assert again.page.locator("#diagnosis .headline").text_content() == headline

    page.page.locator("#faults").select_option(index=0)
    page.until("() => document.querySelector('#diagnosis').dataset.finding === 'healthy'")
    assert tab.locator(".deviations li").count() == 3
    tab.get_by_role("button", name="Fusion efficiency").click()
    assert (page.state["tab"], page.state["diagnostic"]) == ("diagnostics", "efficiency")


def test_the_finding_is_confirmed_while_the_tab_is_closed(open_page: Any) -> None:
    page = open_page("?task=push&filter=crossmodal-ekf&episode=189&faults=contact_inverted&tab=scene")
    page.until("() => document.querySelector('#finding').textContent.includes('Undoing it removes')")
    assert page.page.locator("#diagnosis").is_hidden()


@pytest.mark.long  # tests/app/api/test_diagnosis.py has the same search
def test_the_smallest_repair_is_drawn_in_the_timeline(open_page: Any) -> None:
    faults = "image_occluded%3D14%3Afrom%3D40%3Ato%3D60"
    page = open_page(f"?task=push&filter=crossmodal-ekf&episode=9&faults={faults}&tab=diagnosis", size=(1280, 720))
    key = page.page.locator("#repair-key")
    assert key.is_hidden()
    pixels = "() => [...document.querySelectorAll('#tracks canvas')].map((c) => c.toDataURL()).join()"
    before = page.page.evaluate(pixels)
    page.page.get_by_role("button", name="Find the smallest repair").click()
    page.until("() => document.querySelector('#diagnosis .repair .verdict').textContent.includes('restoring')")
    assert key.is_visible()
    assert page.page.evaluate(pixels) != before
    assert not page.violations()
    page.screenshot("repair")
    page.page.locator("#faults").select_option(index=0)
    page.until("() => document.querySelector('#repair-key').hidden")
