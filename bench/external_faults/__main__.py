"""Diagnose planted faults of eleven external filters and of their data, and count the correct first causes.

    python bench/external_faults
    python bench/external_faults kiln lid --cases healthy0 dt_short
    python bench/external_faults mower shuttle

Each task has a simulator, a correct filter and 12, 10 or 8 faults. Shunter, lid, shuttle and slot are particle filters;
kiln, turbine, mower and tray extended Kalman filters; rover is an unscented, river an ensemble and skiff an error-state
Kalman filter. Tray and slot have a camera and trained networks (``train.py``). The faults of mower and shuttle are
mistakes reported in public, 2 of the data and 10 of the filter; those of shunter, kiln, turbine and lid are 5 of the
data and 7 of the filter, of rover, river and skiff 3 and 5, of tray and slot 5 and 5. The healthy record is 60 clean
episodes; a case has 10 other ones. A diagnosis is correct if its first cause is one of those accepted for the fault. A
healthy sample with any other state than healthy is a false alarm. A task takes 1 to 6 min.
"""

from __future__ import annotations

import argparse
import importlib
import re
import sys
import tempfile
import time
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from beliefbench.scorecard import proportion

import beliefscope as bs
from beliefscope.datasets.errors import BadInput
from external_faults.fault import Fault

TASKS = ("shunter", "kiln", "turbine", "lid", "mower", "shuttle", "rover", "river", "skiff", "tray", "slot")
HEALTHY = [f"healthy{k}" for k in range(5)]


class Answer(NamedTuple):
    """rank: as of ``rank_of``; None of a healthy sample."""

    task: str
    case: str
    fault: Fault | None
    diagnosis: bs.Diagnosis
    rank: int | None


def episodes_of(module: ModuleType, case: str) -> list[bs.Episode]:
    """The 10 episodes of a case; each case has its own seeds."""
    if case in HEALTHY:
        return [module.simulate(20000 + 100 * HEALTHY.index(case) + i) for i in range(10)]
    fault = case if module.FAULTS[case].where == "data" else ""
    return [module.simulate(10000 + 100 * list(module.FAULTS).index(case) + i, fault) for i in range(10)]


def filter_of(module: ModuleType, case: str = "") -> bs.Checkpoint:
    """A new filter of a case; without its fault, if that is one of the data."""
    name = module.TASK.name
    fault = module.FAULTS.get(case)
    return bs.load_filter(
        module.make(case if fault and fault.where == "filter" else ""), name=f"{name}-{case or 'right'}"
    )


def rank_of(fault: Fault, diagnosis: bs.Diagnosis) -> int:
    """Rank of the first accepted cause, from 1; 0 without one."""
    names = [candidate.cause.name for candidate in diagnosis.causes]
    return next((rank for rank, name in enumerate(names, 1) if re.fullmatch(fault.accepted, name)), 0)


def answers(task: str, cases: list[str], folder: Path) -> list[Answer]:
    """Diagnose the cases of a task one after the other, with progress in stderr."""
    module = importlib.import_module(f"external_faults.{task}")
    torch.manual_seed(0)
    record, results = None, []
    chosen = [case for case in [*HEALTHY, *module.FAULTS] if not cases or case in cases]
    for number, case in enumerate(chosen, 1):
        began = time.perf_counter()
        if record is None:
            clean = bs.save_dataset([module.simulate(seed) for seed in range(60)], folder / f"{task}-clean.h5")
            record = bs.healthy_record(filter_of(module), clean)
        data = bs.save_dataset(episodes_of(module, case), folder / f"{task}-{case}.h5")
        diagnosis = bs.diagnose(filter_of(module, case), data, profile_from=record)
        fault = module.FAULTS.get(case)
        results.append(Answer(task, case, fault, diagnosis, rank_of(fault, diagnosis) if fault else None))
        progress = f"{task} {number}/{len(chosen)} {case}: {time.perf_counter() - began:.0f} s: {diagnosis.headline}"
        print(progress, file=sys.stderr, flush=True)
    return results


def row(answer: Answer) -> str:
    """A line of the table in Markdown."""
    fault, headline = answer.fault, answer.diagnosis.headline
    cells = [answer.task, answer.case]
    if fault:
        description = f"{fault.description} ({fault.source})" if fault.source else fault.description
        cells += [fault.where, description, f"`{fault.accepted}`".replace("|", "\\|")]
    else:
        cells += ["", "none", ""]
    rank = "" if answer.rank is None else str(answer.rank or "-")
    return f"| {' | '.join([*cells, headline, rank])} |"


def share(correct: list[bool]) -> str:
    """A share with its Wilson interval of 95 %."""
    if not correct:
        return "none"
    score = proportion("", correct, "")
    low, high = 100 * score.low, 100 * score.high
    return f"{sum(correct)} of {len(correct)} ({100 * score.value:.0f} %, {low:.0f} to {high:.0f} %)"


def totals(results: list[Answer]) -> str:
    """Correct first causes by the place of the fault, and false alarms."""
    ranks = {where: [a.rank for a in results if a.fault and a.fault.where == where] for where in ("data", "filter")}
    ranks["all"] = ranks["data"] + ranks["filter"]
    lines = [f"First cause accepted, {where}: {share([rank == 1 for rank in r])}" for where, r in ranks.items()]
    alarms = [answer.diagnosis.state != "healthy" for answer in results if answer.fault is None]
    return "\n".join([*lines, f"Healthy samples with an alarm: {share(alarms)}"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.prog = "python bench/external_faults"
    parser.add_argument("tasks", nargs="*", metavar="TASK", help=f"any of {', '.join(TASKS)}; default: all")
    parser.add_argument("--cases", nargs="+", default=[], metavar="CASE", help="names of faults, or healthy0 to 4")
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="keep the episodes here; default: temporary")
    options = parser.parse_args()
    tasks = options.tasks or list(TASKS)
    if unknown := set(tasks) - set(TASKS):
        parser.error(f"unknown task {', '.join(sorted(unknown))}; valid: {', '.join(TASKS)}")
    names = {t: importlib.import_module(f"external_faults.{t}").FAULTS for t in tasks}
    valid = [*HEALTHY, *dict.fromkeys(case for faults in names.values() for case in faults)]
    if unknown := set(options.cases) - set(valid):
        parser.error(f"unknown case {', '.join(sorted(unknown))}; valid: {', '.join(valid)}")
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.data or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        try:
            results = [answer for task in tasks for answer in answers(task, options.cases, folder)]
        except BadInput as error:
            sys.exit(str(error))
    print("| task | case | where | fault | accepted causes | headline | rank |")
    print("| --- | --- | --- | --- | --- | --- | ---: |")
    print("\n".join(map(row, results)))
    print(f"\n{totals(results)}")


if __name__ == "__main__":
    main()
