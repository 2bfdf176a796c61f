"""Train and test filters on four divisions of the real pushes, so that each push is tested once.

    python bench/real_divisions.py MIT_PUSH DIR information-ekf information-ekf:image information-ekf:haptics

Division k tests every fourth file in alphabetical order, from the k-th, and trains on the others, every fifth of which
calibrates. MIT_PUSH is a folder with JSON files of one shape (docs/data.md). The task is push-real-field; names of
filters and the training plan are those of ``bench/field_tasks.py``. DIR keeps data, checkpoints and results. Errors are
RMSE in cm from step 0, and NEES/n by step; brackets are 95 % intervals over trajectories.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from shutil import copy

import numpy as np
import torch
from field_tasks import DEFAULT, haptics_share, mean_of_steps, nees_by_step, phases, trained, triple
from numpy.typing import NDArray

from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset, write_dataset
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.models.ekf import ExtendedKalmanFilter
from beliefscope.filters.models.information import InformationFilter
from beliefscope.inspect.statistics.intervals import jackknife

Array = NDArray[np.float64]

DIVISIONS = 4
CALIBRATION = 5
"""One of so many training pushes is for calibration."""
TASK = load_task("push-real-field")


def divide(source: Path, folder: Path, division: int) -> None:
    """Write the training and test file of a division."""
    files = sorted(source.rglob("*.json"))
    tested = files[division::DIVISIONS]
    rest = [file for file in files if file not in tested]
    calibration = rest[::CALIBRATION]
    training = [file for file in rest if file not in calibration]
    for name, splits in {"train": {"train": training, "val": calibration}, "outages": {"test": tested}}.items():
        path = folder / f"{name}.h5"
        if path.exists():
            continue
        for split, members in splits.items():
            target = folder / "pushes" / name / split
            target.mkdir(parents=True, exist_ok=True)
            for file in members:
                copy(file, target)
        with open_dataset(folder / "pushes" / name, TASK) as data:
            write_dataset(path, TASK, data)


def squared_errors(folder: Path, name: str, episodes: Sequence[Episode]) -> tuple[dict[str, Array], Array | None]:
    """Filter, standalone modality or baseline -> (R, 2) steps and squared error; and (T, R) NEES."""
    filter_ = trained(folder, name)
    fused = len(filter_.names) > 1
    result = evaluate(filter_, episodes, baselines=name == DEFAULT[0], modalities=fused)
    column = [0, 1 + list(result.rmse).index("position_cm")]
    by_name = {name: result}
    by_name |= {f"{name}, {modality} standalone": other for modality, other in result.standalone.items()}
    by_name |= {other: metrics for other, metrics in result.baselines.items() if metrics is not None}
    values = nees_by_step(filter_, episodes) if isinstance(filter_, ExtendedKalmanFilter) else None
    return {key: metrics.squares[:, column] for key, metrics in by_name.items()}, values


def rows(squares: dict[str, Array], names: Sequence[str]) -> list[str]:
    """Errors of all filters; the ratio of the first one to the best single modality of its kind and to all others."""

    def ratio(key: str, others: Sequence[str]) -> str:
        sums = np.stack([squares[other][:, 1] for other in (key, *others)], 1)
        return triple(jackknife(sums, lambda s: np.sqrt(s[..., 0] / s[..., 1:].min(-1))))

    first = names[0]
    single = [key for key in squares if key.startswith((f"{first}:", f"{first},"))]
    lines = [f"{key}: {triple(jackknife(s, lambda t: np.sqrt(t[..., 1] / t[..., 0])))}" for key, s in squares.items()]
    lines.append(f"{first} / best of {', '.join(single)}: {ratio(first, single)}")
    lines += [f"{first} / {name}: {ratio(first, [name])}" for name in names[1:] if name not in single]
    return lines + [f"{key} / dynamics: {ratio(key, ['dynamics'])}" for key in single if "haptics" in key]


def main(source: Path, folder: Path, names: Sequence[str]) -> None:
    torch.set_num_threads(1)
    pooled: dict[str, list[Array]] = {}
    consistency: dict[str, list[tuple[Array, dict[str, Array]]]] = {}
    for division in range(DIVISIONS):
        place = folder / str(division)
        divide(source, place, division)
        with open_dataset(place / "outages.h5") as data:
            episodes = list(data)
        squares: dict[str, Array] = {}
        for name in names:
            errors, values = squared_errors(place, name, episodes)
            squares |= errors
            if values is not None:
                consistency.setdefault(name, []).append((values, phases(episodes)))
        for key, value in squares.items():
            pooled.setdefault(key, []).append(value)
        print(f"division {division}, {len(episodes)} episodes", *rows(squares, names), sep="\n  ")
        first = trained(place, names[0])
        if isinstance(first, InformationFilter):
            print("".join(f"  share of haptics, {key}: {v}\n" for key, v in haptics_share(first, episodes).items()))
    print("all divisions", *rows({key: np.concatenate(v) for key, v in pooled.items()}, names), sep="\n  ")
    for name, parts in consistency.items():
        nees = np.concatenate([values for values, _ in parts], 1)
        for phase in parts[0][1]:
            print(
                f"  NEES/n of {name}, {phase}: {mean_of_steps(nees, np.concatenate([m[phase] for _, m in parts], 1))}"
            )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:] or DEFAULT)
