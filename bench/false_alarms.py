"""Alarms of the fast diagnostics on healthy and on faulty copies of the pretrained filters.

python bench/false_alarms.py DIR [TASK-FILTER ...]

Clean episodes of a new seed are simulated into DIR once (50 per task, seed 202), as long as those of the profiles.

false alarms: share of 200 samples of five episodes, drawn without replacement, for which any of the diagnostics
weights, consistency and particles raises an alarm.
overconfident, constant weights: the same for faulty copies of the filter, 50 samples of the first 10 episodes.
``overconfident`` divides the standard deviations of R by 3 (Kalman filters) or multiplies log-likelihoods by 9
(particle filters); ``constant weights`` replaces the output of the weight model by equal weights.

Real pushes have no new episodes: the five are removed from the profile instead.
"""

from __future__ import annotations

import copy
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from healthy_profiles import SIZES

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.simulation.collect import collect
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Evidence
from beliefscope.filters.checkpoint import PRETRAINED, Checkpoint, load_checkpoint
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics.healthy_comparison import compare
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile, find_profile
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all

EPISODES, SEED = 50, 202
SAMPLES, PLANTED_EPISODES, PLANTED_SAMPLES, SIZE = 200, 10, 50, 5
FAULTS = ("overconfident", "constant weights")

Rows = dict[str, list[dict[str, float]]]
"""Diagnostic -> statistics by trajectory."""


def episodes_of(task: str, folder: Path) -> list[Episode]:
    path = folder / f"{task}.h5"
    if not path.exists():
        collect(task, EPISODES, SIZES[task][1], SEED, None, path)
    with open_dataset(path) as data:
        return list(data)


def rows_of(traces: Sequence[Trace]) -> Rows:
    return {
        name: [entry.statistics(trace) for trace in traces]
        for name, entry in DIAGNOSTICS.items()
        if entry.statistics is not None and entry.refusal(traces[0], None) is None
    }


def planted(checkpoint: Checkpoint, fault: str) -> Checkpoint | None:
    """A faulty copy; None if the filter has no weights."""
    filter_ = copy.deepcopy(checkpoint.filter)
    encode = filter_.encode
    if fault == "constant weights":
        if filter_.architecture.fusion != "crossmodal":
            return None

        def equal(batch: Batch) -> Evidence:
            evidence = encode(batch)
            return replace(evidence, log_weights=torch.full_like(evidence.log_weights, -math.log(len(filter_.names))))

        filter_.encode = equal
    elif checkpoint.kind == "pf":
        likelihood = filter_.log_likelihood
        filter_.log_likelihood = lambda evidence, states: 9.0 * likelihood(evidence, states)
    else:

        def confident(batch: Batch) -> Evidence:
            evidence = encode(batch)
            return replace(evidence, noise=evidence.noise / 3.0)

        filter_.encode = confident
    return checkpoint.with_filter(filter_)


def statistics(path: Path, folder: Path) -> dict[str, Rows]:
    """Statistics of the healthy filter and of its faulty copies, from a file in the folder if they are known."""
    stored = folder / f"{path.stem}.json"
    if stored.exists():
        return json.loads(stored.read_text())
    checkpoint = load_checkpoint(path)
    episodes = [] if checkpoint.task.name == "push-real" else episodes_of(checkpoint.task.name, folder)
    result = {"healthy": rows_of(list(trace_all(checkpoint, episodes, range(len(episodes)))))} if episodes else {}
    for fault in FAULTS if episodes else ():
        if (faulty := planted(checkpoint, fault)) is not None:
            result[fault] = rows_of(list(trace_all(faulty, episodes, range(min(PLANTED_EPISODES, len(episodes))))))
    stored.write_text(json.dumps(result))
    return result


def without(profile: HealthyProfile, rows: np.ndarray) -> HealthyProfile:
    kept = np.setdiff1d(np.arange(profile.episodes), rows)
    values = {name: column[kept] for name, column in profile.statistics.items()}
    return replace(profile, episodes=len(kept), statistics=values)


def alarm_rate(profile: HealthyProfile, rows: Rows, samples: int) -> tuple[float, dict[str, int]]:
    """Share of samples with an alarm, and the number of alarms by diagnostic."""
    rng = np.random.default_rng(0)
    count, alarms, by_diagnostic = len(next(iter(rows.values()))), 0, dict.fromkeys(rows, 0)
    for _ in range(samples):
        drawn = rng.choice(count, SIZE, replace=False)
        raised = [name for name in rows if compare(profile, [rows[name][i] for i in drawn]).alarms]
        alarms += bool(raised)
        for name in raised:
            by_diagnostic[name] += 1
    return alarms / samples, by_diagnostic


def rate_without_new_episodes(profile: HealthyProfile) -> float:
    """``alarm_rate`` of samples from the profile itself, compared with the remaining profile."""
    rng, alarms = np.random.default_rng(0), 0
    kinds = {"weights": ("weight", "beta", "regret"), "consistency": ("nees", "nis", "autocorrelation")}
    kinds["particles"] = ("ess", "outside")
    for _ in range(SAMPLES):
        drawn = rng.choice(profile.episodes, SIZE, replace=False)
        rest, raised = without(profile, drawn), False
        for group in kinds.values():
            names = [name for name in profile.statistics if name.split("/")[0] in group]
            rows = [{name: float(profile.statistics[name][i]) for name in names} for i in drawn]
            raised |= bool(names and compare(rest, rows).alarms)
        alarms += raised
    return alarms / SAMPLES


def main() -> None:
    folder, names = Path(sys.argv[1]), sys.argv[2:]
    print("| filter | false alarms | overconfident | constant weights |\n| --- | --- | --- | --- |")
    for path in sorted(PRETRAINED.glob("*.safetensors")):
        if names and path.stem not in names:
            continue
        checkpoint = load_checkpoint(path)
        profile = find_profile(checkpoint.task.name, checkpoint.name, checkpoint.hash, None)
        assert profile is not None
        rows = statistics(path, folder)
        if not rows:
            print(f"| {path.stem} | {100 * rate_without_new_episodes(profile):.1f} % | | |", flush=True)
            continue
        rate, by_diagnostic = alarm_rate(profile, rows["healthy"], SAMPLES)
        rates = [f"{100 * alarm_rate(profile, rows[f], PLANTED_SAMPLES)[0]:.0f} %" if f in rows else "" for f in FAULTS]
        print(f"| {path.stem} | {100 * rate:.1f} % | {rates[0]} | {rates[1]} |", flush=True)
        print(f"{path.stem}: {by_diagnostic}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
