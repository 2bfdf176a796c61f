"""What a diagnosis compared, and what it could not judge."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from itertools import chain

import numpy as np

from beliefscope.datasets.task import display_name
from beliefscope.datasets.text import percent
from beliefscope.filters.angles import jumping_angles
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnosis.case import Case
from beliefscope.inspect.diagnosis.checks.readings import is_expected, modelled_sensors, without_explained
from beliefscope.inspect.diagnostics.healthy_comparison import MIN_HEALTHY
from beliefscope.inspect.diagnostics.statistic_kinds import AROUND_EXPECTED, label_of, sensor_of
from beliefscope.inspect.statistics.innovations import prediction

OF_SOME_RUNS = ("lost weights/", "absent updates/", "innovation share/", "measurement noise/")
"""Statistics of filters that need steps which a run may not have, such as those without resampling."""

LENGTHS = 1.5
"""Largest ratio of the number of steps of an episode to those of the record that is not mentioned."""

EXTRAPOLATED = 0.05
"""Largest share of a sensor's steps with states that the record does not have that is not mentioned."""


def sensor_statistic_names(case: Case) -> set[str]:
    """Compared statistics that are about sensors and controls only."""
    return {name for row in case.sensors for name in without_explained(row)}


def statistics_by_subject(case: Case) -> dict[str, int]:
    """Number of compared statistics about each sensor, the controls, the labels, the models and the filter."""
    of_sensors = sensor_statistic_names(case)

    def subject(statistic: str) -> str:
        kind, about, _ = statistic.split("/")
        if kind == "label shift":
            return "labels"
        if statistic in of_sensors or about == "labels":
            return sensor_of(about, case.inputs.checkpoint.task.observations)[0]
        return "models" if kind.startswith(("module", "dynamics", "process noise")) else "filter"

    numbers = Counter(subject(deviation.statistic) for deviation in case.deviations)
    order = [*case.inputs.checkpoint.task.observations, "control", "labels", "models", "filter"]
    return {name: numbers[name] for name in dict.fromkeys([*order, *numbers]) if numbers[name]}


def unmeasured(case: Case, numbers: Mapping[str, int], new: int) -> list[str]:
    """What the diagnosis cannot judge: sensors without statistics, and statistics that the episodes or the record lack.

    Also whether the length of the episodes causes deviations, if it is not that of the record (``LENGTHS``), sensors at
    states that the record does not have, and what an external filter that reports no predictions does not show.

    Episodes of contact only lack those of free motion, for example, and records of earlier versions those of new kinds.

    Args:
        numbers: of ``statistics_by_subject``.
        new: of ``missing_statistics``.
    """
    sensors = [display_name(key) for key in case.inputs.checkpoint.task.observations if key not in numbers]
    of_sensors, compared = sensor_statistic_names(case), case.by_statistic
    absent = [
        label_of(name, case.inputs.checkpoint.task)
        for name, values in case.profile.statistics.items()
        if name in of_sensors and name not in compared and np.isfinite(values).sum() >= MIN_HEALTHY
    ]
    outdated = [f"statistics that the healthy record of an earlier version lacks ({new}): measure it again"]
    parts = _other_lengths(case), _jumping(case), _extrapolated(case), sensors, _unexpected(case), _unreported(case)
    return [*chain.from_iterable(parts)] + _likelihoods(case) + absent + (outdated if new else [])


def _jumping(case: Case) -> list[str]:
    """Angles whose jumps models of expected readings and dynamics take for motions."""
    jumps, count = jumping_angles([trace.episode for trace in case.traces]), len(case.traces)
    return [
        f"statistics that depend on {display_name(name)}, which jumps by a turn in {number} of {count} episodes: "
        "declare it with wraps=True, and measure the healthy record again"
        for name, number in jumps.items()
    ]


def _extrapolated(case: Case) -> list[str]:
    """Sensors with a considerable share of steps (``EXTRAPOLATED``) whose states the record does not have."""
    result = []
    for model in case.profile.readings:
        counts = [model.unknown_steps(trace.episode) for trace in case.traces if is_expected(model, trace.episode)]
        unknown, total = (sum(values) for values in zip((0, 0), *counts, strict=True))
        if unknown > EXTRAPOLATED * total:
            share = percent(unknown / total)
            result.append(
                f"{display_name(model.key)} at {share} of its steps, with states that the record does not have"
            )
    return result


def _unexpected(case: Case) -> list[str]:
    """Sensors whose readings no model expects, so that channels may be exchanged or inverted without a deviation."""
    task, models = case.inputs.checkpoint.task, {model.key for model in case.profile.readings if model.channels}
    keys = [key for key in modelled_sensors(task) if key not in models and case.profile.readings]
    return [f"exchanged and inverted channels of {display_name(key)}" for key in keys]


def _unreported(case: Case) -> list[str]:
    """What predictions would show of an external filter."""
    if not isinstance(case.inputs.checkpoint, ExternalFilter) or prediction(case.traces[0]) is not None:
        return []
    return ["dynamics and process noise, since the filter reports no predicted_mean and predicted_covariance"]


def _likelihoods(case: Case) -> list[str]:
    """Likelihoods of an external particle filter that cannot be judged, since no model expects the readings."""
    trace, checkpoint = case.traces[0], case.inputs.checkpoint
    if trace.log_likelihood is None or not isinstance(checkpoint, ExternalFilter):
        return []
    known, result = case.by_statistic, []
    for name in (name for name in trace.modalities if f"measurement noise/{name}/all" not in known):
        noise = "" if f"likelihood width/{name}/all" in known else "measurement noise and "
        result.append(f"{noise}measurement function of {display_name(name)}")
    return result


def _other_lengths(case: Case) -> list[str]:
    """Episodes that are longer or shorter than those of the record."""
    if case.profile.steps is None:
        return []
    low, high = case.profile.steps
    lengths = [len(trace) for trace in case.traces if not low / LENGTHS <= len(trace) <= high * LENGTHS]
    if not lengths:
        return []
    own, healthy = (
        f"{a} steps" if a == b else f"{a} to {b} steps" for a, b in ((min(lengths), max(lengths)), (low, high))
    )
    return [f"statistics that depend on the length: episodes have {own}, those of the healthy record {healthy}"]


def missing_statistics(case: Case) -> int:
    """Number of statistics of kinds that the healthy record does not have, since an earlier version measured it."""

    def kind(statistic: str) -> tuple[str, bool]:
        """Also whether it is around expected readings."""
        name, _, phase = statistic.split("/")
        return name, phase in AROUND_EXPECTED

    kinds = {kind(name) for name in case.profile.statistics}
    finite = {name for row in case.rows for name, value in row.items() if np.isfinite(value)}
    models = () if case.profile.readings else (n for n in case.profile.statistics if n.startswith("reading "))
    new = (name for name in finite if kind(name) not in kinds and not name.startswith(OF_SOME_RUNS))
    return len([*new, *models])
