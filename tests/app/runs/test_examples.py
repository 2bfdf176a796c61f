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

MIT_PUSH = Path(__file__).resolve().parents[4] / "shared" / "data" / "mit_push" / "val"


def test_every_example_exists_and_the_first_is_the_default(tmp_path: Path) -> None:
    store = TraceStore(Settings(tmp_path))
    catalog = store.catalog()
    assert [example["link"] for example in catalog["examples"]] == [example.link for example in EXAMPLES]
    available = [example for example in EXAMPLES if not example.setup]
    for example in available:
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


def test_an_example_without_its_data_says_how_to_serve_them(tmp_path: Path) -> None:
    store = TraceStore(Settings(tmp_path))
    assert [example["title"] for example in store.catalog()["examples"] if example["setup"]] == ["Real push"]
    store.close()


@pytest.mark.skipif(not MIT_PUSH.exists(), reason="needs the MIT Push data set")
def test_an_example_of_the_users_data_comes_first_and_needs_no_setup(tmp_path: Path) -> None:
    store = TraceStore(Settings(tmp_path, data={"mine": MIT_PUSH}))
    first, *others = store.catalog()["examples"]
    assert (first["title"], first["setup"]) == ("Real push", "")
    assert len(others) == len(EXAMPLES) - 1
    assert store.default_selection().task == "push-real"
    assert store.default_selection().data == "mine"
    store.close()
