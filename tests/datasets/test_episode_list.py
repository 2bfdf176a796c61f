"""Parts of the list of episodes of a large data set."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beliefscope.datasets.dataset import Dataset, EpisodeSummary
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.episode_list import LISTED, find, nearby
from beliefscope.datasets.simulation.door import DOOR

COUNT = 10_000


class ManyEpisodes(Dataset):
    """Only the summaries of many episodes."""

    path, task = Path("many"), DOOR
    summaries = tuple(
        EpisodeSummary(i, 100, "push" if i % 2 else "pull", "test" if i % 10 == 0 else "train", 3 * i, 0.5)
        for i in range(COUNT)
    )
    hash = ""

    def _episode(self, index: int) -> Episode:
        raise NotImplementedError


def indices(query: str, first: int = 0, limit: int = LISTED) -> tuple[int, list[int]]:
    count, episodes = find(ManyEpisodes(), query, first, limit)
    return count, [episode["index"] for episode in episodes]


def test_every_episode_is_found_by_its_index_and_comes_first() -> None:
    generator = np.random.default_rng(0)
    for index in (0, COUNT - 1, *generator.integers(COUNT, size=20)):
        assert indices(f"episode {index}")[1][0] == index


def test_words_and_pages_select_a_part() -> None:
    assert indices("") == (COUNT, list(range(LISTED)))
    assert indices("", 9_990, 50) == (COUNT, list(range(9_990, COUNT)))
    assert indices("TEST pull", 1, 3) == (1000, [10, 20, 30])
    assert indices("test push") == (0, [])


def test_the_catalog_lists_the_episodes_around_one() -> None:
    for index, first in ((0, 0), (5_000, 4_950), (COUNT - 1, COUNT - LISTED)):
        assert [e["index"] for e in nearby(ManyEpisodes(), index)] == list(range(first, first + LISTED))
