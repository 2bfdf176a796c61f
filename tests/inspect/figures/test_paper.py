"""The paper's figures: which steps they show, that what is drawn is what the engine and the trace say, and refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, shipped
from beliefscope.inspect.diagnostics.plotting import write_figure
from beliefscope.inspect.figures import paper
from beliefscope.inspect.likelihood import MapEngine
from beliefscope.inspect.trace import Trace, trace

SIZE = 21


def run(name: str, task: str = "door") -> tuple[Checkpoint, Trace]:
    checkpoint = load_checkpoint(shipped(task, name))
    with open_dataset(sample_path(task)) as data:
        return checkpoint, trace(checkpoint, data[9], 9, particles=30)


@pytest.fixture(scope="module")
def pf() -> tuple[Checkpoint, Trace]:
    return run("crossmodal-pf")


@pytest.fixture(scope="module")
def ekf() -> tuple[Checkpoint, Trace]:
    return run("crossmodal-ekf", "push")


def planted(made: Trace, *spans: tuple[int, int]) -> Trace:
    """The trace with contact in these spans."""
    contact = np.zeros(len(made), dtype=bool)
    for first, end in spans:
        contact[first:end] = True
    return replace(made, episode=replace(made.episode, contact=contact))


@pytest.mark.parametrize(
    ("mask", "middle"),
    [("", None), ("...", None), ("#", 0), ("..###", 3), ("##.####.#", 4), ("##.##", 0), ("####", 1)],
)
def test_middle_of_the_longest_stretch(mask: str, middle: int | None) -> None:
    assert paper.middle_of_longest(np.array([c == "#" for c in mask], dtype=bool)) == middle


@pytest.mark.parametrize(
    ("spans", "steps"),
    [
        ([(50, 61)], {False: 80, True: 55}),  # 30..49 and 61..99 are free
        ([(0, 40), (60, 75)], {False: 87, True: 67}),  # the longest contact ends at step 40: 10 steps of it count
        ([(5, 10)], {False: 64, True: 7}),  # contact only where metrics do not count
        ([(0, 100)], {True: 64}),  # always: no step without
    ],
)
def test_the_rule_for_steps(pf: tuple[Checkpoint, Trace], spans: list[tuple[int, int]], steps: dict[bool, int]) -> None:
    assert paper.steps_by_contact(planted(pf[1], *spans)) == steps


def test_given_steps_go_before_the_rule(pf: tuple[Checkpoint, Trace]) -> None:
    made = planted(pf[1], (50, 61))
    assert paper.steps_by_contact(made, [51]) == {False: 80, True: 51}
    assert paper.steps_by_contact(made, [51, 3]) == {False: 3, True: 51}
    with pytest.raises(BadInput, match="51 and 52 are both in state 'contact'"):
        paper.steps_by_contact(made, [51, 52])
    with pytest.raises(BadInput, match="steps 0 to 99"):
        paper.steps_by_contact(made, [100])
    with pytest.raises(BadInput, match="never in contact"):
        paper.steps_by_contact(planted(made))


def test_one_panel_a_modality_and_state_whatever_their_names() -> None:
    """A picture has one; anything else, among them models of several modalities, one a state."""
    task = find_task("door")
    task = replace(task, modalities={"camera": ("image",), "wrist": ("force", "torque"), "skin": ("contact",)})
    steps = {False: 3, True: 7}
    shown = [(p.modality, p.contact, p.step) for p in paper.panels(task, ("camera", "wrist", "camera+skin"), steps)]
    assert shown == [
        ("camera", True, 7),
        ("wrist", False, 3),
        ("wrist", True, 7),
        ("camera+skin", False, 3),
        ("camera+skin", True, 7),
    ]
    assert [p.modality for p in paper.panels(task, ("camera", "wrist"), {True: 7})] == ["camera", "wrist"]


def test_drawn_maps_are_the_engines(pf: tuple[Checkpoint, Trace]) -> None:
    checkpoint, made = pf
    steps = paper.steps_by_contact(made)
    figure = paper.maps_figure(checkpoint, made, steps, SIZE)
    engine = MapEngine(checkpoint, made)
    wanted = [("image", True), ("haptics", False), ("haptics", True)]
    for axes, (modality, state) in zip(figure.axes, wanted, strict=False):
        map_ = engine.map(steps[state], size=SIZE)
        likelihood = np.exp(map_.log_likelihood[map_.layers.index(modality)].astype(np.float64))
        (drawn,) = axes.images
        # Float32 exponentials of logs of order 10: 1e-5 of the maximum, which is 1.
        np.testing.assert_allclose(drawn.get_array(), likelihood / likelihood.max(), atol=1e-5)
        assert drawn.origin == "lower"
        np.testing.assert_allclose(drawn.get_extent(), [-13.5, 13.5, -13.5, 13.5])
        assert axes.get_title().endswith(f"{modality}\n{paper.STATES[state]}, step {steps[state]}")
    dots = [[line.get_xydata()[0] for line in axes.lines if line.get_marker() == "o"] for axes in figure.axes[:3]]
    assert [len(each) for each in dots] == [0, 0, 1], "the line belongs to touch in contact"
    step = steps[True]
    effector = made.episode.observations["effector_position"][step, :2] - made.episode.states[step, :2]
    np.testing.assert_allclose(dots[2][0], 100.0 * effector, rtol=1e-5)


def drawn_lines(axes: object) -> dict[str, NDArray[np.float64]]:
    return {line.get_label(): np.asarray(line.get_ydata()) for line in axes.lines}  # type: ignore[attr-defined]


def test_drawn_weights_and_estimates_are_the_traces(ekf: tuple[Checkpoint, Trace]) -> None:
    """Weights for each component; those of a network that act by other shares are drawn beside them."""
    made = ekf[1]
    assert made.weights is not None
    assert made.effective_weights is not None
    made = replace(made, weights=0.5 * made.weights)
    x, y, weight_x, weight_y = paper.weights_figure(made).axes
    for i, (above, below) in enumerate(((x, weight_x), (y, weight_y))):
        estimates, weights = drawn_lines(above), drawn_lines(below)
        np.testing.assert_allclose(estimates["truth"], 100.0 * made.episode.states[:, i])
        np.testing.assert_allclose(estimates["fused"], 100.0 * made.estimate_mean[:, i])
        for k, name in enumerate(made.modalities):
            np.testing.assert_allclose(estimates[name], 100.0 * made.modality_mean[:, k, i])
            np.testing.assert_array_equal(weights[f"{name} beta"], made.weights[:, k, i])
            np.testing.assert_array_equal(weights[f"{name} effective_weights"], made.effective_weights[:, k, i])


def test_bands_cover_the_steps_in_contact(pf: tuple[Checkpoint, Trace]) -> None:
    """Half a step before the first and after the last, a lone step too."""
    (band,) = paper.weights_figure(planted(pf[1], (20, 30), (50, 51))).axes[0].collections
    spans = [(path.vertices[:, 0].min(), path.vertices[:, 0].max()) for path in band.get_paths()]
    assert spans == [(19.5, 29.5), (49.5, 50.5)]


def test_the_same_run_gives_the_same_bytes(pf: tuple[Checkpoint, Trace], tmp_path: Path) -> None:
    checkpoint, made = pf
    for i in range(2):
        write_figure(paper.maps_figure(checkpoint, made, paper.steps_by_contact(made), SIZE), tmp_path / f"maps{i}.svg")
        write_figure(paper.weights_figure(made), tmp_path / f"weights{i}.svg")
    for name in ("maps", "weights"):
        first, second = ((tmp_path / f"{name}{i}.svg").read_bytes() for i in range(2))
        assert first == second
        assert b"</svg>" in first


def test_refusals_say_why(tmp_path: Path) -> None:
    save_checkpoint(build(architecture("door", "lstm")), "lstm", {}, tmp_path / "lstm.safetensors")
    lstm = load_checkpoint(tmp_path / "lstm.safetensors")
    with open_dataset(sample_path("door")) as data, pytest.raises(BadInput, match="has no likelihood maps: an LSTM"):
        paper.maps_figure(lstm, trace(lstm, data[9], 9), {True: 40}, SIZE)
    checkpoint, made = run("image-ekf")
    with pytest.raises(BadInput, match="one measurement model, image, and nothing to weigh it against"):
        paper.weights_figure(made)
    blind = replace(made, modalities=(), effective_weights=None)
    with pytest.raises(BadInput, match="does not weigh its modalities"):
        paper.weights_figure(blind)
    with pytest.raises(BadInput, match="was made by checkpoint"):
        paper.maps_figure(checkpoint, replace(made, checkpoint_hash="other"), {True: 40}, SIZE)
