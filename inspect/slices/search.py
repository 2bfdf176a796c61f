"""Search for data slices with larger scores, by tests that respect the dependence of the steps of an episode.

A candidate is a category, or a range of quantiles of a number, or both of two covariates. Its statistic is the sum of
the normal scores (ranks of all steps, as quantiles of N(0, 1)) of its steps, divided by the standard deviation of this
sum under random pairing. Random pairing assigns to the covariates of each episode the scores of a random episode,
rotated by a random number of steps: it keeps the dependence within episodes and removes every relation to covariates.
The p-value of a candidate is the share of pairings in which any candidate is as good, so it accounts for all of them
(max-T, Westfall and Young, Resampling-Based Multiple Testing, 1993).

The search is greedy: of the candidates with a p-value of at most alpha it takes the one that explains the largest part
of the variance (less for several ends), subtracts the mean score of each bin of its covariates, and repeats with the
other covariates. So a slice that follows from those before is not reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.special import ndtri

from beliefscope.filters.engine import Progress
from beliefscope.inspect.slices.covariates import StepCovariate
from beliefscope.inspect.statistics.measures import Array, Mask

ALPHA = 0.05
"""Probability that any slice is reported if no covariate is related to the score."""

PAIRINGS = 200
"""Random pairings per test."""

BINS = 10
"""Quantile bins of a number; slices of two covariates use the even edges."""

MIN_EPISODES = 5
"""Minimum number of episodes with steps in a slice."""

SHARE = (0.02, 0.6)
"""Smallest and largest share of steps in a slice."""

SIMPLICITY = 0.9
"""Part of the explained variance that counts for each end or category beyond the first."""

MAX_SLICES = 8
"""Largest number of slices."""

Index = NDArray[np.int64]


@dataclass(frozen=True)
class Condition:
    """Values of a covariate: ``low < value <= high``, either end may be None; or a category.

    Attributes:
        covariate, unit: name, and unit of ``low`` and ``high``, that for display.
    """

    covariate: str
    unit: str
    low: float | None = None
    high: float | None = None
    category: str | None = None

    @property
    def ends(self) -> int:
        """Number of values that define it."""
        return sum(value is not None for value in (self.low, self.high, self.category))

    def __str__(self) -> str:
        """``friction > 2.1``, ``1 s < outage length <= 2 s``, ``contact``, ``free motion`` or ``policy is push``."""
        if self.category is not None:
            yes, no = self.covariate, f"no {self.covariate}"
            switch = {"yes": yes, yes: yes, "no": "free motion" if yes == "contact" else no, no: no}
            return switch.get(self.category, f"{self.covariate} is {self.category}")
        low, high = (None if end is None else f"{end:z.3g} {self.unit}".strip() for end in (self.low, self.high))
        if low is None:
            return f"{self.covariate} <= {high}"
        return f"{self.covariate} > {low}" if high is None else f"{low} < {self.covariate} <= {high}"


@dataclass(frozen=True)
class Candidate:
    """A slice with its conditions, one or two; its steps (S,), and the p-value of its test."""

    conditions: tuple[Condition, ...]
    steps: Mask
    p_value: float


def find_candidates(
    score: Array,
    episode: Index,
    covariates: Sequence[StepCovariate],
    *,
    alpha: float = ALPHA,
    pairings: int = PAIRINGS,
    seed: int = 0,
    most: int = MAX_SLICES,
    progress: Progress = None,
) -> list[Candidate]:
    """Slices whose scores are larger than those of the other steps, in the order of their discovery.

    The result depends only on the order of the scores, and on the order of the values of each covariate.

    Args:
        score: (S,) of each step, finite. episode: (S,) index of its episode, ascending.
        most: largest number of slices.
        progress: called with the share done, 0..1.
    """
    families = _families(covariates, episode)
    if not families:
        return []
    order = np.argsort(np.argsort(score, kind="stable"), kind="stable")
    value = ndtri((order + 0.5) / len(order))
    pairing = random_pairings(episode, pairings, np.random.default_rng(seed))
    result: list[Candidate] = []
    for stage in range(most):
        best = _test(families, value, pairing, alpha)
        if progress is not None:
            progress((stage + 1) / most)
        if best is None:
            break
        family, index, p_value = best
        result.append(Candidate(family.conditions[index], family.steps(index), p_value))
        value = value - family.bin_means(value)
        used = {condition.covariate for condition in family.conditions[index]}
        families = [other for other in families if not used & set(other.covariates)]
        if not families:
            break
    if progress is not None:
        progress(1.0)
    return result


@dataclass(frozen=True)
class _Family:
    """Candidates of one covariate, or of two.

    Attributes:
        covariates: names.
        code: (S,) cell of each step, a bin or a pair of bins; -1: none.
        atoms: (A, S) indicator of sets of steps in one cell, shared by many families. cells: (B, A) of their cells.
        members: (K, B) indicator of each candidate's cells; only candidates of permitted sizes.
        conditions, shares: of each of the K candidates, its conditions, and its share of the steps.
        weights: (K,) powers of ``SIMPLICITY``.
    """

    covariates: tuple[str, ...]
    code: Index
    atoms: csr_array
    cells: csr_array
    members: Array
    conditions: tuple[tuple[Condition, ...], ...]
    shares: Array
    weights: Array

    def bin_means(self, value: Array) -> Array:
        """(S,) mean of a value (S,) over the steps of the same cell; steps in no cell form another one."""
        cell = self.code + 1
        result: Array = (np.bincount(cell, value) / np.maximum(np.bincount(cell), 1))[cell]
        return result

    def steps(self, candidate: int) -> Mask:
        """(S,) steps of a candidate."""
        inside: Mask = (self.members[candidate] > 0)[self.code] & (self.code >= 0)
        return inside


def _families(covariates: Sequence[StepCovariate], episode: Index) -> list[_Family]:
    """Candidates of every covariate, and of every pair in which one has categories.

    The atoms of covariates that are constant in each episode are episodes, or the steps of a category in an episode.
    """
    number = np.unique(episode, return_inverse=True)[1]
    identity, episodes = _one_hot(np.arange(len(number))), _one_hot(number)
    binned = [(c, *_bins(c)) for c in covariates]
    constant = [not ((np.diff(code) != 0) & (np.diff(number) == 0)).any() for _, code, _ in binned]
    halves = [_ranges(c, edges, coarse=True) for c, _, edges in binned]
    by_category = [
        _one_hot(np.where(code < 0, -1, number * len(c.categories) + code)) if c.categories else identity
        for c, code, _ in binned
    ]
    families = [
        _family(code, episodes if constant[i] else identity, *_ranges(c, edges), number)
        for i, (c, code, edges) in enumerate(binned)
    ]
    for i, j in combinations(range(len(binned)), 2):
        (first, a, _), (second, b, _) = binned[i], binned[j]
        if first.categories or second.categories:
            code = np.where((a < 0) | (b < 0), -1, a * halves[j][0].shape[1] + b)
            atoms = identity
            if constant[j] and first.categories:
                atoms = by_category[i]
            elif constant[i] and second.categories:
                atoms = by_category[j]
            conditions = [(*x, *y) for x in halves[i][1] for y in halves[j][1]]
            members = np.kron(halves[i][0], halves[j][0]).astype(np.float64)
            families.append(_family(code, atoms, members, conditions, number))
    return [family for family in families if len(family.conditions)]


def _bins(covariate: StepCovariate) -> tuple[Index, Array]:
    """Bin of each step (S,), -1 for none; and edges between bins, which are values of the covariate."""
    values, finite = covariate.values, np.isfinite(covariate.values)
    if covariate.categories:
        return np.where(finite, np.nan_to_num(values), -1).astype(np.int64), np.zeros(0)
    edges = np.unique(np.quantile(values[finite], np.arange(1, BINS) / BINS, method="lower"))
    edges = edges[edges < values[finite].max()]
    return np.where(finite, np.searchsorted(edges, values, side="left"), -1), edges


def _ranges(covariate: StepCovariate, edges: Array, coarse: bool = False) -> tuple[Array, list[tuple[Condition, ...]]]:
    """Indicators (K, B) of the bins of each category or range, and their conditions; coarse: no range with two ends."""
    name, unit, count = covariate.name, covariate.unit, len(edges) + 1
    if names := covariate.categories:
        return np.eye(len(names)), [(Condition(name, unit, category=category),) for category in names]
    ends = [*range(0, count, 2 if coarse and count > 4 else 1), count]
    pairs = [(i, j) for i, j in combinations(ends, 2) if j - i < count and (not coarse or i == 0 or j == count)]
    members = np.array([[i <= b < j for b in range(count)] for i, j in pairs], np.float64).reshape(-1, count)
    bounds = [None, *edges.tolist(), None]
    return members, [(Condition(name, unit, bounds[i], bounds[j]),) for i, j in pairs]


def _one_hot(codes: Index, count: int | None = None) -> csr_array:
    """(B, S) indicator of the steps of each code; -1: of none."""
    at = np.flatnonzero(codes >= 0)
    count = int(codes.max()) + 1 if count is None else count
    return csr_array((np.ones(len(at), np.float32), (codes[at], at)), shape=(count, len(codes)))


def _family(
    code: Index, atoms: csr_array, members: Array, conditions: Sequence[tuple[Condition, ...]], number: Index
) -> _Family:
    """The candidates of permitted sizes. number: (S,) of each step's episode."""
    episodes, cells = int(number[-1]) + 1, members.shape[1]
    index = np.where(code < 0, cells * episodes, code * episodes + number)
    counts = np.bincount(index, minlength=cells * episodes + 1)[:-1].reshape(cells, episodes)
    sizes = members @ counts  # (K, E)
    share = sizes.sum(1) / len(number)
    keep = ((sizes > 0).sum(1) >= MIN_EPISODES) & (share >= SHARE[0]) & (share <= SHARE[1])
    kept = tuple(c for c, ok in zip(conditions, keep, strict=True) if ok)
    filled = np.diff(atoms.indptr) > 0
    of_atoms = np.full(atoms.shape[0], -1)
    of_atoms[filled] = code[atoms.indices[atoms.indptr[:-1][filled]]]  # of the first step
    weights = np.array([SIMPLICITY ** (sum(condition.ends for condition in c) - 1) for c in kept])
    names = tuple(condition.covariate for condition in conditions[0]) if conditions else ()
    return _Family(
        names, code, atoms, _one_hot(of_atoms, cells), members[keep].astype(np.float32), kept, share[keep], weights
    )


def random_pairings(episode: Index, count: int, rng: np.random.Generator) -> Index:
    """(S, P): step whose score is paired with the covariates of each step. A shorter episode repeats."""
    _, first, number, length = np.unique(episode, return_index=True, return_inverse=True, return_counts=True)
    other = rng.permuted(np.broadcast_to(np.arange(len(first))[:, None], (len(first), count)), axis=0)  # (E, P)
    rotation = rng.integers(0, length[other])
    local = np.arange(len(episode)) - first[number]
    index = np.empty((len(episode), count), np.int64)
    for p in range(count):  # limits memory
        source = other[number, p]
        index[:, p] = first[source] + (local + rotation[number, p]) % length[source]
    return index


def _test(families: Sequence[_Family], value: Array, pairing: Index, alpha: float) -> tuple[_Family, int, float] | None:
    """Of all candidates with a p-value of at most alpha, the one that explains the largest part of the variance.

    Returns its family, its index there and its p-value; None if there is no such candidate.
    """
    single = value.astype(np.float32)
    table = np.concatenate([single[:, None], single[pairing]], axis=1)
    observed: list[tuple[Array, Array]] = []
    largest = np.full(pairing.shape[1], -np.inf)
    totals: dict[int, Array] = {}
    for family in families:
        if id(family.atoms) not in totals:
            totals[id(family.atoms)] = family.atoms @ table
        sums = family.members @ (family.cells @ totals[id(family.atoms)])
        mean, scale = sums.mean(1, keepdims=True), sums.std(1, keepdims=True)  # with the data: exchangeable
        z = (sums - mean) / np.maximum(scale, 1e-9)
        largest = np.maximum(largest, z[:, 1:].max(0))
        explained = np.square(sums[:, 0] - mean[:, 0]) / (family.shares * (1.0 - family.shares))
        observed.append((z[:, 0], family.weights * explained))
    number = np.repeat(np.arange(len(families)), [len(z) for z, _ in observed])
    z, explained = (np.concatenate(values) for values in zip(*observed, strict=True))
    p_value = (1 + (largest >= z[:, None]).sum(1)) / (len(largest) + 1)
    if p_value.min() > alpha:
        return None
    best = int(np.where(p_value <= alpha, explained, -np.inf).argmax())
    first = int(np.searchsorted(number, number[best]))
    return families[number[best]], best - first, float(p_value[best])
