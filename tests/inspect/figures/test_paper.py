"""Figures of the paper: selection of steps, drawn values, and refusals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path, save_checkpoint
from beliefscope.inspect.diagnostics.plotting import write_figure
from beliefscope.inspect.figures import paper
from beliefscope.inspect.maps.map_engine import MapEngine
from beliefscope.inspect.trace import Trace, trace

pytestmark = pytest.mark.slow

SIZE = 21


def run(name: str, task: str = "door") -> tuple[Checkpoint, Trace]:
    checkpoint = load_checkpoint(pretrained_path(task, name))
    with open_dataset(sample_path(task)) as data:
        return checkpoint, trace(checkpoint, data[9], 9, particles=30)


@pytest.fixture(scope="module")
def pf() -> tuple[Checkpoint, Trace]:
    return run("crossmodal-pf")


@pytest.fixture(scope="module")
def ekf() -> tuple[Checkpoint, Trace]:
    return run("crossmodal-ekf", "push")


def steps_by_contact(traced: Trace, selection: Sequence[int] = ()) -> dict[bool, int]:
    return paper.steps_by_contact(traced.episode, traced.episode_index, selection)


def planted(traced: Trace, *spans: tuple[int, int]) -> Trace:
    """A copy of a trace with contact in the given spans."""
    contact = np.zeros(len(traced), dtype=bool)
    for first, end in spans:
        contact[first:end] = True
    return replace(traced, episode=replace(traced.episode, contact=contact))


@pytest.mark.parametrize(
    ("mask", "middle"),
    [("", None), ("...", None), ("#", 0), ("..###", 3), ("##.####.#", 4), ("##.##", 0), ("####", 1)],
)
def test_middle_of_the_longest_interval(mask: str, middle: int | None) -> None:
    assert paper.middle_of_longest(np.array([c == "#" for c in mask], dtype=bool)) == middle


@pytest.mark.parametrize(
    ("spans", "steps"),
    [
        ([(50, 61)], {False: 80, True: 55}),  # free motion in 30..49 and 61..99
        ([(0, 40), (60, 75)], {False: 87, True: 67}),  # 10 counted steps of the longest contact
        ([(5, 10)], {False: 64, True: 7}),  # contact in warm-up steps only
        ([(0, 100)], {True: 64}),  # no free motion
    ],
)
def test_default_steps(pf: tuple[Checkpoint, Trace], spans: list[tuple[int, int]], steps: dict[bool, int]) -> None:
    assert steps_by_contact(planted(pf[1], *spans)) == steps


def test_steps_of_a_task_without_contact(pf: tuple[Checkpoint, Trace]) -> None:
    traced = planted(pf[1], (50, 61))
    task = replace(traced.task, covariates={})
    traced = replace(traced, episode=replace(traced.episode, task=task))
    assert steps_by_contact(traced) == {False: 64}
    assert steps_by_contact(traced, [51]) == {False: 51}
    assert [panel.modality for panel in paper.panels(task, traced.modalities, {False: 51})] == ["image", "haptics"]
    with pytest.raises(BadInput, match="steps 51 and 52 are two: select one"):
        steps_by_contact(traced, [51, 52])


def test_selected_steps(pf: tuple[Checkpoint, Trace]) -> None:
    traced = planted(pf[1], (50, 61))
    assert steps_by_contact(traced, [51]) == {False: 80, True: 51}
    assert steps_by_contact(traced, [51, 3]) == {False: 3, True: 51}
    with pytest.raises(BadInput, match="51 and 52 are both in 'contact'"):
        steps_by_contact(traced, [51, 52])
    with pytest.raises(BadInput, match="steps 0 to 99"):
        steps_by_contact(traced, [100])
    with pytest.raises(BadInput, match="has no contact"):
        steps_by_contact(planted(traced))


def test_panels_by_modality_and_contact_state() -> None:
    """Images have one panel; other modalities and shared models have one per contact state."""
    task = find_task("door")
    task = replace(task, modalities={"camera": ("image",), "wrist": ("force", "torque"), "skin": ("contact",)})
    steps = {False: 3, True: 7}
    panels = [(p.modality, p.contact, p.step) for p in paper.panels(task, ("camera", "wrist", "camera+skin"), steps)]
    assert panels == [
        ("camera", True, 7),
        ("wrist", False, 3),
        ("wrist", True, 7),
        ("camera+skin", False, 3),
        ("camera+skin", True, 7),
    ]
    assert [p.modality for p in paper.panels(task, ("camera", "wrist"), {True: 7})] == ["camera", "wrist"]


def test_drawn_maps_equal_the_engine(pf: tuple[Checkpoint, Trace]) -> None:
    checkpoint, traced = pf
    steps = steps_by_contact(traced)
    figure = paper.maps_figure(checkpoint, traced, steps, SIZE)
    engine = MapEngine(checkpoint, traced)
    expected = [("image", True), ("haptics", False), ("haptics", True)]
    for axes, (modality, state) in zip(figure.axes, expected, strict=False):
        map_ = engine.map(steps[state], size=SIZE)
        likelihood = np.exp(map_.log_likelihood[map_.layers.index(modality)].astype(np.float64))
        (image,) = axes.images
        # Tolerance for float32 exponentials.
        np.testing.assert_allclose(image.get_array(), likelihood / likelihood.max(), atol=1e-5)
        assert image.origin == "lower"
        np.testing.assert_allclose(image.get_extent(), [-13.5, 13.5, -13.5, 13.5])
        assert axes.get_title().endswith(f"{modality} likelihood\n{paper.STATES[state]}, step {steps[state]}")
    dots = [[line.get_xydata()[0] for line in axes.lines if line.get_marker() == "o"] for axes in figure.axes[:3]]
    assert [len(points) for points in dots] == [0, 0, 1], "only haptics in contact shows the end effector"
    step = steps[True]
    effector = traced.episode.observations["effector_position"][step, :2] - traced.episode.states[step, :2]
    np.testing.assert_allclose(dots[2][0], 100.0 * effector, rtol=1e-5)
    (ridge,) = (line for line in figure.axes[2].lines if line.get_label() == "expected ridge")
    direction = np.subtract(ridge.get_xy2(), ridge.get_xy1())
    assert np.arctan2(*direction[::-1]) == pytest.approx(traced.episode.states[step, 2] + np.pi / 2)
    posterior = paper.maps_figure(checkpoint, traced, {True: step}, SIZE, "posterior")
    assert posterior.axes[0].get_title().startswith("(a) image posterior")


def lines_of(axes: object) -> dict[str, NDArray[np.float64]]:
    return {line.get_label(): np.asarray(line.get_ydata()) for line in axes.lines}  # type: ignore[attr-defined]


def test_drawn_weights_and_estimates_equal_the_trace(ekf: tuple[Checkpoint, Trace]) -> None:
    """Component-wise weights; effective weights are drawn if they differ from beta."""
    traced = ekf[1]
    assert traced.weights is not None
    assert traced.effective_weights is not None
    traced = replace(traced, weights=0.5 * traced.weights)
    x, y, weight_x, weight_y = paper.weights_figure(traced).axes
    for i, (above, below) in enumerate(((x, weight_x), (y, weight_y))):
        estimates, weights = lines_of(above), lines_of(below)
        np.testing.assert_allclose(estimates["truth"], 100.0 * traced.episode.states[:, i])
        np.testing.assert_allclose(estimates["fused"], 100.0 * traced.estimate_mean[:, i])
        for k, name in enumerate(traced.modalities):
            np.testing.assert_allclose(estimates[f"{name}-only update"], 100.0 * traced.modality_mean[:, k, i])
            np.testing.assert_array_equal(weights[f"{name} beta"], traced.weights[:, k, i])
            np.testing.assert_array_equal(weights[f"{name} effective"], traced.effective_weights[:, k, i])


def test_bands_cover_the_steps_in_contact(pf: tuple[Checkpoint, Trace]) -> None:
    """Bands extend by half a step on both sides, also around isolated steps."""
    (band,) = paper.weights_figure(planted(pf[1], (20, 30), (50, 51))).axes[0].collections
    spans = [(path.vertices[:, 0].min(), path.vertices[:, 0].max()) for path in band.get_paths()]
    assert spans == [(19.5, 29.5), (49.5, 50.5)]


def test_figures_are_reproducible(pf: tuple[Checkpoint, Trace], tmp_path: Path) -> None:
    checkpoint, traced = pf
    for i in range(2):
        write_figure(paper.maps_figure(checkpoint, traced, steps_by_contact(traced), SIZE), tmp_path / f"maps{i}.svg")
        write_figure(paper.weights_figure(traced), tmp_path / f"weights{i}.svg")
    for name in ("maps", "weights"):
        first, second = ((tmp_path / f"{name}{i}.svg").read_bytes() for i in range(2))
        assert first == second
        assert b"</svg>" in first


def test_refusals(tmp_path: Path) -> None:
    save_checkpoint(build(architecture("door", "lstm")), "lstm", {}, tmp_path / "lstm.safetensors")
    lstm = load_checkpoint(tmp_path / "lstm.safetensors")
    with open_dataset(sample_path("door")) as data, pytest.raises(BadInput, match="has no likelihood maps: an LSTM"):
        paper.maps_figure(lstm, trace(lstm, data[9], 9), {True: 40}, SIZE)
    checkpoint, traced = run("image-ekf")
    with pytest.raises(BadInput, match="only one measurement model, image"):
        paper.weights_figure(traced)
    unweighted = replace(traced, modalities=(), effective_weights=None)
    with pytest.raises(BadInput, match="has no fusion weights"):
        paper.weights_figure(unweighted)
    with pytest.raises(BadInput, match="the trace is from checkpoint"):
        paper.maps_figure(checkpoint, replace(traced, checkpoint_hash="other"), {True: 40}, SIZE)


def test_weights_without_effective_ones_are_the_output_of_the_network() -> None:
    """An external filter may report its fusion weights only."""
    _, traced = run("crossmodal-ekf")
    axes = paper.weights_figure(replace(traced, effective_weights=None)).axes[-1]
    assert {line.get_label() for line in axes.lines} == {"image beta", "haptics beta"}


def test_effective_weights_are_drawn_without_updates_by_modality() -> None:
    _, traced = run("crossmodal-ekf")
    unknown = np.full_like(traced.modality_mean, np.nan)
    x, *_, weight = paper.weights_figure(replace(traced, weights=None, modality_mean=unknown)).axes
    assert {*lines_of(x)} == {"fused", "truth"}
    assert {*lines_of(weight)} == {"image effective", "haptics effective"}
