"""Conventions of the inputs: a planted change is found and undone exactly; sensors without influence change nothing."""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.simulation.push import PUSH
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.hand_on_arc import HandOnArc
from beliefscope.filters.external.load import as_external
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics.conventions import RELEVANT, Change, Conventions, changes_of, conventions
from beliefscope.inspect.statistics.measures import squared_errors
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all

sys.path.insert(0, str(Path(__file__).parent))
import planted_traces as plant

pytestmark = pytest.mark.slow

EPISODES, STEPS = 6, 80
MIRRORED = "sensor_gain=effector_position:factor=-1"


class HandOnFieldArc(HandOnArc):
    task = "door-field"


@cache
def filter_() -> Checkpoint:
    return as_external(HandOnFieldArc(), "hand on arc")


@cache
def episodes() -> dict[int, Episode]:
    with open_dataset(sample_path("door-field")) as data:
        return {index: plant.of_length(data[index], STEPS) for index in range(len(data) - EPISODES, len(data))}


def traces(faults: str = "") -> list[Trace]:
    changed = {index: Faults.parse(faults).apply(episode) for index, episode in episodes().items()}
    return list(trace_all(filter_(), changed, changed))


@cache
def of_mirrored_positions() -> Conventions:
    return conventions(traces(MIRRORED), filter_())


@pytest.mark.long
def test_a_planted_sign_is_the_first_finding_and_its_share_that_of_the_clean_runs() -> None:
    result = of_mirrored_positions()
    change, error = result.relevant_removals[0]
    assert result.changes[change].text == "the opposite sign of effector position"
    assert result.verdict.startswith("With the opposite sign of effector position, the ")
    clean, faulty = (np.sum([squared_errors(trace) for trace in runs], axis=0) for runs in (traces(), traces(MIRRORED)))
    assert result.share[change] == pytest.approx(1.0 - np.sqrt(clean / faulty), abs=1e-9)
    assert RELEVANT <= result.share[change, error] <= 1.0
    assert result.low[change, error] > 0.0
    assert result.alarms


def test_sensors_without_influence_change_nothing() -> None:
    """The filter reads neither force nor torque."""
    result = of_mirrored_positions()
    rows = [i for i, change in enumerate(result.changes) if "force" in change.text or "torque" in change.text]
    assert len(rows) == 12
    assert (result.share[rows] == 0.0).all()


@pytest.mark.long
def test_clean_episodes_have_no_finding() -> None:
    result = conventions(traces(), filter_())
    assert (result.relevant_removals, result.alarms) == ([], ())
    assert result.verdict.startswith(f"None of {len(result.changes)} changes of signs")


def test_the_verdict_states_why_large_changes_are_no_finding() -> None:
    start = "None of 2 changes of signs, scales, axes and delays "
    for share, omitted, low, end in (
        (0.1, 0.0, 0.05, "lowers an error by 20 % or more."),
        (0.21, 0.19, 0.1, "lowers an error by 20 % or more below that without the input."),
        (0.3, 0.0, -0.1, "significantly lowers an error by 20 % or more."),
    ):
        numbers = {"share": share, "omitted": omitted, "low": low, "high": 0.5}
        arrays = {name: np.full((2, 1), value) for name, value in numbers.items()}
        changes = (Change("a", ""), Change("b", ""))
        result = Conventions(PUSH, "filter", 6, False, changes, ("position",), **arrays)
        assert result.verdict == start + end


def test_single_traces_have_no_intervals() -> None:
    result = conventions(traces(MIRRORED)[:1], filter_())
    assert np.isnan(result.low).all()
    assert result.alarms == ()
    assert "No intervals: too few episodes (1; at least 5 needed)." in result.verdict
    assert len(result.tables()[0].columns) == 2 + 2 * len(result.errors)


def test_the_plot_shows_the_changes_that_remove_most() -> None:
    result = conventions(traces(MIRRORED)[:1], filter_())
    (plot,) = result.plots()
    assert plot.title == f"Removed error, first 5 of {len(result.changes)} changes"
    assert plot.names == tuple(row[0] for row in result.tables()[0].rows[:5])
    assert min(line.y.min() for line in plot.lines) >= -100.0


@pytest.mark.long
def test_repeated_episodes_are_separate_runs() -> None:
    """Traces of one episode, as with several seeds, cannot run together; pooled twice, they have the same shares."""
    runs = traces()[:2]
    twice, once = conventions([*runs, *runs], filter_()), conventions(runs, filter_())
    assert twice.trajectories == 4
    np.testing.assert_allclose(twice.share, once.share, rtol=1e-9)


def test_a_run_without_truth_is_refused() -> None:
    run = traces()[0]
    entry = DIAGNOSTICS["conventions"]
    assert entry.refusal(run, filter_()) is None
    run.episode.states[3] = np.nan
    assert entry.refusal(run, filter_()) == "the episode has no ground truth at some steps"


def test_all_changes_of_an_array_can_be_made() -> None:
    task = Task("cart", (Component("x", "m"),), {"depth": (4, 6)}, {"depth": ("depth",)}, 0, 0.1, arrays=("depth",))
    episode = Episode(task, np.zeros((5, 1)), observations={"depth": np.random.default_rng(0).normal(size=(5, 4, 6))})
    changes = changes_of(task, ["depth"], episode)
    assert len(changes) > 1
    for change in changes:
        Faults.parse(change.faults).apply(episode)
