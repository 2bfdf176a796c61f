"""Compare tab: an intervention over some steps, and another filter."""

from __future__ import annotations

from typing import Any

import pytest

READY = "() => document.querySelector('#compare .result').dataset.state === 'ready'"
RUN = "?filter=crossmodal-ekf&episode=9&step=45"


def difference(page: Any) -> float:
    """Distance of the fused estimates at the cursor in cm, from the first chart."""
    return float(page.page.locator("#compare .curves figure").first.locator(".line b").first.text_content())


def verdict(page: Any) -> str:
    return page.page.locator("#compare .verdict").text_content()


def test_intervention_is_selected_by_keys_shared_and_undone(open_page: Any) -> None:
    page = open_page(f"{RUN}&tab=diagnostics")  # a tab that loads quickly
    keyboard, form = page.page.keyboard, page.page.locator("#compare form")
    keyboard.press("[")
    keyboard.press("Shift+ArrowRight")
    keyboard.press("]")
    page.until("() => !document.querySelector('#compare').hidden")
    assert [form.locator(f"[name={name}]").input_value() for name in ("from", "to")] == ["45", "56"]
    first, weight = form.locator("[name=from]"), form.locator(".sliders output").first
    first.fill("60")  # after the end
    assert weight.text_content() == "\N{EN DASH} mean in hinge x"
    first.fill("45")
    assert weight.text_content() == "1.00 mean in hinge x"
    form.get_by_role("button", name="Compare").click()
    assert "The intervention is empty" in form.locator(".error").text_content()
    form.locator("[name=intervention_faults]").select_option("blackout=0.8")
    form.get_by_role("button", name="Compare").click()
    page.until(READY)
    assert page.state["against"] == "from=45&to=56&faults=blackout=0.8"
    assert "over steps 45 to 55" in verdict(page)
    assert difference(page) > 0.0  # at the last step of the intervention
    assert page.page.locator("#comparison-key").text_content().strip() == "with intervention"
    for _ in range(11):
        keyboard.press("ArrowLeft")
    page.until("() => beliefscope.state().step === 44 && document.querySelector('#readout b').textContent[0] === '4'")
    page.settle(44)
    assert difference(page) == 0.0  # at the last step before it
    page.until("() => location.search.includes('against=') && location.search.includes('step=44')")

    second = open_page("?" + page.page.url.partition("?")[2], size=(1440, 900))
    second.until(READY)
    assert second.state == page.state
    assert verdict(second) == verdict(page)
    second.screenshot("compare-intervention")

    keyboard.press("Control+z")
    page.until("() => document.querySelector('#compare .result').dataset.state === 'empty'")
    assert page.state["against"] == ""
    assert page.page.locator("#comparison-key").is_hidden()
    keyboard.press("Control+Shift+Z")
    page.until(READY)
    assert page.state["against"] == second.state["against"]


@pytest.mark.long
def test_two_filters_are_compared(open_page: Any) -> None:
    page = open_page(f"{RUN}&tab=compare&against=filter%3Dcrossmodal-pf", theme="dark")
    page.until(READY)
    filters = ["crossmodal-ekf", "crossmodal-pf"]
    assert all(name in verdict(page) for name in filters)
    assert page.page.locator("#comparison-key").text_content().strip() == "crossmodal-pf"
    heads = page.page.locator("#compare .table th").all_text_contents()
    assert [head for head in heads if head in filters] == filters
    assert page.page.locator("#compare [name=filter]").input_value() == "crossmodal-pf"
    page.page.locator("#compare .gain input").check()
    page.until("() => document.querySelector('#maps-kind').textContent === 'Change from crossmodal-pf'")
    overflow = page.page.evaluate(
        "() => ['#compare', '#compare form', '#timeline .bar'].map((e) => document.querySelector(e))"
        ".map((e) => e.scrollWidth - e.clientWidth)"
    )
    assert max(overflow) <= 1
    page.screenshot("compare-filters")
    page.page.locator("#filter").select_option("crossmodal-pf")  # exchanges the two filters
    page.until("() => document.querySelector('#maps-kind').textContent === 'Change from crossmodal-ekf'")
    assert page.state["against"] == "filter=crossmodal-ekf"
    page.page.locator("#compare .clear").click()
    page.until("() => beliefscope.state().against === '' && !location.search.includes('against')")
    page.until("() => document.querySelector('#compare .result').dataset.state === 'empty'")
    page.until("() => document.querySelector('#maps-kind').textContent === 'Likelihood'")
