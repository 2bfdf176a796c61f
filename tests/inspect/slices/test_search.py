"""Search for slices: recovery of an obvious slice, invariances, and false discoveries with dependent steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from beliefscope.inspect.slices.covariates import StepCovariate
from beliefscope.inspect.slices.search import Candidate, Condition, find_candidates, random_pairings
from beliefscope.inspect.statistics.measures import Array

EPISODES, STEPS = 30, 40
EPISODE = np.repeat(np.arange(EPISODES), STEPS)


def errors(rng: np.random.Generator) -> Array:
    """(S,) errors with a level of each episode, and dependence in time."""
    noise = np.zeros((EPISODES, STEPS))
    for step, innovation in enumerate(rng.standard_normal((STEPS, EPISODES))):
        noise[:, step] = 0.9 * noise[:, step - 1] * (step > 0) + innovation
    return np.exp(0.3 * noise + 0.3 * rng.standard_normal((EPISODES, 1))).ravel()


def covariates(rng: np.random.Generator) -> list[StepCovariate]:
    speed = np.abs(np.cumsum(rng.standard_normal((EPISODES, STEPS)), axis=1)).ravel()
    contact = (np.cumsum(rng.standard_normal((EPISODES, STEPS)), axis=1) > 0).ravel().astype(float)
    friction, policy = rng.random(EPISODES)[EPISODE], rng.integers(0, 3, EPISODES)[EPISODE].astype(float)
    return [
        StepCovariate("speed", "m/s", speed),
        StepCovariate("contact", "", contact, ("no", "yes")),
        StepCovariate("friction", "", friction),
        StepCovariate("policy", "", policy, ("pull", "push", "tap")),
    ]


def search(score: Array, columns: list[StepCovariate], **settings: float) -> list[Candidate]:
    return find_candidates(score, EPISODE, columns, pairings=99, **settings)  # type: ignore[arg-type]


def test_an_obvious_slice_is_recovered_exactly() -> None:
    rng = np.random.default_rng(0)
    columns = covariates(rng)
    edge = float(np.quantile(columns[0].values, 0.7, method="lower"))
    planted = columns[0].values > edge
    (result,) = search(np.where(planted, 4.0, 1.0) * errors(rng), columns)
    assert result.conditions == (Condition("speed", "m/s", low=edge),)
    assert (result.steps == planted).all()
    assert result.p_value == pytest.approx(1 / 100)


def test_two_conditions_and_a_second_slice() -> None:
    rng = np.random.default_rng(1)
    columns = covariates(rng)
    speed, contact, friction, _ = (column.values for column in columns)
    edge, limit = (float(np.quantile(values, 0.6, method="lower")) for values in (speed, friction))
    first, second = (speed > edge) & (contact == 1), friction <= limit
    result = search(errors(rng) * np.where(first, 6.0, 1.0) * np.where(second, 3.0, 1.0), columns)
    assert {frozenset(c.covariate for c in candidate.conditions) for candidate in result} == {
        frozenset({"speed", "contact"}),
        frozenset({"friction"}),
    }
    for planted in (first, second):
        assert max((c.steps & planted).sum() / (c.steps | planted).sum() for c in result) > 0.8


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_a_copy_of_a_covariate_is_not_reported_again(seed: int) -> None:
    """The threshold is between two edges, so the best slice does not explain the difference completely."""
    rng = np.random.default_rng(seed)
    columns = covariates(rng)
    noise = 0.02 * rng.standard_normal(len(EPISODE))
    columns.append(replace(columns[0], name="copy", values=columns[0].values + noise))
    planted = columns[0].values > np.quantile(columns[0].values, 0.65)
    result = search(np.where(planted, 3.0, 1.0) * errors(rng), columns)
    assert sum(c.covariate in ("speed", "copy") for candidate in result for c in candidate.conditions) == 1


@pytest.mark.parametrize("transform", [np.log, np.exp, lambda values: 7.0 * values - 2.0], ids=["log", "exp", "affine"])
def test_monotone_transformations_change_only_the_thresholds(transform: Callable[[Array], Array]) -> None:
    rng = np.random.default_rng(3)
    columns = covariates(rng)
    score = np.where(columns[0].values > 3.0, 2.0, 1.0) * errors(rng)
    moved = [column if column.categories else replace(column, values=transform(column.values)) for column in columns]
    before, after, scaled = search(score, columns), search(score, moved), search(np.log(score), columns)
    assert before
    for other in (after, scaled):
        assert [c.p_value for c in other] == [c.p_value for c in before]
        assert all((a.steps == b.steps).all() for a, b in zip(before, other, strict=True))


def test_the_order_of_the_covariates_does_not_matter() -> None:
    rng = np.random.default_rng(4)
    columns = covariates(rng)
    score = np.where(columns[2].values > 0.5, 2.5, 1.0) * errors(rng)
    first, other = search(score, columns), search(score, columns[::-1])
    assert first
    assert [(c.steps.tolist(), c.p_value) for c in first] == [(c.steps.tolist(), c.p_value) for c in other]


@pytest.mark.long
def test_false_discoveries_with_dependent_steps() -> None:
    """With levels of episodes and slow covariates, tests of single steps would reject nearly every time."""
    reports = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        reports.append(bool(search(errors(rng), covariates(rng), alpha=0.1, seed=seed)))
    assert sum(reports) <= 13  # exceeded with probability 0.003 at a rate of 0.1
    assert sum(reports) >= 1  # probability of none 0.002


def test_pairings_are_rotations_of_whole_episodes() -> None:
    episode = np.repeat([0, 1, 2], [5, 7, 5])
    index = random_pairings(episode, 20, np.random.default_rng(0))
    for column in index.T:
        sources = [np.unique(episode[column[episode == e]]) for e in range(3)]
        assert sorted(np.concatenate(sources).tolist()) == [0, 1, 2]
        for e, (source,) in enumerate(sources):
            length = int((episode == source).sum())
            assert (np.diff(column[episode == e]) % length == 1).all()


def test_unknown_values_belong_to_no_slice() -> None:
    rng = np.random.default_rng(5)
    columns = covariates(rng)
    recorded = columns[1].values == 1
    columns[0] = replace(columns[0], values=np.where(recorded, columns[0].values, np.nan))
    (result,) = search(np.where(columns[0].values > 2.0, 4.0, 1.0) * errors(rng), columns)
    assert recorded[result.steps].all()


def test_nothing_to_search() -> None:
    rng = np.random.default_rng(6)
    assert search(errors(rng), []) == []
    assert search(errors(rng), [StepCovariate("rare", "", (EPISODE < 2).astype(float), ("no", "yes"))]) == []


@pytest.mark.parametrize(
    ("category", "text"), [("yes", "fix"), ("fix", "fix"), ("no", "no fix"), ("no fix", "no fix"), ("3D", "fix is 3D")]
)
def test_switches_are_named_by_their_groups(category: str, text: str) -> None:
    assert str(Condition("fix", "", category=category)) == text
