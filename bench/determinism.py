"""Whether the same seed gives the same bits: again, in another process, and with two threads of PyTorch's.

    python bench/determinism.py

Each line is something made four times over; where its bits differ, by how much at most, relative to its largest value.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "fuzz"))

import numpy as np
import torch
from valid_files import episodes

from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import write_dataset
from beliefscope.filters.catalog import architecture
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.filters.finetuning.finetune import FineTune, finetune
from beliefscope.filters.training.train import PLANS, train
from beliefscope.inspect.likelihood import MapEngine
from beliefscope.inspect.trace import arrays_of, trace

Arrays = dict[str, Any]
STEPS = 60


def traced(name: str) -> Arrays:
    return arrays_of(trace(load_checkpoint(shipped("door", name)), episodes("door", STEPS)[0], seed=3))


def mapped(name: str) -> Arrays:
    checkpoint = load_checkpoint(shipped("door", name))
    engine = MapEngine(checkpoint, trace(checkpoint, episodes("door", STEPS)[0], seed=3))
    return {str(step): engine.map(step).log_likelihood for step in (0, 20, 40)}


def trained(name: str) -> Arrays:
    plan = replace(PLANS["smoke"], dynamics=10, models=10, alone=3, together=(3,))
    made = train(architecture("door", name), episodes("door", STEPS), data_hash="0", plan=plan, seed=3)
    return {key: value.numpy() for key, value in made.filter.state_dict().items()}


def tuned(name: str) -> Arrays:
    asked = FineTune(train=("haptics-only",), length=8, windows=4, steps=4, check=2, particles=8, seed=3)
    made = finetune(load_checkpoint(shipped("door", name)), episodes("door", STEPS), data_hash="0", settings=asked)
    assert made is not None
    return {key: value.numpy() for key, value in made.filter.state_dict().items()}


def collected(name: str) -> Arrays:
    with tempfile.TemporaryDirectory() as folder:
        simulate = DOOR.simulate
        assert simulate is not None
        write_dataset(Path(folder) / "door.h5", DOOR, [simulate(3, 0, 20)])
        return {"bytes": np.frombuffer((Path(folder) / "door.h5").read_bytes(), np.uint8)}


MADE: dict[str, Callable[[], Arrays]] = {
    "collected episode": lambda: collected(""),
    "trace, crossmodal-ekf": lambda: traced("crossmodal-ekf"),
    "trace, crossmodal-pf": lambda: traced("crossmodal-pf"),
    "maps, crossmodal-ekf": lambda: mapped("crossmodal-ekf"),
    "maps, crossmodal-pf": lambda: mapped("crossmodal-pf"),
    "training, crossmodal-ekf": lambda: trained("crossmodal-ekf"),
    "training, crossmodal-pf": lambda: trained("crossmodal-pf"),
    "fine-tuning, crossmodal-pf": lambda: tuned("crossmodal-pf"),
}


def made(name: str, threads: int) -> Arrays:
    torch.set_num_threads(threads)
    return MADE[name]()


def elsewhere(name: str, threads: int, folder: Path) -> Arrays:
    """The same, made by another process."""
    path = folder / "made.npz"
    code = f"import determinism, numpy; numpy.savez({str(path)!r}, **determinism.made({name!r}, {threads}))"
    environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parent, env=environment)
    with np.load(path) as found:
        return dict(found)


def difference(one: Arrays, other: Arrays) -> str:
    """``same bits``, or the largest difference relative to the largest value of its array, and where it is."""
    assert one.keys() == other.keys()
    if all(np.asarray(one[key]).tobytes() == np.asarray(other[key]).tobytes() for key in one):
        return "same bits"
    worst, where = 0.0, ""
    for key, values in one.items():
        a, b = np.asarray(values, float), np.asarray(other[key], float)
        scale = float(np.nanmax(np.abs(a), initial=0.0)) or 1.0
        by = float(np.nanmax(np.abs(a - b), initial=0.0)) / scale
        if by >= worst:
            worst, where = by, key
    return f"{worst:.1e} ({where})"


def main() -> None:
    wanted = json.loads(sys.argv[1]) if len(sys.argv) > 1 else list(MADE)
    print("| what | again | another process | two threads | two threads again |\n| --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as place:
        for name in wanted:
            first = made(name, 1)
            again, apart = made(name, 1), elsewhere(name, 1, Path(place))
            two, twice = elsewhere(name, 2, Path(place)), elsewhere(name, 2, Path(place))
            shown = [difference(first, other) for other in (again, apart, two)]
            print(f"| {name} | {' | '.join(shown)} | {difference(two, twice)} |", flush=True)


if __name__ == "__main__":
    main()
