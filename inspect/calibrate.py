"""Fits a calibration to runs of a filter over held-out episodes, and measures the coverage before and after."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import display_name
from beliefscope.datasets.text import percent, plural
from beliefscope.filters.calibration import Calibration, Layer, conformal_radius
from beliefscope.inspect.diagnostics.base import Diagnostic
from beliefscope.inspect.diagnostics.views import Array, Table
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.intervals import jackknife
from beliefscope.inspect.trace import Trace


@dataclass(frozen=True)
class Coverage:
    """Share of the steps of a phase whose true state is in a region, with its 95 % interval over episodes.

    Attributes:
        layer, phase: names. episodes: with steps in the phase.
        region: ``covariance`` and ``scaled covariance``: the ellipsoid of a Gaussian; ``ellipsoid``, ``position`` and
            names of angles: conformal regions.
        share, low, high: the last two are NaN below five episodes.
    """

    layer: str
    phase: str
    region: str
    episodes: int
    share: float
    low: float
    high: float


@dataclass(frozen=True)
class CalibrationReport(Diagnostic):
    """A calibration, and the coverage of its regions over other episodes than those it was fitted to.

    Attributes:
        fitted, tested: indices of the episodes. units: region of distances -> unit for display, and its factor.
    """

    calibration: Calibration
    fitted: tuple[int, ...]
    tested: tuple[int, ...]
    coverage: tuple[Coverage, ...]
    units: Mapping[str, tuple[str, float]]

    @property
    def verdict(self) -> str:
        """Coverage of the fused estimate over all steps."""
        shares = [
            f"{c.region} {percent(c.share, '.1f')}{_interval(c)}"
            for c in self.coverage
            if c.layer == "fused" and c.phase == "all"
        ]
        return (
            f"Coverage of {percent(self.calibration.level, 'g')} regions over "
            f"{plural(len(self.tested), 'other episode')}: {', '.join(shares)}."
        )

    def tables(self) -> list[Table]:
        """Factors and radii of each layer; and coverage, one row per layer and phase."""
        names = tuple(self.calibration.layers["fused"].distances)
        units = self.units
        rows = [
            (layer, c.scale, c.ellipsoid, *(units[name][1] * c.distances[name] for name in names))
            for layer, c in self.calibration.layers.items()
        ]
        distances = (f"{display_name(n)} {units[n][0]}".rstrip() for n in names)
        columns = ("layer", "covariance x", "ellipsoid sigma", *distances)
        regions = tuple(dict.fromkeys(c.region for c in self.coverage))
        cells = {(c.layer, c.phase, c.region): f"{100 * c.share:.1f}{_interval(c)}" for c in self.coverage}
        keys = dict.fromkeys((c.layer, c.phase, c.episodes) for c in self.coverage)
        lines = [(*key, *(cells.get((*key[:2], region)) for region in regions)) for key in keys]
        return [
            Table(f"Calibration from {plural(self.calibration.episodes, 'episode')}", columns, rows),
            Table(
                f"Coverage % of {percent(self.calibration.level, 'g')} regions",
                ("layer", "phase", "episodes", *map(display_name, regions)),
                lines,
            ),
        ]


def check_level(level: float, fitted: int, tested: int) -> None:
    """Raises BadInput for a level that is not between 0 and 1, and for too few episodes."""
    if not 0.0 < level < 1.0:
        raise BadInput(f"level is {level:g}, not a number between 0 and 1")
    needed = math.ceil(level / (1.0 - level) - 1e-9)
    if fitted < needed or not tested:
        raise BadInput(
            f"{plural(fitted, 'episode')} to fit and {tested} to test: regions of level {level:g} need at least "
            f"{needed} and 1; give more held-out episodes or a lower level"
        )


def calibrate(fitted: Sequence[Trace], tested: Sequence[Trace], level: float, data_hash: str = "") -> CalibrationReport:
    """Fits a calibration to traces of one filter and measures it on others.

    The factor on a covariance S is the one of maximum likelihood of a Gaussian, the mean of ``e^T S^-1 e / n``. Radii
    of conformal regions: ``conformal_radius``. Steps of the task's warm-up are not counted.

    Raises BadInput as ``check_level``.
    """
    check_level(level, len(fitted), len(tested))
    first = fitted[0]
    layers = _layers(first)
    fit = [_scores(trace, layers) for trace in fitted]
    calibration = Calibration(
        task=first.task.name,
        filter=first.filter,
        checkpoint_hash=first.checkpoint_hash,
        data_hash=data_hash,
        episodes=len(fitted),
        level=level,
        layers={name: _fit(name, fit, len(first.task.components), level) for name in layers},
    )
    coverage = _coverage(calibration, tested, [_scores(trace, layers) for trace in tested])
    indices, others = (tuple(trace.episode_index for trace in traces) for traces in (fitted, tested))
    task = first.task
    units = {c.name: c.conversion for c in task.components} | {task.main_error.name: task.main_error.conversion}
    return CalibrationReport(calibration, indices, others, coverage, units)


Scores = dict[tuple[str, str], Array]
"""Layer and ``nees`` (e^T S^-1 e / n), the main error or an angle -> (T,) at all steps; SI units."""


def _layers(trace: Trace) -> tuple[str, ...]:
    """Names of the layers with estimates, the fused one last."""
    return (*trace.modalities_with_posterior, "fused")


def _scores(trace: Trace, layers: Sequence[str]) -> Scores:
    error, distance, nees = np.abs(measures.errors(trace)), measures.main_error(trace), measures.nees(trace)
    result: Scores = {}
    for name in layers:
        index = measures.layers(trace).index(name)
        if np.isfinite(nees[:, index]).all():
            result[name, "nees"] = nees[:, index]
        result[name, trace.task.main_error.name] = distance[:, index]
        for i, component in enumerate(trace.task.components):
            if component.unit == "rad" and (i,) != trace.task.main_error.indices:
                result[name, component.name] = error[:, index, i]
    counted = measures.counted(trace)
    return {key: np.where(counted, values, np.nan) for key, values in result.items()}


def _fit(layer: str, episodes: Sequence[Scores], n: int, level: float) -> Layer:
    columns = {
        key[1]: [values[np.isfinite(values)] for values in (scores[key] for scores in episodes)]
        for key in episodes[0]
        if key[0] == layer and all(key in scores for scores in episodes)
    }
    nees = columns.pop("nees", None)
    radii = {name: conformal_radius(values, level) for name, values in columns.items()}
    if nees is None:
        return Layer(None, None, radii)
    radius = conformal_radius([np.sqrt(n * values) for values in nees], level)
    return Layer(float(np.concatenate(nees).mean()), radius, radii)


def _coverage(calibration: Calibration, traces: Sequence[Trace], scores: Sequence[Scores]) -> tuple[Coverage, ...]:
    n = len(traces[0].task.components)
    quantile = float(chdtri(n, 1.0 - calibration.level)) / n  # of e^T S^-1 e / n
    rows = []
    for name, layer in calibration.layers.items():
        limits = [(key, key, radius) for key, radius in layer.distances.items()]
        if layer.scale is not None and layer.ellipsoid is not None:
            gaussian = [("covariance", "nees", quantile), ("scaled covariance", "nees", layer.scale * quantile)]
            limits = [*gaussian, ("ellipsoid", "nees", layer.ellipsoid**2 / n), *limits]
        for phase in measures.phases(traces[0]):
            masks = [measures.phases(trace)[phase] for trace in traces]
            for region, score, limit in limits:
                inside = [values[name, score] <= limit for values in scores]
                sums = np.array([[m.sum(), (m & i).sum()] for m, i in zip(masks, inside, strict=True)], np.float64)
                sums = sums[sums[:, 0] > 0]
                if len(sums):
                    share, low, high = (float(v) for v in jackknife(sums, lambda s: s[..., 1] / s[..., 0]))
                    rows.append(Coverage(name, phase, region, len(sums), share, max(low, 0.0), min(high, 1.0)))
    return tuple(rows)


def _interval(coverage: Coverage) -> str:
    if math.isnan(coverage.low):
        return ""
    return f" [{100 * coverage.low:.1f}, {100 * coverage.high:.1f}]"
