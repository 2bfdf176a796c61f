"""Parts of the list of episodes of a data set: by position, and by words."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from beliefscope.datasets.dataset import Dataset, EpisodeSummary

LISTED = 100
"""Episodes in the catalog of a data set that has more than twice as many, and in an answer without a limit."""


def nearby(data: Dataset, index: int) -> list[dict[str, Any]]:
    """All episodes, or the ``LISTED`` around one if there are more than twice as many."""
    first = max(0, min(index - LISTED // 2, len(data) - LISTED))
    part = slice(None) if len(data) <= 2 * LISTED else slice(first, first + LISTED)
    return to_json(data, data.summaries[part])


def find(data: Dataset, query: str, first: int, limit: int) -> tuple[int, list[dict[str, Any]]]:
    """The number of episodes that have all words of a query, and ``limit`` of them from the ``first`` one.

    Words are parts of the description of an episode: index, policy, split, steps and seed. An episode whose index is a
    word comes first.
    """
    words = query.lower().split()
    matches: Sequence[EpisodeSummary] = data.summaries
    if words:
        matches = [s for s in matches if all(word in _text(s) for word in words)]
        matches.sort(key=lambda s: str(s.index) not in words)
    return len(matches), to_json(data, matches[first : first + limit])


def to_json(data: Dataset, summaries: Sequence[EpisodeSummary]) -> list[dict[str, Any]]:
    """Entries of the episodes. Tasks without contact have no share of steps in contact."""
    changes = {} if "contact" in data.task.covariates else {"contact_fraction": None}
    return [asdict(summary) | changes for summary in summaries]


def _text(summary: EpisodeSummary) -> str:
    return f"episode {summary.index} {summary.policy} {summary.split} {summary.steps} steps seed {summary.seed}".lower()
