"""Numbers of a trace in units for display: by phase, and at one step."""

from __future__ import annotations

from typing import Any

import numpy as np

from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace


def phase_summaries(run: Trace) -> dict[str, dict[str, Any]]:
    """Phase -> number of steps, main error and NEES of each estimate, and effective weights."""
    main, error, nees = run.task.main_error, measures.main_error(run), measures.nees(run)
    return {
        name: {
            "steps": int(mask.sum()),
            f"rmse_{main.key}": _by_layer(run, np.sqrt(np.mean(main.factor**2 * error[mask] ** 2, axis=0))),
            "nees": _by_layer(run, np.array([measures.known_mean(each) for each in nees[mask].T])),
            "effective_weights": _weights(run, mask),
        }
        for name, mask in measures.phases(run).items()
        if mask.any()
    }


def step_values(run: Trace, step: int) -> dict[str, Any]:
    """The true state, all estimates with standard deviations, weights and covariate groups at a step."""
    _, factors = measures.display_units(run.task)
    means = factors * measures.means(run)[step]
    std = factors * np.sqrt(np.diagonal(measures.covariances(run)[step], axis1=-2, axis2=-1))
    names = [component.key for component in run.task.components]
    layers = {
        layer: {"estimate": dict(zip(names, means[i], strict=True)), "sigma": dict(zip(names, std[i], strict=True))}
        for i, layer in enumerate(measures.layers(run))
    }
    return {
        "truth": dict(zip(names, factors * run.episode.states[step], strict=True)),
        "estimates": layers,
        "effective_weights": _weights(run, np.arange(len(run)) == step),
        "groups": [name for name, group in measures.shaded_groups(run).items() if group[step]],
        "blackout": bool(measures.blackout(run)[step]),
    }


def _by_layer(run: Trace, values: measures.Array) -> dict[str, float]:
    return {measures.layer_label(name): float(v) for name, v in zip(measures.layers(run), values, strict=True)}


def _weights(run: Trace, mask: measures.Mask) -> dict[str, float] | None:
    if run.effective_weights is None:
        return None
    weights = run.effective_weights[mask].mean(axis=(0, 2))
    return dict(zip(run.modalities, map(float, weights), strict=True))
