"""The shipped sample set: what is claimed of it in docs/data.md, and that it does not give the hinge away."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.simulation.door import HINGE_CENTRE, HINGE_HALF_RANGE, simulate_door
from beliefscope.datasets.store import open_dataset, sample_path

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def episodes() -> list[Episode]:
    with open_dataset(sample_path("door")) as data:
        return list(data)


def stacked(episodes: list[Episode], key: str) -> Array:
    return np.concatenate([np.asarray(e.observations[key], float) for e in episodes])


def test_it_is_small_enough_to_ship() -> None:
    assert sample_path("door").stat().st_size <= 3_000_000


def test_splits_and_policies(episodes: list[Episode]) -> None:
    assert len(episodes) == 140
    assert {len(e) for e in episodes} == {100}
    for split, count in (("train", 112), ("val", 14), ("test", 14)):
        policies = [e.provenance["policy"] for e in episodes if e.split == split]
        assert len(policies) == count
        assert policies.count("pull") == policies.count("push") == count // 2


def test_statistics_are_of_the_authors_scale(episodes: list[Episode]) -> None:
    states = np.concatenate([e.states for e in episodes]).astype(float)
    contact = np.concatenate([e.contact for e in episodes]).mean()
    assert 0.6 < contact < 0.72
    assert 0.6 < states[:, 2].mean() < 0.8
    assert 0.3 < states[:, 2].std() < 0.4
    assert states[:, 2].max() > 1.5
    np.testing.assert_allclose(states[:, :2].std(0), 0.0565, atol=0.004)
    assert (stacked(episodes, "force").std(0) > 15).all()
    assert (stacked(episodes, "effector_position").std(0) > (0.08, 0.1, 0.04)).all()


def test_something_happens_in_every_trajectory(episodes: list[Episode]) -> None:
    moved = [float(np.ptp(e.states[:, 2])) for e in episodes]
    assert np.mean(moved) > 0.5
    assert np.mean(np.array(moved) < 0.1) < 0.05
    pushes = [e for e in episodes if e.provenance["policy"] == "push"]
    assert np.mean([np.diff(e.contact.astype(int)).clip(0).sum() for e in pushes]) > 1.3, "contacts made a trajectory"
    assert np.mean([e.contact.any() for e in pushes]) > 0.95


def hinge_error(train: list[Episode], test: list[Episode], contact: bool) -> Array:
    """(2,) RMSE, m, across and along the panel, of ridge regression from angle and hand position to the hinge."""

    def features(episodes: list[Episode]) -> tuple[Array, Array, Array]:
        keep = np.concatenate([e.contact for e in episodes]) == contact
        states = np.concatenate([e.states for e in episodes]).astype(float)[keep]
        hand = stacked(episodes, "effector_position")[keep]
        angle = states[:, 2:]
        c, s = np.cos(angle), np.sin(angle)
        x = np.concatenate([np.ones_like(c), angle, c, s, hand, hand * c, hand * s, hand**2], axis=1)
        return x, states[:, :2] - HINGE_CENTRE, angle[:, 0]

    x, y, _ = features(train)
    weights = np.linalg.solve(x.T @ x + 1e-2 * np.eye(x.shape[1]), x.T @ y)
    x, y, angle = features(test)
    error = y - x @ weights
    across = np.cos(angle) * error[:, 0] + np.sin(angle) * error[:, 1]
    along = -np.sin(angle) * error[:, 0] + np.cos(angle) * error[:, 1]
    return np.array([np.sqrt((across**2).mean()), np.sqrt((along**2).mean())])


def test_free_hand_does_not_give_the_hinge_away(episodes: list[Episode]) -> None:
    """Nobody who knows only where the policy moves the hand finds the hinge better than by guessing its mean."""
    pushes = [e for e in episodes if e.provenance["policy"] == "push"]
    error = hinge_error([e for e in pushes if e.split == "train"], [e for e in pushes if e.split != "train"], False)
    assert np.sqrt((error**2).mean()) > 0.9 * HINGE_HALF_RANGE / np.sqrt(3)


def test_touch_tells_the_hinge_across_the_door_but_not_along_it(episodes: list[Episode]) -> None:
    """The ridge of the paper's likelihood figure: a hand on the bar does not know how far from the hinge it is."""
    pulls = [e for e in episodes if e.provenance["policy"] == "pull"]
    across, along = hinge_error(
        [e for e in pulls if e.split == "train"], [e for e in pulls if e.split != "train"], True
    )
    assert across < 0.01
    assert along > 0.03


def test_pictures_tell_the_hinge(episodes: list[Episode]) -> None:
    """A linear guess from single pictures already beats the mean by far."""
    train, test = ([e for e in episodes if (e.split == "train") == t] for t in (True, False))

    def pictures(episodes: list[Episode]) -> tuple[Array, Array]:
        x = np.concatenate([e.observations["image"][::10, :20].reshape(10, -1) for e in episodes]) / 255.0
        return x, np.concatenate([e.states[::10, :2] for e in episodes]) - np.array(HINGE_CENTRE)

    (x, y), (xt, yt) = pictures(train), pictures(test)
    mean = x.mean(0)
    x, xt = x - mean, xt - mean
    dual = np.linalg.solve(x @ x.T + 1.0 * np.eye(len(x)), y)
    error = np.sqrt(((yt - xt @ x.T @ dual) ** 2).mean(0))
    assert (error < 0.6 * yt.std(0)).all()


def test_simulated_again_it_begins_the_same(episodes: list[Episode]) -> None:
    """The hinge exactly; what physics adds, only nearly, because processors may round differently."""
    for index in (0, 1):
        again, shipped = simulate_door(0, index, 5), episodes[index]
        np.testing.assert_array_equal(again.states[:, :2], shipped.states[:5, :2])
        np.testing.assert_allclose(again.qpos, shipped.qpos[:5], atol=1e-3)
        assert np.abs(again.observations["image"].astype(int) - shipped.observations["image"][:5]).mean() < 0.5
