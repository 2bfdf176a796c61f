"""Running tools: Python functions, commands, and stored answers."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import pytest
from beliefbench import tools
from beliefbench.tools import NO_ANSWER, answers_of, command_tool, find_tool, mean_cpu_seconds


class FakeCase:
    episodes: ClassVar[dict[int, Any]] = {}

    class checkpoint:
        class task:
            name = "door"

        name = "crossmodal-ekf"

    folder, particles, seed, runnable = Path("case"), 300, 7, True


@pytest.mark.slow
def test_commands_get_the_files_and_print_json() -> None:
    script = "import json, sys; print(json.dumps({'state': 'healthy', 'causes': [], 'arguments': sys.argv[1:]}))"
    case: Any = FakeCase()
    tool = command_tool(f'{sys.executable} -c "{script}" {{checkpoint}} --seed {{seed}}')
    assert tool(case)["arguments"] == [str(Path("case/checkpoint.safetensors")), "--seed", "7"]
    with pytest.raises(RuntimeError, match=r"printed no JSON document for case: .*broken"):
        command_tool(f"{sys.executable} -c \"raise SystemExit('broken')\"")(case)
    case.runnable = False
    assert tool(case) is NO_ANSWER


def test_functions_get_the_checkpoint_and_the_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    class Result:
        def __init__(self, **values: Any) -> None:
            self.values = values

        def to_json(self) -> dict[str, Any]:
            return {"state": "healthy", **self.values}

    module: Any = ModuleType("own_tool")
    module.plain = lambda checkpoint, episodes, *, particles, seed: {"checkpoint": checkpoint, "seed": seed}
    module.typed = lambda checkpoint, episodes, *, particles, seed: Result(particles=particles, episodes=episodes)
    monkeypatch.setitem(sys.modules, "own_tool", module)
    case: Any = FakeCase()
    assert find_tool("own_tool:plain")(case) == {"checkpoint": FakeCase.checkpoint, "seed": 7}
    assert find_tool("own_tool:typed")(case) == {"state": "healthy", "particles": 300, "episodes": {}}


def test_stored_answers_are_not_computed_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tools, "load_case", lambda folder: folder.name)
    calls: list[Any] = []

    def tool(case: Any) -> dict[str, Any]:
        calls.append(case)
        return {"state": case}

    cases = [Path("a"), Path("b")]
    assert answers_of(tool, cases[:1], tmp_path, print) == [{"state": "a"}]
    assert answers_of(tool, cases, tmp_path, print) == [{"state": "a"}, {"state": "b"}]
    assert calls == ["a", "b"]
    assert 0.0 <= mean_cpu_seconds(cases, tmp_path) < 1.0
