"""Fine-tune tab: a short run, its results, promotion to the default, and removal."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset

STATE = "document.querySelector('#finetune article')?.dataset.state"
SELECTED = f"() => window.beliefscope && {STATE} === 'ready' && beliefscope.state().filter"
FILTERS = "() => [...document.querySelector('#filter').options].map((option) => option.value)"


def test_filter_is_finetuned_promoted_and_discarded(
    open_page: Any, start_server: Callable[..., Any], short_episodes: Callable[..., list[Episode]], tmp_path: Path
) -> None:
    with open_dataset(sample_path("door")) as data:
        held_out = data.held_out()
        indices = [index for index in range(0, len(data), 11) if index not in held_out] + held_out[:2]
    write_dataset(tmp_path / "few.h5", find_task("door"), short_episodes("door", indices, 60))
    # A separate server, as the test changes the default filter.
    server = start_server("--data", str(tmp_path / "few.h5"))
    page = open_page("?tab=finetune&filter=crossmodal-ekf&data=few", server.url)
    panel = page.page.locator("#finetune")
    page.until("() => document.querySelectorAll('#finetune .module button').length > 20")
    assert panel.locator(".weakness .item").count() == 1, "the run is healthy: the default fault is the only weakness"
    assert panel.locator("select[name=preset]").input_value() == "reliability-only"
    assert panel.locator("select[name=slice]").input_value() == "image occluded"
    assert panel.locator("select[name=criterion]").input_value() == "image occluded"
    assert "noise of the measurement models" in panel.locator(".help").text_content()
    panel.locator("select[name=preset]").select_option("haptics-only")
    assert "26,054 of 449,097" in panel.locator(".count").text_content()
    panel.get_by_label("Train virtual_sensors.haptics", exact=True).click()
    assert panel.locator("select[name=preset]").input_value() == "custom"
    panel.get_by_role("button", name="Fine-tune").click()
    assert "nothing to train" in panel.locator(".error").text_content()
    panel.get_by_label("Train virtual_sensors.haptics.state", exact=True).click()
    assert page.violations("#finetune") == []
    panel.locator("summary").click()
    assert panel.locator("input[name=clean_weight]").input_value() == "0.97"  # of the default slice
    panel.locator("select[name=slice]").select_option("haptics only")
    assert panel.locator("input[name=clean_weight]").input_value() == "0.5"
    panel.locator("select[name=criterion]").select_option("contact")
    for name, value in (("by", "20"), ("steps", "3"), ("length", "8"), ("rate", "0.0003")):
        panel.locator(f"input[name={name}]").fill(value)
    page.screenshot("finetune-form")
    panel.get_by_role("button", name="Fine-tune").click()
    page.until(f"() => {STATE} === 'ready'", 180.0)  # training, and evaluation of both filters on all held-out episodes
    assert page.state["run"]
    assert panel.locator(".statement").text_content() == (
        "Criterion: The position error in slice \u201ccontact\u201d falls by at least 20 %, "
        "and in no other slice rises by more than 5 %."
    )
    assert panel.locator(".verdict").text_content().startswith(("Not met: contact ", "Inconclusive: contact "))
    assert panel.locator(".slices tbody tr").count() == 6
    row = panel.locator(".runs tbody tr.here").text_content()
    assert "contact at least 20 % better, others at most 5 % worse" in row
    assert panel.locator("h3").text_content() == "crossmodal-ekf: virtual_sensors.haptics.state on haptics only"
    assert "virtual sensors.image" in panel.get_by_label("Modules", exact=True).last.text_content()
    page.until("() => document.querySelectorAll('#finetune .live canvas').length === 2")
    page.screenshot("finetune")

    before = page.page.evaluate(FILTERS)
    with page.page.expect_navigation():
        panel.get_by_role("button", name="Promote to default").click()
    page.until(f"{SELECTED} !== 'crossmodal-ekf'")
    finetuned = page.state["filter"]
    assert page.page.evaluate(FILTERS) == [finetuned, *before]
    with page.page.expect_navigation():
        panel.get_by_role("button", name="Discard").click()
    page.until(f"{SELECTED} === 'crossmodal-ekf'")
    assert page.page.evaluate(FILTERS) == before

    with page.page.expect_request(lambda request: request.method == "POST" and "finetune" in request.url) as request:
        panel.get_by_role("button", name="Train longer").click()
    assert request.value.post_data_json["steps"] == 6
    panel.get_by_role("button", name="Pause").click()
    page.until("() => document.querySelector('#finetune .verdict').textContent.startsWith('Paused.')")
