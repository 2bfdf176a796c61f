"""A survey by episode agrees with ``evaluate``, and what is drawn of an episode leaves out no peak."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, shipped
from beliefscope.filters.evaluate import LEFT_OUT, evaluate
from beliefscope.inspect.diagnostics.base import as_json
from beliefscope.inspect.failures.by_episode import POINTS, by_episode
from beliefscope.inspect.failures.moments import survey_of
from beliefscope.inspect.failures.step_scores import Survey

CHOSEN = (9, 19, 59)


@pytest.fixture(scope="module")
def checkpoint() -> Checkpoint:
    return load_checkpoint(shipped("door", "crossmodal-ekf"))


@pytest.fixture(scope="module")
def episodes() -> dict[int, Episode]:
    with open_dataset(sample_path("door")) as data:
        return {index: data[index] for index in CHOSEN}


@pytest.fixture(scope="module")
def survey(checkpoint: Checkpoint, episodes: dict[int, Episode]) -> Survey:
    return survey_of(checkpoint, episodes, CHOSEN)


def test_pooled_it_is_what_evaluate_says(survey: Survey, checkpoint: Checkpoint, episodes: dict[int, Episode]) -> None:
    found = by_episode(survey)
    counted = np.array([one.steps - LEFT_OUT for one in found])
    pooled = np.sqrt((counted * np.array([one.rmse for one in found]) ** 2).sum() / counted.sum())
    wanted = evaluate(checkpoint.filter, list(episodes.values())).rmse["position_cm"]
    assert 100 * pooled == pytest.approx(wanted, rel=1e-4)  # float32 filters, in a batch there and one by one here


def test_an_episode_is_its_own_steps(survey: Survey, episodes: dict[int, Episode]) -> None:
    for one in by_episode(survey):
        error = survey.error[survey.episode == one.index, -1]
        assert one.steps == len(error) == len(episodes[one.index])
        assert one.worst == error.max() == error[one.worst_step] == one.error.max()
        assert len(one.error) == len(one.contact) == POINTS
        assert one.contact.any() == episodes[one.index].contact.any()
    assert [one.index for one in by_episode(survey)] == list(CHOSEN)


def test_parts_are_even_and_keep_the_worst_of_each(survey: Survey) -> None:
    one = by_episode(survey)[0]
    error = survey.error[survey.episode == one.index, -1]
    part = np.arange(len(error)) * POINTS // len(error)  # which part a step is in, were they of one size
    for i, worst in enumerate(one.error):
        near = error[np.abs(part - i) <= 1]
        assert near.min() <= worst <= near.max()
    assert set(one.error) <= set(error)


def test_an_episode_without_a_known_error_is_json(survey: Survey) -> None:
    lost = replace(survey, error=np.where(survey.episode[:, None] == CHOSEN[0], np.nan, survey.error))
    first, second, _ = as_json(by_episode(lost))
    assert (first["rmse"], first["worst"], first["worst_step"]) == (None, None, None)
    assert second == as_json(by_episode(survey))[1]
    json.dumps([first, second], allow_nan=False)
