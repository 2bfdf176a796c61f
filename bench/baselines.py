"""Re-evaluate pretrained checkpoints from offset starts, beside their baselines, as a Markdown table.

    python bench/baselines.py door/crossmodal-ekf push/crossmodal-ekf > table.md

An argument is a pretrained filter or the path of a checkpoint, such as one of a study. Without arguments: all
pretrained filters of door and push. The test episodes of the sample sets, 64 a task, were not used in training. The
belief starts 3 cm and 20 deg off; the first 30 steps count only in "from step 0". Brackets: 95 % percentile bootstrap
over trajectories.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import PRETRAINED, load_checkpoint, pretrained_path
from beliefscope.filters.evaluate import Metrics, evaluate
from beliefscope.filters.start_offset import STUDY_OFFSET
from beliefscope.filters.training.plan import EVALUATED_BLACKOUTS
from beliefscope.filters.training.study_table import headline_keys, label

RESAMPLES = 2000


def interval(result: Metrics, key: str) -> str:
    """``0.55 [0.49, 0.62]``"""
    count = len(result.squares)
    counts = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), RESAMPLES)
    samples = counts @ result.squares
    column = 1 + list(result.rmse).index(key)
    low, high = np.percentile(np.sqrt(samples[:, column] / samples[:, 0]), [2.5, 97.5])
    return f"{result.rmse[key]:.2f} [{low:.2f}, {high:.2f}]"


def main(names: list[str]) -> None:
    print("| task | filter | image blackout | quantity | RMSE | from step 0 | dynamics | stay |")
    print("| --- | --- | ---: | --- | ---: | ---: | ---: | ---: |", flush=True)
    for text in names:
        path = Path(text) if text.endswith(".safetensors") else pretrained_path(*text.split("/"))
        checkpoint = load_checkpoint(path)
        task, filter_ = checkpoint.task, checkpoint.filter
        with open_dataset(sample_path(task.name)) as data:
            episodes = [data[index] for index in data.held_out()]
        baselines = {}
        for blackout in EVALUATED_BLACKOUTS:
            faults = Faults.parse(f"blackout={blackout}")
            first = blackout == EVALUATED_BLACKOUTS[0]  # a blackout does not change the baselines
            result = evaluate(
                filter_, episodes, faults=faults, start_offset=STUDY_OFFSET.for_task(task), baselines=first
            )
            baselines = result.baselines or baselines
            for key in headline_keys(result.rmse):
                values = [interval(result, key), f"{result.rmse_from_step_0[key]:.2f}"]
                values += [f"{m.rmse[key]:.2f}" if (m := baselines[b]) else "" for b in ("dynamics", "stay")]
                condition = f"{task.name} | {checkpoint.name} | {blackout:.0%} | {label(key)}"
                print(f"| {condition} | {' | '.join(values)} |", flush=True)


if __name__ == "__main__":
    available = [p.stem.split("-", 1) for p in sorted(PRETRAINED.glob("*.safetensors")) if "push-real" not in p.stem]
    main(sys.argv[1:] or [f"{task}/{name}" for task, name in available])
