"""Errors and beliefs of filters over episodes, added up by episode and slice: all that metrics and intervals need."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Task
from beliefscope.filters.batch import Batch, Steps
from beliefscope.filters.evaluate import LEFT_OUT
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.slices import Slice
from beliefscope.filters.rollout import rollout, start_at_truth
from beliefscope.inspect.diagnostics.base import Array
from beliefscope.inspect.statistics.calibration import LEVELS, gaussian_level
from beliefscope.inspect.statistics.measures import FLOOR, wrapped

SMALLEST = 1e-9
"""m, rad: an error below it has no logarithm to speak of."""

Condition = tuple[str, tuple[str, ...]]
"""A slice's faults as text, and its ``only``: slices that share both are parts of one run."""


@dataclass(frozen=True)
class Measure:
    """One number of a filter's errors or of its beliefs.

    Attributes:
        name: ``position``, a component, ``nll``, ``nees``, ``coverage95`` or ``miscalibration``. unit: inside.
        of: sums (..., Q) -> values (...). off: values -> how far from good on a scale of natural logarithms, so that
            the difference of two tells by which factor one is worse, for errors and beliefs alike.
    """

    name: str
    unit: str
    of: Callable[[Array], Array]
    off: Callable[[Array], Array]

    @property
    def is_error(self) -> bool:
        """Whether it is a root mean square error, and not one of what the filter believes of its errors."""
        return self.unit in ("m", "rad")


@dataclass(frozen=True)
class Tally:
    """F filters over E episodes in S slices.

    Attributes:
        sums: (E, F, S, Q) over counted steps: how many, n squared errors, squared distance on the map, negative
            log-likelihood, ``e^T S^-1 e``, and for each of ``LEVELS`` whether the truth is in the region. Without a
            covariance all after the distance is NaN.
        distance: condition -> for each episode (F, T) m, of the estimate from the truth on the map.
    """

    sums: Array
    distance: dict[Condition, list[Array]]


def condition(slice_: Slice) -> Condition:
    """What has to be run for a slice."""
    return str(slice_.faults), slice_.only


def measures_of(task: Task) -> tuple[Measure, ...]:
    """All that is measured: errors first, the map's before those of each component."""
    n = len(task.components)

    def root(column: int) -> Callable[[Array], Array]:
        return lambda sums: np.sqrt(_mean(sums, column))

    def logarithm(values: Array) -> Array:
        return np.log(np.maximum(values, SMALLEST))

    components = [Measure(c.name, c.unit, root(1 + i), logarithm) for i, c in enumerate(task.components)]
    return (
        Measure("position", "m", root(n + 1), logarithm),
        *components,
        # Errors and deviations r times as large: the NLL is n ln r more.
        Measure("nll", "nats", lambda sums: _mean(sums, n + 2), lambda values: values / n),
        # Deviations r times too small: NEES is r^2.
        Measure("nees", "", lambda sums: _mean(sums, n + 3) / n, lambda values: np.abs(logarithm(values)) / 2.0),
        Measure("coverage95", "", lambda sums: _mean(sums, -1), lambda values: np.abs(values - LEVELS[-1])),
        Measure("miscalibration", "", lambda sums: np.abs(curve(sums) - LEVELS).mean(-1), lambda values: values),
    )


def curve(sums: Array) -> Array:
    """(..., Q) to the calibration curve (..., P): share of steps whose truth lies in the region of each level."""
    counts = sums[..., -len(LEVELS) :]
    with np.errstate(invalid="ignore"):
        return counts / sums[..., :1]


def _mean(sums: Array, column: int) -> Array:
    # Where no step counts there is no mean: NaN.
    with np.errstate(invalid="ignore"):
        return sums[..., column] / sums[..., 0]


@torch.no_grad()
def tally(
    filters: Sequence[Filter],
    slices: Sequence[Slice],
    episodes: Sequence[Episode],
    *,
    particles: int = 300,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> Tally:
    """Runs filters of one task over whole episodes as ``evaluate`` does, each condition of the slices once.

    Filters draw the same random numbers, so that they differ only by what they are. The first ``LEFT_OUT`` steps do
    not count. Raises BadInput for episodes that do not fit the task.
    """
    task = filters[0].task
    n = len(task.components)
    sums = np.zeros((len(episodes), len(filters), len(slices), n + 4 + len(LEVELS)))
    distance = {condition(one): [np.zeros((len(filters), len(e))) for e in episodes] for one in slices}
    by_faults: dict[str, list[int]] = {}
    for s, one in enumerate(slices):
        by_faults.setdefault(str(one.faults), []).append(s)
    groups: dict[int, list[int]] = {}
    for number, episode in enumerate(episodes):
        groups.setdefault(len(episode), []).append(number)
    total, done = len(distance) * len(filters) * len(episodes), 0
    for faults, chosen in by_faults.items():
        steps = Steps.of(task, slices[chosen[0]].broken(episodes, seed))
        for length, members in sorted(groups.items()):
            batch = steps.windows(steps.first[members], length)
            for f, filter_ in enumerate(filters):
                evidence = filter_.encode(batch)
                for only in dict.fromkeys(slices[s].only for s in chosen):
                    alike = [s for s in chosen if slices[s].only == only]
                    heard = slices[alike[0]].heard(evidence, filter_.names)
                    generator = torch.Generator().manual_seed(seed)
                    estimate = rollout(
                        filter_,
                        heard,
                        start_at_truth(filter_, batch),
                        generator,
                        particles,
                        progress=_part(progress, done, len(members), total),
                    ).estimate
                    columns = _columns(
                        task,
                        filter_.statistics.state_to_si(estimate.mean) - batch.states,
                        filter_.statistics.covariance_to_si(estimate.covariance),
                    )
                    for s in alike:
                        sums[members, f, s] = _added(columns, slices[s].mask(batch))
                    for i, number in enumerate(members):
                        distance[faults, only][number][f] = np.sqrt(columns[:, i, n + 1])
                    done += len(members)
    return Tally(sums, distance)


def spread(episodes: Sequence[Episode], task: Task, count: int) -> Batch:
    """Up to ``count`` single steps, evenly spread over all of the episodes': T = 1."""
    steps = Steps.of(task, episodes)
    return steps.windows(torch.linspace(0, len(steps.states) - 1, min(count, len(steps.states))).long().unique(), 1)


def _columns(task: Task, error: Tensor, covariance: Tensor) -> Array:
    """(T, N, Q): what ``Tally.sums`` adds up. error: (T, N, n), covariance: (T, N, n, n); SI units."""
    e, n = wrapped(task, error.numpy()), len(task.components)
    s = covariance.double().numpy() + FLOOR * np.eye(n)
    squared = (e * np.linalg.solve(s, e[..., None])[..., 0]).sum(-1)
    with np.errstate(invalid="ignore"):  # of a filter without a covariance
        nll = 0.5 * (squared + np.linalg.slogdet(s)[1] + n * math.log(2.0 * math.pi))
    inside = np.where(np.isnan(squared)[..., None], np.nan, gaussian_level(squared, n)[..., None] <= LEVELS)
    on_map = np.square(e[..., list(task.map_indices)]).sum(-1)
    singles = [np.ones_like(on_map), *np.moveaxis(np.square(e), -1, 0), on_map, nll, squared]
    return np.concatenate([np.stack(singles, -1), inside], -1)


def _added(columns: Array, mask: Tensor) -> Array:
    """(N, Q): sums over the steps of the mask (T, N) that count."""
    first = min(LEFT_OUT, len(columns) - 1)
    return np.where(mask.numpy()[first:, :, None], columns[first:], 0.0).sum(0)


def _part(progress: Callable[[float], None] | None, done: int, size: int, total: int) -> Callable[[float], None] | None:
    return None if progress is None else lambda share: progress((done + share * size) / total)
