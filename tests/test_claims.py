"""The tool that compares documented numbers with the output of commands."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
CLAIMS = runpy.run_path(str(ROOT / "tools" / "claims.py"))
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PRINT = """python -c "print('{\\"rmse\\": {\\"x\\": 0.01234, \\"y\\": 2}, \\"episodes\\": [12345, 3]}')" """


def result(tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, str]:
    path = tmp_path / "page.md"
    path.write_text(text.replace("PRINT", PRINT.strip()))
    code: int = CLAIMS["main"]([str(path), *options])
    captured = capsys.readouterr()
    return code, captured.out + captured.err


@pytest.mark.slow
def test_equal_numbers_pass(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = """Of 12,345 episodes, errors are 1.23 and 2 cm.<!-- claim: PRINT => $.rmse.x * 100, $.rmse.y -->
| a | 12,345 <!-- claim: PRINT => "episodes": .(\\d+), --> |
An error of 0.012 <!-- claim: PRINT => $.rmse.x --> to 0.02<!-- claim: PRINT => $.rmse.x ± 0.01 -->"""
    code, output = result(tmp_path, text, capsys)
    assert code == 0, output
    assert "5 numbers, 0 differ" in output
    assert output.count("python -c") == 1, "the same command must run once"


@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [
        "The error is 1.25 cm.<!-- claim: PRINT => $.rmse.x * 100 -->",
        "The error is 1.2 and 3 cm.<!-- claim: PRINT => $.rmse.x * 100, $.rmse.y -->",
        "The error is 1.22 cm.<!-- claim: PRINT => $.rmse.x * 100 ± 0.001 -->",
        "The error is 1 cm.<!-- claim: PRINT => $.rmse.z -->",
        "The error is 1 cm.<!-- claim: PRINT => error (\\d) -->",
        "The error is 1 cm.<!-- claim: python -c 1/0 => $.rmse.z -->",
        "No number.<!-- claim: PRINT => $.rmse.x -->",
        "The error is 1 cm.<!-- claim: PRINT -->",
    ],
)
def test_wrong_numbers_fail(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert result(tmp_path, text, capsys)[0] == 1


@pytest.mark.slow
def test_long_commands_run_on_request(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = "The error is 9 cm<!-- claim long: PRINT => $.rmse.y --> in 7 s<!-- measured: PRINT -->."
    assert result(tmp_path, text, capsys)[0] == 0
    code, output = result(tmp_path, text, capsys, "--all")
    assert code == 1
    assert "1 numbers, 1 differ" in output


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_claims_of_the_documentation_can_be_read(path: Path) -> None:
    for claim in CLAIMS["read"](path):
        for command in claim.command.split(" && "):
            program, *rest = command.split()
            assert program in ("beliefscope", "python"), claim.place
            assert program == "beliefscope" or rest[0] == "-c" or (ROOT / rest[0]).exists(), claim.place
