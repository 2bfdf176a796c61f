"""The page with user-defined filters, data and tasks."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from typing import Any

import pytest

from beliefscope.datasets.catalog import find_task, load_task
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import save_checkpoint

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "own_task.py"


def untrained(task: str, name: str, data: Path, path: Path) -> None:
    with open_dataset(data) as episodes:
        filter_ = build(architecture(task, name))
        filter_.statistics.fit(Steps.from_episodes(find_task(task), [episodes[0]]))
    save_checkpoint(filter_, name, {}, path)


def select(page: Any, picker: str, value: str) -> None:
    page.page.locator(f"#{picker}").select_option(value)


@pytest.mark.long  # tests/app/api/test_every_filter_and_task.py has the same checks of the server
def test_missing_outputs_are_explained_per_filter(open_page: Any, start_server: Any, tmp_path: Path) -> None:
    names = ("feature-ekf", "lstm")
    for name in names:
        untrained("door", name, sample_path("door"), tmp_path / f"my-{name}.safetensors")
    options = [part for name in names for part in ("--filter", str(tmp_path / f"my-{name}.safetensors"))]
    page = open_page(url=start_server(*options, "--data", str(sample_path("door"))).url)
    text = page.page.locator

    assert page.state["filter"] == "my-feature-ekf"
    assert text("#heatmaps h3").all_text_contents() == ["image + haptics"]
    assert text("#step-table tbody th").all_text_contents() == ["estimate"]
    assert "a single measurement model uses" in text("#timeline .track-note").text_content()
    assert text("#data").locator("option").all_text_contents() == ["door", "sample"]
    page.screenshot("single-model")

    select(page, "filter", "my-lstm")
    page.until("() => document.querySelector('#heatmaps').dataset.state === 'empty'")
    assert "an LSTM has no likelihood" in text("#heatmaps .note").text_content()
    assert text("#step-summary").text_content().endswith("no predicted standard deviation.")
    assert "\N{GREEK SMALL LETTER SIGMA}" not in text("#step-table thead").text_content()
    assert not text("#angle-label").is_visible()
    page.page.keyboard.press("ArrowRight")
    page.settle(1)
    page.screenshot("lstm")

    select(page, "filter", "crossmodal-pf")
    page.until("() => document.querySelectorAll('#heatmaps h3').length === 3")
    assert text("#step-table tbody th").all_text_contents() == ["image-only update", "haptics-only update", "fused"]
    assert text("#angle-label").is_visible()
    select(page, "data", "sample")
    page.until("() => location.search.includes('data=sample')")
    assert page.state["step"] == 0


@pytest.mark.long
def test_user_defined_task(open_page: Any, start_server: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data, checkpoint = tmp_path / "ball.h5", tmp_path / "checkpoint.safetensors"
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), str(data)])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    name = "ball"
    untrained(load_task(f"{EXAMPLE}:TASK"), "crossmodal-pf", data, checkpoint)
    page = open_page(
        url=start_server("--task", f"{EXAMPLE}:TASK", "--data", str(data), "--filter", str(checkpoint)).url
    )
    text = page.page.locator
    assert page.state["task"] == name
    assert text("#maps-quantity").text_content() == "position"
    assert text("#heatmaps h3").all_text_contents() == ["image", "sound", "fused"]
    assert not text("#angle-label").is_visible()
    assert text("#camera figcaption").text_content() == "camera, 16 \N{MULTIPLICATION SIGN} 16"
    page.settle(0)
    page.screenshot("user-defined-task")
    select(page, "task", "door")
    page.until("() => document.querySelector('#maps-quantity').textContent === 'hinge'")
    assert page.state["component"] == "hinge_x"
    assert text("#angle-label").is_visible()
