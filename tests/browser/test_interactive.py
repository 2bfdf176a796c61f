"""Interactive pages in the browser: one cursor, deep links, no network, no errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import beliefscope as bs
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.trace import trace
from beliefscope.recordings.interactive.export import write_interactive


def test_cursor_and_deep_links(context: Any, tmp_path: Path) -> None:
    checkpoint = load_checkpoint(pretrained_path("push", "crossmodal-ekf"))
    with open_dataset(sample_path("push")) as data:
        run = trace(checkpoint, data[29], 29, faults=Faults.parse("blackout=0.4"))
    write_interactive(run, tmp_path / "run.html", checkpoint, 21)
    page = context.new_page()
    problems: list[str] = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
    requests: list[str] = []
    page.on("request", lambda request: requests.append(request.url))
    address = (tmp_path / "run.html").as_uri()
    page.goto(f"{address}#step=42")
    assert page.text_content("#place") == "step 42 of 99, 4.20 s"
    assert page.locator("#maps canvas").count() == 3
    image = "() => document.querySelector('#maps canvas').toDataURL()"
    first = page.evaluate(image)
    page.keyboard.press("ArrowRight")
    assert page.evaluate("() => location.hash") == "#step=43"
    assert page.evaluate(image) != first
    page.keyboard.press("End")
    assert page.text_content("#place").startswith("step 99 of 99")
    page.locator("#events a").first.click()
    page.wait_for_function("() => location.hash !== '#step=99'")
    moment = int(page.evaluate("() => location.hash").removeprefix("#step="))
    assert page.input_value("#cursor") == str(moment)
    cells = page.locator("#values tbody tr").last.locator("td").all_text_contents()
    estimate = 100.0 * run.estimate_mean[moment, 0]
    assert abs(float(cells[1]) - estimate) <= 5e-3 * abs(estimate)  # three digits
    page.set_viewport_size({"width": 800, "height": 768})
    values = page.locator("#values")
    assert values.evaluate("({ scrollWidth, clientWidth }) => scrollWidth <= clientWidth"), "columns are cut"
    assert requests == [f"{address}#step=42"] or requests == [address]
    assert not problems
    page.close()


def far_off(*, observations: dict[str, NDArray[np.float32]], controls: NDArray[np.float32]) -> Any:
    """50 cm off in x: outside of the map."""
    mean = observations["effector_position"][..., :2] + np.array([0.5, 0.0], np.float32)
    return mean, np.broadcast_to(np.eye(2, dtype=np.float32) * 1e-4, (*mean.shape, 2))


@pytest.mark.long
def test_an_estimate_outside_of_the_map_is_named(context: Any, tmp_path: Path) -> None:
    """An external filter without updates by modality has one row of values."""
    checkpoint = bs.load_filter(far_off, "push", name="far")
    bs.export_page(bs.trace(checkpoint, "push", 29), tmp_path / "run.html", checkpoint)
    page = context.new_page()
    page.goto(f"{(tmp_path / 'run.html').as_uri()}#step=42")
    assert page.locator("#maps figcaption").all_text_contents() == ["fused; estimate outside"]
    assert page.locator("#values tbody th").all_text_contents() == ["fused"]
    assert "faults none" in page.text_content("footer")
    page.close()


HOST = """
const traits = JSON.parse(document.querySelector('#traits').textContent), listeners = [];
window.model = {
  get: (name) => traits[name],
  set: (name, value) => { traits[name] = value; },
  save_changes: () => {},
  on: (event, listener) => listeners.push(listener),
  off: () => listeners.pop(),
  push: (step) => { traits.step = step; listeners.forEach((listener) => listener()); },
};
const url = URL.createObjectURL(new Blob([traits._esm], { type: 'text/javascript' }));
const { default: widget } = await import(url);
window.close_widget = widget.render({ model, el: document.querySelector('#cell') });
"""
"""A notebook as the widget sees it: the model with its traits, and an element."""


@pytest.mark.long
def test_widget_shares_its_cursor(context: Any) -> None:
    from beliefscope.recordings.interactive.widget import RunWidget  # imports IPython

    with open_dataset(sample_path("push")) as data:
        run = trace(load_checkpoint(pretrained_path("push", "crossmodal-ekf")), data[29], 29)
    widget = RunWidget(run, load_checkpoint(pretrained_path("push", "crossmodal-ekf")), 21)
    traits = {name: getattr(widget, name) for name in ("_esm", "_run", "_body", "_style", "step")}
    page = context.new_page()
    problems: list[str] = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    text = json.dumps(traits).replace("<", "\\u003c")
    page.set_content(
        '<body data-jp-theme-light="false"><div id="cell"></div>'
        f'<script type="application/json" id="traits">{text}</script>'
        f'<script type="module">{HOST}</script>'
    )
    page.wait_for_function("() => window.close_widget")
    assert page.text_content("#place").startswith(f"step {widget.step} of 99")
    assert page.locator(".run.dark").count() == 1
    page.evaluate("() => model.push(42)")
    assert page.text_content("#place") == "step 42 of 99, 4.20 s"
    page.locator(".run").press("ArrowRight")
    assert page.evaluate("() => model.get('step')") == 43
    page.locator("#events a").first.click()
    assert page.evaluate("() => model.get('step')") == widget.step
    assert page.evaluate("() => location.hash") == ""
    assert page.locator("#timeline canvas").count() >= 4
    page.evaluate("() => close_widget()")
    assert not problems
    page.close()
