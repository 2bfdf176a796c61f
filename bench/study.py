"""Holds a study's results against what is expected of the filters, as a Markdown table.

python bench/study.py docs/study/study.json
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from beliefscope.datasets.catalog import find_task
from beliefscope.filters.study import TRIVIAL

TIMES_BETTER = 5.0
"""Than the training mean, for what fuses, on the place and with whole pictures."""

SHARE_BETTER = 0.2
"""Than the picture alone, for crossmodal filters, on what moves, with 80 % black pictures."""

TIMES_WORSE = 2.0
"""Than the best filter, for the LSTM."""


def main(path: Path) -> None:
    study = json.loads(path.read_text())
    rows = [row for row in study["rows"] if row["seeds"] or row["filter"] == TRIVIAL]
    print("| task | what is expected | filter | black pictures | expected | measured | |")
    print("| --- | --- | --- | ---: | ---: | ---: | --- |")
    for task in dict.fromkeys(row["task"] for row in rows):
        errors = {(row["filter"], row["blackout"]): row["mean"] for row in rows if row["task"] == task}
        alone = {(row["filter"], row["blackout"]): row.get("alone", {}) for row in rows if row["task"] == task}
        for what, name, blackout, bar, measured in expectations(task, errors, alone):
            verdict = "yes" if measured <= bar else "**no**"
            black = "" if blackout is None else f"{blackout:.0%}"
            print(f"| {task} | {what} | {name} | {black} | <= {bar:.2f} | {measured:.2f} | {verdict} |")


Errors = dict[tuple[str, float | None], dict[str, Any]]
Expectation = tuple[str, str, float | None, float, float]
"""What, filter, chance of a black picture, the highest error that is well, the measured one."""


def expectations(task: str, errors: Errors, alone: Errors) -> Iterator[Expectation]:
    names = list(dict.fromkeys(name for name, _ in errors if name != TRIVIAL))
    angles = [f"{c.name}_deg" for c in find_task(task).components if c.unit == "rad"]
    moving = angles or ["position_cm"]
    for name in names:
        if name.startswith(("crossmodal", "feature")):
            bar = errors[TRIVIAL, None]["position_cm"] / TIMES_BETTER
            what = f"position (cm), {TIMES_BETTER:g} x better than the {TRIVIAL}"
            yield what, name, 0.0, bar, errors[name, 0.0]["position_cm"]
    for name in [name for name in names if name.startswith("crossmodal")]:
        kind = "pf" if name.endswith("pf") else "ekf"
        for blackout in (0.0, 0.4, 0.8):
            for key in ("position_cm", *angles):
                best = min(of_one[key] for of_one in alone[name, blackout].values())
                what = f"{shown(key)}, no worse than the better of its modalities"
                yield what, name, blackout, best, errors[name, blackout][key]
        if (f"image-{kind}", 0.8) in errors:
            for key in moving:
                bar = (1.0 - SHARE_BETTER) * errors[f"image-{kind}", 0.8][key]
                what = f"{shown(key)}, {SHARE_BETTER:.0%} better than image-{kind}"
                yield what, name, 0.8, bar, errors[name, 0.8][key]
    if "lstm" in names:
        for key in ("position_cm", *angles):
            best = min(errors[name, 0.0][key] for name in names)
            what = f"{shown(key)}, within {TIMES_WORSE:g} x of the best filter"
            yield what, "lstm", 0.0, TIMES_WORSE * best, errors["lstm", 0.0][key]


def shown(key: str) -> str:
    name, unit = key.rsplit("_", 1)
    return f"{name} ({unit})"


if __name__ == "__main__":
    main(Path(sys.argv[1]))
