"""Write the healthy profiles of the pretrained checkpoints beside them.

python bench/healthy_profiles.py [TASK-FILTER ...] [--push-real push-real.h5]

The episodes are simulated with a seed that neither training nor tests use. Those of push-real are the validation
episodes of the data of filters/pretrained/README.md, since real pushes have no others.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.checkpoint import PRETRAINED, load_checkpoint
from beliefscope.inspect.diagnostics.healthy_profile import SENSORS_SUFFIX, SUFFIX, HealthyProfile
from beliefscope.inspect.healthy import SensorRecord, profile_of, sensor_record

REAL = "beliefscope convert push-real --data mit_push -o push-real.h5"
SEED = 7
SIZES = {"door": (200, 100), "push": (200, 100), "door-field": (120, 200), "push-field": (120, 200)}
"""Task -> numbers of episodes and of steps."""


def held_out(task: str, real: Path | None) -> tuple[list[Episode], str]:
    """Clean episodes of a task and the command that makes them."""
    if task in SIZES:
        simulate, (count, steps) = load_task(task).simulate, SIZES[task]
        command = f"beliefscope collect {task} --episodes {count} --steps {steps} --seed {SEED} --split test"
        return [simulate(SEED, i, steps) for i in range(count)], command
    if real is None:
        raise BadInput(f"task {task}: --push-real is needed")
    with open_dataset(real) as data:
        return [data[s.index] for s in data.summaries if s.split == "val"], REAL


def write_sensors(task: str, sensors: SensorRecord, profile: HealthyProfile) -> None:
    """What is the same for all filters of a task: one line per statistic."""
    document = profile.to_json()
    names = dict.fromkeys(name for row in sensors.rows for name in row)
    common = {name: values for name, values in document["statistics"].items() if name in names}
    write(PRETRAINED / (task + SENSORS_SUFFIX), {"statistics": common, "reference": document["reference"]})


def write_profile(path: Path, checkpoint_hash: str, sensors: SensorRecord, profile: HealthyProfile) -> None:
    """The profile without what is the same for all filters of the task."""
    document = profile.to_json()
    names = {name for row in sensors.rows for name in row}
    own = {name: values for name, values in document["statistics"].items() if name not in names}
    head = {key: value for key, value in document.items() if key not in ("statistics", "reference")}
    write(path, {"checkpoint": checkpoint_hash, "healthy_profile": head | {"statistics": own}})


def write(path: Path, document: dict[str, Any]) -> None:
    """One line per statistic."""
    text = json.dumps(document).replace('], "', '],\n"').replace('"statistics": {', '"statistics": {\n')
    write_atomically(path, (text + "\n").encode())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="TASK-FILTER")
    parser.add_argument("--push-real", type=Path)
    options = parser.parse_args()
    episodes: dict[str, tuple[list[Episode], str, SensorRecord]] = {}
    for path in sorted(PRETRAINED.glob("*.safetensors")):
        if options.names and path.stem not in options.names:
            continue
        checkpoint = load_checkpoint(path)
        task = checkpoint.task.name
        if task not in episodes:
            clean, source = held_out(task, options.push_real)
            episodes[task] = clean, source, sensor_record(clean)
        profile = profile_of(checkpoint, *episodes[task])
        sensors = episodes[task][2]
        write_sensors(task, sensors, profile)
        write_profile(path.with_name(path.stem + SUFFIX), checkpoint.hash, sensors, profile)
        print(f"{path.stem}: {profile.episodes} episodes, {len(profile.statistics)} statistics", flush=True)


if __name__ == "__main__":
    main()
