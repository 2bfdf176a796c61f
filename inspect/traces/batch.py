"""Traces of many episodes in one run per length, several times faster than one run per episode."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.filters.batch import Steps
from beliefscope.filters.belief import Gaussian, Recurrent, StepTrace
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.engine import Progress
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.models.common_random_numbers import Common
from beliefscope.filters.rollout import first_belief, rollout
from beliefscope.inspect.traces.data import Trace
from beliefscope.inspect.traces.external import are_independent, run_together
from beliefscope.inspect.traces.restarts import trace_with_restarts
from beliefscope.inspect.traces.run import assemble_trace, step_arrays, trace

EPISODES, STEPS = 32, 10_000
"""Maximum number of episodes in one run, and of their steps; limits memory."""

FEWEST = 5
"""Fewest episodes that an external filter runs over in batches: it first runs over one alone and two together."""

Episodes = Dataset | Mapping[int, Episode] | Sequence[Episode]
"""Episodes by their indices."""


@torch.no_grad()
def trace_all(
    checkpoint: Checkpoint,
    data: Episodes,
    indices: Collection[int],
    seed: int = 0,
    particles: int = 300,
    faults: Faults = NO_FAULTS,
    progress: Progress = None,
    restart: bool = False,
) -> Iterator[Trace]:
    """Trace the episodes with these indices, those of equal length together.

    The traces have the random numbers of ``trace`` and differ from it by rounding only, which may select another
    particle in a resampling. Raises BadInput as ``trace``.
    External filters run one by one if they draw random numbers or if their batches are not independent.

    Args:
        progress: called with the completed fraction, 0..1.
        restart: whether an external filter that fails at a step is restarted (``trace_with_restarts``).
    """
    if isinstance(checkpoint, ExternalFilter):
        yield from _trace_external(checkpoint, data, indices, seed, faults, progress, restart)
        return
    done = 0
    for episodes in _blocks(data, indices):
        for selected in _by_length(checkpoint, episodes):
            share = part_of(progress, done, len(indices), len(selected))
            yield from _run_together(checkpoint, selected, seed, particles, faults, share)
            done += len(selected)


def _trace_external(
    external: ExternalFilter,
    data: Episodes,
    indices: Collection[int],
    seed: int,
    faults: Faults,
    progress: Progress,
    restart: bool,
) -> Iterator[Trace]:
    """Traces in the order of the indices: in batches, if this changes no result and the filter fails in no episode."""
    run_one = trace_with_restarts if restart else trace
    done, in_batches, is_checked = 0, external.adapter.batched and len(indices) >= FEWEST, False
    for block in _blocks(data, indices):
        traces: dict[int, Trace] = {}
        try:
            for group in _by_length(external, block) if in_batches else ():
                if len(group) == 1:
                    continue
                inputs = [faults.apply(episode, seed) for episode in group.values()]
                faults.check(external.task, len(inputs[0]))
                in_batches = is_checked = is_checked or are_independent(external, inputs[:2], seed)
                if not in_batches:
                    break
                run = {"seed": seed, "faults": faults}
                origins = [{**run, "episode_index": i, "data_hash": e.digest()} for i, e in group.items()]
                share = part_of(progress, done + len(traces), len(indices), len(group))
                traces |= zip(group, run_together(external, inputs, share, origins), strict=True)
        except BadInput:  # one of the episodes, which the filter runs over alone
            in_batches, traces = False, {}
        for index, episode in block.items():
            share = part_of(progress, done, len(indices))
            if index in traces:
                yield traces[index]
            else:
                yield run_one(external, episode, index, seed, faults=faults, progress=share)
            done += 1


def _by_length(checkpoint: Checkpoint, episodes: Mapping[int, Episode]) -> list[dict[int, Episode]]:
    """The episodes by index in groups of equal length, shortest first. Raises BadInput if one is of another task."""
    lengths: dict[int, dict[int, Episode]] = {}
    for index, episode in episodes.items():
        checkpoint.check_task(episode)
        lengths.setdefault(len(episode), {})[index] = episode
    return [group for _, group in sorted(lengths.items())]


def _blocks(data: Episodes, indices: Iterable[int]) -> Iterator[dict[int, Episode]]:
    """Episodes by index, as many as run together."""
    block: dict[int, Episode] = {}
    for index in indices:
        episode = data[index]
        if len(block) == EPISODES or (block and sum(map(len, block.values())) + len(episode) > STEPS):
            yield block
            block = {}
        block[index] = episode
    if block:
        yield block


def _run_together(
    checkpoint: Checkpoint,
    episodes: Mapping[int, Episode],
    seed: int,
    particles: int,
    faults: Faults,
    progress: Progress,
) -> Iterator[Trace]:
    """The traces of episodes of equal length."""
    inputs = [faults.apply(episode, seed) for episode in episodes.values()]
    steps = Steps.from_episodes(checkpoint.task, inputs)
    batch = steps.windows(steps.first, len(inputs[0]))
    evidence, start = checkpoint.filter.encode(batch), first_belief(checkpoint.filter, batch)
    generator = Common().manual_seed(seed)  # ``trace`` gives each episode the numbers of a batch of one
    result = rollout(checkpoint.filter, evidence, start, generator, particles, keep=True, progress=progress)
    joined = _join(result.steps)
    for i, (index, episode) in enumerate(zip(episodes, inputs, strict=True)):
        yield assemble_trace(
            checkpoint,
            episode,
            Gaussian(start.mean[i : i + 1], start.covariance[i : i + 1]),
            step_arrays(checkpoint, evidence.trajectory(i), [_select(joined, i)]),
            data_hash=episodes[index].digest(),
            episode_index=index,
            seed=seed,
            faults=faults,
            settings={"particles": particles, "torch": torch.__version__},
        )


def part_of(progress: Progress, done: int, total: int, size: int = 1) -> Progress:
    """The progress of the next part of this size of a whole; None without one."""
    return None if progress is None else lambda share: progress((done + share * size) / total)


def _join(steps: Sequence[StepTrace]) -> StepTrace:
    """Step traces of N trajectories as one, with tensors (N, T, ...): cheaper than cutting each step into N."""
    joined: dict[tuple[int, ...], Tensor] = {}  # a step trace has some tensors twice

    def join(parts: Sequence[Any]) -> Any:
        first = parts[0]
        if isinstance(first, Tensor):
            key = tuple(map(id, parts))
            if key not in joined:
                joined[key] = torch.stack(list(parts), dim=1)
            return joined[key]
        if first is None or isinstance(first, Recurrent):  # no trace contains the memory of a sequence model
            return first
        values = {f.name: join([getattr(part, f.name) for part in parts]) for f in dataclasses.fields(first)}
        return dataclasses.replace(first, **values)

    result: StepTrace = join(steps)
    return result


def _select(value: Any, i: int) -> Any:
    """Trajectory i of the tensors (N, T, ...) of joined steps: (T, ...)."""
    if isinstance(value, Tensor):
        return value[i]
    if value is None or isinstance(value, Recurrent):
        return value
    return dataclasses.replace(value, **{f.name: _select(getattr(value, f.name), i) for f in dataclasses.fields(value)})
