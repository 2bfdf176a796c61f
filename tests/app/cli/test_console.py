"""Tests of the progress display where standard error is not a terminal, and of printed results."""

from __future__ import annotations

from pathlib import Path

import pytest

from beliefscope.app.cli import console


def test_redirected_progress_prints_lines(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: clock[0])
    with console.bars() as update:
        for i in range(101):
            clock[0] = 0.3 * i
            update("Filtering", i / 100, "loss 0.1")
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "Filtering: 10 %, 3 s, 27 s left, loss 0.1"
    assert lines[-1] == "Filtering: 100 %, 30 s, loss 0.1"
    assert len(lines) == 10


def test_the_remaining_time_of_a_task_does_not_count_the_time_before(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: clock[0])
    with console.bars() as update:
        for i in range(101):
            clock[0] = 60.0 + 0.3 * i
            update("Filtering", i / 100, "")
    assert capsys.readouterr().err.startswith("Filtering: 10 %, 63 s, 27 s left\n")


def test_redirected_progress_of_a_fast_command_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with console.progress("Filtering") as advance:
        for i in range(101):
            advance(i / 100)
    assert capsys.readouterr().err == "Filtering: 100 %, 0 s\n"


@pytest.mark.parametrize(("size", "text"), [(2_300, "2.3 kB"), (1_100_000, "1.1 MB")])
def test_size_of_the_written_file(capsys: pytest.CaptureFixture[str], tmp_path: Path, size: int, text: str) -> None:
    path = tmp_path / "run.trace"
    path.write_bytes(bytes(size))
    console.Result({}, "100 steps", path).print(None)
    assert capsys.readouterr().out == f"{path} ({text}): 100 steps\n"
