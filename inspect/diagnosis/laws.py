"""Laws that every correct external filter obeys: one that never did does not deviate from its own healthy record."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from beliefscope.datasets.task import display_name
from beliefscope.datasets.text import capitalised
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnosis.case import Case
from beliefscope.inspect.diagnosis.cause import index_ranges
from beliefscope.inspect.diagnosis.checks.measurements import is_of_readings
from beliefscope.inspect.diagnostics.healthy_comparison import MIN_HEALTHY
from beliefscope.inspect.diagnostics.kalman_equations import wrong_equations
from beliefscope.inspect.diagnostics.statistic_kinds import label_of

NOISE_SLOPE, LARGEST_NIS = 0.3, 2.0
"""Smallest slope of the effect of a control that is noise only, below 0, and the largest NIS of correct dynamics."""

PRECISION = 3.0
"""Smallest distance from the expected value in standard errors of the record's mean."""


class Law(NamedTuple):
    """Value of a kind of statistic in a correct filter, and the largest deviation from it that is not mentioned.

    mistake: what a filter that breaks it does, with the modality in the place of ``{}``; empty to state the value.
    """

    kind: str
    expected: float
    tolerance: float
    mistake: str = ""


LAWS = (
    Law("lost weights", 0.0, 0.2, "Particle weights are not kept without resampling"),
    Law("late readings", 0.0, 0.5, "Updates with {} use earlier readings"),
    Law("absent updates", 0.0, 0.2, "The filter updates with {} where it has no reading"),
    Law("inverted likelihood", 0.0, 0.5, "The likelihood of {} grows with the error of the reading"),
    Law("likelihood share", 1.0, 0.3),
    Law("estimate mean", 0.0, 0.2),
    Law("covariance update", 1.0, 0.2),
    Law("correction slope", 1.0, 0.3),
    Law("dynamics effect", 1.0, 0.3),
    Law("measurement function", 0.0, 2.0),
    Law("likelihood offset", 0.0, 0.3),
)
"""Earlier laws come first, because breaking one of them also breaks later ones. Those of updates need filters without
fusion weights."""

OF_UPDATES = ("likelihood share", "covariance update", "correction slope")


def defect_of(case: Case) -> str:
    """What is wrong in a filter although it does not deviate from its record; empty if nothing is known."""
    return turned_text(case) or _wrong_equations(case) or _broken_law(case)


def turned_text(case: Case) -> str:
    """The modalities with innovations of about a full turn, and the episodes; empty if there is none.

    They are wrong in any filter, but a few such episodes are no significant deviation, and the record may have them.
    """
    found: dict[str, list[int]] = {}
    for trace, row in zip(case.traces, case.rows, strict=True):
        for name in (name for name, value in row.items() if name.startswith("innovation turns/") and value > 0.0):
            found.setdefault(name.split("/")[1], []).append(trace.episode_index)
    if not found:
        return ""
    names = ", ".join(map(display_name, found))
    episodes = sorted({episode for group in found.values() for episode in group})
    return f"Innovations of {names} not wrapped in episode{'s' * (len(episodes) > 1)} {index_ranges(episodes)}"


def _wrong_equations(case: Case) -> str:
    """Wrong equations of an external Kalman filter, whatever the record, which may have them too; empty without any."""
    return capitalised("; ".join(wrong_equations(case.traces, case.inputs.checkpoint)))


def _may_be_noise(case: Case, name: str, slope: float) -> bool:
    """Whether the noise of a control can make the slope of its effect smaller than 1: if Q contains its errors.

    The noise of measured controls, such as odometry, has no effect on the state.
    """
    nis = case.profile.statistics.get(f"dynamics nis/{name.split('/')[2]}/all", np.empty(0))
    known = nis[np.isfinite(nis)]
    return -NOISE_SLOPE <= slope <= 1.0 and len(known) > 0 and float(np.median(known)) < LARGEST_NIS


def _broken_law(case: Case) -> str:
    """The first law that the healthy record contradicts, with its largest deviation; empty if there is none."""
    if not isinstance(case.inputs.checkpoint, ExternalFilter):
        return ""
    is_weighted = case.traces[0].weights is not None
    for law in LAWS:
        if is_weighted and law.kind in OF_UPDATES:
            continue
        broken = {}
        for name, values in case.profile.statistics.items():
            known = values[np.isfinite(values)]
            if name.split("/")[0] != law.kind or len(known) < MIN_HEALTHY:
                continue
            median = float(np.median(known))
            distance = abs(median - law.expected)
            if law.kind == "dynamics effect" and _may_be_noise(case, name, median):
                continue
            if law.kind == "measurement function" and not is_of_readings(
                case.traces[0], case.inputs.checkpoint, case.profile.readings, name.split("/")[1]
            ):
                continue
            if distance > max(law.tolerance, PRECISION * float(known.std()) / np.sqrt(len(known))):
                broken[name] = distance, median
        if broken:
            name, (_, median) = max(broken.items(), key=lambda item: item[1][0])
            if law.mistake:
                return law.mistake.format(display_name(name.split("/")[1]))
            label = label_of(name, case.inputs.checkpoint.task).rstrip(",")
            return f"{capitalised(label)} is {median:z.2g}, in a correct filter {law.expected:.0f}"
    return ""
