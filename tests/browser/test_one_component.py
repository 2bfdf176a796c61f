"""A task of one component in K: every view shows its unit and its curve, and none fails."""

from __future__ import annotations

import runpy
import shutil
from pathlib import Path
from typing import Any

import pytest

from beliefscope.datasets.store import write_dataset

TANK = Path(__file__).with_name("tank.py")


@pytest.mark.long
def test_every_view_of_a_task_with_one_component(open_page: Any, start_server: Any, tmp_path: Path) -> None:
    tank = runpy.run_path(str(TANK))
    write_dataset(tmp_path / "tank.h5", tank["TASK"], [tank["episode"](seed) for seed in range(5)])
    options = ["--task", f"{TANK}:TASK", "--data", str(tmp_path / "tank.h5"), "--filter", f"{TANK}:build"]
    page = open_page(url=start_server(*options).url, scene=True)
    text = page.page.locator
    page.until("() => document.querySelector('#diagnosis').checkVisibility()")  # instead of an empty scene
    page.page.keyboard.press("ArrowRight")
    page.settle(1)
    assert text("#heatmaps h3").all_text_contents() == ["thermometer", "pyrometer", "fused"]
    assert "temperature" in text("#maps h2").text_content()
    assert "(K)" in text("#maps-axis-names").text_content()
    summary = text("#step-summary").text_content()
    assert " K, " in summary
    assert "\N{EN DASH}" not in summary  # the error is known
    assert "Temperature error" in text("#timeline").text_content()
    text("#heatmaps canvas").first.hover()
    assert " K" in text("#maps-value").text_content()
    page.screenshot("one-component")
    cut = "(d) => { d.firstChild.data = '-1080.3'; return d.scrollWidth > d.clientWidth; }"
    assert not page.page.evaluate(f"[...document.querySelectorAll('.legend dd')].filter({cut}).length")

    page.page.evaluate("document.querySelector('#tab-scene').click()")
    page.until("() => document.querySelector('#scene').dataset.state === 'empty'")
    assert "No 3D scene" in text("#scene .note").text_content()
    page.page.select_option("#episode", "1")  # another run opens the diagnosis instead
    page.until("() => beliefscope.state().tab === 'diagnosis'")
    page.until("() => document.querySelector('#diagnosis').dataset.state === 'absent'")
    assert "has no healthy record" in text("#diagnosis .headline").text_content()
    assert text("#diagnosis > .doing button").text_content() == "Measure a healthy record"
    assert not text("#diagnosis .repair").is_visible()
    text("#diagnosis > .doing button").click()
    page.until("() => document.querySelector('#diagnosis').dataset.state === 'error'")
    status = text("#diagnosis > .status").text_content()
    assert "a healthy record needs at least" in status
    assert not text("#diagnosis > .doing button").count(), "trying again cannot help"
    page.screenshot("refused-record")
    page.errors[:] = [line for line in page.errors if "status of 400" not in line]
    page.page.evaluate("document.querySelector('#tab-failures').click()")
    text("#failures").get_by_role("button", name="Search for failures", exact=True).click()
    page.until("() => document.querySelector('#failures').dataset.state === 'ready'")
    assert "temperature error K" in text("#failures thead").first.text_content()
    for tab in ("diagnostics", "finetune", "study", "recordings"):
        if text(f"#tab-{tab}").is_visible():
            text(f"#tab-{tab}").click()
            page.until(f"() => document.querySelector('#{tab}').checkVisibility()")
    words = page.page.evaluate("document.body.innerText")
    assert " cm" not in words


SCALED = f"""
import sys
sys.path.insert(0, {str(TANK.parent)!r})
import tank
from beliefscope.filters.external.adapter import Adapter

class Scaled(tank.Kalman):
    def forward(self, *, observations, controls):
        scaled = observations | {{"colour": 1.02 * observations["colour"]}}
        return super().forward(observations=scaled, controls=controls)

def build():
    return Adapter(Scaled(), modalities=tuple(tank.TASK.modalities), initial_std=(0.3,), task=tank.TASK)
"""


@pytest.mark.long
def test_a_healthy_record_is_measured_and_measured_again(open_page: Any, start_server: Any, tmp_path: Path) -> None:
    tank = runpy.run_path(str(TANK))
    write_dataset(tmp_path / "tank.h5", tank["TASK"], [tank["episode"](seed) for seed in range(60)])
    options = ["--task", f"{TANK}:TASK", "--data", str(tmp_path / "tank.h5"), "--filter", f"{TANK}:build"]
    page = open_page("?tab=diagnosis", url=start_server(*options).url)
    assert not page.page.locator("#diagnosis .healthy-filter >> visible=true").count()  # there is no other filter
    page.page.get_by_role("button", name="Measure a healthy record").click()
    page.until("() => document.querySelector('#diagnosis').dataset.finding === 'healthy'")
    folder = tmp_path / "workspace" / "healthy"
    (record,) = folder.iterdir()
    first = record.stat().st_mtime_ns
    again = page.page.get_by_role("button", name="Measure again")
    again.click()
    page.until("() => document.querySelector('#diagnosis .record progress')")
    page.screenshot("measuring-again")
    page.until("() => !document.querySelector('#diagnosis .record progress')")
    again.wait_for()
    page.until("() => document.querySelector('#diagnosis').dataset.finding === 'healthy'")
    assert record.stat().st_mtime_ns > first
    page.screenshot("measured-again")


@pytest.mark.long
def test_another_filter_runs_over_the_healthy_episodes(open_page: Any, start_server: Any, tmp_path: Path) -> None:
    """A factor on all readings of a sensor is in the record of the filter that has it, but not in that of another."""
    (tmp_path / "scaled.py").write_text(SCALED)
    tank = runpy.run_path(str(TANK))
    write_dataset(tmp_path / "tank.h5", tank["TASK"], [tank["episode"](seed) for seed in range(60)])
    options = ["--task", f"{TANK}:TASK", "--data", str(tmp_path / "tank.h5")]
    shutil.copyfile(TANK, tmp_path / "tank_old.py")
    filters = ["--filter", f"{tmp_path}/scaled.py:build", "--filter", f"{tmp_path}/tank_old.py:build"]
    page = open_page("?tab=diagnosis", url=start_server(*options, *filters).url)
    choice = page.page.locator("#diagnosis > .healthy-filter select")
    assert choice.locator("option").all_text_contents() == ["this filter", "tank_old-build"]
    choice.select_option("tank_old-build")
    page.page.get_by_role("button", name="Measure a healthy record").click()
    page.until("() => document.querySelector('#diagnosis').dataset.finding === 'fault'")
    about = page.page.locator("#diagnosis .about").text_content()
    assert "Healthy record: 60 held-out episodes of tank, run by tank_old-build" in about
    page.screenshot("record-of-another-filter")
