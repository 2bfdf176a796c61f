"""How fusion rules degrade under sensor faults absent from the training data, as a Markdown table.

    python bench/fault_table.py push crossmodal-ekf unimodal-ekf feature-ekf image-ekf haptics-ekf
    python bench/fault_table.py push-field DIR/a.safetensors DIR/b.safetensors --data DIR/outages.h5 --seeds 3

The first filter is compared with the others. Cells: position RMSE under the fault over that on clean data, both over
whole episodes, with a 95 % interval over trajectories (inspect/statistics/intervals.py). The last rows test whether
the first filter degrades less: ratio of its increase to that of the other filter, geometric mean over all faults, and
the number of faults under which it degrades less, more, or neither (interval around 1); and whether its error is
smaller, over all faults. With --seeds N, squared errors are averaged over the checkpoints DIR/a.safetensors,
DIR/a-seed1.safetensors and so on, as ``bench/field_study.py`` names them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.filter import Filter
from beliefscope.filters.open_filter import open_filter
from beliefscope.inspect.statistics.intervals import jackknife

Array = NDArray[np.float64]

KEY = "position_cm"

FAULTS = (
    "blackout=0.5",
    "image_outage=0.5:seconds=2",
    "image_frozen:from=20:to=60",
    "image_underexposed=0.4",
    "image_noise=40",
    "image_blur=1.5",
    "image_occluded=12",
    "delay=image:steps=3",
    "drop=haptics:from=20:to=60",
    "delay=haptics:steps=3",
    "force_bias={force}:y={force}",
    "force_drift={drift}:y={drift}",
    "force_noise={force}",
    "force_saturation={force}",
    "force_stuck=x",
    "torque_bias={torque}:y={torque}",
    "torque_noise={torque}",
    "effector_offset=0.02",
    "effector_noise=0.01",
    "contact_inverted=0.3",
    "contact_delayed=5",
)
"""``{force}``, ``{torque}``: standard deviation of the sensor in the data; ``{drift}``: the same after 10 s."""


def faults_for(episodes: Sequence[Episode]) -> list[str]:
    """The faults, with magnitudes of the order of the readings."""
    force, torque = (np.concatenate([e.observations[key] for e in episodes]).std() for key in ("force", "torque"))
    sizes = {"force": f"{force:.2g}", "torque": f"{torque:.2g}", "drift": f"{force / 10.0:.2g}"}
    return [text.format(**sizes) for text in FAULTS]


def of_seed(name: str, seed: int) -> str:
    """The checkpoint of another training seed."""
    path = Path(name)
    return str(path.with_stem(f"{path.stem}-seed{seed}")) if seed else name


def squared_errors(filters: Sequence[Filter], episodes: Sequence[Episode], text: str) -> Array:
    """(R,) sum of squared position errors of each trajectory, mean over the training seeds of a filter."""
    faults = Faults.parse(text) if text else NO_FAULTS
    results = [evaluate(filter_, episodes, faults=faults) for filter_ in filters]
    return np.mean([result.squares[:, 1 + list(result.rmse).index(KEY)] for result in results], axis=0)


def cells(logs: tuple[Array, Array, Array]) -> list[str]:
    """Factors with intervals, from logarithms (F,) each."""
    return ["{:.2f} [{:.2f}, {:.2f}]".format(*np.exp(values)) for values in np.stack(logs, axis=-1)]


def main(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task")
    parser.add_argument("filters", nargs="+", help="names or checkpoints; the first is compared with the others")
    parser.add_argument("--data", help="test episodes; default: the test episodes of the sample set")
    parser.add_argument("--seeds", type=int, default=1, help="number of training seeds (1)")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    filters = [
        [open_filter(options.task, of_seed(name, seed)).filter for seed in range(options.seeds)]
        for name in options.filters
    ]
    with open_dataset(options.data or sample_path(options.task)) as data:
        episodes = [data[s.index] for s in data.summaries if s.split == "test"]
    texts = faults_for(episodes)
    clean = np.stack([squared_errors(f, episodes, "") for f in filters], axis=1)  # (R, F)
    faulty = []
    for text in texts:
        faulty.append(np.stack([squared_errors(f, episodes, text) for f in filters], axis=1))
        print(f"\r{len(faulty)} of {len(texts)} faults", end="", file=sys.stderr)
    print(file=sys.stderr)
    print_table([Path(name).stem for name in options.filters], texts, clean, np.stack(faulty, axis=1))


def print_table(names: Sequence[str], texts: Sequence[str], clean: Array, faulty: Array) -> None:
    """Args: clean (R, F), faulty (R, S, F): sums of squares of R trajectories, S faults, F filters."""
    sums = np.concatenate([clean[:, None], faulty], axis=1)  # (R, 1 + S, F)

    def increase(s: Array) -> Array:
        """log of the increase of the error, (..., S, F)."""
        return 0.5 * (np.log(s[..., 1:, :]) - np.log(s[..., :1, :]))

    def excess(s: Array) -> Array:
        """log of the first filter's increase over that of each other filter, (..., S, F - 1)."""
        logs = increase(s)
        return logs[..., :1] - logs[..., 1:]

    ratios, relative = jackknife(sums, increase), jackknife(sums, excess)
    mean = jackknife(sums, lambda s: excess(s).mean(-2))
    print(f"| fault | {' | '.join(names)} |\n| --- |{' ---: |' * len(names)}")
    for row, text in enumerate(texts):
        value, low, high = ratios
        print(f"| `{text}` | {' | '.join(cells((value[row], low[row], high[row])))} |")
    if len(names) == 1:
        return
    print(f"| increase of {names[0]} / of this filter, all faults | | {' | '.join(cells(mean))} |")
    less, more = (relative[2] < 0.0).sum(0), (relative[1] > 0.0).sum(0)
    counts = [f"{a}, {b}, {len(texts) - a - b}" for a, b in zip(less, more, strict=True)]
    print(f"| faults under which {names[0]} degrades less, more, neither | | {' | '.join(counts)} |")
    error = jackknife(sums, lambda s: 0.5 * (np.log(s[..., 1:, :1]) - np.log(s[..., 1:, 1:])).mean(-2))
    print(f"| error of {names[0]} / of this filter, all faults | | {' | '.join(cells(error))} |")


if __name__ == "__main__":
    main(sys.argv[1:])
