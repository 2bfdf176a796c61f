"""The timeline as a figure and as CSV: the plotted values, the marks and the errors."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.inspect.diagnosis.checks.test_innovations import BIAS, STD, Boat, sail

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import as_external
from beliefscope.inspect.figures.timeline import Timeline, View, timeline
from beliefscope.inspect.figures.timeline_charts import Chart, Series, chart_names, value_range
from beliefscope.inspect.figures.timeline_figure import encoded_timeline, timeline_figure
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace, trace

pytestmark = pytest.mark.slow

FAULTS = "blackout=0.5:from=20:to=60"
SVG = "{http://www.w3.org/2000/svg}"


def run(name: str, faults: str = "") -> Trace:
    checkpoint = load_checkpoint(pretrained_path("door", name))
    with open_dataset(sample_path("door")) as data:
        return trace(checkpoint, data[9], 9, particles=30, faults=Faults.parse(faults))


@pytest.fixture(scope="module")
def ekf() -> Trace:
    return run("crossmodal-ekf", FAULTS)


@pytest.fixture(scope="module")
def pf() -> Trace:
    return run("crossmodal-pf")


@pytest.fixture(scope="module")
def boat() -> Trace:
    """A run of a Kalman filter that reports its innovations; the radar has a reading at every fourth step."""
    episode = sail(0)
    adapter = Adapter(Boat(), batched=False, modalities=tuple(STD), initial_std=(0.5, 0.5, 0.1, BIAS))
    return trace(as_external(adapter, "boat", episode.task), episode)


def table(drawn: Timeline) -> dict[str, NDArray[np.float64]]:
    """Column -> values of the CSV file; NaN for an empty cell."""
    header, *rows = csv.reader(io.StringIO(drawn.csv()))
    values = np.array([[float(cell or "nan") for cell in row] for row in rows])
    return dict(zip(header, values.T, strict=True))


def test_csv_has_the_values_of_the_visible_steps_with_units(ekf: Trace) -> None:
    values = table(timeline(ekf, View(("estimate", "error", "signed", "nees"), "angle", window="15.5-70")))
    steps = np.arange(16, 71)
    assert values["step"].tolist() == steps.tolist()
    np.testing.assert_allclose(values["time_s"], 0.1 * steps)
    degrees = np.degrees(1.0)
    np.testing.assert_allclose(values["angle_truth_deg"], degrees * ekf.episode.states[steps, 2], rtol=1e-6)
    np.testing.assert_allclose(values["angle_fused_deg"], degrees * ekf.estimate_mean[steps, 2], rtol=1e-6)
    sigma = degrees * np.sqrt(ekf.modality_covariance[steps, 0, 2, 2])
    np.testing.assert_allclose(values["angle_image_only_update_sigma_deg"], sigma, rtol=1e-5)
    errors = degrees * measures.errors(ekf)[steps, :, 2]
    np.testing.assert_allclose(values["signed_error_angle_haptics_only_update_deg"], errors[:, 1], rtol=1e-5)
    np.testing.assert_allclose(values["angle_error_fused_deg"], np.abs(errors[:, 2]), rtol=1e-5)
    np.testing.assert_allclose(values["nees_n_fused"], measures.nees(ekf)[steps, 2], rtol=1e-5)
    for name, mask in (("contact", ekf.episode.contact > 0), ("image_blackout", measures.blackout(ekf))):
        assert values[name].astype(bool).tolist() == mask[steps].tolist()
    assert values["injected_fault"].tolist() == ((steps >= 20) & (steps < 60)).astype(float).tolist()


def test_weights_are_effective_or_beta(ekf: Trace) -> None:
    effective, beta = (table(timeline(ekf, View(("weights",), beta=beta))) for beta in (False, True))
    assert ekf.effective_weights is not None
    assert ekf.weights is not None
    image = effective["effective_weight_hinge_x_image"]
    np.testing.assert_allclose(image, ekf.effective_weights[:, 0, 0], rtol=1e-6)
    np.testing.assert_allclose(beta["fusion_weight_beta_hinge_x_haptics"], ekf.weights[:, 1, 0], rtol=1e-6)


def test_reported_innovations_and_readings_are_lines_of_channels(boat: Trace) -> None:
    assert {"innovation/radar", "innovation/compass", "readings/radar", "readings/control"} <= {*chart_names(boat)}
    drawn = timeline(boat, View(("innovation", "innovation/radar", "readings/radar")))
    innovations, radar, readings = drawn.charts
    assert [line.source for line in innovations.series] == [*range(len(innovations.series))]
    assert len(radar.series) == 2 < len(innovations.series)
    assert boat.innovation is not None
    np.testing.assert_allclose(radar.series[0].values, boat.innovation[:, boat.modalities.index("radar"), 0], rtol=1e-5)
    absent = ~boat.episode.present("radar")
    assert np.isnan(readings.series[0].values[absent]).all()
    sigma = radar.series[0].sigma
    assert sigma is not None
    assert np.isfinite(sigma[np.flatnonzero(~absent)[0] :]).all()  # held between readings
    assert len(timeline_figure(drawn).axes) == 3


def test_charts_without_values_are_named(ekf: Trace, pf: Trace) -> None:
    assert timeline(ekf, View(("particles", "error"))).missing == {"particles": "the filter has no particles"}
    drawn = timeline(pf, View(("innovation", "particles")))
    assert [*drawn.missing] == ["innovation"]
    np.testing.assert_allclose(
        table(drawn)["effective_sample_size_of_30_particles_fused"],
        pf.effective_sample_size,
        rtol=1e-5,
    )


@pytest.mark.parametrize(
    ("view", "message"),
    [
        ({"charts": ("bars",)}, "chart 'bars' does not exist"),
        ({"charts": ("particles",)}, "no chart has values: particles: the filter has no particles"),
        ({"component": "z"}, "component 'z' of task 'door' does not exist"),
        ({"group": "rain"}, "group 'rain' of steps does not exist. Available: contact"),
        ({"window": "20"}, "window '20' is not FIRST-LAST, such as 20-60"),
        ({"window": "-5-20"}, "window '-5-20' is not FIRST-LAST"),
        ({"window": "50-50"}, "window '50-50' has one step: a line needs two"),
        ({"window": "60-20"}, "window '60-20' has no steps: the run has steps 0 to 99"),
        ({"window": "200-300"}, "window '200-300' has no steps: the run has steps 0 to 99"),
    ],
)
def test_invalid_views_are_refused(ekf: Trace, view: dict[str, str], message: str) -> None:
    with pytest.raises(BadInput, match=re.escape(message)):
        timeline(ekf, View(**view))  # type: ignore[arg-type]


def test_comparison_run(ekf: Trace, pf: Trace, boat: Trace) -> None:
    other = replace(pf, settings={**pf.settings, "edits": [{"from": 30, "to": 40}]})
    drawn = timeline(ekf, View(), other)
    values = table(drawn)
    expected = 100.0 * measures.main_error(pf)[:, -1]
    np.testing.assert_allclose(values["position_error_fused_comparison_cm"], expected, rtol=1e-5)
    assert np.flatnonzero(values["intervention"]).tolist() == [*range(30, 40)]
    assert "position_error_truth_comparison_cm" not in values
    alone = timeline(ekf, View(("estimate",)), replace(pf, settings={**pf.settings, "standalone": "image"}))
    (line,) = [line for line in alone.charts[0].series if line.comparison and line.name == "image standalone"]
    assert line.source == "image"
    particles = timeline(ekf, View(("particles",)), pf)  # only the comparison run has them
    assert particles.charts[0].series[0].comparison
    assert timeline_figure(drawn).axes[0].get_legend().get_texts()[-1].get_text()
    with pytest.raises(BadInput, match="another episode"):
        timeline(ekf, View(), boat)


def test_figure_has_one_column_with_axes_units_legend_and_marks(ekf: Trace) -> None:
    drawn = timeline(ekf, View(window="15-70", seconds=True))
    figure = timeline_figure(drawn)
    assert figure.get_figwidth() == pytest.approx(8.5 / 2.54)
    weights, estimate, error = figure.axes
    assert [axes.get_ylabel() for axes in figure.axes] == ["", "cm", "cm"]
    assert error.get_xlabel() == "time (s)"
    assert error.get_xlim() == pytest.approx((1.5, 7.0))
    fused = estimate.get_lines()[-1]
    np.testing.assert_allclose(fused.get_ydata(), 100.0 * ekf.estimate_mean[15:71, 0], rtol=1e-6)
    labels = [[text.get_text() for text in axes.get_legend().get_texts()] for axes in (weights, estimate)]
    assert {*labels[0]} == {"image", "haptics", "contact", "image blackout", "injected fault"}
    assert {*labels[1]} == {"truth", "image-only update", "haptics-only update", "fused", "±2σ"}  # noqa: RUF001
    assert error.get_legend() is None  # its labels are in the legends above
    low, high = value_range(drawn.charts[2], 15, 70)
    assert error.get_ylim()[0] == low
    assert error.get_ylim()[1] > high  # room for the marks


@pytest.mark.long
def test_files_have_embedded_fonts_and_are_reproducible(ekf: Trace) -> None:
    drawn = timeline(ekf, View(("estimate",)))
    pdf = encoded_timeline(drawn, "pdf")
    assert b"/FontFile2" in pdf  # TrueType
    assert b"/Type3" not in pdf
    assert pdf == encoded_timeline(drawn, "pdf")
    drawing = ElementTree.fromstring(encoded_timeline(drawn, "svg"))
    assert {"Hinge x", "cm", "fused"} <= {text.text for text in drawing.iter(f"{SVG}text")}
    assert encoded_timeline(drawn, "csv").startswith(b"step,time_s,hinge_x_truth_cm")


def test_the_range_leaves_out_outliers_of_modalities_only() -> None:
    values = np.r_[np.linspace(0.0, 1.0, 99), 50.0]
    of_modality, of_truth = (value_range(Chart("", "", [Series("", s, values)]), 0, 99)[1] for s in ("image", "truth"))
    assert of_modality < 2.0
    assert of_truth > 50.0
    assert value_range(Chart("", "", [Series("", "fused", np.ones(3))], bounds=(0.1, 3.0)), 0, 2) == (0.05, 6.0)
    assert value_range(Chart("", "", [Series("", "fused", np.full(3, np.nan))]), 0, 2) == pytest.approx((-0.06, 1.06))
