"""Store the matrices of checkpoints as bfloat16, in place, so that the checkpoints of all filters fit into the wheel.

    python bench/store_bfloat16.py filters/pretrained/push-field-image-ekf.safetensors

Tensors with at least 1024 values and two axes are rounded to 8 significant bits; filters compute in 32 bits as before.
Prints the errors and NEES/n before and after, of 10 held-out episodes. Then run
``bench/healthy_profiles.py`` and ``bench/pretrained.py``: profiles and README contain the hash of the file.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint
from beliefscope.filters.evaluate import Metrics, evaluate

VALUES = 1024
"""Smaller tensors, such as biases and the statistics of the training set, keep 32 bits."""
EPISODES = 10


def halve(path: Path) -> None:
    """Raises safetensors.SafetensorError for a file of another format."""
    with safe_open(path, framework="pt") as file:
        metadata, tensors = file.metadata(), {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    stored = {
        key: value.bfloat16() if value.ndim > 1 and value.numel() >= VALUES else value for key, value in tensors.items()
    }
    write_atomically(path, save(stored, metadata=metadata))


def errors(path: Path, episodes: list[Episode]) -> Metrics:
    return evaluate(load_checkpoint(path).filter, episodes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", type=Path, metavar="FILE")
    parser.add_argument("--data", type=Path, help="episodes; default: the sample set of the filter's task")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for path in options.paths:
        with open_dataset(options.data or sample_path(load_checkpoint(path).task.name)) as data:
            episodes = [data[index] for index in data.held_out()[:EPISODES]]
        before = errors(path, episodes)
        halve(path)
        after = errors(path, episodes)
        changes = ", ".join(f"{key} {value:.4f} -> {after.rmse[key]:.4f}" for key, value in before.rmse.items())
        print(f"{path.stem}: {changes}; NEES/n {before.nees:.3f} -> {after.nees:.3f}", flush=True)


if __name__ == "__main__":
    main()
