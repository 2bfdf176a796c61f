"""Out-of-distribution check: data statistics compared with those of a checkpoint's training data.

Two tests, both on means over R episodes, because the steps of an episode are dependent:

* A channel's mean and root mean square, in the checkpoint's normalised units. Under the training distribution an
  episode's mean has a standard deviation of at most 1 (law of total variance), so the mean over R episodes of at most
  1 / sqrt(R).
* Features whose mean and spread between training episodes are known: brightness and contrast of images, and the mean
  product of every two channels, which shows swapped axes and wrong signs. New checkpoints have this summary in their
  record; ``pretrained/data_summary.json`` has that of the pretrained ones.

Thresholds leave no false warning on the sample sets (tests/filters/test_out_of_distribution.py).
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.datasets.task import Task
from beliefscope.filters.batch import Statistics
from beliefscope.filters.checkpoint import PRETRAINED, Checkpoint
from beliefscope.filters.external.load import ExternalFilter

MEAN_LIMIT = 4.5
"""Of a channel's mean, in its largest standard deviation, 1 / sqrt(R)."""

SIZE_LIMIT = (1.0, 6.0)
"""(a, b): a channel's root mean square is at most a + b / sqrt(R) in normalised units."""

FEATURE_LIMIT = (5.0, 2.5)
"""(a, b): a feature's mean is at most a + b / sqrt(R) standard errors from that of the training data."""

TOLERANCE = 0.03
"""Added to the standard error of features, in normalised units: a smaller difference has no effect on a filter."""

CLIP = 5.0
"""Largest normalised value in features: a single collision must not dominate an episode."""

DURATION_TOLERANCE = 0.05
"""Relative difference of a step's duration from the task's: jitter of clocks."""

SUMMARIES = PRETRAINED / "data_summary.json"

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Channel:
    """group: ``state``, ``control`` or a modality. key: of the observation, or the group. unit: of a state only."""

    group: str
    key: str
    name: str
    unit: str = ""


@dataclass(frozen=True)
class Finding:
    """A difference from the training data. severity: test statistic over its limit, above 1. message: one line.

    relation: whether it is one of two channels, which a change of either alone causes as well.
    """

    channel: Channel
    severity: float
    message: str
    relation: bool = False


def channels(task: Task) -> list[Channel]:
    """All vector channels, in the order of ``_values``."""
    result = [Channel("state", "state", c.label, c.unit) for c in task.components]
    result += [Channel("control", "control", task.channel("control", i).label) for i in range(task.control_size)]
    for modality, keys in task.modalities.items():
        for key in keys:
            size, *others = task.observations[key]
            result += [Channel(modality, key, task.channel(key, i).label) for i in range(0 if others else size)]
    return result


def _normalised(statistics: Statistics, task: Task, episode: Episode) -> tuple[Array, Array]:
    """(T, C) values of ``channels`` and (images, 2) mean and standard deviation of all gray levels, normalised."""
    groups = {"state": episode.states, "control": episode.controls}
    images = []
    for modality, keys in task.modalities.items():
        arrays = [np.asarray(episode.observations[key]) for key in keys]
        if arrays[0].ndim == 3:
            center, scale = (float(value) for value in statistics.mean_std(modality))
            images.append([(arrays[0].mean() - center) / scale, arrays[0].std() / scale])
        else:
            groups[modality] = np.concatenate(arrays, axis=1)
    columns = []
    for name, values in groups.items():
        mean, std = (value.cpu().numpy().astype(float) for value in statistics.mean_std(name))
        columns.append((values - mean) / std)
    return np.concatenate(columns, axis=1), np.array(images).reshape(-1, 2)


def _features(values: Array, images: Array) -> Array:
    """(F,): brightness and contrast of each image modality, then the mean products of two channels."""
    clipped = values.clip(-CLIP, CLIP)
    products = clipped.T @ clipped / len(clipped)
    return np.concatenate([images.ravel(), products[np.triu_indices(len(products), 1)]])


def summarise(statistics: Statistics, task: Task, episodes: Sequence[Episode]) -> dict[str, Any]:
    """Number of episodes, and mean and standard deviation of each feature between them, as JSON."""
    features = np.array([_features(*_normalised(statistics, task, episode)) for episode in episodes])
    return {
        "episodes": len(episodes),
        "mean": features.mean(0).round(4).tolist(),
        "std": features.std(0).round(4).tolist(),
    }


def summary_key(statistics: Statistics) -> str:
    """Identifies the training data of pretrained checkpoints: SHA-256 of the normalisation statistics."""
    digest = hashlib.sha256()
    for name, value in sorted(statistics.state_dict().items()):
        digest.update(name.encode() + value.cpu().numpy().tobytes())
    return digest.hexdigest()


@lru_cache(maxsize=1)
def _pretrained_summaries() -> Mapping[str, Any]:
    return json.loads(SUMMARIES.read_text()) if SUMMARIES.is_file() else {}


def findings(checkpoint: Checkpoint, episodes: Sequence[Episode], ignored: Sequence[str] = ()) -> list[Finding]:
    """Differences from the training data: of states, other channels, relations; the most severe first.

    An external filter has no statistics, and thus no findings.

    Args:
        ignored: observation keys that are not compared, such as those with injected faults, and ``control``.
    """
    if isinstance(checkpoint, ExternalFilter) or not episodes:
        return []
    task, statistics = checkpoint.task, checkpoint.statistics
    parts = [_normalised(statistics, task, episode) for episode in episodes]
    result = _channel_findings(task, statistics, [values for values, _ in parts])
    summary = checkpoint.record.get("data_summary") or _pretrained_summaries().get(summary_key(statistics))
    if summary:
        result += _feature_findings(task, summary, np.array([_features(*part) for part in parts]), ignored)
    kept = [finding for finding in result if finding.channel.key not in ignored]
    return sorted(kept, key=lambda f: (f.channel.group != "state", f.relation, -f.severity))


def _channel_findings(task: Task, statistics: Statistics, values: Sequence[Array]) -> list[Finding]:
    root = np.sqrt(len(values))
    means = np.mean([v.mean(0) for v in values], axis=0)
    sizes = np.sqrt(np.mean([np.square(v).mean(0) for v in values], axis=0))
    limit = SIZE_LIMIT[0] + SIZE_LIMIT[1] / root
    std = statistics.mean_std("state")[1].cpu().numpy()
    result = []
    for i, channel in enumerate(channels(task)):
        if i in statistics.angles.indices:
            continue  # not standardised, and the same place after a turn
        shift, size = abs(means[i]) * root / MEAN_LIMIT, sizes[i] / limit
        spread = np.sqrt(max(sizes[i] ** 2 - means[i] ** 2, 0.0)) / limit
        if shift > 1.0 and spread <= 1.0:
            distance = f"{abs(means[i]) * std[i]:.2f} {channel.unit}" if channel.unit else f"{abs(means[i]):.1f} std"
            result.append(
                Finding(channel, shift, f"mean {channel.name} of the data is {distance} from the training data's")
            )
        elif size > 1.0:
            text = f"{channel.name} of the data is {sizes[i]:.1f} times as large as in the training data"
            result.append(Finding(channel, size, text))
    return result


def _feature_findings(task: Task, summary: Mapping[str, Any], features: Array, ignored: Sequence[str]) -> list[Finding]:
    mean, std = np.array(summary["mean"]), np.array(summary["std"])
    if mean.shape != features.shape[1:]:
        return []
    error = np.sqrt(std**2 * (1 / len(features) + 1 / summary["episodes"]) + TOLERANCE**2)
    difference = features.mean(0) - mean
    severity = np.abs(difference) / error / (FEATURE_LIMIT[0] + FEATURE_LIMIT[1] / np.sqrt(len(features)))
    images = [m for m, keys in task.modalities.items() if len(task.observations[keys[0]]) == 2]
    result = []
    for i, (modality, kind) in enumerate(itertools.product(images, ("brightness", "contrast"))):
        if severity[i] > 1.0:
            channel = Channel(modality, task.modalities[modality][0], modality)
            text = f"{kind} of the {modality} differs by {difference[i]:+z.1f} std of the training data's gray levels"
            result.append(Finding(channel, float(severity[i]), text))
    pairs = itertools.combinations(channels(task), 2)
    for (a, b), value in zip(pairs, severity[2 * len(images) :], strict=True):
        if value > 1.0 and not {a.key, b.key} & {"state", *ignored}:
            text = f"the relation of {a.name} and {b.name} differs from that in the training data (axes or signs?)"
            result.append(Finding(b, float(value), text, relation=True))
    return result


def duration_warning(checkpoint: Checkpoint, episodes: Sequence[Episode]) -> str | None:
    """Why the learned dynamics do not fit the durations of the steps; None if they do, and for external filters.

    The built-in dynamics predict over one step of the task and receive no times; external filters receive ``dt``.
    """
    if isinstance(checkpoint, ExternalFilter) or not episodes:
        return None
    dt = checkpoint.task.dt
    durations = np.concatenate([episode.durations for episode in episodes])
    if np.allclose(durations, dt, rtol=DURATION_TOLERANCE, atol=0.0):
        return None
    low, high = durations.min(), durations.max()
    span = f"{low:.3g} s" if np.isclose(low, high) else f"{low:.3g} to {high:.3g} s"
    return f"steps of the data last {span}; the filter's dynamics predict over {dt:.3g} s and ignore the times"


def data_warning(checkpoint: Checkpoint, episodes: Sequence[Episode], faults: Faults = NO_FAULTS) -> str | None:
    """Durations of steps and ``findings`` in one line; None without any.

    faults: injected into the episodes; their sensors are ignored.
    """
    if warning := duration_warning(checkpoint, episodes):
        return warning
    ignored = {key for fault in faults for key in fault.keys(checkpoint.task)}
    result = findings(checkpoint, episodes, [*ignored, *(["control"] if ignored else [])])
    if not result:
        return None
    first, others = result[0], len({finding.channel.name for finding in result}) - 1
    more = f", and {others} more channel{'s differ' if others > 1 else ' differs'}" if others else ""
    return f"{first.message}{more}{'; try --align' if first.channel.unit == 'm' else ''}"
