"""Effect of each fine-tuning preset on the pretrained filters, as a Markdown table.

    python bench/finetune_presets.py                             # the default of every filter of door and push
    python bench/finetune_presets.py --all door/crossmodal-ekf   # all presets of a filter

Every run has the filter's default settings (``filters/finetuning/defaults.py``) except for the trained modules. Ratios
are errors after / before: root mean square over all components, standardised, without the first 30 steps. Validation:
on the val episodes, which select the weights. Test: on the 64 test episodes of the sample set, which select nothing;
brackets are 95 % percentile bootstrap intervals over trajectories. Finished runs are kept in ``build``.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.store import has_sample, open_dataset, sample_path
from beliefscope.filters.checkpoint import PRETRAINED, load_checkpoint, pretrained_path
from beliefscope.filters.evaluate import Metrics, evaluate
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.defaults import default_settings
from beliefscope.filters.finetuning.finetune import finetune
from beliefscope.filters.finetuning.module_selection import presets

FOLDER = Path(__file__).resolve().parent.parent / "build" / "finetune_presets"
RESAMPLES, PARTICLES = 2000, 100

Result = dict[str, Any]


def squares(filter_: Filter, result: Metrics) -> np.ndarray:
    """(R,) sums of squared standardised errors of each episode."""
    _, std = filter_.statistics.mean_std("state")
    factors = np.array([c.conversion[1] for c in filter_.task.components])
    components = result.squares[:, 1 : 1 + len(factors)]
    return np.asarray((components / np.square(factors * std.numpy())).sum(1))


def ratio(before: np.ndarray, after: np.ndarray) -> list[float]:
    """Root mean square error after / before, and its 95 % interval over trajectories."""
    counts = np.random.default_rng(0).multinomial(len(before), np.full(len(before), 1 / len(before)), RESAMPLES)
    samples = np.sqrt((counts @ after) / (counts @ before))
    return [float(np.sqrt(after.sum() / before.sum())), *map(float, np.percentile(samples, [2.5, 97.5]))]


def run(task: str, name: str, preset: str) -> Result:
    """Fine-tunes one filter with one preset, unless it was done before."""
    base = load_checkpoint(pretrained_path(task, name))
    settings = replace(default_settings(base.filter), train=(preset,))
    path = FOLDER / f"{task}-{name}-{preset}.json"
    key = {"base": base.hash, "settings": settings.to_json()}
    if path.is_file() and (saved := json.loads(path.read_text()))["key"] == key:
        return dict(saved["result"])
    with open_dataset(sample_path(task)) as data:
        episodes, data_hash = list(data), data.hash
    began = time.process_time()
    tuned = finetune(base, episodes, data_hash=data_hash, settings=settings)
    seconds = time.process_time() - began
    assert tuned is not None
    ((slice_, _),) = settings.mix
    first, best = (
        next(v for v in tuned.record["validations"] if v["step"] == step) for step in (0, tuned.record["best_step"])
    )
    result: Result = {
        "task": task,
        "filter": name,
        "preset": preset,
        "slice": slice_.name,
        "seconds": seconds,
        "validation": {s: best["slices"][s]["error"] / first["slices"][s]["error"] for s in (slice_.name, "clean")},
        "test": {},
        "nees": [],
    }
    test = [e for e in episodes if e.split == "test"]
    for title, faults in ((slice_.name, slice_.faults), ("clean", NO_FAULTS)):
        before, after = (_measure(filter_, test, faults) for filter_ in (base.filter, tuned.filter))
        result["test"][title] = ratio(squares(base.filter, before), squares(base.filter, after))
        result["nees"] = [before.nees, after.nees]  # of clean data, which come last
    FOLDER.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps({"key": key, "result": result}, indent=1).encode())
    return result


def _has_training_episodes(task: str) -> bool:
    """Whether the sample set has; those of field tasks have test episodes only, and real pushes have none."""
    if not has_sample(task):
        return False
    with open_dataset(sample_path(task)) as data:
        return any(summary.split == "train" for summary in data.summaries)


def _measure(filter_: Filter, episodes: Sequence[Episode], faults: Faults) -> Metrics:
    return evaluate(filter_, episodes, faults=faults, particles=PARTICLES)


def row(result: Result) -> str:
    name = result["slice"]
    cells = [f"{result['task']} {result['filter']}", f"`{result['preset']}`", name]
    cells += [f"{result['validation'][title]:.2f}" for title in (name, "clean")]
    cells += ["{:.2f} [{:.2f}, {:.2f}]".format(*result["test"][title]) for title in (name, "clean")]
    before, after = result["nees"]
    cells += ["-" if before is None or np.isnan(before) else f"{before:.2f} -> {after:.2f}", f"{result['seconds']:.0f}"]
    return f"| {' | '.join(cells)} |"


def main(arguments: list[str]) -> None:
    every = "--all" in arguments
    checkpoints = map(load_checkpoint, sorted(PRETRAINED.glob("*.safetensors")))
    names = [f"{c.task.name}/{c.name}" for c in checkpoints if _has_training_episodes(c.task.name)]
    print("| filter | preset | fault | validation | clean, validation | test | clean, test | NEES/n, clean | CPU, s |")
    print("| --- | --- | --- | ---: | ---: | --- | --- | ---: | ---: |", flush=True)
    for text in [argument for argument in arguments if argument != "--all"] or names:
        task, name = text.split("/")
        filter_ = load_checkpoint(pretrained_path(task, name)).filter
        for preset in presets(filter_) if every else default_settings(filter_).train:
            print(row(run(task, name, preset)), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
