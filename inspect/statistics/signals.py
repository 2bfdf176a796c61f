"""Robust estimates of signals: level and drift, noise, lag, and the interval in which a series deviates."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAX_LAG = 12
"""Largest lag that is searched, steps."""

LONGEST_DELAY = 0.5
"""s: largest delay that is searched where steps are short."""

MIN_SCORE = 3.5
"""Smallest correlation of two signals with a lag, in standard errors of white noise, 1 / sqrt(number of steps)."""

MIN_GAIN, MIN_STEP_GAIN = 2.0, 0.02
"""By how much the correlation at a lag of more than one step must exceed that without a lag: in standard errors of
Fisher's z, 1 / sqrt(number of steps), and itself by step of the lag. A smooth signal correlates at many lags."""

SMALL_REST = 0.3
"""Largest share of the variance of a signal that another one does not predict at the best lag."""

BETTER = 0.9
"""Largest unpredicted variance at a lag, relative to that without one."""

DRIFTS = 0.6
"""As ``BETTER``, of a lag that grows."""

FASTEST, RATES = 0.25, 51
"""Largest growth of a lag by step, and number of growths that are searched: an odd one."""

MAX_PAIRS = 4_000
"""Number of steps of a signal that are compared at each lag, evenly spaced."""

MIN_RATIO = 15.0
"""Smallest log-likelihood ratio of a lag to none, times two: that of a lag by chance is rarely larger."""

MAX_EDGES = 1_001
"""Maximum number of steps at which an interval may begin or end."""

MIN_STEPS = 10
"""Minimum number of steps of an estimate."""

FIT_ITERATIONS = 6
"""Of a robust fit; further ones hardly change it."""

TURN = 2.0 * np.pi
"""rad: a full turn."""

NEAR_TURN = 1.0
"""rad: largest distance of a jump from a full turn that is one, and largest excess of angles over a turn."""

OTHER_JUMPS = 0.02
"""Largest share of steps in which an angle that wraps around turns by a quarter of a turn or more."""

NEIGHBOURS = 8
"""Errors on each side with which an error is compared."""

ISOLATED = 6.0
"""Smallest distance of an isolated error from the median of its neighbours, in standard deviations of normal ones."""

NORMAL_MAD = 0.6745
"""Median absolute deviation of the standard normal distribution."""


def nearer_slope(slope: Array | float, opposite: Array | float, expected: Array | float) -> Array:
    """The slope of two that is nearer to an expected one, which is taken if it is between them.

    Noise in one of two signals flattens one of their regressions, the more the less they vary; a factor changes both.

    Args:
        opposite: slope by the regression in the other direction, where both are equal without noise; NaN if unknown.
    """
    other = np.where(np.isfinite(opposite), opposite, slope)
    return np.where(np.less(slope, expected), np.clip(other, slope, expected), np.clip(other, expected, slope))


def robust_line(values: Array, at: Mask) -> tuple[Array, Array]:
    """Level at step 0 and slope per step of values (T, d) over the steps ``at`` (T,), each (d,).

    Theil-Sen estimate: the slope is the median of those of all pairs. Adding a + b t to the values adds exactly a to
    the level and b to the slope. NaN for less than ``MIN_STEPS`` steps.
    """
    if at.sum() < MIN_STEPS:
        unknown = np.full(values.shape[1], np.nan)
        return unknown, unknown
    steps, chosen = np.flatnonzero(at), values[at]
    i, j = np.triu_indices(len(steps), 1)
    slope = np.median((chosen[j] - chosen[i]) / (steps[j] - steps[i])[:, None], axis=0)
    return np.median(chosen - slope * steps[:, None], axis=0), slope


def robust_fit(columns: Array, values: Array) -> Array:
    """(A, k) coefficients of values (A, T) by columns (A, T, k) with Huber's weights, by reweighted least squares.

    Residuals above their median count with their size instead of its square.
    """
    scale = np.maximum(np.abs(columns).mean(1, keepdims=True), 1e-12)  # of units
    columns, weight = columns / scale, np.ones_like(values)
    for _ in range(FIT_ITERATIONS):
        weighted = columns * weight[..., None]
        gram, moment = weighted.mT @ columns, weighted.mT @ values[..., None]
        fit = np.linalg.pinv(gram, hermitian=True) @ moment
        left = np.abs(values - (columns @ fit)[..., 0])
        weight = 1.0 / np.maximum(left / np.maximum(np.median(left, axis=1, keepdims=True), 1e-9), 1.0)
    result: Array = fit[..., 0] / scale[:, 0]
    return result


def is_angle(values: Array, successive: Mask | None = None) -> bool:
    """Whether a signal (T,) is an angle in rad that wraps around: from -pi to pi or 0 to 2 pi, with jumps of a turn.

    Other jumps of more than a quarter of a turn are rare (``OTHER_JUMPS``), unlike those of noise.

    successive: (T - 1,) whether a value and the next one have no gap between them; jumps over gaps do not count.
    """
    if len(values) < 2 or min(np.abs(values - middle).max() for middle in (0.0, np.pi)) > (TURN + NEAR_TURN) / 2.0:
        return False
    jumps = np.abs(np.diff(values))[... if successive is None else successive]
    turns = jumps > TURN - NEAR_TURN
    return bool(turns.any() and np.mean((jumps > TURN / 4.0) & ~turns) < OTHER_JUMPS)


def significant(values: Any, digits: int) -> Any:
    """A number, or an array as nested lists of numbers, with this many significant digits, for JSON."""
    plain = values.tolist() if isinstance(values, np.ndarray) else values
    return float(f"{plain:.{digits}g}") if isinstance(plain, float) else [significant(x, digits) for x in plain]


def wrapped(angles: Array) -> Array:
    """Angles in rad modulo a turn, in [-pi, pi)."""
    return np.asarray((angles + np.pi) % TURN - np.pi)


def noise_level(values: Array, present: Mask | None = None) -> Array:
    """(...,) standard deviation of independent noise in values (T, ...), whatever smooth signal it is added to.

    Median absolute second difference, which has the standard deviation sqrt(6) sigma. With absent values, the distance
    of a value from the line between its neighbours, which has sqrt(1 + a^2 + b^2) sigma with their weights a and b.
    NaN for less than 3 values.

    Args:
        present: (T,) steps with a value; default: all.
    """
    steps = np.arange(len(values)) if present is None else np.flatnonzero(present)
    if len(steps) < 3:
        return np.full(values.shape[1:], np.nan)
    if len(steps) == len(values):
        second: Array = np.median(np.abs(np.diff(values, n=2, axis=0)), axis=0) / (NORMAL_MAD * np.sqrt(6.0))
        return second
    chosen = values[steps]
    weight = ((steps[2:] - steps[1:-1]) / (steps[2:] - steps[:-2])).reshape(-1, *[1] * (values.ndim - 1))
    distance = chosen[1:-1] - weight * chosen[:-2] - (1.0 - weight) * chosen[2:]
    spread = np.sqrt(1.0 + weight**2 + (1.0 - weight) ** 2)
    result: Array = np.median(np.abs(distance / spread), axis=0) / NORMAL_MAD
    return result


def isolated(errors: Array) -> Mask:
    """(T, A): errors (T, A) far from those of their neighbours (``ISOLATED``), such as those of false detections.

    Far compared with the variation of the neighbours and with the usual one: a bias, a drift and a noisy stretch are
    not isolated. None of too few errors.
    """
    if len(errors) <= NEIGHBOURS:
        return np.zeros(errors.shape, dtype=bool)
    padded = np.pad(errors, ((NEIGHBOURS, NEIGHBOURS), (0, 0)), mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEIGHBOURS + 1, axis=0)  # (T, A, window)
    middle = np.median(windows, axis=-1)
    distance = np.abs(errors - middle)
    near = np.median(np.abs(windows - middle[..., None]), axis=-1)
    usual = np.median(distance, axis=0)
    return np.asarray((distance > ISOLATED / NORMAL_MAD * np.maximum(near, usual)) & (usual > 0.0))


def repeats(values: NDArray[np.generic], held: int = 0) -> Mask:
    """(T,): whether a reading (T, ...) equals the previous one.

    At the start of an episode, up to ``MAX_LAG`` repetitions do not count: a delayed sensor repeats its first reading.
    They count if no other reading follows.

    Args:
        held: consecutive repetitions that are no fault, of a slow sensor (``Task.held_steps``).
    """
    same = np.zeros(len(values), dtype=bool)
    same[1:] = (values[1:] == values[:-1]).all(axis=tuple(range(1, values.ndim)))
    leading = len(values) if same[1:].all() else int(np.argmin(same[1:]))
    if leading <= MAX_LAG and leading < len(values):
        same[: leading + 1] = False
    return long_runs(same, held + 1) if held else same


def lag(late: Array, early: Array, valid: Mask | None = None) -> tuple[float, float]:
    """Steps by which ``late`` (T, d) follows ``early`` (T, d), and the correlation at that lag.

    The lag, at most ``MAX_LAG`` in size, has the largest correlation of late[t] with early[t - lag], pooled over the
    d columns. NaN if none is significant (``MIN_SCORE``), or if it is hardly larger than without a lag (``MIN_GAIN``).

    Args:
        valid: (T,) steps at which ``late`` is known; default: all.
    """
    steps, lags = len(late), np.arange(-MAX_LAG, MAX_LAG + 1)
    source = np.arange(steps)[:, None] - lags  # (T, L): step of ``early`` that belongs to a step of ``late``
    paired = (source >= 0) & (source < steps)
    late_known, early_known = (np.asarray(np.isfinite(values).all(axis=1)) for values in (late, early))
    paired &= late_known[:, None] & early_known[source.clip(0, steps - 1)]
    if valid is not None:
        paired &= valid[:, None]
    count = paired.sum(0)
    a = np.where(paired[..., None], np.nan_to_num(late)[:, None], 0.0)  # (T, L, d)
    b = np.where(paired[..., None], np.nan_to_num(early)[source.clip(0, steps - 1)], 0.0)
    size = np.maximum(count, 1)[:, None]
    a, b = (np.where(paired[..., None], x - x.sum(0) / size, 0.0) for x in (a, b))
    power = (a * a).sum((0, 2)) * (b * b).sum((0, 2))
    enough = (count >= max(MIN_STEPS, steps // 3)) & (power > 1e-24)
    correlation = np.where(enough, (a * b).sum((0, 2)) / np.sqrt(np.maximum(power, 1e-24)), -1.0)
    best = int(correlation.argmax())
    if correlation[best] < MIN_SCORE / np.sqrt(max(count[best], 1)):
        return np.nan, np.nan
    if abs(lags[best]) > 1 and enough[MAX_LAG]:
        largest, without = np.clip(correlation[[best, MAX_LAG]], -0.999, 0.999)
        gain = (np.arctanh(largest) - np.arctanh(without)) * np.sqrt(count[best])
        if gain < MIN_GAIN or largest - without < MIN_STEP_GAIN * abs(lags[best]):
            return np.nan, np.nan
    return float(lags[best]), float(correlation[best])


def fitted_lag(late: Array, early: Array, late_known: Mask, early_known: Mask, largest: int = MAX_LAG) -> float:
    """Steps by which ``late`` (T, d) follows ``early`` (T, d): those at which a line by column leaves the least of it.

    More exact than ``lag`` for smooth signals that predict each other well. Columns do not count if a line of positive
    slope leaves more than ``SMALL_REST`` of their variance at all lags; NaN without any. 0 if no lag is clearly better
    (``BETTER``, ``MIN_RATIO``).

    Args:
        late_known, early_known: (T,) steps at which they are known.
        largest: largest lag in size, steps; at most a quarter of T.
    """
    if min(late_known.sum(), early_known.sum()) < MIN_STEPS:
        return np.nan
    largest = min(largest, len(late) // 4)
    lags = np.arange(-largest, largest + 1)
    source = np.flatnonzero(late_known)[:, None] - 1.0 * lags  # (S, L): step of ``early`` of a step of ``late``
    rest, count = _left_by_lines(late[late_known], early, source, early_known)
    chosen = rest.min(0) < SMALL_REST
    if not chosen.any():
        return np.nan
    total = rest[:, chosen].sum(1)
    best = int(total.argmin())
    is_better = total[best] < BETTER * total[largest] and _is_likely(rest[:, chosen], count, best)
    return float(lags[best]) if is_better else 0.0


def drifting_lag(late: Array, early: Array, late_known: Mask, early_known: Mask) -> float:
    """Mean of the steps by which ``late`` (T, d) follows ``early`` (T, d) if the clock of one of them drifts.

    The lag grows linearly from 0 at the first step. Arguments as of ``fitted_lag``. NaN if no such lag is clearly
    better than none (``DRIFTS``, ``MIN_RATIO``). Columns count if a line then leaves less than ``SMALL_REST`` of them.
    """
    if min(late_known.sum(), early_known.sum()) < MIN_STEPS:
        return np.nan
    rates = np.linspace(-FASTEST, FASTEST, RATES)
    source = np.flatnonzero(late_known)[:, None] * (1.0 - rates)
    rest, count = _left_by_lines(late[late_known], early, source, early_known)
    chosen = rest.min(0) < np.minimum(SMALL_REST, DRIFTS * rest[RATES // 2])
    if not chosen.any():
        return np.nan
    best = int(rest[:, chosen].sum(1).argmin())
    return 0.5 * float(rates[best]) * len(late) if _is_likely(rest[:, chosen], count, best) else np.nan


def _left_by_lines(late: Array, early: Array, source: Array, known: Mask) -> tuple[Array, Array]:
    """Share (L, d) of the variance of a signal (S, d) that a line of positive slope through another one leaves.

    Also the numbers (L,) of pairs; 1 is left by too few of them. The other signal (T, d) is taken at steps (S, L), for
    each of L lags, between which it is linear.
    """
    every = slice(None, None, 1 + len(late) // MAX_PAIRS)
    late, source = late[every, None], source[every]
    before = source.clip(0, len(early) - 1).astype(int)
    after = np.minimum(before + 1, len(early) - 1)
    part = (source - before)[..., None]
    inside = (source >= 0) & (source <= len(early) - 1)
    paired = (inside & known[before] & (known[after] | (source == before)))[..., None]
    count = np.maximum(paired.sum(0), 1)
    between = np.where(part > 0.0, (1.0 - part) * early[before] + part * early[after], early[before])
    a, b = (np.where(paired, x, 0.0) for x in (late, between))  # (S, L, d)
    a, b = (np.where(paired, x - x.sum(0) / count, 0.0) for x in (a, b))
    correlation = (a * b).sum(0) / np.sqrt(np.maximum((a * a).sum(0) * (b * b).sum(0), 1e-24))
    rest = 1.0 - np.square(np.maximum(correlation, 0.0))
    rest[count[:, 0] < MIN_STEPS] = 1.0
    return rest, count[:, 0]


def _is_likely(rest: Array, count: Array, best: int) -> bool:
    """Whether the log-likelihood of a lag exceeds that of none, in the middle of (L, d), with independent noise."""
    smaller = np.log(np.maximum(rest[[len(rest) // 2, best]], 1e-9))
    return float(count[best] * (smaller[0] - smaller[1]).sum()) > MIN_RATIO


def largest_lag(dt: float) -> int:
    """Largest lag that is searched for ``fitted_lag``, steps: ``LONGEST_DELAY``, and at least ``MAX_LAG``."""
    return max(MAX_LAG, round(LONGEST_DELAY / dt))


def deviating_interval(series: Array) -> tuple[int, int]:
    """First and last step of the interval whose mean exceeds that of the rest of a series (T,) the most.

    It maximises n m / T (mean - rest)^2, with n steps in the interval and m others: the likelihood ratio of a step
    change and its end in Gaussian noise. All steps if none exceeds the rest. It begins and ends at one of ``MAX_EDGES``
    steps, evenly spaced.
    """
    steps = len(series)
    edges = np.unique(np.linspace(0, steps, MAX_EDGES).astype(int))
    total = np.concatenate([[0.0], np.cumsum(series - series.mean())])[edges]
    first, end = np.triu_indices(len(edges), 1)
    length = edges[end] - edges[first]
    excess = np.maximum(total[end] - total[first], 0.0)
    gain = np.where(length < steps, excess**2 / (length * np.maximum(steps - length, 1)), 1e-12)
    best = int(gain.argmax())
    return int(edges[first[best]]), int(edges[end[best]]) - 1


def long_runs(mask: Mask, shortest: int = 3) -> Mask:
    """(T,): the steps of a mask that are in runs of at least ``shortest`` steps."""
    edges = np.diff(np.concatenate([[0], mask.astype(np.int8), [0]]))
    begin, end = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return np.repeat(end - begin >= shortest, end - begin)[np.cumsum(mask) - 1] & mask if mask.any() else mask
