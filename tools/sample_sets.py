"""Build the sample sets: 140 episodes of seed 0, followed by 50 test episodes of seed 2; field tasks: 40 of seed 2.

    python tools/sample_sets.py [FOLDER]
    python tools/sample_sets.py --index    # only write the indexes of the current files

Episodes 0 to 139 are copied from the current file, because another processor may round differently.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from beliefscope.datasets.episode_index import write_index
from beliefscope.datasets.simulation.collect import collect
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset

KEPT, ADDED, STEPS, SEED = 140, 50, 100, 2
FIELD, FIELD_EPISODES, FIELD_STEPS = ("door-field", "push-field"), 40, 200
"""Field tasks: test episodes only, at most 5 MB."""


def main() -> None:
    only_index = sys.argv[1:] == ["--index"]
    target = Path(sys.argv[1]) if len(sys.argv) > 1 and not only_index else sample_path("door").parent
    if not only_index:
        build(target)
    for task in ("door", "push", *FIELD):
        with open_dataset(target / f"{task}.h5") as data:
            write_index(data.path, data.summaries, data.hash, by_content=True)
            print(task, len(data), data.hash, data.path.stat().st_size)


def build(target: Path) -> None:
    """Write the files."""
    with tempfile.TemporaryDirectory() as folder:
        for task in ("door", "push"):
            path = Path(folder) / f"{task}.h5"
            collect(task, ADDED, STEPS, SEED, None, path, split="test")
            with open_dataset(sample_path(task)) as current, open_dataset(path) as added:
                episodes = [current[i] for i in range(KEPT)] + list(added)
                write_dataset(target / f"{task}.h5", current.task, episodes)
    for task in FIELD:
        collect(task, FIELD_EPISODES, FIELD_STEPS, SEED, None, target / f"{task}.h5", split="test")


if __name__ == "__main__":
    main()
