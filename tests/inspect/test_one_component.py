"""A state of one component in any unit: the map is a curve, and every number follows from closed forms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from beliefscope.app.protocol.map_format import encode_maps
from beliefscope.app.protocol.trace_format import columns, header, scene_layers
from beliefscope.datasets.covariate import Covariate
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.datasets.task import Component, Task
from beliefscope.datasets.task_json import task_from_json, task_to_json
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.start_offset import StartOffset
from beliefscope.inspect.catalog import DIAGNOSTICS, run_diagnostics
from beliefscope.inspect.compare.counterfactual import compare
from beliefscope.inspect.compare.two_runs import compare_runs
from beliefscope.inspect.failures.events import find_failures
from beliefscope.inspect.failures.step_scores import OTHER, EpisodeScores, Survey, phases_of, scores_of
from beliefscope.inspect.figures.paper import maps_figure, steps_by_contact
from beliefscope.inspect.maps.map_engine import MapEngine
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.sweep import summary
from beliefscope.inspect.trace import Trace, trace
from beliefscope.inspect.traces.replay import Intervention
from beliefscope.recordings.export import export_trace
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.report.compose import compose, write_report
from beliefscope.recordings.write import write_recording

DRIFT, NOISE, STEPS = 0.3, 0.5, 200  # K, standard deviations per step


def task(unit: str = "K", display: tuple[str, float] | None = None, scale: float = 1.0) -> Task:
    """A random walk that one sensor reads. scale: numbers of the unit for 1 K."""
    return Task(
        name="tank",
        components=(Component("temperature", unit, display=display),),
        observations={"reading": (1,)},
        modalities={"thermometer": ("reading",)},
        control_size=1,
        dt=0.1,
        map_components=("temperature",),
        map_half_width=2.0 * scale,
        warmup=0,
        covariates={},
    )


class Kalman(nn.Module):
    """The Kalman filter of the walk. scale: numbers of the unit for 1 K."""

    def __init__(self, scale: float = 1.0) -> None:
        super().__init__()
        self.scale = scale

    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        self.mean, self.covariance = mean, covariance

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> dict[str, Tensor]:
        predicted = self.covariance + (DRIFT * self.scale) ** 2
        noise = torch.full_like(predicted, (NOISE * self.scale) ** 2)
        gain = predicted / (predicted + noise)
        reading = observations["reading"]
        self.mean = self.mean + gain[:, 0] * (reading - self.mean)
        self.covariance = predicted - gain * predicted
        return {
            "estimate_mean": self.mean,
            "estimate_covariance": self.covariance,
            "observation_mean": reading[:, None],
            "observation_covariance": noise[:, None],
            "modality_mean": self.mean[:, None],
            "modality_covariance": self.covariance[:, None],
            "effective_weights": torch.ones_like(noise),
        }


def episode(definition: Task, seed: int, scale: float = 1.0) -> Episode:
    rng = np.random.default_rng(seed)
    states = 20.0 + np.cumsum(DRIFT * rng.standard_normal((STEPS, 1)), axis=0)
    reading = states + NOISE * rng.standard_normal((STEPS, 1))
    return Episode(
        task=definition,
        states=(scale * states).astype(np.float32),
        controls=np.zeros((STEPS, 1), np.float32),
        observations={"reading": (scale * reading).astype(np.float32)},
        contact=np.zeros(STEPS, bool),
        qpos=np.zeros((STEPS, 0)),
        dt=0.1,
        seed=seed,
        split="test",
        provenance={},
    )


def checkpoint(definition: Task, scale: float = 1.0) -> ExternalFilter:
    return ExternalFilter(
        Adapter(Kalman(scale), modalities=("thermometer",), initial_std=(0.3 * scale,)), definition, "kalman"
    )


@pytest.fixture(scope="module")
def runs() -> list[Trace]:
    filter_ = checkpoint(task())
    return [replace(trace(filter_, episode(task(), seed)), episode_index=seed) for seed in range(6)]


def test_nees_and_covariance_are_those_of_the_riccati_equation(runs: list[Trace]) -> None:
    q, r = DRIFT**2, NOISE**2
    predicted = 0.5 * (q + np.sqrt(q * q + 4.0 * q * r))  # the positive root of p^2 = q (p + r)
    assert runs[0].estimate_covariance[-1, 0, 0] == pytest.approx(predicted * r / (predicted + r), rel=1e-5)
    nees = np.concatenate([measures.nees(run)[20:, -1] for run in runs])
    deviation = np.sqrt(2.0 / len(nees)) * 2.0  # of a chi-squared mean; 2 for its correlation over steps
    assert nees.mean() == pytest.approx(1.0, abs=4.0 * deviation)


def test_a_single_model_has_no_weights(runs: list[Trace]) -> None:
    """Its effective weight is always one; scores and audits of fusion do not apply."""
    assert runs[0].effective_weights is None
    assert scores_of(task())["disagreement"].why_not(runs[0]) is not None


def test_the_figure_of_maps_has_curves(runs: list[Trace]) -> None:
    figure = maps_figure(
        checkpoint(task()), runs[0], steps_by_contact(runs[0].episode, 0, [50]), size=101, quantity="posterior"
    )
    (axes,) = figure.axes
    curve = axes.lines[0].get_xydata()
    expected = runs[0].estimate_mean[50, 0] - runs[0].episode.states[50, 0]
    assert curve[curve[:, 1].argmax(), 0] == pytest.approx(expected, abs=4.0 / 101)
    assert axes.get_xlabel() == "temperature offset (K)"
    assert axes.get_title() == "thermometer posterior\nstep 50"


def test_the_map_is_the_density_over_the_component(runs: list[Trace]) -> None:
    engine, step = MapEngine(checkpoint(task()), runs[0]), 50
    for quantity, mean, variance in (
        ("likelihood", runs[0].episode.observations["reading"][step, 0], NOISE**2),
        ("posterior", runs[0].estimate_mean[step, 0], runs[0].estimate_covariance[step, 0, 0]),
    ):
        map_ = engine.map(step, size=101, quantity=quantity)  # type: ignore[arg-type]
        at = runs[0].episode.states[step, 0] + map_.offsets_x.astype(float)
        expected = -0.5 * (at - mean) ** 2 / variance - 0.5 * np.log(2.0 * np.pi * variance)
        assert map_.log_likelihood.shape[1:] == (1, 101)
        np.testing.assert_allclose(map_.log_likelihood[-1, 0], expected, atol=2e-4)  # float32 states near 20
        assert map_.offsets_x[-1] == pytest.approx(2.0 * 100 / 101)
    encoded = encode_maps(runs[0], step, engine.map(step, size=101))
    assert '"rows": 1' in encoded.description
    # Of a Gaussian, 95 % are within 1.96 standard deviations.
    area = np.array(engine.map(step, size=1001, quantity="posterior").log_likelihood[-1, 0], float)
    share = np.sort(np.exp(area - area.max()))[::-1].cumsum()
    inside = np.searchsorted(share, 0.95 * share[-1]) * 4.0 / 1001
    assert inside == pytest.approx(2 * 1.96 * np.sqrt(runs[0].estimate_covariance[step, 0, 0]), rel=0.02)


@pytest.mark.parametrize(("unit", "display", "scale"), [("mm", ("cm", 0.1), 1000.0), ("km", ("cm", 1e5), 1e-3)])
def test_numbers_do_not_depend_on_the_unit_of_the_state(unit: str, display: tuple[str, float], scale: float) -> None:
    metres, other = task("m"), task(unit, display, scale)
    assert metres.main_error.label == other.main_error.label == "temperature (cm)"
    pairs = [(metres, 1.0), (other, scale)]
    rmse = [evaluate(checkpoint(d, s), [episode(d, 0, s)]).rmse for d, s in pairs]
    assert rmse[0] == pytest.approx(rmse[1], rel=1e-4)  # float32
    results = [
        run_diagnostics(
            [trace(checkpoint(d, s), episode(d, seed, s)) for seed in range(2)], None, {"errors": {}}, False
        )[0]["errors"]
        for d, s in pairs
    ]
    assert results[0].verdict == results[1].verdict
    for first, second in zip(results[0].tables(), results[1].tables(), strict=True):
        assert first.columns == second.columns
        for row, same in zip(first.rows, second.rows, strict=True):
            assert row[0] == same[0]
            assert row[1:] == pytest.approx(same[1:], rel=1e-3, abs=1e-3)


@pytest.mark.long
@pytest.mark.slow
def test_every_diagnostic_is_computed_or_refused_with_a_reason(runs: list[Trace]) -> None:
    results, reasons = run_diagnostics(runs, checkpoint(task()), {name: {} for name in DIAGNOSTICS}, True)
    assert {"consistency", "errors", "maps"} <= set(results)
    assert all(result.verdict and result.tables() is not None for result in results.values())
    assert all(reasons.values())
    text = " ".join(result.verdict for result in results.values())
    text += str([table for result in results.values() for table in result.tables()])
    assert " cm" not in text
    assert "osition" not in text
    (table,) = results["maps"].tables()
    assert not [name for name in table.columns if any(word in name for word in ("ridge", "ring", "area", "elong"))]
    assert {"50 % region (K)", "95 % region (K)"} <= set(table.columns)
    size = table.rows[0][table.columns.index("95 % region (K)")]
    assert size == pytest.approx(2.0 * 1.96 * NOISE, abs=2.0 * task().map_half_width / 41)  # of the Gaussian; a cell
    assert results["maps"].verdict == f"The median 95 % region of the fused likelihood is {size:.3g} K."


def test_columns_of_a_component_without_a_unit_name_none() -> None:
    plain = task(unit="")
    filter_ = ExternalFilter(Adapter(Kalman(), modalities=("thermometer",), initial_std=(0.3,)), plain, "kalman")
    run = trace(filter_, episode(plain, 0))
    results, _ = run_diagnostics([run], filter_, {name: {} for name in DIAGNOSTICS}, True)
    counterfactual = replace(run, estimate_mean=run.estimate_mean + 0.1)
    compared = [compare_runs(run, counterfactual), compare(run, counterfactual, Intervention(5, 9))]
    for table in (table for result in (*results.values(), *compared) for table in result.tables()):
        cells = [*table.columns, *(cell for row in table.rows for cell in row if isinstance(cell, str))]
        assert not [text for text in cells if "()" in text or text != text.strip(", ")], table.title


def test_start_offsets_have_the_unit_of_the_component() -> None:
    offset = StartOffset.parse("2.5K", task())
    assert (dict(offset.lengths), str(offset)) == ({"K": 2.5}, "2.5K")
    assert StartOffset.parse("5 cm", task("km", ("cm", 1e5), 1e-3)).lengths["km"] == pytest.approx(5e-5)
    with pytest.raises(BadInput, match="not in a unit of task 'tank': K"):
        StartOffset.parse("3cm", task())


def test_rows_of_sweeps_have_the_error_of_the_main_component() -> None:
    """The main error is that of the first of two components: its key is also that of the component."""
    door = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
    with open_dataset(sample_path("door")) as data:
        run = trace(door, data[9], 9)
    task_ = replace(run.task, map_components=("hinge_x",))
    named = replace(run, episode=replace(run.episode, task=task_))
    row = next(iter(summary(named)))
    error = 100.0 * measures.errors(named)[measures.phases(named)[row["phase"]], -1, 0]
    assert row["error"] == row["hinge_x_cm"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-6)
    assert row["worst"] == pytest.approx(np.abs(error).max(), rel=1e-6)
    assert row["angle_deg"] > 0.0


def test_failures_are_in_the_unit_of_the_component(runs: list[Trace]) -> None:
    failures = find_failures(checkpoint(task()), [run.episode for run in runs])
    assert (failures.title, failures.unit, failures.conversion) == ("temperature error", "K", ("K", 1.0))
    assert "K at step" in failures.verdict


def test_phases_of_failures_are_groups_of_declared_covariates(runs: list[Trace]) -> None:
    """Without covariates all steps are of one group; a rare group precedes a common one that contains its steps."""
    assert phases_of(task()) == ("blackout", "fast motion", "start", OTHER)
    covariates = {"lit": Covariate("boolean"), "stage": Covariate("categorical", ("heat", "hold"))}
    steps = np.arange(STEPS)
    values = {"lit": (steps < 150).astype(np.float32), "stage": (steps >= 20).astype(np.float32)}
    declared = replace(task(), covariates=covariates)
    traces = [replace(run, episode=replace(run.episode, task=declared, covariates=values)) for run in runs]
    survey = Survey.from_episodes(map(EpisodeScores.from_trace, traces))
    assert [*survey.phases][3:] == ["heat", "no lit", "lit", "hold", OTHER]
    assert sorted(survey.phases) == sorted(phases_of(declared))
    phase = np.array([*survey.phases])[survey.phase_index].reshape(len(runs), STEPS)
    slow = ~survey.phases["fast motion"].reshape(phase.shape)
    for name, where in (("heat", steps < 20), ("lit", (steps >= 20) & (steps < 150)), ("no lit", steps >= 150)):
        assert (phase[:, where][slow[:, where]] == name).all()
    assert not evaluate(checkpoint(declared), [traces[0].episode]).rmse_before_contact


@pytest.mark.slow
@pytest.mark.long
def test_recording_report_export_and_page(runs: list[Trace], tmp_path: Path) -> None:
    run, filter_ = runs[0], checkpoint(task())
    maps = MapEngine(filter_, run).maps(range(0, 200, 50), size=41)
    recording = write_recording(run, tmp_path / "run.rrd", maps)
    assert read_recording(recording).task == run.task
    write_report(compose([run], filter_, files=[recording]), tmp_path / "report")
    html = (tmp_path / "report" / "report.html").read_text()
    assert "temperature (K)" in html
    assert " cm" not in html
    for suffix in ("parquet", "mcap", "npz"):
        export_trace(run, tmp_path / f"run.{suffix}")
    assert scene_layers(run.task, run, None) == []
    assert header(run, columns(run)[0], run.task, None, {})["components"][0]["display_unit"] == "K"


def test_the_definition_is_stored_with_one_map_component() -> None:
    assert task_from_json(task_to_json(task())) == task()
    for names in ([], ["temperature", "temperature"]):
        with pytest.raises(BadInput, match="expected one or two names"):
            task_from_json(task_to_json(task()) | {"map_components": names})
