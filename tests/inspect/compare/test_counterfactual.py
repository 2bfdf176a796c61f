"""Editing a run in time: nothing edited gives the same bits, and what an edit does is what a faults does."""

from __future__ import annotations

import numpy as np
import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.compare.counterfactual import compare
from beliefscope.inspect.likelihood import MapEngine
from beliefscope.inspect.trace import ARRAYS, Trace, trace
from beliefscope.inspect.traces.replay import Edit, Replay


@pytest.fixture(scope="module", params=("crossmodal-ekf", "crossmodal-pf"))
def replay(request: pytest.FixtureRequest) -> Replay:
    checkpoint = load_checkpoint(shipped("door", request.param))
    with open_dataset(sample_path("door")) as data:
        return Replay(checkpoint, trace(checkpoint, data[9], 9, seed=3, particles=100))


def different(one: Trace, other: Trace) -> list[str]:
    return [n for n in ARRAYS if getattr(one, n) is not None and not np.array_equal(getattr(one, n), getattr(other, n))]


@pytest.mark.parametrize("first", [0, 40, 99])
def test_an_edit_of_nothing_changes_no_bit(replay: Replay, first: int) -> None:
    assert replay.exact
    edit = Edit(first, 100)
    again = replay.edited(edit)
    assert not different(replay.original, again)
    assert compare(replay.original, again, edit).verdict.endswith("changed nothing.")


def test_an_edit_is_the_faults_over_its_span(replay: Replay) -> None:
    edit = Edit(40, 60, Faults.parse("blackout"))
    edited, original = replay.edited(edit), replay.original
    faults = Faults.parse("blackout:from=40:to=60")
    whole = trace(replay.checkpoint, original.episode, 9, seed=3, particles=100, faults=faults)
    assert not different(whole, edited)
    assert edited.faults == faults
    result = compare(original, edited, edit)
    assert not result.distance[:40].any()
    assert result.distance[40:60].all()
    assert result.carrier == "haptics"


def test_beta_by_hand(replay: Replay) -> None:
    edited = replay.edited(Edit(40, 60, weights={"image": 0.25}))
    assert edited.weights is not None
    np.testing.assert_allclose(edited.weights[40:60, 0], 0.25, atol=1e-6)
    np.testing.assert_allclose(edited.weights[40:60, 1], 0.75, atol=1e-6)
    assert Replay(replay.checkpoint, edited).exact


def test_bad_edits(replay: Replay) -> None:
    with pytest.raises(BadInput, match="has no steps"):
        Edit(60, 40)
    with pytest.raises(BadInput, match="span of its own"):
        Edit(40, 60, Faults.parse("blackout:from=3"))
    with pytest.raises(BadInput, match="so is their sum"):
        Edit(40, 60, weights={"image": 1.5})
    with pytest.raises(BadInput, match="beyond this trace"):
        replay.edited(Edit(40, 101))
    with pytest.raises(BadInput, match="'touch' does not exist"):
        replay.edited(Edit(40, 60, weights={"touch": 0.5}))


@pytest.mark.parametrize("replay", ["crossmodal-pf"], indirect=True)  # an EKF's maps are its posteriors
def test_maps_are_fused_with_the_beta_that_was_set_by_hand(replay: Replay) -> None:
    edited = replay.edited(Edit(20, 40, weights={"image": 1.0}))
    step, size = 25, 21
    image, haptics, fused = MapEngine(replay.checkpoint, edited).map(step, size=size).log_likelihood
    # The mixture subtracts one number from each model's map; with all weight on one nothing else remains.
    np.testing.assert_allclose(fused - fused.max(), image - image.max(), atol=1e-4)  # float32 of log-likelihoods
    assert np.abs((fused - fused.max()) - (haptics - haptics.max())).max() > 1.0
    same = (MapEngine(replay.checkpoint, one).map(step - 10, size=size) for one in (edited, replay.original))
    np.testing.assert_array_equal(*(one.log_likelihood for one in same))
