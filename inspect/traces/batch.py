"""Traces of many episodes in one run per length, several times faster than one run per episode."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.filters.batch import Steps
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.rollout import rollout, start_at_truth
from beliefscope.inspect.traces.data import Trace
from beliefscope.inspect.traces.run import assemble_trace, trace

AT_ONCE = 32
"""Episodes in one run; limits memory."""


@torch.no_grad()
def trace_all(
    checkpoint: Checkpoint,
    episodes: Sequence[Episode],
    seed: int = 0,
    particles: int = 300,
    faults: Faults = NO_FAULTS,
) -> Iterator[Trace]:
    """Trace all episodes, in any order; ``episode_index`` is the position in ``episodes``.

    The random numbers of a particle filter differ from those of ``trace``, which has one generator per episode, so its
    traces have the same distribution but other bits. Raises BadInput as ``trace``.
    """
    if isinstance(checkpoint, ExternalFilter):
        for index, episode in enumerate(episodes):
            yield trace(checkpoint, episode, index, seed, particles, faults)
        return
    filter_ = checkpoint.filter
    generator = torch.Generator().manual_seed(seed)
    lengths: dict[int, list[int]] = {}
    for index, episode in enumerate(episodes):
        lengths.setdefault(len(episode), []).append(index)
    for length, members in sorted(lengths.items()):
        for first in range(0, len(members), AT_ONCE):
            chosen = members[first : first + AT_ONCE]
            inputs = [faults.apply(episodes[index], seed) for index in chosen]
            steps = Steps.from_episodes(filter_.task, inputs)
            batch = steps.windows(steps.first, length)
            evidence, start = filter_.encode(batch), start_at_truth(filter_, batch)
            result = rollout(filter_, evidence, start, generator, particles, keep=True)
            for i, (index, episode) in enumerate(zip(chosen, inputs, strict=True)):
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
                    settings={"particles": particles, "torch": torch.__version__},
                )


def _select(value: Any, i: int, axis: int = 0) -> Any:
    """Trajectory i of all tensors of a dataclass, with N = 1."""
    if isinstance(value, Tensor):
        return value.narrow(axis, i, 1)
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    parts = {f.name: _select(getattr(value, f.name), i, axis) for f in dataclasses.fields(value)}
    return dataclasses.replace(value, **parts)
