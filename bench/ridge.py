"""Direction of the haptics ridge on newly simulated doors: angle to the panel and to the line to the end effector.

    python bench/ridge.py --episodes 24 --seed 4711

Prints the median over the steps in contact with its 95 % interval over trajectories, for each direction.
"""

from __future__ import annotations

import argparse

import numpy as np

from beliefscope.datasets.simulation.door import DOOR
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.diagnostics.likelihood_maps import maps, median_interval
from beliefscope.inspect.trace import trace


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=24)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--seed", type=int, default=4711)
    parser.add_argument("--filter", default="crossmodal-pf")
    options = parser.parse_args()
    assert DOOR.simulate is not None
    checkpoint = load_checkpoint(pretrained_path("door", options.filter))
    episodes = [DOOR.simulate(options.seed, index, options.steps) for index in range(options.episodes)]
    runs = [trace(checkpoint, episode, index) for index, episode in enumerate(episodes)]
    survey = maps(runs, checkpoint)
    numbers, contact = survey.numbers, survey.phases["contact"]
    haptics = numbers.layers.index("haptics")
    effector = np.concatenate([e.observations["effector_position"][:, :2] - e.states[:, :2] for e in episodes])
    off = numbers.axis[:, haptics] - np.arctan2(effector[:, 1], effector[:, 0])
    off_effector = np.abs((off + np.pi / 2.0) % np.pi - np.pi / 2.0)
    for name, values in (("panel", numbers.deviation[:, haptics]), ("line to the end effector", off_effector)):
        median, low, high = median_interval(np.degrees(values[contact]), survey.trajectory[contact])
        print(f"{name}: {median:.1f} deg [{low:.1f}, {high:.1f}] over {contact.sum()} steps in contact")
    print(survey.verdict)


if __name__ == "__main__":
    main()
