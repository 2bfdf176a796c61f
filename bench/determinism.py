"""Bitwise determinism for the same seed: repeated, in another process, and with two PyTorch threads.

    python bench/determinism.py

Each line compares repetitions of one computation: identical bits, or the largest relative difference.
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
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.filters.finetuning.finetune import finetune
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.training.plan import PLANS
from beliefscope.filters.training.train import train
from beliefscope.inspect.maps.map_engine import MapEngine
from beliefscope.inspect.trace import arrays_of, trace

Arrays = dict[str, Any]
STEPS = 60


def trace_arrays(name: str) -> Arrays:
    return arrays_of(trace(load_checkpoint(pretrained_path("door", name)), episodes("door", STEPS)[0], seed=3))


def map_arrays(name: str) -> Arrays:
    checkpoint = load_checkpoint(pretrained_path("door", name))
    engine = MapEngine(checkpoint, trace(checkpoint, episodes("door", STEPS)[0], seed=3))
    return {str(step): engine.map(step).log_likelihood for step in (0, 20, 40)}


def trained_weights(name: str) -> Arrays:
    plan = replace(PLANS["smoke"], dynamics=10, models=10, single=3, together=(3,))
    result = train(architecture("door", name), episodes("door", STEPS), data_hash="0", plan=plan, seed=3)
    return {key: value.numpy() for key, value in result.filter.state_dict().items()}


def finetuned_weights(name: str) -> Arrays:
    settings = FineTune(train=("haptics-only",), length=8, windows=4, steps=4, check=2, particles=8, seed=3)
    base = load_checkpoint(pretrained_path("door", name))
    result = finetune(base, episodes("door", STEPS), data_hash="0", settings=settings)
    assert result is not None
    return {key: value.numpy() for key, value in result.filter.state_dict().items()}


def collected_bytes() -> Arrays:
    with tempfile.TemporaryDirectory() as folder:
        simulate = DOOR.simulate
        assert simulate is not None
        write_dataset(Path(folder) / "door.h5", DOOR, [simulate(3, 0, 20)])
        return {"bytes": np.frombuffer((Path(folder) / "door.h5").read_bytes(), np.uint8)}


COMPUTATIONS: dict[str, Callable[[], Arrays]] = {
    "collected episode": collected_bytes,
    "trace, crossmodal-ekf": lambda: trace_arrays("crossmodal-ekf"),
    "trace, crossmodal-pf": lambda: trace_arrays("crossmodal-pf"),
    "maps, crossmodal-ekf": lambda: map_arrays("crossmodal-ekf"),
    "maps, crossmodal-pf": lambda: map_arrays("crossmodal-pf"),
    "training, crossmodal-ekf": lambda: trained_weights("crossmodal-ekf"),
    "training, crossmodal-pf": lambda: trained_weights("crossmodal-pf"),
    "fine-tuning, crossmodal-pf": lambda: finetuned_weights("crossmodal-pf"),
}


def compute(name: str, threads: int) -> Arrays:
    torch.set_num_threads(threads)
    return COMPUTATIONS[name]()


def compute_in_subprocess(name: str, threads: int, folder: Path) -> Arrays:
    """The same computation in another process."""
    path = folder / "result.npz"
    code = f"import determinism, numpy; numpy.savez({str(path)!r}, **determinism.compute({name!r}, {threads}))"
    environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parent, env=environment)
    with np.load(path) as arrays:
        return dict(arrays)


def difference(first: Arrays, second: Arrays) -> str:
    """``same bits``, or the largest difference relative to the largest value of its array, with the array's name."""
    assert first.keys() == second.keys()
    if all(np.asarray(first[key]).tobytes() == np.asarray(second[key]).tobytes() for key in first):
        return "same bits"
    worst, name = 0.0, ""
    for key, values in first.items():
        a, b = np.asarray(values, float), np.asarray(second[key], float)
        scale = float(np.nanmax(np.abs(a), initial=0.0)) or 1.0
        relative = float(np.nanmax(np.abs(a - b), initial=0.0)) / scale
        if relative >= worst:
            worst, name = relative, key
    return f"{worst:.1e} ({name})"


def main() -> None:
    names = json.loads(sys.argv[1]) if len(sys.argv) > 1 else list(COMPUTATIONS)
    print(
        "| result | repeated | another process | two threads | two threads repeated |\n| --- | --- | --- | --- | --- |"
    )
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            first, repeated = compute(name, 1), compute(name, 1)
            external = compute_in_subprocess(name, 1, Path(folder))
            two, two_repeated = (compute_in_subprocess(name, 2, Path(folder)) for _ in range(2))
            columns = [difference(first, other) for other in (repeated, external, two)]
            print(f"| {name} | {' | '.join(columns)} | {difference(two, two_repeated)} |", flush=True)


if __name__ == "__main__":
    main()
