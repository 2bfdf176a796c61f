"""Gaps in the true states, as of motion capture that loses its markers: measures are those of the other steps."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beliefscope.inspect.diagnostics.consistency import consistency
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.sweep import summary
from beliefscope.inspect.trace import Trace

sys.path.insert(0, str(Path(__file__).parents[1] / "diagnostics"))
import planted_traces as plant

GAP = slice(40, 60)


def with_gap(run: Trace, components: slice = slice(None)) -> Trace:
    states = run.episode.states.copy()
    states[GAP, components] = np.nan
    return replace(run, episode=replace(run.episode, states=states))


@pytest.mark.parametrize("components", [slice(None), slice(0, 1)])
def test_measures_are_those_of_the_known_steps(components: slice) -> None:
    (run,) = plant.simulated(1)
    gap = with_gap(run, components)
    known = measures.counted(run)
    known[GAP] = False
    np.testing.assert_array_equal(measures.counted(gap), known)
    expected = measures.nees(run)[known, -1].mean()
    assert consistency([gap]).entry("fused").nees == pytest.approx(expected)
    row = next(iter(summary(replace(gap, weights=None, effective_weights=None))))
    assert row["nees"] == pytest.approx(expected)
    assert row["error"] == pytest.approx(100.0 * np.sqrt(np.square(measures.main_error(run)[known, -1]).mean()))  # cm
    assert row["steps"] == known.sum()


def test_a_component_that_no_step_knows_is_no_gap() -> None:
    (run,) = plant.simulated(1)
    states = run.episode.states.copy()
    states[:, 0] = np.nan
    unknown = replace(run, episode=replace(run.episode, states=states))
    np.testing.assert_array_equal(measures.counted(unknown), measures.counted(run))
