"""Sums of errors and belief measures by episode and slice, from which metrics and intervals are computed."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Task
from beliefscope.filters.batch import Batch, Steps
from beliefscope.filters.belief import Evidence
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.covariance_floor import is_covariance, with_floor
from beliefscope.filters.engine import Engine, Progress, run_blocks
from beliefscope.filters.evaluate import blocks_of, external_run
from beliefscope.filters.external.ablation import with_only
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.slices import Slice
from beliefscope.filters.rollout import first_belief, rollout
from beliefscope.filters.training.encoder_cache import Images, Tables, cached_encoders, index_images
from beliefscope.inspect.statistics.calibration import LEVELS, gaussian_level
from beliefscope.inspect.statistics.measures import Array
from beliefscope.inspect.traces.batch import part_of

SMALLEST = 1e-9
"""m, rad: lower limit of errors before taking the logarithm."""

Condition = tuple[str, tuple[str, ...]]
"""Faults as text, and ``only``; slices with equal conditions are evaluated in one run."""


BELIEF_MEASURES = ("nll", "nees", "coverage95", "miscalibration")
"""Names of the measures of beliefs; the others are errors."""


@dataclass(frozen=True)
class Measure:
    """A measure of errors or beliefs.

    Attributes:
        name: that of ``Task.main_error``, a component, ``nll``, ``nees``, ``coverage95`` or ``miscalibration``.
        unit, factor: for display, and the factor of the values.
        value: sums (..., Q) -> values (...).
        loss: values -> loss on a natural logarithmic scale, on which differences are relative changes.
    """

    name: str
    unit: str
    factor: float
    value: Callable[[Array], Array]
    loss: Callable[[Array], Array]

    def loss_of(self, sums: Array) -> Array:
        """Sums (..., Q) to (...): loss of their value."""
        return self.loss(self.value(sums))

    @property
    def is_error(self) -> bool:
        """Whether the measure is a root mean square error rather than a measure of the belief."""
        return self.name not in BELIEF_MEASURES


@dataclass(frozen=True)
class EpisodeSums:
    """F filters over E episodes in S slices.

    Attributes:
        sums: (E, F, S, Q) sums over counted steps: number of steps, n squared errors, squared position error, negative
            log-likelihood, ``e^T S^-1 e``, and for each of ``LEVELS`` whether the true state is in the region. Columns
            after the position error are NaN without a covariance.
        distance: condition -> (F, T) m by episode, position error.
    """

    sums: Array
    distance: dict[Condition, list[Array]]


def condition(slice_: Slice) -> Condition:
    """Condition of a slice."""
    return str(slice_.faults), slice_.only


def measures_of(task: Task) -> tuple[Measure, ...]:
    """All measures: position error, component errors, belief measures."""
    n = len(task.components)

    def root(column: int) -> Callable[[Array], Array]:
        return lambda sums: np.sqrt(_mean(sums, column))

    def logarithm(values: Array) -> Array:
        return np.log(np.maximum(values, SMALLEST))

    main = task.main_error
    components = [
        Measure(c.name, *c.conversion, root(1 + i), logarithm)
        for i, c in enumerate(task.components)
        if (i,) != main.indices
    ]
    return (
        Measure(main.name, main.unit, main.factor, root(n + 1), logarithm),
        *components,
        # If errors and standard deviations grow by r, the NLL grows by n ln r.
        Measure("nll", "nats", 1.0, lambda sums: _mean(sums, n + 2), lambda values: values / n),
        # If standard deviations are too small by r, NEES is r^2.
        Measure("nees", "", 1.0, lambda sums: _mean(sums, n + 3) / n, lambda values: np.abs(logarithm(values)) / 2.0),
        Measure("coverage95", "", 1.0, lambda sums: _mean(sums, -1), lambda values: np.abs(values - LEVELS[-1])),
        Measure(
            "miscalibration", "", 1.0, lambda sums: np.abs(calibration(sums) - LEVELS).mean(-1), lambda values: values
        ),
    )


def calibration(sums: Array) -> Array:
    """(..., Q) to the calibration curve (..., P): share of steps with the true state in the region of each level."""
    counts = sums[..., -len(LEVELS) :]
    with np.errstate(invalid="ignore"):
        return counts / sums[..., :1]


def _mean(sums: Array, column: int) -> Array:
    with np.errstate(invalid="ignore"):  # NaN without counted steps
        return sums[..., column] / sums[..., 0]


def sum_episodes(
    filters: Sequence[Checkpoint],
    slices: Sequence[Slice],
    episodes: Sequence[Episode],
    *,
    particles: int = 300,
    seed: int = 0,
    engine: Engine = "local",
    workers: int = 1,
    progress: Progress = None,
) -> EpisodeSums:
    """Run filters of one task over complete episodes as ``evaluate`` does, once per condition.

    All filters draw the same random numbers. Steps of the task's warm-up are not counted.

    Args:
        engine, workers: where to run, as for ``filters.engine.run_blocks``. The values do not depend on them.

    Raises BadInput for episodes that do not fit the task, and as ``evaluate`` does.
    """
    sums = np.zeros((len(episodes), len(filters), len(slices), _width(filters[0].task)))
    distance = {condition(slice_): [np.zeros((len(filters), len(e))) for e in episodes] for slice_ in slices}
    function = partial(_sum_block, filters, slices, particles, seed)
    for block, (block_sums, distances) in run_blocks(
        function, blocks_of(list(enumerate(episodes))), engine, workers, progress
    ):
        numbers = [number for number, _ in block]
        sums[numbers] = block_sums
        for condition_, values in distances.items():
            for number, row in zip(numbers, values, strict=True):
                distance[condition_][number][:] = row
    return EpisodeSums(sums, distance)


@torch.no_grad()
def _sum_block(
    filters: Sequence[Checkpoint],
    slices: Sequence[Slice],
    particles: int,
    seed: int,
    block: Sequence[tuple[int, Episode]],
    progress: Progress,
) -> tuple[Array, dict[Condition, Array]]:
    """``EpisodeSums`` of equally long episodes: (N, F, S, Q), and condition -> (N, F, T)."""
    task, episodes = filters[0].task, [episode for _, episode in block]
    length, n = len(episodes[0]), len(task.components)
    sums = np.zeros((len(block), len(filters), len(slices), _width(task)))
    distance = {condition(slice_): np.zeros((len(block), len(filters), length)) for slice_ in slices}
    by_faults: dict[str, list[int]] = {}
    for s, slice_ in enumerate(slices):
        by_faults.setdefault(str(slice_.faults), []).append(s)
    total, done, first = len(distance) * len(filters), 0, task.first_counted(length)
    faulty = {faults: slices[members[0]].apply_faults(episodes, seed) for faults, members in by_faults.items()}
    # Many faults leave most images as they are, and most fine-tuned filters have the image encoders of their bases.
    indexed, images = index_images([Steps.from_episodes(task, members) for members in faulty.values()])
    tables: Tables = {}
    for (faults, fault_slices), steps in zip(by_faults.items(), indexed, strict=True):
        batch = steps.windows(steps.first, length)
        for f, filter_ in enumerate(filters):
            run = _runner(filter_, faulty[faults], batch, images, tables, particles, seed)
            for only in dict.fromkeys(slices[s].only for s in fault_slices):
                run_slices = [s for s in fault_slices if slices[s].only == only]
                columns = _columns(task, *run(slices[run_slices[0]], part_of(progress, done, total)))
                for s in run_slices:
                    sums[:, f, s] = _sum_steps(columns[first:], slices[s].mask(batch)[first:])
                distance[faults, only][:, f] = np.sqrt(columns[..., n + 1]).T
                done += 1
    return sums, distance


def _width(task: Task) -> int:
    """Number Q of columns of ``EpisodeSums.sums``."""
    return len(task.components) + 4 + len(LEVELS)


def _runner(
    checkpoint: Checkpoint,
    episodes: Sequence[Episode],
    batch: Batch,
    images: Images,
    tables: Tables,
    particles: int,
    seed: int,
) -> Callable[[Slice, Progress], tuple[Array, Tensor]]:
    """Runs a filter with the modalities of a slice: errors (T, N, n) and covariances (T, N, n, n), SI units.

    batch: with indices in place of the images. tables: features of images that are known, to which it adds others.
    """
    if isinstance(checkpoint, ExternalFilter):
        return partial(_run_external, checkpoint, episodes, batch, seed)
    with cached_encoders(checkpoint.filter, images, tables):
        evidence = checkpoint.filter.encode(batch)
    return partial(_run, checkpoint.filter, evidence, batch, particles, seed)


def _run(
    filter_: Filter,
    evidence: Evidence,
    batch: Batch,
    particles: int,
    seed: int,
    slice_: Slice,
    progress: Progress,
) -> tuple[Array, Tensor]:
    estimate = rollout(
        filter_,
        slice_.select_evidence(evidence, filter_.names),
        first_belief(filter_, batch),
        torch.Generator().manual_seed(seed),
        particles,
        progress=progress,
    ).estimate
    mean = filter_.statistics.state_to_si(estimate.mean)
    return filter_.task.difference(mean.numpy(), batch.states.numpy()), filter_.statistics.covariance_to_si(
        estimate.covariance
    )


def _run_external(
    external: ExternalFilter,
    episodes: Sequence[Episode],
    batch: Batch,
    seed: int,
    slice_: Slice,
    progress: Progress,
) -> tuple[Array, Tensor]:
    seen = [with_only(episode, slice_.only or None, external.adapter.absent) for episode in episodes]
    values, _ = external.run(seen, seed, progress)
    errors, covariance = external_run(external.task, values, batch.states)
    valid = torch.from_numpy(is_covariance(covariance.numpy()))
    return errors.numpy(), torch.where(valid[..., None, None], covariance, torch.nan)


def sample_steps(episodes: Sequence[Episode], task: Task, count: int) -> Batch:
    """Up to ``count`` single steps (T = 1), evenly spaced over all episodes."""
    steps = Steps.from_episodes(task, episodes)
    return steps.windows(torch.linspace(0, len(steps.states) - 1, min(count, len(steps.states))).long().unique(), 1)


def _columns(task: Task, e: Array, covariance: Tensor) -> Array:
    """(T, N, Q): columns that ``EpisodeSums.sums`` adds up. e: errors (T, N, n), covariance: (T, N, n, n); SI units."""
    n = len(task.components)
    s = with_floor(covariance.double().numpy())
    squared = (e * np.linalg.solve(s, e[..., None])[..., 0]).sum(-1)
    with np.errstate(invalid="ignore"):  # filter without a covariance
        nll = 0.5 * (squared + np.linalg.slogdet(s)[1] + n * math.log(2.0 * math.pi))
    inside = np.where(np.isnan(squared)[..., None], np.nan, gaussian_level(squared, n)[..., None] <= LEVELS)
    on_map = np.square(task.main_error.norm(e))
    singles = [np.ones_like(on_map), *np.moveaxis(np.square(e), -1, 0), on_map, nll, squared]
    return np.concatenate([np.stack(singles, -1), inside], -1)


def _sum_steps(columns: Array, mask: Tensor) -> Array:
    """(N, Q): sums of columns (T, N, Q) over the steps of the mask (T, N)."""
    return np.where(mask.numpy()[..., None], columns, 0.0).sum(0)
