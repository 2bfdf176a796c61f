"""Covariates of real episodes, and slices in words."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.slices.covariates import StepCovariate, covariates_of
from beliefscope.inspect.slices.report import find_slices, slices_of
from beliefscope.inspect.slices.search import Condition
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all

EPISODES = 12


@pytest.fixture(scope="module")
def traces() -> list[Trace]:
    checkpoint = load_checkpoint(pretrained_path("push-field", "information-ekf"))
    with open_dataset(sample_path("push-field")) as data:
        return list(trace_all(checkpoint, data, range(EPISODES)))


def column(covariates: Sequence[StepCovariate], name: str) -> StepCovariate:
    (result,) = (covariate for covariate in covariates if covariate.name == name)
    return result


def test_covariates_describe_each_step(traces: list[Trace]) -> None:
    covariates = covariates_of(traces)
    assert {len(covariate.values) for covariate in covariates} == {sum(map(len, traces))}
    contact = np.concatenate([trace.episode.contact for trace in traces])
    assert (column(covariates, "contact").values == contact).all()
    duration, dt = column(covariates, "contact duration").values, traces[0].episode.dt
    assert (np.isfinite(duration) == contact).all()
    following = contact[1:] & contact[:-1] & (np.diff(measures.trace_indices(traces)) == 0)
    assert np.diff(duration)[following] == pytest.approx(dt)
    friction = [trace.episode.provenance["ingredients"]["puck"]["friction"] for trace in traces]
    assert np.unique(column(covariates, "puck friction").values) == pytest.approx(np.unique(friction))


def test_constant_covariates_and_names_are_left_out(traces: list[Trace]) -> None:
    numbered = [
        replace(trace, episode=replace(trace.episode, provenance={"robot": "panda", "file": f"{i}.bag", "lamp": i > 5}))
        for i, trace in enumerate(traces * 2)
    ]
    covariates = covariates_of(numbered)
    assert {"robot", "file"}.isdisjoint(covariate.name for covariate in covariates)
    assert column(covariates, "lamp").categories == ("no", "yes")


def test_ingredients_have_the_units_of_their_task(traces: list[Trace]) -> None:
    """Data files do not contain them."""
    covariates = covariates_of(traces)
    units = {"camera pose turn z": "deg", "image quality blur": "pixels", "puck mass": "kg", "puck friction": ""}
    assert {name: column(covariates, name).unit for name in units} == units
    for task in TASKS.values():
        for ingredient in task.ingredients.values():
            assert set(ingredient.units) <= set(ingredient.ranges)


def test_conditions_in_words() -> None:
    assert str(Condition("friction", "", low=0.6234)) == "friction > 0.623"
    assert str(Condition("outage length", "s", 1.0, 2.0)) == "1 s < outage length <= 2 s"
    assert str(Condition("puck radius", "cm", low=4.663)) == "puck radius > 4.66 cm"
    assert str(Condition("object speed", "cm/s", high=5.0)) == "object speed <= 5 cm/s"
    assert str(Condition("policy", "", category="push")) == "policy is push"
    assert [str(Condition("contact", "", category=c)) for c in ("yes", "no")] == ["contact", "free motion"]
    assert [str(Condition("fix", "", category=c)) for c in ("fix", "no fix")] == ["fix", "no fix"]


def test_a_planted_slice_in_words(traces: list[Trace]) -> None:
    """In 10 of 24 episodes, all errors are three times as large."""
    planted = []
    for i, trace in enumerate(traces * 2):
        heavy = i % EPISODES < 5
        episode = replace(trace.episode, provenance={"heavy load": heavy})
        truth = episode.states
        estimate = truth + (3.0 if heavy else 1.0) * (trace.estimate_mean - truth)
        planted.append(replace(trace, episode=episode, episode_index=i, estimate_mean=estimate))
    report = slices_of(planted)
    (slice_,) = (s for s in report.slices if s.conditions[0].covariate == "heavy load")
    heavy_ones = [i for i in range(24) if i % EPISODES < 5]
    assert slice_.episodes == tuple(heavy_ones)
    error = np.array([measures.main_error(trace)[:, -1].mean() for trace in planted])
    assert slice_.inside == pytest.approx(error[heavy_ones].mean())
    assert slice_.ratio == pytest.approx(error[heavy_ones].mean() / np.delete(error, heavy_ones).mean())
    assert slice_.low < slice_.ratio < slice_.high
    episode, step = slice_.worst
    assert measures.main_error(planted[episode])[step, -1] == max(
        measures.main_error(planted[i])[measures.counted(planted[i]), -1].max() for i in heavy_ones
    )
    sentence = report.sentence(slice_)
    assert sentence.startswith(f"Position error is {slice_.ratio:.2g} times as large (")
    assert sentence.endswith("where heavy load: 10 of 24 episodes, 42 % of steps.")
    assert sentence in report.verdict
    document = report.to_dict()
    json.dumps(document, allow_nan=False)
    assert document["slices"][report.slices.index(slice_)]["where"] == "heavy load"
    assert len(report.tables()[0].rows) == len(report.slices)


def test_each_slice_opens_an_episode_of_its_own(traces: list[Trace]) -> None:
    """Two conditions enlarge the errors; both hold in the episodes with the largest ones."""
    planted = []
    for i, trace in enumerate(traces * 2):
        heavy, wet = i % EPISODES < 5, i % 3 == 0
        episode = replace(trace.episode, provenance={"heavy load": heavy, "wet floor": wet})
        factor = (3.0 if heavy else 1.0) * (3.0 if wet else 1.0)
        estimate = episode.states + factor * (trace.estimate_mean - episode.states)
        planted.append(replace(trace, episode=episode, episode_index=i, estimate_mean=estimate))
    slices = slices_of(planted).slices
    assert len(slices) > 1
    assert all(slice_.worst[0] in slice_.episodes for slice_ in slices)
    opened = [slice_.worst[0] for slice_ in slices]
    assert len(set(opened)) == len(opened)


def test_invalid_scores(traces: list[Trace]) -> None:
    with pytest.raises(BadInput, match=r"score .*'speed'"):
        slices_of(traces, "speed")
    with pytest.raises(BadInput, match="no particles"):
        slices_of(traces, "ess")
    with pytest.raises(BadInput, match="at least one trace"):
        slices_of([])


@pytest.mark.slow
@pytest.mark.long
def test_runs_of_a_data_set(traces: list[Trace]) -> None:
    checkpoint = load_checkpoint(pretrained_path("push-field", "information-ekf"))
    shares: list[float] = []
    report = find_slices(
        checkpoint, [trace.episode for trace in traces], range(EPISODES), by="nees", progress=shares.append
    )
    assert report == slices_of(traces, "nees")
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    with pytest.raises(BadInput, match="1 episode; a search for slices needs at least 8"):
        find_slices(checkpoint, [traces[0].episode], range(1))
