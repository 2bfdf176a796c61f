"""Import of user code."""

from __future__ import annotations

from pathlib import Path

import pytest

from beliefscope.datasets.io import user_code


def test_included_modules_are_no_user_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process of a job is not used again after user code."""
    monkeypatch.setattr(user_code, "_places", set())
    user_code.load_module("beliefscope.datasets.errors")
    assert not user_code.has_run()
    user_code.load_module("json")
    assert user_code.has_run()


def test_files_in_two_folders_import_their_own_neighbours_of_the_same_name(tmp_path: Path) -> None:
    """Such as two versions of a filter, of which one has the healthy record."""
    places = []
    for version, folder in (("old", tmp_path / "old"), ("new", tmp_path)):
        (folder / "parts_of_it").mkdir(parents=True)
        (folder / "parts_of_it" / "name.py").write_text(f"NAME = {version!r}\n")
        (folder / "model_of_it.py").write_text(f"VERSION = {version!r}\n")
        (folder / "own.py").write_text("from model_of_it import VERSION\nfrom parts_of_it.name import NAME\n")
        places.append(str(folder / "own.py"))
    found = []
    for place in (*places, places[0]):
        with user_code.importable(place):
            module = user_code.load_module(place)
        found.append((module.VERSION, module.NAME))
    assert found == [("old", "old"), ("new", "new"), ("old", "old")]
