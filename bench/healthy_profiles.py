"""Write the healthy profiles of the shipped checkpoints beside them, from the test episodes of their training data.

python bench/healthy_profiles.py DIR [TASK-FILTER ...]

DIR: has the data of filters/pretrained/README.md, ``door.h5``, ``push.h5`` and ``push-real.h5``, and the test sets of
docs/field_tasks.md with outages, ``door-field.h5`` and ``push-field.h5``; of missing data of door and push the test
episodes are simulated. Real pushes have none, so their validation episodes are used.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from shipped import COLLECTED

from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.simulation.simulate import split_of
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.checkpoint import PRETRAINED, load_checkpoint
from beliefscope.inspect.diagnostics.healthy_profile import SUFFIX, HealthyProfile
from beliefscope.inspect.healthy import profile_of

FIELD = "beliefscope collect {0} --episodes 60 --steps 200 --seed 1 --split test -o {0}.h5"
RECORDED = {"push-real": "beliefscope convert push-real --data mit_push -o push-real.h5"}
COUNTS = {"door": 600, "push": 500}
STEPS, SEED = 100, 1


def held_out(task: str, folder: Path) -> list[Episode]:
    path = folder / f"{task}.h5"
    if path.exists() or task not in COUNTS:
        with open_dataset(path) as data:
            splits = {s.split for s in data.summaries}
            return [data[s.index] for s in data.summaries if s.split == ("test" if "test" in splits else "val")]
    indices = [i for i in range(COUNTS[task]) if split_of(i) == "test"]
    simulate = load_task(task).simulate
    return [simulate(SEED, i, STEPS) for i in indices]


def write(path: Path, checkpoint_hash: str, profile: HealthyProfile) -> None:
    """One line per statistic."""
    text = json.dumps({"checkpoint": checkpoint_hash, "healthy_profile": profile.to_json()})
    text = text.replace('], "', '],\n"').replace('"statistics": {', '"statistics": {\n')
    write_atomically(path, (text + "\n").encode())


def main() -> None:
    folder, names = Path(sys.argv[1]), sys.argv[2:]
    episodes: dict[str, list[Episode]] = {}
    for path in sorted(PRETRAINED.glob("*.safetensors")):
        if names and path.stem not in names:
            continue
        checkpoint = load_checkpoint(path)
        task = checkpoint.task.name
        if task not in episodes:
            episodes[task] = held_out(task, folder)
        collected = FIELD.format(task) if checkpoint.task.start_distance else (COLLECTED | RECORDED)[task]
        profile = profile_of(checkpoint, episodes[task], collected)
        write(path.with_name(path.stem + SUFFIX), checkpoint.hash, profile)
        print(f"{path.stem}: {profile.episodes} episodes, {len(profile.statistics)} statistics", flush=True)


if __name__ == "__main__":
    main()
