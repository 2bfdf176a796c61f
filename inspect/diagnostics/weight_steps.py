"""Weights, errors and correlations of weights by step, from which the weight audit is computed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.intervals import correlate, correlation_sums, jackknife
from beliefscope.inspect.statistics.measures import Array
from beliefscope.inspect.statistics.oracle import constant_weights, oracle_weights
from beliefscope.inspect.trace import Trace

NEGLIGIBLE = 0.01
"""In the unit for display: its square is added to mean squared errors in ratios, so that errors below 0.1 mm are not
compared."""


@dataclass(frozen=True)
class Correlation:
    """Correlation of a modality's weight with another signal over all counted steps.

    Attributes:
        weight: ``beta``, ``effective_weights`` or ``oracle``.
        modality, component: of the weight; component is None for a scalar weight.
        other: ``contact`` or ``blackout`` (point-biserial), or ``oracle``, the oracle's weight.
        value: NaN if one of the signals is constant.
        low, high: 95 % interval over episodes; NaN for too few of them.
    """

    weight: str
    modality: str
    component: str | None
    other: str
    value: float
    low: float
    high: float


def trajectory_statistics(trace: Trace) -> dict[str, float]:
    """Statistics of a healthy profile: mean weights by phase, and the error relative to that with the oracle's."""
    steps = weight_steps(trace)
    task, count = trace.task, len(trace.modalities)
    negligible = (NEGLIGIBLE / task.main_error.factor) ** 2
    columns = [c.name for c in task.components] if steps["oracle"].shape[-1] == len(task.components) else [""]
    sources = {"weight": "effective_weights"}
    if "beta" in steps and not np.allclose(steps["beta"], steps["effective_weights"], atol=1e-3):
        sources["beta"] = "beta"
    values = {}
    for phase, mask in measures.long_phases(trace).items():
        for kind, source in sources.items():
            for k in range(1 if count == 2 else count):
                for w, column in enumerate(columns):
                    name = f"{kind}/{trace.modalities[k]} {column}".rstrip()
                    values[f"{name}/{phase}"] = float(steps[source][mask, k, w].mean())
        fused, oracle = (np.square(steps[name][mask, 0]).mean() for name in ("fused", "hindsight"))
        values[f"regret//{phase}"] = float(np.sqrt((fused + negligible) / (oracle + negligible)))
    return {name: value for name, value in values.items() if math.isfinite(value)}


def main_regret(trace: Trace) -> Array:
    """(T,) SI: fused main error minus the error with the oracle's weights.

    Negative if the filter is better than any convex combination, which is possible for a product of experts.
    """
    steps = weight_steps(trace)
    return steps["fused"][:, 0] - steps["hindsight"][:, 0]


def weight_steps(trace: Trace) -> dict[str, Array]:
    """By step: weights (T, K, W), regret (T, W), position and component errors (T, 1 + n), unimodal (T, K, 1 + n)."""
    assert trace.effective_weights is not None
    effective_weights = trace.effective_weights.astype(np.float64)
    task, error = trace.task, measures.errors(trace)
    main = task.main_error
    unimodal, fused = error[:, :-1], error[:, -1]
    per_component = effective_weights.shape[-1] == error.shape[-1]
    if per_component:
        near = np.swapaxes(effective_weights, 1, 2)
        oracle = np.swapaxes(oracle_weights(np.swapaxes(unimodal, 1, 2)[:, :, None], near), 1, 2)
    else:  # a scalar weight minimises the main error
        oracle = oracle_weights(np.swapaxes(unimodal[..., list(main.indices)], 1, 2), effective_weights[..., 0])[
            ..., None
        ]
    hindsight = (oracle * unimodal).sum(1)
    distances = [np.abs(e) if per_component else main.norm(e)[:, None] for e in (fused, hindsight)]
    steps = {
        "effective_weights": effective_weights,
        "oracle": oracle,
        # A product of experts may be better than any convex weights; the regret is zero then.
        "regret": np.maximum(distances[0] - distances[1], 0.0),
        "fused": measures.with_main(task, fused),
        "hindsight": measures.with_main(task, hindsight),
        "unimodal": measures.with_main(task, unimodal),
    }
    return steps if trace.weights is None else {"beta": trace.weights.astype(np.float64), **steps}


def add_constant(step_values: list[dict[str, Array]], traces: Sequence[Trace]) -> list[dict[str, Array]]:
    """Add ``constant``, errors (T, 1 + n) with the best constant weights by phase; NaN for one episode."""
    if len(traces) == 1:
        return [steps | {"constant": np.full_like(steps["fused"], np.nan)} for steps in step_values]
    task = traces[0].task
    where = list(task.main_error.indices)
    errors = [np.swapaxes(measures.errors(trace)[:, :-1], 1, 2) for trace in traces]  # (T, n, K)
    scalar = step_values[0]["oracle"].shape[-1] == 1
    # Blackout, contact, free motion; the warm-up is not used.
    phases = [
        np.where(measures.counted(t), np.where(measures.blackout(t), 2, t.episode.contact.astype(bool)), 3)
        for t in traces
    ]
    weights = constant_weights(
        [e[:, None, where] if scalar else e[:, :, None] for e in errors],
        phases,
        [np.swapaxes(steps["effective_weights"], 1, 2) for steps in step_values],
    )
    return [
        steps | {"constant": measures.with_main(task, (w * e).sum(-1))}
        for steps, w, e in zip(step_values, weights, errors, strict=True)
    ]


def excess_error(traces: Sequence[Trace], step_values: Sequence[dict[str, Array]]) -> tuple[float, float, float]:
    """Relative excess of the position RMSE over that with constant weights, with its interval over episodes."""
    keep = [measures.counted(trace) for trace in traces]
    squares = [
        [np.square(steps[name][mask, 0]).sum() for name in ("fused", "constant")]
        for steps, mask in zip(step_values, keep, strict=True)
    ]
    logs = jackknife(np.array(squares), lambda sums: 0.5 * np.log(sums[..., 0] / sums[..., 1]))
    value, low, high = (math.expm1(float(x)) for x in logs)
    return value, low, high


def weight_correlations(traces: Sequence[Trace], step_values: Sequence[dict[str, Array]]) -> list[Correlation]:
    """Correlations of each weight with contact, image blackout and the oracle's weight, over the counted steps.

    Args:
        step_values: of each trace: ``beta``, ``effective_weights`` and ``oracle``, (T, K, W), where it has them.
    """
    names = [name for name in ("beta", "effective_weights", "oracle") if name in step_values[0]]
    task, modalities = traces[0].task, traces[0].modalities
    width = step_values[0]["oracle"].shape[-1]
    columns: list[str | None] = [c.name for c in task.components] if width == len(task.components) else [None]
    labels = [
        (name, modality, column, other)
        for name in names
        for modality in modalities
        for column in columns
        for other in ("contact", "blackout", *(("oracle",) if name != "oracle" else ()))
    ]
    sums = []
    for trace, steps in zip(traces, step_values, strict=True):
        keep = measures.counted(trace)
        phases = {"contact": trace.episode.contact, "blackout": measures.blackout(trace)}
        pairs = []
        for name, modality, column, other in labels:
            at = (keep, modalities.index(modality), columns.index(column))
            y = phases[other][keep].astype(np.float64) if other in phases else steps[other][at]
            pairs.append((steps[name][at], y))
        sums.append(correlation_sums(*(np.stack(side) for side in zip(*pairs, strict=True))))
    return [
        Correlation(*label, *map(float, values))
        for label, *values in zip(labels, *correlate(np.stack(sums)), strict=True)
    ]
