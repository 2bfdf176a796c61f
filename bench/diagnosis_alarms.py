"""False alarms of ``beliefscope diagnose``: shares of healthy samples of six new clean episodes with an alarm.

    python bench/diagnosis_alarms.py door/crossmodal-ekf push/crossmodal-pf --episodes 120 --seed 9006
    python bench/diagnosis_alarms.py push/crossmodal-pf --episodes 420 --orders 1 --seed 9107

The episodes are simulated with a seed that no healthy record has. Each random order of them gives disjoint samples, so
120 episodes have 20 independent ones; further orders only average over the divisions. Alarms without any intervention:
undoing a cause never makes a case healthy.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from healthy_profiles import SIZES

from beliefscope.datasets.catalog import load_task
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.diagnosis.case import compared, observe
from beliefscope.inspect.diagnosis.diagnose import required_profile
from beliefscope.inspect.diagnosis.undo.run_inputs import RunInputs
from beliefscope.inspect.traces.batch import trace_all

RATES = (0.05, 0.02, 0.01)
SIZE = 6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("filters", nargs="+", metavar="TASK/FILTER")
    parser.add_argument("--episodes", type=int, default=120)
    parser.add_argument("--orders", type=int, default=10)
    parser.add_argument("--seed", type=int, default=9006)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(f"| filter | {' | '.join(f'--alarm-rate {rate:g}' for rate in RATES)} |\n| --- |{' ---: |' * len(RATES)}")
    for name in options.filters:
        shares = false_alarms(*name.split("/"), options.episodes, options.orders, options.seed)
        print(f"| {name} | {' | '.join(f'{100 * share:.1f} %' for share in shares)} |", flush=True)


def false_alarms(task: str, name: str, count: int, orders: int, seed: int) -> list[float]:
    """Share of samples with an alarm, by alarm rate."""
    checkpoint = load_checkpoint(pretrained_path(task, name))
    profile, simulate = required_profile(checkpoint), load_task(task).simulate
    assert simulate is not None
    episodes = {index: simulate(seed, index, SIZES[task][1]) for index in range(count)}
    traces = list(trace_all(checkpoint, episodes, episodes))
    observed = [observe(trace, checkpoint, profile) for trace in traces]
    rng, alarms = np.random.default_rng(0), []
    for _ in range(orders):
        for sample in rng.permutation(count)[: count // SIZE * SIZE].reshape(-1, SIZE):
            rows, sensors = zip(*(observed[i] for i in sample), strict=True)
            chosen = [traces[i] for i in sample]
            inputs = RunInputs(checkpoint, {t.episode_index: t.episode for t in chosen}, 300, frozenset())
            cases = [compared(inputs, chosen, rows, sensors, profile, rate) for rate in RATES]
            alarms.append([bool(case.alarms) for case in cases])
    return np.mean(alarms, axis=0).tolist()


if __name__ == "__main__":
    main()
