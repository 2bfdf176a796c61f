"""First visit: the example, its finding in words, and the other examples."""

from __future__ import annotations

from typing import Any

EXAMPLES = 5


def test_a_first_visit_opens_an_example_with_its_finding(open_page: Any) -> None:
    page = open_page(scene=True, size=(1280, 720))
    assert (page.state["task"], page.state["weights"]) == ("push-field", "effective")
    step = page.state["step"]
    finding = page.page.locator("#intro .finding")
    assert f"goes dark at step {step + 1}, in contact; the effective weight of haptics rises" in finding.text_content()
    assert not page.violations()
    chips = page.page.locator("#intro .chip")
    assert chips.count() == EXAMPLES
    chips.nth(2).click()
    page.until("() => document.querySelector('#diagnosis').dataset.finding === 'fault'")
    assert page.state["faults"].startswith("image_frozen")
    assert "Image frozen" in page.page.locator("#diagnosis .headline").text_content()
    assert finding.text_content().startswith("The camera repeats one image")
    page.page.get_by_role("button", name="Close the introduction").click()
    assert page.page.locator("#intro").is_hidden()
