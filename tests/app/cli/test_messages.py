"""Warnings of Python and errors of options, as the commands print them."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from beliefscope.app.cli.main import short_warning

Run = Callable[..., tuple[int, str, str]]


def test_warnings_for_users_have_the_form_of_notes() -> None:
    text = short_warning("Recorder\nis in training mode", UserWarning, "own.py", 3)
    assert text == "Warning: Recorder is in training mode\n"
    assert "own.py:3: RuntimeWarning" in short_warning("overflow", RuntimeWarning, "own.py", 3)


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


def test_a_missing_value_of_the_data_is_named(run: Run) -> None:
    error = "error: Option '--data' requires an argument. See: beliefscope --help\n"
    assert run("evaluate door --filter crossmodal-pf --data")[::2] == (2, error)
