"""Scale and delay of controls that do not command a measured hand, against the labels."""

from __future__ import annotations

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.inspect.diagnosis.vector_checks import commands_hand
from beliefscope.inspect.statistics.signals import MAX_LAG, MIN_STEPS

EXPLAINED = 0.5
"""Smallest share of the variance of a component's changes that the controls explain."""

LATER = 0.5
"""Largest unexplained variance at a lag, relative to that without one."""

SMALLEST = 1e-4
"""Smallest share of unexplained variance that counts."""

MAX_CHANNELS = 12
"""Maximum number of controls."""


def control_label_statistics(episode: Episode) -> dict[str, float]:
    """Controls against the changes of the true state, whose regression on the controls has the best fit at some lag.

    ``control lag/control``: steps by which the controls follow the changes. ``control gain/control COMPONENT CHANNEL``:
    coefficients at this lag, of components whose changes the controls explain (``EXPLAINED``).
    """
    controls, states, task = episode.controls.astype(np.float64), episode.states.astype(np.float64), episode.task
    known = bool(np.isfinite(states).all()) and not task.rotations
    steps = np.arange(MAX_LAG, len(states) - 1 - MAX_LAG)
    if commands_hand(task) or not known or not 0 < controls.shape[1] <= MAX_CHANNELS:
        return {}
    if len(steps) < MIN_STEPS + controls.shape[1]:
        return {}
    change = task.difference(states[1:], states[:-1])[steps]
    moved = change.std(0) > 0.0
    if not moved.any():
        return {}
    change = change[:, moved] - change[:, moved].mean(0)
    lags = np.arange(-MAX_LAG, MAX_LAG + 1)
    inputs = controls[1 + steps + lags[:, None]]  # (L, S, c)
    inputs = inputs - inputs.mean(1, keepdims=True)
    fits = np.linalg.pinv(inputs, rcond=1e-6) @ change
    shares = np.square(change - inputs @ fits).mean(1) / np.square(change).mean(0)  # (L, moved)
    follows = shares.min(0) < 1.0 - EXPLAINED
    if not follows.any():
        return {}
    # The component that the controls explain best counts most.
    total = np.log(np.maximum(shares[:, follows], SMALLEST)).sum(1)
    best = int(total.argmin())
    best = best if total[best] < total[MAX_LAG] + np.log(LATER) else MAX_LAG
    values = {"control lag/control/all": float(best - MAX_LAG)}
    for i in np.flatnonzero(follows):
        name = task.components[np.flatnonzero(moved)[i]].name
        for channel in range(controls.shape[1]):
            values[f"control gain/control {name} {channel}/all"] = float(fits[best][channel, i])
    return values
