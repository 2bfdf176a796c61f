"""How often the diagnostic *Conventions of the inputs* finds a change in clean episodes, and planted ones in others.

    python bench/convention_alarms.py push-field/information-ekf door/crossmodal-pf --planted push-field/information-ekf

Samples of twelve new episodes, simulated with a seed that no healthy record has.
"""

from __future__ import annotations

import argparse

import torch
from healthy_profiles import SIZES

from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.faults.injection import Faults
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.diagnostics.conventions import Conventions, conventions
from beliefscope.inspect.traces.batch import trace_all

EPISODES, PARTICLES = 12, 100
UNDONE = {
    "sensor_gain=force:factor=-1": "the opposite sign of force",
    "sensor_swapped=force:first=0:second=1": "channels 0 and 1 of force exchanged",
    "sensor_gain=force:factor=10": "force times 0.1",
    "sensor_swapped=effector_position:first=0:second=1": "channels 0 and 1 of effector position exchanged",
}
"""Planted fault -> the change that undoes it."""


def diagnosed(name: str, sample: int, seed: int, faults: str = "") -> Conventions:
    task, filter_ = name.split("/")
    checkpoint, simulate = load_checkpoint(pretrained_path(task, filter_)), load_task(task).simulate
    assert simulate is not None
    injected = Faults.parse(faults)
    episodes = {
        index: injected.apply(simulate(seed, index, SIZES[task][1]))
        for index in range(sample * EPISODES, (sample + 1) * EPISODES)
    }
    return conventions(list(trace_all(checkpoint, episodes, episodes, 0, PARTICLES)), checkpoint)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("filters", nargs="+", metavar="TASK/FILTER")
    parser.add_argument("--planted", action="append", default=[], metavar="TASK/FILTER")
    parser.add_argument("--samples", type=int, default=4)
    parser.add_argument("--seed", type=int, default=9206)
    options = parser.parse_args()
    torch.set_num_threads(1)
    total = 0
    for name in options.filters:
        alarms = [diagnosed(name, sample, options.seed).alarms for sample in range(options.samples)]
        total += sum(map(bool, alarms))
        print(f"{name}, clean: {sum(map(bool, alarms))} of {options.samples} {[a[0] for a in alarms if a]}", flush=True)
    print(f"clean: {total} of {len(options.filters) * options.samples} samples with an alarm", flush=True)
    for name in options.planted:
        for faults, change in UNDONE.items():
            results = [diagnosed(name, sample, options.seed, faults) for sample in range(options.samples)]
            first = sum(bool(r.alarms) and r.alarms[0].startswith(change) for r in results)
            print(f"{name}, {faults}: named first in {first} of {options.samples}", flush=True)


if __name__ == "__main__":
    main()
