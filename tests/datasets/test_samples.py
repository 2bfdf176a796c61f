"""The door samples: properties stated in docs/data.md, and no leakage of the hinge position."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.simulation.door import simulate_door
from beliefscope.datasets.simulation.door_physics import HINGE_CENTRE, HINGE_HALF_RANGE
from beliefscope.datasets.store import open_dataset, sample_path

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def episodes() -> list[Episode]:
    with open_dataset(sample_path("door")) as data:
        return list(data)


def stacked(episodes: list[Episode], key: str) -> Array:
    return np.concatenate([np.asarray(e.observations[key], float) for e in episodes])


def test_file_size() -> None:
    assert sample_path("door").stat().st_size <= 4_100_000


@pytest.mark.slow
def test_splits_and_policies(episodes: list[Episode]) -> None:
    assert len(episodes) == 190
    assert {len(e) for e in episodes} == {100}
    assert [(e.seed, e.provenance["spawn_index"]) for e in episodes] == [
        *((0, i) for i in range(140)),
        *((2, i) for i in range(50)),
    ]
    assert {e.split for e in episodes[140:]} == {"test"}
    for split, count in (("train", 112), ("val", 14), ("test", 64)):
        policies = [e.provenance["policy"] for e in episodes if e.split == split]
        assert len(policies) == count
        assert policies.count("pull") == policies.count("push") == count // 2


def test_statistics_are_similar_to_the_paper(episodes: list[Episode]) -> None:
    states = np.concatenate([e.states for e in episodes]).astype(float)
    contact = np.concatenate([e.contact for e in episodes]).mean()
    assert 0.6 < contact < 0.72
    assert 0.6 < states[:, 2].mean() < 0.8
    assert 0.3 < states[:, 2].std() < 0.4
    assert states[:, 2].max() > 1.5
    np.testing.assert_allclose(states[:, :2].std(0), 0.0565, atol=0.004)
    assert (stacked(episodes, "force").std(0) > 15).all()
    assert (stacked(episodes, "effector_position").std(0) > (0.08, 0.1, 0.04)).all()


def test_doors_move_and_are_touched(episodes: list[Episode]) -> None:
    motion = [float(np.ptp(e.states[:, 2])) for e in episodes]
    assert np.mean(motion) > 0.5
    assert np.mean(np.array(motion) < 0.1) < 0.05
    pushes = [e for e in episodes if e.provenance["policy"] == "push"]
    assert np.mean([np.diff(e.contact.astype(int)).clip(0).sum() for e in pushes]) > 1.3, "contacts per trajectory"
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


def test_free_hand_does_not_reveal_the_hinge(episodes: list[Episode]) -> None:
    """Hand positions without contact predict the hinge no better than its mean."""
    pushes = [e for e in episodes if e.provenance["policy"] == "push"]
    error = hinge_error([e for e in pushes if e.split == "train"], [e for e in pushes if e.split != "train"], False)
    assert np.sqrt((error**2).mean()) > 0.9 * HINGE_HALF_RANGE / np.sqrt(3)


def test_contact_reveals_the_hinge_only_across_the_door(episodes: list[Episode]) -> None:
    """The ridge in the paper's likelihood figure: the distance along the bar to the hinge is not observable."""
    pulls = [e for e in episodes if e.provenance["policy"] == "pull"]
    across, along = hinge_error(
        [e for e in pulls if e.split == "train"], [e for e in pulls if e.split != "train"], True
    )
    assert across < 0.01
    assert along > 0.03


def test_images_reveal_the_hinge(episodes: list[Episode]) -> None:
    """Linear regression from single images is much better than the mean."""
    train, test = ([e for e in episodes if (e.split == "train") == t] for t in (True, False))

    def inputs(episodes: list[Episode]) -> tuple[Array, Array]:
        x = np.concatenate([e.observations["image"][::10, :20].reshape(10, -1) for e in episodes]) / 255.0
        return x, np.concatenate([e.states[::10, :2] for e in episodes]) - np.array(HINGE_CENTRE)

    (x, y), (xt, yt) = inputs(train), inputs(test)
    mean = x.mean(0)
    x, xt = x - mean, xt - mean
    dual = np.linalg.solve(x @ x.T + 1.0 * np.eye(len(x)), y)
    error = np.sqrt(((yt - xt @ x.T @ dual) ** 2).mean(0))
    assert (error < 0.6 * yt.std(0)).all()


def test_simulation_reproduces_the_samples(episodes: list[Episode]) -> None:
    """The hinge exactly; simulated values approximately, because processors round differently."""
    for index in (0, 1):
        simulated, stored = simulate_door(0, index, 5), episodes[index]
        np.testing.assert_array_equal(simulated.states[:, :2], stored.states[:5, :2])
        np.testing.assert_allclose(simulated.qpos, stored.qpos[:5], atol=1e-3)
        assert np.abs(simulated.observations["image"].astype(int) - stored.observations["image"][:5]).mean() < 0.5
