"""Invalid arguments are reported before a filter runs: this one fails at its first step."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

Run = Callable[..., tuple[int, str, str]]

FILTER = """
class Slow:
    def initialize_beliefs(self):
        pass

    def forward(self, observations, controls):
        raise RuntimeError("the filter has run")


def build():
    return Slow()
"""


@pytest.fixture
def source(tmp_path: Path) -> str:
    path = tmp_path / "slow.py"
    path.write_text(FILTER)
    return f"{path}:build"


def test_the_filter_fails_when_it_runs(run: Run, source: str, tmp_path: Path) -> None:
    code, _, err = run("trace", "door", "--filter", source, "-o", tmp_path / "run.trace")
    assert code == 2
    assert "the filter has run" in err


EDIT = ("counterfactual", "door", "--faults", "blackout", "--from", 40)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ((*EDIT, "--to", 900), "step 900 is after the last step of this episode, 99"),
        ((*EDIT[:-1], 900, "--to", 901), "step 900 is not in this episode: it has steps 0 to 99"),
        ((*EDIT, "--to", 60, "--weights", "image=0.2"), "its fusion weights cannot be set; use sensor faults"),
        ((*EDIT, "--to", 60, "--episode", 9999), "Episode 9999 is not in"),
        (("figure", "maps", "door", "-o", "new.svg", "--step", 900), "step 900 is not in this episode"),
        (("figure", "maps", "door", "-o", "new.svg", "--step", 0, "--step", 1), "steps 0 and 1 are both in"),
        (("diagnose", "door", "--episode", 9999), "Episode 9999 is not in"),
        (("diagnose", "door", "--repair", 9), "has no smallest repair: its sensors cannot be dropped"),
        (("diagnose", "door", "--profile-filter", "crossmodal-ekf"), "--profile-filter needs --profile-from"),
        (("failures", "door", "--by", "eror"), "score 'eror' of task 'door' does not exist"),
        (("failures", "door", "--url", "foo"), "--url 'foo' is not an address such as http://127.0.0.1:8000"),
        (("evaluate", "door", "--start-offset", "3K"), "start offset '3K' is not in a unit of task 'door': cm, deg"),
        (("evaluate", "door", "--only", "sound"), "'sound'"),
        (("slices", "door", "--alpha", 2), "--alpha is 2, not a probability"),
        (("calibrate", "door", "-o", "new.json", "--level", 2), "level is 2, not a number between 0 and 1"),
        (("live", "door", "--episode", 9999), "Episode 9999 is not in"),
        (
            ("record", "door", "-o", "new.rrd", "--faults", "blackout:key=force"),
            "image sensor 'force' of task 'door' does not exist",
        ),
    ],
)
def test_arguments_are_checked_before(run: Run, source: str, command: tuple[object, ...], message: str) -> None:
    code, _, err = run(*command, "--filter", source)
    assert code == 2
    assert message in err
    assert "the filter has run" not in err
