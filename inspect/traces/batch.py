"""Traces of many episodes in one run per length, several times faster than one run per episode."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any

import torch
from torch import Tensor

from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.filters.batch import Steps
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.rollout import first_belief, rollout
from beliefscope.inspect.traces.data import Trace
from beliefscope.inspect.traces.run import assemble_trace, trace

AT_ONCE = 32
"""Episodes in one run; limits memory."""


@torch.no_grad()
def trace_all(
    checkpoint: Checkpoint,
    data: Dataset | Mapping[int, Episode] | Sequence[Episode],
    indices: Iterable[int],
    seed: int = 0,
    particles: int = 300,
    faults: Faults = NO_FAULTS,
) -> Iterator[Trace]:
    """Trace the episodes with these indices, those of equal length together, with an external filter one by one.

    Traces without random numbers differ from those of ``trace`` by rounding only. The random numbers of a particle
    filter differ, as ``trace`` has one generator per episode: same distribution, other values. Raises BadInput as
    ``trace``.
    """
    generator = torch.Generator().manual_seed(seed)
    settings = {"particles": particles, "torch": torch.__version__}
    remaining = iter(indices)
    if isinstance(checkpoint, ExternalFilter):
        for index in remaining:
            yield trace(checkpoint, data[index], index, seed=seed, particles=particles, faults=faults)
    while episodes := {index: data[index] for index in islice(remaining, AT_ONCE)}:
        lengths: dict[int, list[int]] = {}
        for index, episode in episodes.items():
            checkpoint.check_task(episode)
            lengths.setdefault(len(episode), []).append(index)
        for length, members in sorted(lengths.items()):
            inputs = [faults.apply(episodes[index], seed) for index in members]
            steps = Steps.from_episodes(checkpoint.task, inputs)
            batch = steps.windows(steps.first, length)
            evidence, start = checkpoint.filter.encode(batch), first_belief(checkpoint.filter, batch)
            result = rollout(checkpoint.filter, evidence, start, generator, particles, keep=True)
            for i, (index, episode) in enumerate(zip(members, inputs, strict=True)):
                yield assemble_trace(
                    checkpoint,
                    episode,
                    _select(start, i),
                    _select(evidence, i, axis=1),
                    [_select(step, i) for step in result.steps],
                    data_hash=episodes[index].digest(),
                    episode_index=index,
                    seed=seed,
                    faults=faults,
                    settings=settings,
                )


def _select(value: Any, i: int, axis: int = 0) -> Any:
    """Trajectory i of all tensors of a dataclass, with N = 1."""
    if isinstance(value, Tensor):
        return value.narrow(axis, i, 1)
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    parts = {f.name: _select(getattr(value, f.name), i, axis) for f in dataclasses.fields(value)}
    return dataclasses.replace(value, **parts)
