"""Comparison of trajectories with a healthy profile by a permutation test over all statistics at once.

If the trajectories are healthy, they are exchangeable with those of the profile, whatever their distribution. So the
probability of an alarm is at most ``SIGNIFICANCE`` for any number of trajectories, tails and dependent statistics.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import display_name
from beliefscope.inspect.diagnostics.healthy_profile import Array, HealthyProfile
from beliefscope.inspect.diagnostics.views import Table

SIGNIFICANCE = 0.01
"""Probability of an alarm of one diagnostic for healthy trajectories."""

SINGLE_SIGNIFICANCE = 0.02
"""The same for one trajectory, whose p-value is at least 1 / (1 + number of healthy trajectories)."""

PERMUTATIONS = 1999
"""Number of random divisions into tested and healthy trajectories."""

TAIL = 0.99
"""Quantile of a statistic's t-values over healthy samples to which its critical value is proportional."""

CRITICAL = 0.05
"""Share of healthy samples with a deviation above its critical value, for which causes are calibrated."""

SMALLEST_T = 2.0
"""Lower limit of this quantile."""

MIN_HEALTHY = 10
"""Minimum number of healthy trajectories with a value of a statistic."""

MIN_EFFECT = 0.5
"""Minimum difference of an alarm, in standard deviations between healthy trajectories."""

KINDS = {
    "nees": ("NEES/n", True, 0.05),
    "nis": ("NIS/n", True, 0.05),
    "autocorrelation": ("autocorrelation at lag 1 of the innovations", False, 0.02),
    "beta": ("beta", False, 0.01),
    "weight": ("effective weight", False, 0.01),
    "regret": ("error relative to the oracle's weights", True, 0.02),
    "ess": ("effective sample size", True, 0.05),
    "error": ("RMS position error", True, 0.02),
    "angle error": ("RMS error of angles in rad", True, 0.02),
    "module bias": ("bias of the measurement model", False, 5e-4),
    "module error": ("error of the measurement model", True, 0.02),
    "module std": ("predicted standard deviation of the measurement model", True, 0.02),
    "module power": ("sharpness of the measurement model", True, 0.02),
    "module nis": ("squared error over predicted variance of the measurement model", True, 0.05),
    "module spread": ("standard deviation of the error of the measurement model", True, 0.02),
    "module scatter": ("variation of the bias between episodes of the measurement model", True, 0.05),
    "dynamics bias": ("bias of the dynamics model", False, 2e-5),
    "dynamics error": ("error of the dynamics model", True, 0.02),
    "dynamics nis": ("squared error over process noise of the dynamics model", True, 0.05),
    "dynamics slope": ("slope of the predicted on the true change", False, 0.02),
    "dynamics spread": ("error beyond bias and slope of the dynamics model", True, 0.02),
    "process noise": ("process noise", True, 0.02),
    "beta logit": ("log-odds of beta", False, 0.05),
    "beta spread": ("variation of the log-odds of beta", True, 0.05),
    "beta contact": ("change of the log-odds of beta with contact", False, 0.02),
    "reported variance": ("log-ratio of the reported to the used variance", False, 0.02),
    "fusion variance": ("log-ratio of the used variance to that of the fusion rule", False, 0.02),
    "fusion mean": ("distance of the estimate from the fusion rule", True, 1.0),
    "prior ess": ("effective sample size after resampling", False, 0.01),
    "particles": ("number of particles", True, 0.02),
    "ancestors": ("share of particles with offspring", False, 0.01),
    "offspring": ("squared difference of the number of offspring from its expectation", True, 0.02),
    "outside": ("share of steps with the true state outside of the particles", False, 0.01),
    "black": ("share of lost readings", False, 0.02),
    "frozen": ("share of repeated readings", False, 0.02),
    "sharpness": ("sharpness", True, 0.05),
    "brightness": ("exposure{of} relative to healthy images", True, 0.03),
    "occlusion": ("share of occluded pixels", False, 0.01),
    "shift": ("shift in pixels", False, 0.2),
    "lag": ("delay{of} in steps behind the other sensors", False, 0.5),
    "hand offset": ("distance in pixels of the hand in the image from its measured position{axis}", False, 0.1),
    "hand match": ("similarity of the hand in the image to healthy images{axis}", True, 0.05),
    "object offset": ("distance in pixels of the object in the image from its labelled position{axis}", False, 0.1),
    "object match": ("similarity of the object in the image to healthy images{axis}", True, 0.05),
    "contact distance": (
        "distance in m of the hand from the labelled object beyond healthy ones{axis}",
        False,
        5e-4,
    ),
    "contact distance error": ("deviation in m of the hand from the labelled object{axis}", False, 5e-4),
    "contact distance scatter": (
        "variation in m of the hand's deviation between episodes{axis}",
        False,
        5e-4,
    ),
    "offset": ("offset{of} from the measured hand or the estimates (m, rad)", False, 0.002),
    "level": ("level", False, 0.15),
    "drift": ("drift", False, 0.01),
    "change": ("second difference", False, 0.05),
    "noise": ("noise", False, 0.02),
    "position noise": ("noise in m", False, 5e-4),
    "stuck": ("share of repeated readings", False, 0.02),
    "saturation": ("share of saturated readings", False, 0.01),
    "share": ("share of steps with the flag{of}", False, 0.02),
    "toggles": ("share of steps at which the flag{of} changes", False, 0.01),
    "agreement": ("correlation{of} with the force", False, 0.05),
    "opposition": ("negative correlation{of} with the force", False, 0.05),
    "unflagged force": ("force in N without the flag{of}", True, 0.2),
    "size": ("standard deviation", True, 0.1),
    "lever": ("lever in m of the torque{axis}", False, 0.01),
    "axes": ("evidence for the order of the axes", False, 0.3),
    "direction": ("cosine between force and motion of the hand{axis}", False, 0.05),
    "scale": ("scale{of} relative to the motion of the hand", False, 0.02),
}
"""Kind of statistic -> display name, whether it is compared on a logarithmic scale, and on this scale the smallest
standard deviation between trajectories, below which differences are irrelevant. A name may have a place ``{of}`` for
the statistic's subject, or ``{axis}`` for its axis only, if they are not at its end."""

UNITS = {"force": "N", "torque": "N m", "image": "gray levels"}
"""Units of the readings of sensors that all simulated tasks have."""

IN_UNITS = {"level": "", "drift": "/s", "change": "", "noise": "", "size": ""}
"""Kinds of statistics in the units of the readings -> what follows these."""

LEVER = 0.1
"""m: smallest standard deviation of a torque (N m) relative to that of a force (N)."""

PHASES = {
    "all": ("", ""),
    "extreme": ("most extreme ", " over 20 steps"),
    "range": ("range of the ", " over windows of 20 steps"),
}
"""Phase of a statistic -> how its label begins and ends; others are phases of the task."""

RISING = frozenset(
    {"error", "angle error", "regret", "outside", "black", "frozen", "stuck", "saturation", "occlusion", "change"}
    | {
        "opposition",
        "contact distance error",
        "contact distance scatter",
        "module error",
        "module scatter",
        "dynamics error",
    }
)
"""Kinds of statistics whose decrease is no sign of a fault."""


@dataclass(frozen=True)
class Deviation:
    """A statistic of the tested trajectories compared with its healthy values.

    Attributes:
        statistic: ``KIND/SUBJECT/PHASE``.
        value, healthy: means over the tested and over the healthy trajectories.
        low, high: 95 % range of means over as many healthy trajectories as were tested.
        p_value: probability of a deviation of this size in any statistic, if the trajectories are healthy.
        alarm: whether it is significant and at least ``MIN_EFFECT``.
        t: difference of the means over its standard error; of ``with_critical_values``, relative to its critical value.
    """

    statistic: str
    value: float
    healthy: float
    low: float
    high: float
    p_value: float
    alarm: bool
    t: float

    @property
    def label(self) -> str:
        """Display name of the statistic."""
        return label_of(self.statistic)

    @property
    def text(self) -> str:
        """Label, value and healthy range."""
        numbers = (_number(x) for x in (self.value, self.healthy, self.low, self.high))
        return "{} is {}, healthy {} ({} to {})".format(self.label, *numbers)


def label_of(statistic: str) -> str:
    """Display name of a statistic, such as ``effective weight of image (hinge x) in contact``."""
    kind, subject, phase = statistic.split("/")
    title = KINDS[kind][0] if kind in KINDS else kind
    if kind in IN_UNITS and (unit := UNITS.get(subject.partition(" ")[0])):
        title += f" in {unit}{IN_UNITS[kind]}"
    name, _, axis = subject.partition(" ")
    of, axis = f" of {display_name(name)}" if name else "", f" ({display_name(axis)})" if axis else ""
    title = title.format(of=of + axis, axis=axis) if "{" in title else title + of + axis
    before, after = PHASES.get(phase, ("", f" in {phase}"))
    return f"{before}{title}{after}"


@dataclass(frozen=True)
class Comparison:
    """Result of ``compare``, largest deviation first.

    Attributes:
        trajectories, healthy_trajectories: number of tested trajectories, and of those in the profile.
        data: of the profile.
        deviations: by statistic.
        p_value: probability of a deviation of this size in any statistic, each relative to a high quantile of its own
            t-values over the divisions.
    """

    trajectories: int
    healthy_trajectories: int
    data: str
    deviations: tuple[Deviation, ...]
    p_value: float = 1.0

    @property
    def alarms(self) -> tuple[Deviation, ...]:
        """Deviations with an alarm."""
        return tuple(deviation for deviation in self.deviations if deviation.alarm)

    @property
    def sentence(self) -> str:
        """``No alarm`` or the largest alarms. One trajectory alone is no evidence of a fault and at most unusual."""
        if self.trajectories == 1 and 1.0 / (self.healthy_trajectories + 1) > SINGLE_SIGNIFICANCE:
            return "Too few trajectories (1; at least 2 needed) to compare with the healthy record."
        alarms = self.alarms
        record = f"the healthy record of {self.healthy_trajectories} trajectories"
        if not alarms:
            return f"No alarm: within {record}."
        more = f", and {len(alarms) - 3} more" if len(alarms) > 3 else ""
        texts = f"compared with {record}: {'; '.join(alarm.text for alarm in alarms[:3])}{more}."
        if self.trajectories > 1:
            return f"Alarm, {texts}"
        rarity = f"as up to 1 in {1.0 / SINGLE_SIGNIFICANCE:.0f} healthy ones"
        return f"Unusual episode ({rarity}), {texts} Test several episodes before concluding a fault."

    def table(self) -> Table:
        """One row per statistic."""
        verdict = "alarm" if self.trajectories > 1 else "unusual"
        columns = ("statistic", "value", "healthy", "95 % range from", "to", "p-value", verdict)
        rows = tuple(
            (d.label, d.value, d.healthy, d.low, d.high, d.p_value, "yes" if d.alarm else "") for d in self.deviations
        )
        return Table("Comparison with the healthy record", columns, rows)


def compare(profile: HealthyProfile, trajectories: Sequence[Mapping[str, float]], seed: int = 0) -> Comparison:
    """Compare trajectory statistics with those of a profile; statistics that only one of them has are omitted.

    Max-T test of Westfall and Young: in a division of all trajectories into n and the others, each statistic has a
    t-value, the difference of the means over its standard error, with the spread of the others. ``p_value`` is the
    share of divisions whose largest absolute t is at least that of the statistic.
    """
    names = [name for name in profile.statistics if any(name in values for values in trajectories)]
    count = len(trajectories)
    if not names:
        return Comparison(count, profile.episodes, profile.data, ())
    tested = np.array([[values.get(name, np.nan) for name in names] for values in trajectories]).reshape(count, -1)
    tested = tested[np.lexsort(np.nan_to_num(tested).T)]  # the random divisions must not depend on their order
    values = np.concatenate([tested, np.stack([profile.statistics[name] for name in names], axis=1)])
    keep = (np.isfinite(values[:count]).any(0)) & (np.isfinite(values[count:]).sum(0) >= MIN_HEALTHY)
    names, values = [name for name, kept in zip(names, keep, strict=True) if kept], values[:, keep]
    if not names:
        return Comparison(count, profile.episodes, profile.data, ())
    scaled, floor, rising = _scaled(names, values)
    divisions = np.concatenate([np.arange(len(values))[None] < count, _divisions(len(values), count, seed)])
    t, effect = _t_values(scaled, divisions, floor, rising)
    # Rounding must not distinguish a division from itself.
    largest = np.abs(t).max(1) * (1.0 + 1e-9)
    at_least = (largest[1:, None] >= np.abs(t[0])).sum(0)
    # All divisions with one tested trajectory are enumerated, including the actual one.
    p_value = at_least / len(values) if count == 1 else (1.0 + at_least) / len(divisions)
    alarm = (p_value <= (SINGLE_SIGNIFICANCE if count == 1 else SIGNIFICANCE)) & (np.abs(effect[0]) >= MIN_EFFECT)
    low, high = _ranges(values[count:], count, seed)
    mean, healthy = np.nanmean(values[:count], axis=0), np.nanmean(values[count:], axis=0)
    columns = [column.tolist() for column in (mean, healthy, low, high, p_value, alarm, t[0])]
    rows: Iterable[tuple[Any, ...]] = zip(names, *columns, strict=True)
    deviations = [Deviation(*row) for row in rows]
    order = np.argsort(-np.abs(t[0]), kind="stable")
    relative = (np.abs(t) / _own_scale(t[1:], t, count == 1)).max(1)
    extreme = int((relative[1:] * (1.0 + 1e-9) >= relative[0]).sum())
    p_any = extreme / len(values) if count == 1 else (1.0 + extreme) / len(divisions)
    return Comparison(count, profile.episodes, profile.data, tuple(deviations[i] for i in order), p_any)


def _own_scale(distribution: Array, t: Array, single: bool) -> Array:
    """High quantile of absolute t-values of each statistic: (S,), or (B, S) for the t-values (B, S) of one trajectory.

    The scale of one trajectory is the largest of the other ones in the distribution (D, S), because it would hide
    itself among few others.
    """
    size = np.abs(distribution)
    if not single:
        return np.maximum(np.quantile(size, TAIL, axis=0), SMALLEST_T)
    second, largest = np.partition(size, -2, axis=0)[-2:]
    return np.maximum(np.where(np.abs(t) >= largest, second, largest), SMALLEST_T)


def with_critical_values(profile: HealthyProfile, comparison: Comparison, alarm_rate: float) -> tuple[Deviation, ...]:
    """The deviations with t-values relative to critical ones, and alarms where the ratio is at least 1; largest first.

    Distributions of t-values differ between statistics; those of rare events have heavy tails. The critical value of a
    statistic is proportional to its own high quantile, so that a share of healthy samples, ``CRITICAL``, exceeds any.
    With a larger ``alarm_rate``, alarms begin at lower ratios.
    """
    names = [deviation.statistic for deviation in comparison.deviations]
    if not names:
        raise BadInput(
            f"the healthy record of {profile.episodes} episodes has no statistic in common with the "
            f"{comparison.trajectories} diagnosed ones; measure it from at least {MIN_HEALTHY} healthy episodes"
        )
    values, floor, rising = _scaled(names, np.stack([profile.statistics[name] for name in names], axis=1))
    count = min(comparison.trajectories, profile.episodes // 2)
    t = np.abs(_t_values(values, _divisions(profile.episodes, count, 0), floor, rising)[0])
    own = _own_scale(t, t, count == 1)
    limit, alarm = np.quantile((t / own).max(1), [1.0 - CRITICAL, 1.0 - max(CRITICAL, alarm_rate)])
    critical = limit * (own if own.ndim == 1 else np.maximum(t.max(0), SMALLEST_T))
    error = math.sqrt(1.0 / comparison.trajectories + 1.0 / profile.episodes)
    result = [
        replace(d, t=d.t / c, alarm=bool(abs(d.t) >= max(c * alarm / limit, MIN_EFFECT / error)))
        for d, c in zip(comparison.deviations, critical, strict=True)
    ]
    return tuple(sorted(result, key=lambda deviation: -abs(deviation.t)))


def _scaled(names: Sequence[str], values: Array) -> tuple[Array, Array, np.ndarray]:
    """Values (N, S) on the scale of their kind, smallest standard deviations (S,), and whether ``RISING`` (S,)."""
    settings = [KINDS.get(name.split("/")[0], ("", False, 1e-9)) for name in names]
    logarithmic = np.array([s[1] for s in settings])
    floor = np.array([s[2] * (LEVER if "/torque " in n else 1.0) for n, s in zip(names, settings, strict=True)])
    rising = np.array([name.split("/")[0] in RISING or name.endswith("/range") for name in names])
    return np.where(logarithmic, np.log(np.maximum(values, 1e-12)), values), floor, rising


@lru_cache(maxsize=16)
def _divisions(total: int, count: int, seed: int) -> np.ndarray:
    """(B, total) masks of ``count`` tested of ``total`` trajectories: random, or all of them if one is tested."""
    if count == 1:
        return np.eye(total, dtype=bool)
    order = np.random.default_rng(seed).random((PERMUTATIONS, total)).argsort(axis=1)
    return order < count


def _t_values(values: Array, divisions: np.ndarray, floor: Array, rising: np.ndarray) -> tuple[Array, Array]:
    """(B, S) t-values and effects in standard deviations of values (N, S) for divisions (B, N). NaN is missing.

    Both are zero for a decrease of a ``rising`` statistic (S,).
    """
    known = np.isfinite(values)
    present = known.astype(np.float64)
    centred = np.where(known, values - np.nanmean(values, axis=0), 0.0)
    inside = divisions.astype(np.float64)
    count, total = inside @ present, inside @ centred
    others = present.sum(0) - count
    mean = total / np.maximum(count, 1.0)
    rest = (centred.sum(0) - total) / np.maximum(others, 1.0)
    squares = np.square(centred).sum(0) - inside @ np.square(centred)
    variance = np.maximum(squares - others * rest**2, 0.0) / np.maximum(others - 1.0, 1.0)
    effect = (mean - rest) / np.maximum(np.sqrt(variance), floor)
    valid = (count >= 1.0) & (others >= 2.0)
    effect = np.where(valid & ~(rising & (effect < 0.0)), effect, 0.0)
    return effect / np.sqrt(1.0 / np.maximum(count, 1.0) + 1.0 / np.maximum(others, 1.0)), effect


@lru_cache(maxsize=16)
def _draws(total: int, count: int, seed: int) -> Array:
    """(2000, total): how often each of ``total`` trajectories is among ``count`` drawn with replacement."""
    return np.random.default_rng(seed).multinomial(count, np.full(total, 1.0 / total), 2000).astype(np.float64)


def _ranges(healthy: Array, count: int, seed: int) -> tuple[Array, Array]:
    """(S,) 95 % range of the mean of ``count`` trajectories drawn from the healthy ones (E, S)."""
    drawn = _draws(len(healthy), count, seed)
    known = np.isfinite(healthy)
    size = drawn @ known.astype(np.float64)
    means = np.where(size > 0, drawn @ np.where(known, healthy, 0.0) / np.maximum(size, 1.0), np.nan)
    low, high = np.nanpercentile(means, [2.5, 97.5], axis=0)
    return low, high


def _number(value: float) -> str:
    return f"{value:.2g}" if abs(value) < 10 else f"{value:.0f}"
