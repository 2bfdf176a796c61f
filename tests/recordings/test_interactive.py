"""Interactive pages: complete, self-contained, and equal to the trace."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.maps.map_engine import MapEngine
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace, save_trace, trace
from beliefscope.recordings.interactive.export import MAP_BYTES, write_interactive

pytestmark = pytest.mark.slow

Run = Callable[..., tuple[int, str, str]]
SIZE = 21


@pytest.fixture(scope="module")
def run_() -> Trace:
    with open_dataset(sample_path("door")) as data:
        return trace(load_checkpoint(pretrained_path("door", "crossmodal-ekf")), data[9], 9)


@pytest.fixture(scope="module")
def page(run_: Trace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "run.html"
    write_interactive(run_, path, load_checkpoint(pretrained_path("door", "crossmodal-ekf")), SIZE)
    return path


def embedded(page: Path) -> dict[str, Any]:
    (text,) = re.findall(r'<script type="application/json" id="run">(.*?)</script>', page.read_text(), re.DOTALL)
    document: dict[str, Any] = json.loads(text)
    return document


def test_numbers_equal_the_trace(run_: Trace, page: Path) -> None:
    document = embedded(page)
    close = {"rtol": 1e-4, "atol": 1e-12}  # five digits
    np.testing.assert_allclose(document["error"]["values"], 100.0 * measures.main_error(run_).T, **close)
    factors = (100.0, 100.0, 180.0 / np.pi)
    for i, component in enumerate(document["components"]):
        np.testing.assert_allclose(component["truth"], factors[i] * run_.episode.states[:, i], **close)
        np.testing.assert_allclose(component["mean"][-1], factors[i] * run_.estimate_mean[:, i], **close)
        std = np.sqrt(run_.estimate_covariance[:, i, i])
        np.testing.assert_allclose(component["std"][-1], factors[i] * std, **close)
    worst = measures.main_error(run_)[:, -1]
    assert document["moments"][0]["step"] == int(worst.argmax())
    image = np.frombuffer(base64.b64decode(document["images"][0]["data"]), np.uint8)
    np.testing.assert_array_equal(image, run_.episode.observations["image"].ravel())


def test_maps_equal_those_of_the_engine(run_: Trace, page: Path) -> None:
    maps = embedded(page)["maps"]
    data = np.frombuffer(base64.b64decode(maps["data"]), np.uint8).reshape(-1, *maps["shape"])
    assert len(data) == len(run_)
    assert data.size <= MAP_BYTES
    engine = MapEngine(load_checkpoint(pretrained_path("door", "crossmodal-ekf")), run_)
    for step in (0, 57):
        np.testing.assert_array_equal(data[step], engine.map(step, size=SIZE).normalised())
    assert maps["reach"] == pytest.approx([100.0 * run_.task.map_half_width] * 2)


@pytest.mark.long
def test_causes_have_titles_and_are_preliminary(tmp_path: Path) -> None:
    checkpoint, faults = load_checkpoint(pretrained_path("door", "crossmodal-ekf")), Faults.parse("image_noise")
    with open_dataset(sample_path("door")) as data:
        faulty = trace(checkpoint, data[9], 9, faults=faults)
    write_interactive(faulty, path := tmp_path / "run.html", checkpoint, SIZE)
    text = path.read_text()
    assert "<h2>Probable causes, preliminary</h2>" in text
    assert "<li>Image noisy (image.noise), probability " in text


def test_the_page_loads_nothing(page: Path) -> None:
    text = page.read_text()
    assert not re.findall(r"""(?:src|href)=["'](?!#|data:)""", text)
    assert "default-src 'none'" in text
    assert len(text) < 10e6


@pytest.mark.long
def test_text_of_a_trace_cannot_end_the_script(run_: Trace, tmp_path: Path) -> None:
    from dataclasses import replace

    name = "</script><script>alert(1)</script>"
    write_interactive(replace(run_, filter=name), tmp_path / "run.html")
    assert name not in (tmp_path / "run.html").read_text()
    assert name in embedded(tmp_path / "run.html")["title"]
    assert "maps need the filter" in embedded(tmp_path / "run.html")["no_maps"]


@pytest.mark.long
def test_folder_with_an_index(run: Run, run_: Trace, tmp_path: Path) -> None:
    for name in ("a", "b"):
        save_trace(run_, tmp_path / f"{name}.trace")
    code, _, _ = run("export -o", tmp_path / "pages", tmp_path / "a.trace", tmp_path / "b.trace")
    assert code == 0
    index = (tmp_path / "pages" / "index.html").read_text()
    assert re.findall(r'href="(.+?)"', index) == ["a.html", "b.html"]
    assert embedded(tmp_path / "pages" / "a.html") == embedded(tmp_path / "pages" / "b.html")
    code, _, error = run("export -o", tmp_path / "one.html", tmp_path / "a.trace", tmp_path / "b.trace")
    assert (code, "need a folder" in error) == (2, True)
    code, _, error = run("export --interactive -o", tmp_path / "run.npz", tmp_path / "a.trace")
    assert (code, "must end in .html" in error) == (2, True)
