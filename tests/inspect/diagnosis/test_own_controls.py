"""Causes in controls that do not command a measured hand: of a cart whose velocity is controlled."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from torch import Tensor

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.external.load import as_external
from beliefscope.filters.models.dynamics import Dynamics
from beliefscope.inspect.diagnosis.catalog import causes_of
from beliefscope.inspect.diagnosis.checks.controls import law_statistics
from beliefscope.inspect.diagnosis.checks.dynamics import module_dynamics_statistics
from beliefscope.inspect.diagnosis.scoring import applicable, explain, probabilities
from beliefscope.inspect.diagnosis.undo.readings import advance, negate_control, scale_control
from beliefscope.inspect.diagnosis.undo.run_inputs import RunInputs, Undo
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation

TASK = Task("cart", (Component("x", "m"), Component("y", "m")), {"gps": (2,)}, {"gps": ("gps",)}, 2, 0.1)
NOISE = 0.01


class Driven(Dynamics):
    """``x' = x + 0.1 u``."""

    def control_part(self, controls: Tensor) -> Tensor:
        return controls

    def forward(self, states: Tensor, control_part: Tensor) -> Tensor:
        return states + 0.1 * control_part


@pytest.fixture
def episode() -> Episode:
    rng = np.random.default_rng(0)
    controls = rng.normal(1.0, 1.0, (200, 2)).astype(np.float32)
    moved = 0.1 * controls + NOISE * rng.normal(size=(200, 2))
    states = np.cumsum(moved, axis=0).astype(np.float32)
    return Episode(TASK, states, controls, {"gps": states})


def statistics(episode: Episode, faults: str = "") -> dict[str, float]:
    filter_ = build(architecture(TASK, "gps-ekf"))
    cast(Any, filter_).dynamics = Driven(2, 2, 4)
    faulty = Faults.parse(faults).apply(episode)
    return law_statistics(faulty) | module_dynamics_statistics(faulty, cast(Any, SimpleNamespace(filter=filter_)))


@pytest.mark.parametrize("channel", [0, 1])
def test_an_opposite_sign_is_that_of_its_channel(episode: Episode, channel: int) -> None:
    """With the sign that fits, the residual is the noise; with the other one, it is also 2 * 0.1 u."""
    healthy, faulty = statistics(episode), statistics(episode, f"control_scale=-1:channel={channel}")
    names = [f"opposed/control {axis}/all" for axis in "xy"]
    assert [healthy[name] for name in names] == [0.0, 0.0]
    doubled = 0.2 * episode.controls[1:, channel]
    expected = 0.5 * np.log1p(np.square(doubled).mean() / (2.0 * NOISE**2))
    assert faulty[names[channel]] == pytest.approx(expected, abs=0.1)
    assert faulty[names[1 - channel]] == 0.0


def test_size_and_delay_of_the_controls(episode: Episode) -> None:
    healthy, scaled = statistics(episode), statistics(episode, "control_scale=0.5:channel=1")
    late = statistics(episode, "control_delay=3")
    assert scaled["size/control y/all"] == pytest.approx(0.5 * healthy["size/control y/all"], rel=1e-6)
    assert scaled["size/control x/all"] == healthy["size/control x/all"]
    assert (healthy["lag/dynamics/all"], late["lag/dynamics/all"]) == (0.0, -3.0)


def deviation(name: str, value: float, healthy: float) -> Deviation:
    t = np.sign(value - healthy) * 8.0
    return Deviation(name, value, healthy, healthy - 0.1, healthy + 0.1, 0.0, True, t)


def test_each_cause_is_named_by_its_own_statistic() -> None:
    slope, spread = deviation("dynamics slope/x/all", 0.4, 1.0), deviation("dynamics spread/x/all", 2.0, 1.0)
    cases = {
        "control.scale": (deviation("size/control x/all", 2.0, 1.0), slope),
        "control.sign": (deviation("opposed/control x/all", 2.0, 0.0), slope),
        "control.delay": (deviation("lag/dynamics/all", -3.0, 0.0), spread),
        "dynamics.frozen": (slope,),
    }
    unchanged = [deviation(name, 1.0, 1.0) for name in ("size/control x/all", "opposed/control x/all")]
    unchanged.append(deviation("lag/dynamics/all", 0.0, 0.0))
    quiet = {d.statistic: replace(d, alarm=False, t=0.0) for d in unchanged}
    for name, changed in cases.items():
        deviations = list((quiet | {d.statistic: d for d in changed}).values())
        causes = applicable(causes_of(TASK), [d.statistic for d in deviations])
        ranked = probabilities({cause.name: explain(cause, deviations) for cause in causes})
        assert max(ranked, key=ranked.__getitem__) == name, ranked


def test_controls_of_a_measured_hand_and_no_controls_have_no_such_causes() -> None:
    assert "control.sign" in {cause.name for cause in causes_of(TASK)}
    for task in (replace(TASK, control_size=0), find_task("door")):
        assert "control.sign" not in {cause.name for cause in causes_of(task)}


@pytest.mark.parametrize(
    ("faults", "undo", "deviations"),
    [
        ("control_scale=-1:channel=1", negate_control, [deviation("opposed/control y/all", 2.0, 0.0)]),
        ("control_scale=0.25:channel=0", scale_control, [deviation("size/control x/all", 0.25, 1.0)]),
        ("control_delay=3", lambda *args: advance("control", *args), [deviation("lag/dynamics/all", -3.0, 0.0)]),
    ],
)
def test_undoing_restores_the_controls(episode: Episode, faults: str, undo: Undo, deviations: list[Deviation]) -> None:
    def still(*, observations: object, controls: np.ndarray) -> np.ndarray:
        return np.zeros((*controls.shape[:-1], 2))

    inputs = RunInputs(as_external(still, "still", TASK), {0: Faults.parse(faults).apply(episode)}, 1, frozenset({0}))
    result = undo(inputs, {d.statistic: d for d in deviations})
    assert result is not None
    assert np.array_equal(result.episodes[0].controls[:-3], episode.controls[:-3])
    assert undo(inputs, {}) is None


@pytest.mark.parametrize(("of_controls", "cause"), [(9.0, "control.bias"), (0.0, "gps.bias")])
def test_readings_that_depend_on_the_controls_show_their_bias(of_controls: float, cause: str) -> None:
    """The controls of a current explain its expected readings; without a bias of their own they are not at fault."""
    deviations = [
        Deviation(f"reading bias/{channel}/all", t, 0.0, -0.5, 0.5, 0.0, t > 0.0, t)
        for channel, t in (("control x", of_controls), ("gps x", 9.0))
    ]
    causes = applicable(causes_of(TASK), [deviation.statistic for deviation in deviations])
    result = probabilities({c.name: explain(c, deviations) for c in causes})
    assert max(result, key=lambda name: result[name]) == cause
    assert result[cause] > 0.8
