"""The samples of the field tasks: fresh test episodes with all ingredients, from the documented command."""

from __future__ import annotations

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset, sample_path

TASKS = ("door-field", "push-field")


@pytest.fixture(scope="module", params=TASKS)
def episodes(request: pytest.FixtureRequest) -> list[Episode]:
    with open_dataset(sample_path(request.param)) as data:
        return list(data)


@pytest.mark.parametrize("task", TASKS)
def test_file_size(task: str) -> None:
    assert sample_path(task).stat().st_size <= 5_000_000


def test_all_episodes_are_for_testing(episodes: list[Episode]) -> None:
    """Of seed 2: the pretrained filters of field tasks are trained on seed 0 and measured on seed 1."""
    assert [(e.seed, e.provenance["spawn_index"], e.split, len(e)) for e in episodes] == [
        (2, index, "test", 200) for index in range(40)
    ]


def test_every_episode_has_all_ingredients(episodes: list[Episode]) -> None:
    names = {frozenset(e.provenance["ingredients"]) for e in episodes}
    assert len(names) == 1
    assert {"camera-pose", "outages", "wrist", "start"} <= next(iter(names))
    black = np.concatenate([e.observations["image"].max(axis=(1, 2)) == 0 for e in episodes])
    assert 0.3 < black.mean() < 0.5
    assert all(e.contact.any() for e in episodes)


@pytest.mark.first(1)
def test_simulation_reproduces_the_samples(episodes: list[Episode]) -> None:
    """Approximately, because processors round differently."""
    simulate = episodes[0].task.simulate
    assert simulate is not None
    simulated, stored = simulate(2, 0, 200), episodes[0]
    np.testing.assert_allclose(simulated.states[:20], stored.states[:20], atol=1e-3)
    assert simulated.provenance["ingredients"] == stored.provenance["ingredients"]
