"""Likelihood maps: values, exported files, display options and permalinks."""

from __future__ import annotations

import csv
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.maps.map_engine import LikelihoodMap, MapEngine
from beliefscope.inspect.maps.map_statistics import measure_maps
from beliefscope.inspect.maps.shape import SHAPES
from beliefscope.inspect.trace import Trace, trace

STEP = 25
LINK = f"?filter=crossmodal-pf&step={STEP}&tab=diagnostics"


@pytest.fixture(scope="module")
def engine() -> MapEngine:
    checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-pf"))
    with open_dataset(sample_path("door")) as data:
        episode = data[9]
    return MapEngine(checkpoint, trace(checkpoint, episode, episode_index=9))


@pytest.fixture(scope="module")
def expected(engine: MapEngine) -> LikelihoodMap:
    return engine.map(STEP)


def numbers(text: str) -> list[float]:
    return [float(n.replace("\N{MINUS SIGN}", "-")) for n in re.findall("[+\N{MINUS SIGN}]?\\d+(?:\\.\\d+)?", text)]


def test_values_and_exports_match_the_engine_and_the_quantity_is_a_switch(
    open_page: Any, engine: MapEngine, expected: LikelihoodMap, tmp_path: Path
) -> None:
    page = open_page(LINK)
    assert page.state["episode"] == 9
    check_probe(page, expected)
    page.page.locator("#maps-view").click()
    check_numbers(page, expected, engine.trace)
    files = {}
    for kind in ("csv", "svg", "png"):
        with page.page.expect_download() as download:
            page.page.locator(f"#maps-options [data-as={kind}]").click()
        files[kind] = tmp_path / download.value.suggested_filename
        download.value.save_as(files[kind])
    assert files["csv"].name == "door-crossmodal-pf-episode9-step25-maps.csv"
    rows = list(csv.reader(line for line in files["csv"].read_text().splitlines() if not line.startswith("#")))
    assert rows[0] == ["hinge_x_offset_cm", "hinge_y_offset_cm", "hinge_x_cm", "hinge_y_cm"] + [
        f"{m}_ln_likelihood_nats" for m in expected.layers
    ]
    cells = np.array(rows[1:], dtype=float)
    # Likelihoods have four decimals and 65535 levels over less than 64 nats; positions have three decimals in cm.
    np.testing.assert_allclose(
        cells[:, 4:].T.reshape(expected.log_likelihood.shape), expected.log_likelihood, atol=6e-4
    )
    dx, dy = np.meshgrid(100.0 * expected.offsets_x, 100.0 * expected.offsets_y)
    np.testing.assert_allclose(cells[:, :2], np.stack([dx.ravel(), dy.ravel()], axis=1), atol=1e-3)
    np.testing.assert_allclose(
        cells[:, 2:4] - cells[:, :2], 100.0 * expected.centre[None].repeat(len(cells), 0), atol=2e-3
    )
    page.page.keyboard.press("Escape")
    for query, command in {"step 12": "Go toStep 12", "export csv": "ActionExport the maps as CSV"}.items():
        page.page.keyboard.press("Escape")
        page.page.keyboard.press("Control+k")
        page.page.keyboard.type(query)
        assert page.page.locator("#command-list > *").first.text_content() == command
    with page.page.expect_download() as download:
        page.page.keyboard.press("Enter")
    assert download.value.suggested_filename == files["csv"].name
    drawing = ElementTree.parse(files["svg"]).getroot()
    assert len(drawing.findall(".//{*}clipPath")) == 3
    texts = [text.text for text in drawing.iter("{http://www.w3.org/2000/svg}text")]
    assert {*(f"{layer} likelihood" for layer in expected.layers), "Δ hinge x (cm)"} <= {*texts}
    assert {"truth", "image-only update", "haptics-only update", "fused", "50 % region"} <= {*texts}
    assert files["png"].read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    page.page.keyboard.press("Escape")
    check_quantity(page)


def check_numbers(page: Any, expected: LikelihoodMap, run: Trace) -> None:
    """Numbers in the menu of the maps, with their displayed precision, and the names of the shapes on the maps."""
    measured = measure_maps([expected], run)
    for layer, row in enumerate(page.page.locator("#maps-measures tbody tr").all()):
        peak, area50, area95, entropy, shape = row.locator("td").all_text_contents()
        assert numbers(peak) == pytest.approx((100.0 * expected.peaks()[layer]).tolist(), abs=0.051)
        areas_cm2 = [1e4 * a[0, layer] for a in (measured.area50, measured.area95)]
        assert numbers(area50 + " " + area95) == pytest.approx(areas_cm2, abs=0.51)
        assert numbers(entropy) == pytest.approx([measured.entropy[0, layer] + np.log(1e4)], abs=0.0051)
        assert shape.startswith(SHAPES[measured.shape[0, layer]])
        if shape.startswith("ridge"):
            sizes = [np.degrees(measured.axis[0, layer]), measured.elongation[0, layer], 1]
            sizes.append(np.degrees(measured.deviation[0, layer]))
            assert numbers(shape) == pytest.approx(sizes, abs=0.51)
        assert shape.startswith(page.page.locator("#heatmaps .shape").nth(layer).text_content())
    pair = numbers(page.page.locator("#maps-pairs").text_content())
    assert pair[:2] == pytest.approx([measured.divergence[0, 0, 1], measured.divergence[0, 1, 0]], abs=0.051)
    assert pair[2] == pytest.approx(100.0 * measured.overlap[0, 0, 1], abs=0.51)


def check_probe(page: Any, expected: LikelihoodMap) -> None:
    """Arrow keys on a map move the probe and keep the step."""
    heights = "() => document.querySelector('#maps').offsetHeight"
    before = page.page.evaluate(heights)
    page.page.locator("#heatmaps canvas").nth(1).focus()
    for key in ("ArrowRight", "Shift+ArrowUp"):
        page.page.keyboard.press(key)
    assert page.state["step"] == STEP
    assert page.page.locator("#maps-value").text_content() == "+0.2, +1.0 cm"
    values = expected.log_likelihood[:, 67 + 5, 67 + 1]
    relative = np.exp(values - expected.log_likelihood.max(axis=(1, 2)))
    assert numbers(" ".join(page.page.locator("#maps-readout div p").all_text_contents())) == pytest.approx(
        [relative[1], values[1]], abs=0.0061
    )
    for layer, text in enumerate(page.page.locator("#heatmaps .shape").all_text_contents()):
        assert numbers(text) == pytest.approx([relative[layer]], abs=0.0061)
    assert "haptics" in page.page.locator("#maps-announcement").text_content()
    assert page.page.evaluate(heights) == before
    page.page.keyboard.press("Escape")
    assert page.page.locator("#maps-readout").is_hidden()


@pytest.mark.long
def test_other_components_are_selected_in_the_menu(open_page: Any, engine: MapEngine) -> None:
    page = open_page(f"{LINK}&map=posterior")
    page.page.locator("#maps-view").click()
    page.page.locator("#maps-options select").first.select_option("hinge_x,angle")
    title = "Posterior of the hinge x, angle. Fused: prior times beta-weighted sum"
    page.until(f"() => document.querySelector('#maps h2').textContent.startsWith('{title}')")
    assert page.page.locator("#angle-label").text_content().startswith("Cross-section at hinge y")
    page.page.locator("#maps-others label", has=page.page.locator("[value=marginal]")).click()
    page.until("() => document.querySelector('#maps-rule').textContent.includes('hinge y integrated out')")
    assert page.page.locator("#angle-label").is_hidden()
    page.settle(STEP)
    expected = engine.map(STEP, quantity="posterior", components=("hinge_x", "angle"), others="marginal")
    degrees = np.array([100.0, 180.0 / np.pi])
    for layer, line in enumerate(page.page.locator("#maps-measures td:nth-child(2)").all_text_contents()):
        assert numbers(line) == pytest.approx(expected.peaks()[layer] * degrees, abs=0.051)
    page.until(
        "() => location.search.includes('plane=hinge_x%2Cangle&') && location.search.includes('others=marginal')"
    )


@pytest.mark.long
def test_options_are_in_the_permalink_and_gains_refer_to_the_pinned_step(
    open_page: Any, expected: LikelihoodMap
) -> None:
    page = open_page(LINK)
    plain = page.maps()
    page.page.locator("#maps-view").click()
    for option, value in [("scale", "log"), ("range", "same"), ("axes", "world"), ("cloud", "shown")]:
        before = page.maps()
        page.page.locator(f"#maps-{option} label", has=page.page.locator(f"[value={value}]")).click()
        page.until(f"() => location.search.includes('{option}={value}')")
        assert page.maps() != before
    top = expected.log_likelihood.max()
    lowest = max(expected.log_likelihood.min(), top - 40.0)
    ends = page.page.locator("#maps-colour-bar b").all_text_contents()
    assert [numbers(end)[0] for end in ends] == pytest.approx([lowest, top], abs=0.51)
    assert page.page.locator("#maps-colour-bar span").text_content() == "log likelihood, nats"
    page.screenshot("maps-log-world")
    page.page.locator("#maps-scale label").first.click()
    page.page.keyboard.press("Escape")
    page.page.locator("h1").click()
    page.page.keyboard.press("m")
    page.page.locator("#heatmaps canvas").first.hover()
    values = page.page.locator("#heatmaps .shape").all_text_contents()
    assert all(text == "change 0.00 nats" for text in values)  # relative to itself
    page.page.keyboard.press("Shift+ArrowRight")
    page.settle(STEP + 10)
    assert page.page.locator("#maps-kind").text_content() == f"Change from step {STEP}"
    values = page.page.locator("#heatmaps .shape").all_text_contents()
    assert not any(text == "change 0.00 nats" for text in values)
    page.screenshot("maps-gain")
    page.until(f"() => location.search.includes('pin=') && location.search.includes('step={STEP + 10}')")
    again = open_page("?" + page.page.url.partition("?")[2])  # the pinned step is restored without a visit
    again.until(f"() => document.querySelector('#maps-kind').textContent === 'Change from step {STEP}'")
    assert (again.state["pin"], again.state["step"]) == (page.state["pin"], STEP + 10)
    again.page.locator("#heatmaps canvas").first.hover()
    assert again.page.locator("#heatmaps .shape").all_text_contents() == values
    page.page.keyboard.press("m")
    page.page.keyboard.press("Shift+ArrowLeft")
    page.settle(STEP)
    for option in ("range", "axes", "cloud"):
        page.page.evaluate(f"() => document.querySelector('#maps-{option} input').click()")
    page.page.mouse.move(5, 5)
    page.until("() => !location.search.includes('axes=')")
    assert page.maps() == plain


def check_quantity(page: Any) -> None:
    """The quantity of the maps is a switch, has a key, is in the permalink and can be undone."""
    rule, kind = page.page.locator("#maps-rule"), page.page.locator("#maps-kind")
    assert kind.text_content() == "Likelihood"
    assert rule.text_content() == ". Fused: beta-weighted sum of normalised likelihoods (crossmodal)"
    likelihoods = page.maps()
    page.page.locator("#maps-map label", has_text="Posterior").click()
    page.until("() => document.querySelector('#maps-rule').textContent.startsWith('. Fused: prior times')")
    page.until("() => location.search.includes('map=posterior')")
    page.settle(STEP)
    posteriors = page.maps()
    assert posteriors != likelihoods
    assert kind.text_content() == "Posterior"
    page.page.locator("h1").click()
    page.page.keyboard.press("p")
    page.until("() => !location.search.includes('map=posterior')")
    page.page.keyboard.press("Control+z")
    page.until("() => location.search.includes('map=posterior')")
    assert page.page.locator("#maps-map input:checked").input_value() == page.state["map"] == "posterior"
    check_tiles(page)


def check_tiles(page: Any) -> None:
    """Small maps of several steps: each tile has its own content and moves the cursor."""
    page.page.evaluate("() => document.querySelector('#maps-tiles input[value=several]').click()")
    page.until("() => location.search.includes('tiles=several')")
    assert not page.page.locator("#heatmaps").is_visible()
    heads = page.page.locator("#map-tiles .step")
    steps = [int(text) for text in page.page.locator("#map-tiles .step span:first-child").all_text_contents()]
    assert steps == [11, 12, 15, 20, 25, 30, 35, 40]
    assert heads.nth(0).get_attribute("aria-label") == "Step 11, free"
    assert heads.nth(1).get_attribute("aria-label") == "Step 12, contact"
    content = "[...document.querySelectorAll('#map-tiles canvas')].map((c) => c.toDataURL())"
    page.until(f"() => new Set({content}).size === 24")
    page.until("() => document.querySelectorAll('#map-tiles [data-cells=\"135\"]').length === 24")  # fine ones follow
    page.screenshot("maps-tiles")
    page.page.locator("#map-tiles canvas").nth(8 + 1).click()  # haptics at the first contact
    page.settle(12)
    assert page.page.locator("#map-tiles .step.current").first.get_attribute("data-step") == "12"
    page.page.evaluate("() => document.querySelector('#maps-tiles input').click()")
    page.until("() => !location.search.includes('tiles=')")
    page.page.locator("#heatmaps canvas").first.wait_for()


@pytest.mark.long
def test_summary_and_zoom_of_a_step(open_page: Any) -> None:
    page = open_page("?task=push&filter=crossmodal-ekf&episode=79&step=68")
    assert (
        page.page.locator("#step-summary")
        .text_content()
        .endswith("although the error of the image-only update is 0.76 cm.")
    )
    images = {"fit": page.maps()}
    for zoom in ("4", "1"):
        page.page.evaluate(f"""() => document.querySelector('#maps-zoom input[value="{zoom}"]').click()""")
        page.until(f"() => beliefscope.state().zoom === '{zoom}'")
        page.page.evaluate("() => new Promise(requestAnimationFrame)")
        images[zoom] = page.maps()
    assert images["4"] != images["1"]
    assert images["fit"] in (images["4"], images["1"])
