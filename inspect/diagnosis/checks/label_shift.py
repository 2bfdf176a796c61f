"""Labels whose origin differs from that of all sensors: one shift that explains the errors of several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import LENGTHS
from beliefscope.inspect.statistics.reading_features import CONTROL
from beliefscope.inspect.statistics.reading_model import ReadingModel
from beliefscope.inspect.statistics.signals import MIN_STEPS, Array

STEP = 0.1
"""Shift of the difference quotients, in standard deviations of the component."""

DEPENDENT = 0.3
"""Smallest change of the readings by one standard deviation of the position, relative to their noise."""


def label_shift_statistics(episode: Episode, models: Sequence[ReadingModel]) -> dict[str, float]:
    """``label shift//all``: half the log-ratio of the squared errors of readings to those with shifted labels.

    The shift of the position on the map has the least squared errors of all sensors together. The value is that of the
    modality with the second largest ratio, and at least 0: a bias of one sensor is no shift of the labels, which would
    increase the errors of the other sensors. Absent unless two modalities depend on the position, and without one.
    """
    task = episode.task
    components = [i for i in task.map_indices if task.components[i].unit in LENGTHS]
    if not components:
        return {}
    parts: dict[str, tuple[Array, Array]] = {}
    for model in (model for model in models if model.channels and model.key != CONTROL):
        modality = next((name for name, keys in task.modalities.items() if model.key in keys), "")
        errors, slopes = _errors_and_slopes(episode, model, components)
        variation = slopes * episode.states.astype(np.float64).std(0)[components]
        if modality and len(errors) >= MIN_STEPS and np.square(variation).sum(1).mean() > DEPENDENT**2:
            known = parts.get(modality, (np.empty(0), np.empty((0, len(components)))))
            parts[modality] = np.concatenate([known[0], errors]), np.concatenate([known[1], slopes])
    if len(parts) < 2:
        return {}
    errors, slopes = (np.concatenate(values) for values in zip(*parts.values(), strict=True))
    shift = np.linalg.lstsq(slopes, errors)[0]
    ratios = [np.square(e).sum() / max(np.square(e - j @ shift).sum(), 1e-12) for e, j in parts.values()]
    return {"label shift//all": max(0.0, 0.5 * float(np.log(sorted(ratios)[-2])))}


def _errors_and_slopes(episode: Episode, model: ReadingModel, components: Sequence[int]) -> tuple[Array, Array]:
    """Errors (S,) of all readings of a sensor, relative to their noise, and their slopes (S, p) by the components."""
    compared = model.compare(episode)
    steps, states = compared.steps(), episode.states.astype(np.float64)
    slopes = []
    for i in components:
        shift = np.zeros(states.shape[1])
        shift[i] = max(STEP * float(states[:, i].std()), 1e-6)
        moved = model.expected(replace(episode, states=(states + shift).astype(np.float32)))
        slopes.append((moved - compared.expected)[steps] / shift[i] / model.noise)
    errors = (compared.readings - compared.expected)[steps] / model.noise
    all_slopes = np.stack(slopes, axis=-1)
    known = np.isfinite(errors) & np.isfinite(all_slopes).all(-1)
    return errors[known], all_slopes[known]
