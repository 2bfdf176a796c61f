"""Running a tool over cases: a Python callable, or a command that prints its answer as JSON."""

from __future__ import annotations

import importlib
import json
import resource
import shlex
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from beliefbench.cases import Case, load_case
from beliefbench.scorecard import Answer

Tool = Callable[[Case], Answer]

DIAGNOSE = "beliefscope.inspect.diagnosis.diagnose:diagnose"

NO_ANSWER: Mapping[str, Any] = {"state": "unsure", "masked": False, "causes": []}


def find_tool(name: str) -> Tool:
    """``diagnose``, or ``module:function`` of a function ``f(checkpoint, episodes, *, particles, seed) -> answer``.

    The answer is a document, or an object with ``to_json()``.
    """
    module, _, function = (DIAGNOSE if name == "diagnose" else name).partition(":")
    diagnose = getattr(importlib.import_module(module), function)

    def tool(case: Case) -> Answer:
        answer = diagnose(case.checkpoint, case.episodes, particles=case.particles, seed=case.seed)
        return answer.to_json() if hasattr(answer, "to_json") else answer

    return tool


def command_tool(template: str) -> Tool:
    """A shell-like command; ``{task} {filter} {checkpoint} {episodes} {particles} {seed}`` are replaced.

    It must print one JSON document. Cases whose equations were changed in memory cannot be run from their files; the
    answer to them is ``NO_ANSWER``.
    """

    def tool(case: Case) -> Answer:
        if not case.runnable:
            return NO_ANSWER
        values = {
            "task": case.checkpoint.task.name,
            "filter": case.checkpoint.name,
            "checkpoint": case.folder / "checkpoint.safetensors",
            "episodes": case.folder / "episodes.h5",
            "particles": case.particles,
            "seed": case.seed,
        }
        words = shlex.split(template)
        for name, value in values.items():
            words = [word.replace(f"{{{name}}}", str(value)) for word in words]
        result = subprocess.run(words, capture_output=True, text=True, check=False)
        try:
            return json.loads(result.stdout)
        except ValueError:
            raise RuntimeError(
                f"{words[0]} printed no JSON document for {case.folder}: {result.stderr[-500:]}"
            ) from None

    return tool


def answers_of(tool: Tool, folders: Sequence[Path], store: Path, progress: Callable[[str], None]) -> list[Answer]:
    """Answers to cases, stored as ``NAME.json`` with their CPU seconds; stored ones are not computed again."""
    store.mkdir(parents=True, exist_ok=True)
    answers = []
    for folder in folders:
        path = store / f"{folder.name}.json"
        if not path.exists():
            case, began = load_case(folder), cpu_seconds()
            document = {"answer": tool(case), "cpu_seconds": round(cpu_seconds() - began, 2)}
            path.write_text(json.dumps(document) + "\n")
            progress(f"{folder.name}: {document['cpu_seconds']} s")
        answers.append(json.loads(path.read_text())["answer"])
    return answers


def mean_cpu_seconds(folders: Sequence[Path], store: Path) -> float:
    """Mean CPU seconds of the stored answers."""
    return fmean(json.loads((store / f"{folder.name}.json").read_text())["cpu_seconds"] for folder in folders)


def cpu_seconds() -> float:
    """CPU time of this process and of its finished children."""
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)
