from __future__ import annotations

import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset, sample_path


@pytest.fixture(scope="module")
def episode() -> Episode:
    """A push, with steps in contact and in free motion."""
    with open_dataset(sample_path("door")) as data:
        index = next(s.index for s in data.summaries if s.policy == "push" and 0.2 < s.contact_fraction < 0.8)
        return data[index]
