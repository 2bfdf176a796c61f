"""Error summaries by episode agree with ``evaluate`` and keep the maxima."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.filters.evaluate import evaluate
from beliefscope.inspect.diagnostics.views import as_json
from beliefscope.inspect.failures.by_episode import POINTS, by_episode
from beliefscope.inspect.failures.step_scores import Survey
from beliefscope.inspect.failures.survey import survey_of

EPISODES = (9, 19, 59)


@pytest.fixture(scope="module")
def checkpoint() -> Checkpoint:
    return load_checkpoint(pretrained_path("door", "crossmodal-ekf"))


@pytest.fixture(scope="module")
def episodes() -> dict[int, Episode]:
    with open_dataset(sample_path("door")) as data:
        return {index: data[index] for index in EPISODES}


@pytest.fixture(scope="module")
def survey(checkpoint: Checkpoint, episodes: dict[int, Episode]) -> Survey:
    return survey_of(checkpoint, episodes, EPISODES)


def test_pooled_errors_equal_evaluate(survey: Survey, checkpoint: Checkpoint, episodes: dict[int, Episode]) -> None:
    summaries = by_episode(survey)
    counted = np.array([summary.steps - DOOR.warmup for summary in summaries])
    pooled = np.sqrt((counted * np.array([summary.rmse for summary in summaries]) ** 2).sum() / counted.sum())
    expected = evaluate(checkpoint.filter, list(episodes.values())).rmse["position_cm"]
    assert 100 * pooled == pytest.approx(expected, rel=1e-4)  # float32 filters, in a batch and one by one


def test_summary_of_an_episode(survey: Survey, episodes: dict[int, Episode]) -> None:
    for summary in by_episode(survey):
        error = survey.error[survey.episode == summary.index, -1]
        assert summary.steps == len(error) == len(episodes[summary.index])
        assert summary.worst == error.max() == error[summary.worst_step] == summary.error.max()
        assert len(summary.error) == len(summary.contact) == POINTS
        assert summary.contact.any() == episodes[summary.index].contact.any()
    assert [summary.index for summary in by_episode(survey)] == list(EPISODES)


def test_parts_are_equal_and_keep_their_maxima(survey: Survey) -> None:
    summary = by_episode(survey)[0]
    error = survey.error[survey.episode == summary.index, -1]
    part = np.arange(len(error)) * POINTS // len(error)  # part of each step for equal parts
    for i, worst in enumerate(summary.error):
        near = error[np.abs(part - i) <= 1]
        assert near.min() <= worst <= near.max()
    assert set(summary.error) <= set(error)


def test_unknown_errors_are_valid_json(survey: Survey) -> None:
    unknown = replace(survey, error=np.where(survey.episode[:, None] == EPISODES[0], np.nan, survey.error))
    first, second, _ = as_json(by_episode(unknown))
    assert (first["rmse"], first["worst"], first["worst_step"]) == (None, None, None)
    assert second == as_json(by_episode(survey))[1]
    json.dumps([first, second], allow_nan=False)
