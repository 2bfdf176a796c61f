"""Study tab: bars and table agree, and bars open the largest errors of available checkpoints."""

from __future__ import annotations

from typing import Any

import pytest

READY = "() => document.querySelector('#study').dataset.state === 'ready'"
LABELS = "(all) => all.map((a) => [a.getAttribute('aria-label'), a.hasAttribute('href')])"


@pytest.mark.long
def test_bar_opens_the_largest_error(open_page: Any) -> None:
    page = open_page("?tab=study&step=40", size=(1440, 900))
    page.until(READY)
    panel = page.page.locator("#study")
    (study,) = page.page.request.get(f"{page.url}api/studies").json()["studies"]
    (door,) = (task for task in study["tasks"] if task["name"] == "door")
    assert door["rows"][0]["start"] == "3cm,20deg", "offset starts do not lead"
    offset, rows = (
        {(row["filter"], row["blackout"]): row for row in door["rows"] if row["start"] == start}
        for start in ("3cm,20deg", "")
    )
    assert panel.locator("#start input").first.is_checked()
    about = panel.locator(".about").text_content()
    assert "start 3 cm, 20° off: 1 seed per filter" in about
    assert "64 test episodes of the sample set" in about
    row = offset["crossmodal-ekf", 0.95]
    cells = panel.locator("tbody tr").first.locator("td").all_text_contents()
    assert cells[3] == f"{row['mean']['position_cm']:.2f}"
    row = offset["crossmodal-ekf", 0.0]
    titles = panel.locator("thead th").all_text_contents()[5:8]
    assert titles == ["from step 0, cm", "dynamics, cm", "stay, cm"]
    numbers = [row["from_step_0"], row["baselines"]["dynamics"], row["baselines"]["stay"]]
    assert cells[4:7] == [f"{values['position_cm']:.2f}" for values in numbers]
    assert cells[6] == "3.00", "keeping the start does not have the error of the start"
    page.screenshot("study-offset")
    panel.get_by_text("at the truth", exact=True).click()
    page.until(f"() => document.querySelectorAll('#study .chart a').length === {len(rows) - 1}")  # the mean is a line
    assert page.state["start"] == "truth"
    labels = panel.locator(".chart a").evaluate_all(LABELS)
    for label, linked in labels:
        name, share = label.split(": ")[0].split(", ")
        row = rows[name, int(share.split()[0]) / 100]
        seeds = ", ".join(f"seed {seed}: {numbers['position_cm']:.2f}" for seed, numbers in row["by_seed"].items())
        assert f": {row['mean']['position_cm']:.2f} ± {row['spread']['position_cm']:.2f} cm ({seeds}); " in label
        assert linked == (name not in ("crossmodal-ukf", "lstm")) == label.endswith("opens the worst events of seed 0")

    head = panel.locator("thead button")
    head.get_by_text("80 % blackout").click()
    sorted_ = panel.locator("tbody tr th").all_text_contents()
    means = [rows[name, 0.8]["mean"]["position_cm"] for name in sorted_[:-1]]
    assert (means, sorted_[-1]) == (sorted(means), "training mean")
    panel.get_by_text("angle", exact=True).click()
    page.until("() => location.search.includes('quantity=angle_deg')")
    page.screenshot("study")

    first = panel.locator(".chart a[tabindex='0']")
    assert first.count() == 1, "the bars are not a single stop of the tab key"
    first.focus()
    page.page.keyboard.press("ArrowDown")  # the same filter with 40 % image blackout
    focused = page.page.evaluate("() => document.activeElement.getAttribute('aria-label')")
    assert focused.startswith("crossmodal-ekf, 40 % blackout")
    page.page.keyboard.press("Enter")
    page.until("() => document.querySelector('#failures').dataset.state === 'ready'", 120.0)
    address = f"{page.url}api/failures/door/crossmodal-ekf?faults=blackout%3D0.4&among=held-out"
    scores = {score["name"]: score for score in page.page.request.get(address).json()["scores"]}
    worst = scores["angle"]["events"][0]
    page.until(f"() => beliefscope.state().step === {worst['step']}")
    expected = {
        "tab": "failures",
        "filter": "crossmodal-ekf",
        "faults": "blackout=0.4",
        "by": "angle",
        "component": "angle",
    }
    assert page.state.items() >= {**expected, "episode": worst["episode"]}.items()


def test_a_task_without_a_study_says_how_to_make_one(open_page: Any) -> None:
    page = open_page("?task=push-field&tab=study", size=(1280, 720))
    page.until("() => document.querySelector('#study').dataset.state === 'empty'")
    note = page.page.locator("#study .note")
    command = "beliefscope study --task push-field --data push-field=push-field.h5 --filter crossmodal-ekf"
    assert command in note.locator("pre").text_content()
    assert not page.violations()
    page.screenshot("no-study")
    note.get_by_role("button", name="push", exact=True).click()
    page.until("() => document.querySelector('#study').dataset.state === 'ready'")
    assert page.state["task"] == "push"
