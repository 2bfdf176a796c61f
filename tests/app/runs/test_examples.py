"""Examples of the page."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import parse_qs

import pytest

from beliefscope.app.runs.examples import EXAMPLES
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import sample_path

pytestmark = pytest.mark.slow


def test_every_example_exists_and_the_first_is_the_default(tmp_path: Path) -> None:
    store = TraceStore(Settings(tmp_path))
    catalog = store.catalog()
    assert [example["link"] for example in catalog["examples"]] == [example.link for example in EXAMPLES]
    for example in EXAMPLES:
        data = store.dataset(example.task, "")[1]
        faults = Faults.parse(parse_qs(example.link).get("faults", [""])[0])
        store.key(Selection(example.task, example.filter, data.held_out()[0], faults))  # raises for unknown names
    (entry,) = next(task for task in catalog["tasks"] if task["name"] == EXAMPLES[0].task)["data"]
    expected = Selection(EXAMPLES[0].task, EXAMPLES[0].filter, entry["first"], data=entry["name"])
    assert store.default_selection() == expected
    store.close()


def test_files_of_the_user_come_first(tmp_path: Path) -> None:
    store = TraceStore(Settings(tmp_path, data={"mine": sample_path("door")}))
    assert store.catalog()["examples"] == []
    assert store.default_selection().data == "mine"
    store.close()
