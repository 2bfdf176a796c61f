"""Holds a study's results against what is expected of the filters, as a Markdown table.

python bench/study.py filters/pretrained/study.json
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from beliefscope.datasets.catalog import find_task
from beliefscope.filters.training.study import TRIVIAL

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
        spread = {(row["filter"], row["blackout"]): row["spread"] for row in rows if row["task"] == task}
        for what, key, name, blackout, bar in expectations(task, errors, alone):
            measured = errors[name, blackout][key]
            luck = spread[name, blackout].get(key) or 0.0
            verdict = "yes" if measured <= bar else "within the spread" if measured - luck <= bar else "**no**"
            print(
                f"| {task} | {shown(key)}, {what} | {name} | {blackout:.0%} | <= {bar:.3f} "
                f"| {measured:.3f} ± {luck:.3f} | {verdict} |"
            )


Errors = dict[tuple[str, float | None], dict[str, Any]]
Expectation = tuple[str, str, str, float, float]
"""What, of which error, filter, chance of a black picture, the highest error that is well."""


def expectations(task: str, errors: Errors, alone: Errors) -> Iterator[Expectation]:
    names = list(dict.fromkeys(name for name, _ in errors if name != TRIVIAL))
    angles = [f"{c.name}_deg" for c in find_task(task).components if c.unit == "rad"]
    for name in names:
        if name.startswith(("crossmodal", "feature")):
            bar = errors[TRIVIAL, None]["position_cm"] / TIMES_BETTER
            yield f"{TIMES_BETTER:g} x better than the {TRIVIAL}", "position_cm", name, 0.0, bar
    for name in [name for name in names if name.startswith("crossmodal")]:
        image = "image-pf" if name.endswith("pf") else "image-ekf"
        for blackout in (0.0, 0.4, 0.8):
            for key in ("position_cm", *angles):
                best = min(of_one[key] for of_one in alone[name, blackout].values())
                yield "no worse than the better of its modalities", key, name, blackout, best
        if (image, 0.8) in errors:
            for key in angles or ["position_cm"]:  # what moves
                bar = (1.0 - SHARE_BETTER) * errors[image, 0.8][key]
                yield f"{SHARE_BETTER:.0%} better than {image}", key, name, 0.8, bar
    if "lstm" in names:
        for key in ("position_cm", *angles):
            best = min(errors[name, 0.0][key] for name in names)
            yield f"within {TIMES_WORSE:g} x of the best filter", key, "lstm", 0.0, TIMES_WORSE * best


def shown(key: str) -> str:
    name, unit = key.rsplit("_", 1)
    return f"{name} ({unit})"


if __name__ == "__main__":
    main(Path(sys.argv[1]))
