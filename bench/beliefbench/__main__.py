"""Generate the cases of BeliefBench and score tools on them (docs/beliefbench.md)."""

from __future__ import annotations

import argparse
import json
import random
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from beliefbench.cases import FILTERS, folders, plan, read_truth
from beliefbench.generate import write_case
from beliefbench.scorecard import confusion, score_card, table
from beliefbench.tools import Tool, answers_of, command_tool, find_tool, mean_cpu_seconds

BASELINES = ("first-alarm", "nearest-neighbour", "decision-tree")


def part(items: list[Any], arguments: argparse.Namespace) -> list[Any]:
    """Every Nth item in a random order that is always the same: what an interrupted run has done is a random sample."""
    return random.Random(0).sample(items, len(items))[arguments.first :: arguments.every]


def generate(arguments: argparse.Namespace) -> None:
    specs = part(plan(arguments.split, arguments.repeats), arguments)
    for number, spec in enumerate(specs, 1):
        if not (arguments.directory / spec.name / "truth.json").exists():
            began = time.process_time()
            write_case(spec, arguments.directory)
            print(f"{number}/{len(specs)} {spec.name} {spec.label}: {time.process_time() - began:.1f} s", flush=True)


def tool_of(arguments: argparse.Namespace) -> Tool:
    if arguments.command:
        return command_tool(arguments.command)
    if arguments.tool not in BASELINES:
        return find_tool(arguments.tool)
    from beliefbench.baselines import Learned, first_alarm  # imports scikit-learn

    if arguments.tool == "first-alarm":
        return first_alarm
    if arguments.tuning is None:
        sys.exit(f"{arguments.tool} is fitted to tuning cases: give their directory with --tuning")
    learned = Learned.fit(folders(arguments.tuning))
    return learned.nearest_neighbour if arguments.tool == "nearest-neighbour" else learned.decision_tree


def answer(arguments: argparse.Namespace) -> None:
    cases = part(folders(arguments.directory), arguments)
    answers_of(tool_of(arguments), cases, arguments.answers, lambda line: print(line, flush=True))


def score(arguments: argparse.Namespace) -> None:
    scores, documents = {}, {}
    for store in arguments.answers:
        cases = [folder for folder in folders(arguments.directory) if (store / f"{folder.name}.json").exists()]
        truths = [read_truth(folder) for folder in cases]
        answers = [json.loads((store / f"{folder.name}.json").read_text())["answer"] for folder in cases]
        scores[store.name] = score_card(truths, answers)
        documents[store.name] = {
            "cases": len(cases),
            "cpu_seconds": round(mean_cpu_seconds(cases, store), 2),
            "scores": [s.to_json() for s in scores[store.name]],
            "confusion": confusion(truths, answers),
        }
    if arguments.json:
        print(json.dumps(documents, indent=1))
        return
    print(table(scores))
    print("".join(f"\n{name}: {d['cases']} cases, {d['cpu_seconds']} CPU-s per case" for name, d in documents.items()))


def add_part(command: argparse.ArgumentParser) -> None:
    command.add_argument("--first", type=int, default=0, help="skip N cases of a fixed random order")
    command.add_argument("--every", type=int, default=1, help="only every Nth case")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("generate", help="write the cases of a split; resumes if interrupted")
    command.add_argument("directory", type=Path)
    command.add_argument("--split", choices=FILTERS, required=True)
    command.add_argument("--repeats", type=int, default=1, help="cases per cause and filter, with other seeds")
    add_part(command)
    command.set_defaults(run=generate)
    command = commands.add_parser("answer", help="run a tool on cases; resumes if interrupted")
    command.add_argument("directory", type=Path)
    command.add_argument("answers", type=Path, help="folder for the answers")
    command.add_argument(
        "--tool", default="diagnose", help=f"module:function, {', '.join(BASELINES)}; default: diagnose"
    )
    command.add_argument(
        "--command", help="command that prints the answer, with {checkpoint} {episodes} {particles} ..."
    )
    command.add_argument("--tuning", type=Path, help="tuning cases, for the two learned baselines")
    add_part(command)
    command.set_defaults(run=answer)
    command = commands.add_parser("score", help="print the score card of folders of answers")
    command.add_argument("directory", type=Path)
    command.add_argument("answers", type=Path, nargs="+")
    command.add_argument("--json", action="store_true", help="with the confusion of causes")
    command.set_defaults(run=score)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
