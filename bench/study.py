"""Compare the results of a study, from starts at the truth, with expectations, as a Markdown table.

python bench/study.py filters/pretrained/study.json
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from beliefscope.datasets.catalog import find_task
from beliefscope.filters.training.study_table import TRIVIAL, label

TIMES_BETTER = 5.0
"""Than the training mean: required position error of fusing filters on clean data."""

SHARE_BETTER = 0.2
"""Than the image-only filter: required error of crossmodal filters in the moving components, 80 % image blackout."""

TIMES_WORSE = 2.0
"""Than the best filter: allowed error of the LSTM."""


def main(path: Path) -> None:
    study = json.loads(path.read_text())
    rows = [row for row in study["rows"] if (row["seeds"] or row["filter"] == TRIVIAL) and not row.get("start")]
    print("| task | expectation | filter | image blackout | bound | measured | met |")
    print("| --- | --- | --- | ---: | ---: | ---: | --- |")
    for task in dict.fromkeys(row["task"] for row in rows):
        errors = {(row["filter"], row["blackout"]): row["mean"] for row in rows if row["task"] == task}
        alone = {
            (row["filter"], row["blackout"]): row.get("standalone", row.get("alone", {}))
            for row in rows
            if row["task"] == task
        }
        spread = {(row["filter"], row["blackout"]): row["spread"] for row in rows if row["task"] == task}
        for expectation, key, name, blackout, bar in expectations(task, errors, alone):
            measured = errors[name, blackout][key]
            deviation = spread[name, blackout].get(key) or 0.0
            verdict = "yes" if measured <= bar else "within one std" if measured - deviation <= bar else "**no**"
            print(
                f"| {task} | {label(key)}, {expectation} | {name} | {blackout:.0%} | <= {bar:.3f} "
                f"| {measured:.3f} ± {deviation:.3f} | {verdict} |"
            )


Errors = dict[tuple[str, float | None], dict[str, Any]]
Expectation = tuple[str, str, str, float, float]
"""Expectation, metric, filter, image blackout, largest allowed error."""


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
                best = min(metrics[key] for metrics in alone[name, blackout].values())
                yield "no worse than its better modality", key, name, blackout, best
        if (image, 0.8) in errors:
            for key in angles or ["position_cm"]:  # the moving components
                bar = (1.0 - SHARE_BETTER) * errors[image, 0.8][key]
                yield f"{SHARE_BETTER:.0%} better than {image}", key, name, 0.8, bar
    if "lstm" in names:
        for key in ("position_cm", *angles):
            best = min(errors[name, 0.0][key] for name in names)
            yield f"within {TIMES_WORSE:g} x of the best filter", key, "lstm", 0.0, TIMES_WORSE * best


if __name__ == "__main__":
    main(Path(sys.argv[1]))
