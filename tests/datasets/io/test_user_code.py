"""Import of user code."""

from __future__ import annotations

import pytest

from beliefscope.datasets.io import user_code


def test_included_modules_are_no_user_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process of a job is not used again after user code."""
    monkeypatch.setattr(user_code, "_places", set())
    user_code.load_module("beliefscope.datasets.errors")
    assert not user_code.has_run()
    user_code.load_module("json")
    assert user_code.has_run()
