"""Computation of healthy profiles from clean held-out episodes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task_json import check_names
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.engine import Progress
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.filter import Filter
from beliefscope.inspect.diagnosis.checks.episode_statistics import episode_statistics
from beliefscope.inspect.diagnosis.checks.readings import modelled_keys
from beliefscope.inspect.diagnosis.checks.sensors import sensor_statistics
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile, pretrained_reference
from beliefscope.inspect.statistics.reading_fit import fit_reading_models
from beliefscope.inspect.statistics.reading_model import ReadingModel
from beliefscope.inspect.statistics.reference_images import Reference, measure_reference
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all

MAX_EPISODES = 120
"""Maximum number of episodes of a profile; more hardly change it."""

SENSOR_SHARE = 0.85
"""Share of the time of a profile that its sensor record takes."""


FOLDS = 4
"""Number of groups of episodes."""


@dataclass(frozen=True)
class SensorRecord:
    """The part of a healthy profile about sensors, which is the same for all filters of a task.

    Attributes:
        rows: statistics of the sensors by episode. Images and readings are compared with a reference of the other
            groups of episodes, so that the statistics are those of new ones.
        reference: images of all episodes.
        readings: models of the vector sensors of unknown physics.
    """

    rows: Sequence[Mapping[str, float]]
    reference: Reference | None
    readings: tuple[ReadingModel, ...]


def sensor_record(
    episodes: Sequence[Episode], reference: Reference | None = None, progress: Progress = None
) -> SensorRecord:
    """The statistics of the sensors of clean episodes, and their images.

    Args:
        reference: images of other clean episodes of the same camera; default: measured, which takes most of the time.
        progress: called with the completed fraction, 0..1.

    Raises BadInput for a name with a slash in a task of an earlier version.
    """
    if episodes:
        check_names(episodes[0].task)
    keys = modelled_keys(episodes[0].task) if episodes else []
    report, parts = progress or (lambda share: None), FOLDS + 2
    images, models = reference or measure_reference(episodes), fit_reading_models(episodes, keys)
    report(1 / parts)
    by_key = {model.key: model for model in models}
    folds = []
    for fold in range(FOLDS):
        group = [episode for i, episode in enumerate(episodes) if i % FOLDS != fold]
        of_group = fit_reading_models(group, [model.key for model in models], models)
        own = [model.with_noise_of(by_key[model.key]) for model in of_group]
        folds.append((reference or measure_reference(group), own))
        report((fold + 2) / parts)
    rows = []
    for i, episode in enumerate(episodes):
        rows.append(sensor_statistics(episode, *folds[i % FOLDS]))
        report((FOLDS + 1 + (i + 1) / len(episodes)) / parts)
    return SensorRecord(rows, images, models)


def profile_of(
    checkpoint: Checkpoint,
    episodes: Sequence[Episode],
    data: str,
    sensors: SensorRecord | None = None,
    progress: Progress = None,
    indices: Sequence[int] | None = None,
    reference: Reference | None = None,
) -> HealthyProfile:
    """The healthy profile of a filter over clean episodes.

    Args:
        data: where the episodes come from.
        sensors: record of their sensors, if it is known.
        progress: called with the completed fraction, 0..1.
        indices: of the episodes in their data set, for messages.
        reference: as for ``sensor_record``.

    Raises BadInput if the filter fails; an external one in an episode, which is named.
    """
    report = progress or (lambda share: None)
    measured = SENSOR_SHARE if sensors is None else 0.0
    sensors = sensors or sensor_record(episodes, reference, lambda share: report(measured * share))
    done = 0

    def runs() -> Iterator[tuple[Trace, Mapping[str, float]]]:
        nonlocal done
        for trace in trace_all(checkpoint, episodes, range(len(episodes)), progress=on_run):
            yield trace, sensors.rows[trace.episode_index]
            done += 1

    def on_run(share: float) -> None:
        report(measured + (1.0 - measured) * share)

    try:
        return _profile_of_runs(checkpoint, runs(), data, sensors)
    except BadInput as error:
        if not isinstance(checkpoint, ExternalFilter):  # which run together
            raise
        failed = done if indices is None else indices[done]
        advice = "`--profile-filter` measures the record with another version of the filter"
        raise BadInput(f"{error} (healthy episode {failed})", advice) from None


def recorded_profile(
    checkpoint: Checkpoint, traces: Sequence[Trace], data: str, progress: Progress = None
) -> HealthyProfile:
    """The healthy profile of a filter over its recorded runs of clean episodes, as ``profile_of``."""
    sensors = sensor_record([trace.episode for trace in traces], progress=progress)
    return _profile_of_runs(checkpoint, zip(traces, sensors.rows, strict=True), data, sensors)


def _profile_of_runs(
    checkpoint: Checkpoint, runs: Iterable[tuple[Trace, Mapping[str, float]]], data: str, sensors: SensorRecord
) -> HealthyProfile:
    """The profile of runs, each with the statistics of its sensors."""
    rows, lengths, particles = [], [], None
    for trace, own in runs:
        rows.append(episode_statistics(trace, checkpoint, own, sensors.readings))
        lengths.append(len(trace))
        particles = trace.particle_count
    names = dict.fromkeys(name for row in rows for name in row)
    columns = {name: np.array([row.get(name, np.nan) for row in rows]) for name in names}
    steps, task = (min(lengths), max(lengths)), checkpoint.task.name
    return HealthyProfile(data, len(rows), particles, columns, sensors.reference, sensors.readings, steps, task)


def overlap_warning(record: Iterable[Episode], diagnosed: Iterable[Episode]) -> str | None:
    """One line about episodes of a healthy record that are themselves diagnosed, or None."""
    digests = {episode.digest() for episode in diagnosed}
    shared = digests.intersection(episode.digest() for episode in record)
    if not shared:
        return None
    return (
        f"the healthy record contains {len(shared)} of the {len(digests)} diagnosed episodes, whose faults it hides; "
        "measure it from other episodes, which are known to be clean"
    )


def measure_profile(
    filter_: Filter,
    name: str,
    episodes: Sequence[Episode],
    data: str,
    is_sample: bool = False,
    progress: Progress = None,
) -> dict[str, Any] | None:
    """JSON of the healthy profile of a trained filter over the held-out of the episodes; None if there are none.

    data: where the episodes come from. is_sample: whether they have the images of the pretrained filters' camera.
    progress: called with the completed fraction, 0..1.
    """
    held_out = [episode for episode in episodes if episode.split != "train"][-MAX_EPISODES:]
    if not held_out:
        return None
    reference = pretrained_reference(filter_.task) if is_sample else None
    checkpoint = Checkpoint(filter_, name, "", {})
    return profile_of(checkpoint, held_out, data, progress=progress, reference=reference).to_json()
