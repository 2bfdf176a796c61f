"""Warnings of Python and errors of options, as the commands print them."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import pytest

from beliefscope.app.cli.main import _short_warnings

Run = Callable[..., tuple[int, str, str]]


def test_warnings_for_users_have_the_form_of_notes() -> None:
    default = warnings.formatwarning
    with _short_warnings():
        assert warnings.formatwarning("Recorder\nis in training mode", UserWarning, "own.py", 3) == (
            "Warning: Recorder is in training mode\n"
        )
        assert "own.py:3: RuntimeWarning" in warnings.formatwarning("overflow", RuntimeWarning, "own.py", 3)
    assert warnings.formatwarning is default


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("inspect run.trace --data logs", "No such option: --data: traces contain their episodes."),
        ("faults --data logs", "No such option: --data."),
    ],
)
def test_data_of_traces_are_refused_without_another_option(run: Run, line: str, error: str) -> None:
    command = line.split()[0]
    assert run(line)[::2] == (2, f"error: {error} See: beliefscope {command} --help\n")
