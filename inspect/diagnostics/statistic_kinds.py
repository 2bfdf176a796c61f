"""Names and units of the statistics of healthy profiles, ``KIND/SUBJECT/PHASE``."""

from __future__ import annotations

from collections.abc import Iterable

from beliefscope.datasets.covariate import in_phase
from beliefscope.datasets.task import Component, Task, axis_name, display_name, display_unit
from beliefscope.inspect.statistics.array_channels import channel_names

KINDS = {
    "nees": ("NEES/n", True, 0.05),
    "nis": ("NIS/n", True, 0.05),
    "autocorrelation": ("autocorrelation at lag 1 of the innovations", False, 0.02),
    "beta": ("beta", False, 0.01),
    "weight": ("effective weight", False, 0.01),
    "regret": ("error relative to the oracle's weights", True, 0.02),
    "ess": ("effective sample size", True, 0.05),
    "error": ("RMS position error", True, 0.02),
    "angle error": ("RMS error of angles", True, 0.02),
    "component error": ("RMS error", True, 0.02),
    "module bias": ("bias of the measurement model", False, 5e-4),
    "module error": ("error of the measurement model", True, 0.02),
    "module std": ("predicted standard deviation of the measurement model", True, 0.02),
    "module power": ("sharpness of the measurement model", True, 0.02),
    "module nis": ("squared error over predicted variance of the measurement model", True, 0.05),
    "module spread": ("standard deviation of the error of the measurement model", True, 0.02),
    "module scatter": ("variation between episodes of the bias of the measurement model", True, 0.05),
    "dynamics bias": ("bias of the dynamics model", False, 2e-5),
    "dynamics error": ("error of the dynamics model", True, 0.02),
    "dynamics offset": ("mean error of the dynamics model", False, 2e-5),
    "dynamics scatter": ("variation between episodes of the mean error of the dynamics model", False, 2e-5),
    "dynamics nis": ("squared error over process noise of the dynamics model", True, 0.05),
    "dynamics slope": ("slope of the predicted on the true change", False, 0.02),
    "dynamics response": ("slope of the predicted on the true change, without that of the opposite one", False, 0.02),
    "dynamics effect": ("true effect{of} relative to the predicted one", False, 0.05),
    "dynamics spread": ("error beyond bias and slope of the dynamics model", True, 0.02),
    "process noise": ("process noise", True, 0.02),
    "beta logit": ("log-odds of beta", False, 0.05),
    "beta spread": ("variation of the log-odds of beta", True, 0.05),
    "beta contact": ("change of the log-odds of beta with contact", False, 0.02),
    "measurement noise": ("standard deviation of the measurement noise", True, 0.02),
    "innovation std": ("predicted standard deviation of the innovations", True, 0.05),
    "innovation share": ("predicted standard deviation of the innovations{of} relative to all others", True, 0.02),
    "innovation bias": ("mean of the innovations, in standard deviations,", False, 0.05),
    "measurement function": (
        "error of the measurement function{of}, relative to the noise of the readings,",
        False,
        0.1,
    ),
    "prediction jacobian": ("error of the Jacobian of the dynamics", False, 0.02),
    "measurement jacobian": ("error of the Jacobian of the measurement function", False, 0.15),
    "correction slope": ("slope of the corrections{of} on those of a correct update", False, 0.2),
    "component correction": ("slope of the corrections{of} on those of a correct update", False, 0.2),
    "covariance update": ("reduction of the covariance by updates, relative to that of correct ones,", False, 0.05),
    "inverted likelihood": ("likelihood{of} that grows with the error of the reading", False, 0.1),
    "ignored start": ("independence of the belief at the start", False, 0.1),
    "late readings": ("number of readings by which the used ones{of} are late", False, 0.3),
    "innovation turns": ("share of innovations of about a full turn", False, 2e-4),  # one is decisive
    "updates": ("share of steps with an accepted measurement, or one that a correct gate rejects,", False, 0.02),
    "absent updates": ("share of steps without a reading that have a measurement", False, 0.02),
    "reported variance": ("log-ratio of the reported to the used variance", False, 0.02),
    "belief variance": ("mean log-variance of the estimate", False, 0.02),
    "fusion variance": ("log-ratio of the used variance to that of the fusion rule", False, 0.02),
    "fusion mean": ("distance of the estimate from the fusion rule", True, 1.0),
    "estimate mean": ("distance of the estimate from the mean of the particles, in standard deviations,", False, 0.02),
    "prior ess": ("effective sample size after resampling", False, 0.01),
    "lost weights": ("share of steps without resampling that do not keep the weights", False, 0.02),
    "particles": ("number of particles", True, 0.02),
    "likelihood share": ("power of the likelihood{of} in the particle weights", False, 0.02),
    "likelihood offset": ("offset of the particles by the likelihood, in their standard deviations,", False, 0.05),
    "likelihood width": ("width of the likelihood{of} at true states", True, 0.05),
    "innovation spread": ("standard deviation of the innovations at true states", True, 0.02),
    "innovation drift": (
        "change of the innovations at true states over the episode, in their standard deviations,",
        False,
        0.1,
    ),
    "innovation offset": ("mean of the innovations at true states, in their standard deviations,", False, 0.05),
    "ancestors": ("share of particles with offspring", False, 0.01),
    "relative ancestors": ("share of particles with offspring, relative to the expected share,", False, 0.02),
    "offspring": ("squared difference of the number of offspring from its expectation", True, 0.02),
    "outside": ("share of steps with the true state outside of the particles", False, 0.01),
    "black": ("share of lost readings", False, 0.02),
    "losses": ("losses{of} per step", False, 0.01),
    "frozen": ("share of repeated readings", False, 0.02),
    "absent": ("share of steps without a reading", False, 0.02),
    "clipped": ("share of saturated pixels", False, 0.01),
    "sharpness": ("sharpness", True, 0.05),
    "brightness": ("exposure{of} relative to healthy images", True, 0.03),
    "occlusion": ("share of occluded pixels", False, 0.01),
    "shift": ("shift", False, 0.2),
    "lag": ("delay{of} behind the other sensors", False, 0.5),
    "contact lag": ("delay{of} behind the labelled contact", False, 0.5),
    "reading lag": ("delay{of} behind the labels", False, 0.5),
    "reading lag scatter": ("variation between episodes of the delay{of} behind the labels", False, 0.5),
    "reading bias": ("error{of} against the value expected from the labels, relative to its noise,", False, 0.3),
    "reading drift": (
        "change{of} over the episode against the value expected from the labels, relative to its noise,",
        False,
        0.3,
    ),
    "reading scatter": ("variation between episodes of the error{of}, relative to its noise,", False, 0.3),
    "reading gain": ("slope{of} on the value expected from the labels", False, 0.02),
    "reading noise": ("noise{of} around the value expected from the labels, relative to healthy noise,", True, 0.05),
    "reading outliers": ("share of isolated readings{of} far from the expected ones", False, 0.01),
    "reading ratio": ("ratio{of} to the value expected from the labels", False, 0.01),
    "label shift": ("evidence for labels with an offset from all sensors", False, 0.1),
    "inverted": ("evidence for the opposite sign of the channel{of}", False, 0.1),
    "exchanged": ("evidence for another order of the channels{of}", False, 0.1),
    "hand offset": ("distance of the hand in the image from its measured position{axis}", False, 0.1),
    "hand match": ("similarity of the hand in the image to healthy images{axis}", True, 0.05),
    "object offset": ("distance of the object in the image from its labelled position{axis}", False, 0.1),
    "object match": ("similarity of the object in the image to healthy images{axis}", True, 0.05),
    "contact distance": ("distance of the hand from the labelled object minus the healthy distance{axis}", False, 5e-4),
    "contact distance error": ("deviation of the hand from the labelled object{axis}", False, 5e-4),
    "contact distance scatter": ("variation of the hand's deviation between episodes{axis}", False, 5e-4),
    "offset": ("offset{of} from the measured hand", False, 0.002),
    "level": ("level", False, 0.15),
    "drift": ("drift", False, 0.01),
    "change": ("second difference", False, 0.05),
    "noise": ("noise", False, 0.02),
    "position noise": ("noise", False, 5e-4),
    "stuck": ("share of repeated readings", False, 0.02),
    "dead": ("share of elements{of} that never change", False, 0.002),
    "holes": ("share{of} without a value", False, 0.01),
    "saturation": ("share of saturated readings", False, 0.01),
    "share": ("share of steps with the flag{of} set", False, 0.02),
    "toggles": ("share of steps at which the flag{of} changes", False, 0.01),
    "agreement": ("correlation{of} with the force", False, 0.05),
    "opposition": ("negative correlation{of} with the force", False, 0.05),
    "unflagged force": ("force without the flag{of}", True, 0.2),
    "size": ("standard deviation", True, 0.1),
    "roughness": ("noise{of} relative to its standard deviation", True, 0.05),
    "lever": ("lever of the torque{axis}", False, 0.01),
    "axes": ("evidence for the order of the axes", False, 0.3),
    "direction": ("cosine between force and motion of the hand{axis}", False, 0.05),
    "compliance": ("compliance of the hand to the force{axis}", False, 2e-5),
    "following": ("delay of the hand behind its set point{axis}", False, 0.05),
    "opposed": ("evidence for the opposite sign", False, 0.1),
    "scale": ("scale{of} relative to the motion of the hand", False, 0.02),
    "step scale": ("scale{of} relative to the steps of the set point", False, 0.02),
}
"""Kind of statistic -> display name, whether it is compared on a logarithmic scale, and on this scale the smallest
standard deviation between episodes, below which differences are irrelevant. A name may have a place ``{of}`` for
the statistic's subject, or ``{axis}`` for its axis only, if they are not at its end."""

OF_READINGS = {"level": "", "drift": "/s", "change": "", "noise": "", "size": ""}
"""Kinds of statistics in the unit of the readings -> what follows it."""

LEVER = 0.1
"""m: smallest standard deviation of a torque (N m) relative to that of a force (N)."""

ADJUSTED = "adjusted"
"""Phase of statistics of modules that are adjusted for the readings of the episode."""

EXPECTED, EXPECTED_EXTREME = "expected", "expected extreme"
AROUND_EXPECTED = (EXPECTED, EXPECTED_EXTREME)
"""Phases of the noise around the expected readings, of the episode and of its noisiest window."""

PHASES = {
    "all": ("", ""),
    ADJUSTED: ("", ", given the readings"),
    "extreme": ("most extreme ", " over 20 steps"),
    "range": ("range of the ", " over windows of 20 steps"),
    EXPECTED: ("", " around the expected readings"),
    EXPECTED_EXTREME: ("most extreme ", " around the expected readings over 20 steps"),
}
"""Phase of a statistic -> how its label begins and ends; others are phases of the task."""

RISING = frozenset(
    {
        "error",
        "angle error",
        "component error",
        "regret",
        "outside",
        "black",
        "losses",
        "frozen",
        "stuck",
        "dead",
        "holes",
        "saturation",
        "clipped",
        "absent",
        "occlusion",
        "change",
        "opposition",
        "opposed",
        "inverted",
        "exchanged",
        "estimate mean",
        "inverted likelihood",
        "innovation turns",
        "measurement function",
        "prediction jacobian",
        "measurement jacobian",
        "reading noise",
        "reading outliers",
        "reading scatter",
        "reading lag scatter",
        "contact distance error",
        "contact distance scatter",
    }
    | {"module error", "module scatter", "dynamics error", "dynamics scatter"}
)
"""Kinds of statistics whose decrease is no sign of a fault."""

LOST = frozenset({"black"})
"""Kinds of shares of lost readings, which are compared by minus the logarithm of the remaining share: with outages in
healthy episodes, the loss of all readings is further from the loss of most than that from the loss of few."""

LENGTHS = ("contact distance", "contact distance error", "contact distance scatter", "lever", "position noise")
"""Kinds of statistics in m."""

OF_KINDS = {
    "angle error": display_unit("rad"),
    **dict.fromkeys(("shift", "hand offset", "object offset"), ("px", 1.0)),
    "unflagged force": ("N", 1.0),
    "compliance": ("mm/N", 1e3),
    **dict.fromkeys(("lag", "contact lag", "reading lag", "reading lag scatter", "following"), ("steps", 1.0)),
    **dict.fromkeys(LENGTHS, display_unit("m")),
}
"""Kind of statistic -> its unit for display, and the factor from its own."""

OF_COMPONENTS = frozenset(
    {f"module {value}" for value in ("bias", "error", "std", "spread", "scatter")}
    | {f"dynamics {value}" for value in ("bias", "error", "spread", "offset", "scatter")}
    | {"component error", "process noise", "offset"}
)
"""Kinds of statistics in the unit of the state component that their subject ends with; else m, of the controls."""

OF_MODALITIES = frozenset({"measurement noise", "innovation std"})
"""Kinds of statistics in the unit of all channels of a modality; without a unit if these differ."""


def is_contact_known(task: Task) -> bool:
    """Whether contact is measured or labelled. Otherwise, statistics of these phases are those of whole episodes."""
    return "contact" in task.observations or "contact" in task.covariates


def label_of(statistic: str, task: Task | None = None) -> str:
    """Display name of a statistic, such as ``effective weight of image (hinge x) in contact``."""
    kind, subject, phase = statistic.split("/")
    if task is not None:
        phase = phase if is_contact_known(task) or phase not in ("contact", "free motion") else "all"
        if channel := channel_of(subject, task):
            subject = subject.removesuffix(channel[0]) + channel[1].name
    owners = () if task is None else (*task.observations, *task.modalities, *(c.name for c in task.components))
    name, axis = sensor_of(subject, owners)
    title = KINDS[kind][0] if kind in KINDS else kind
    if (kind, name) == ("lag", "labels"):
        return f"delay of the labels behind {display_name(axis) or 'all modalities'}"
    if (kind, name) == ("offset", "labels"):
        return f"offset of the labels ({display_name(axis)}) from what all modalities measure"
    owner = f" of {display_name(name)}" if name else ""
    axis = f" ({display_name(axis)})" if axis and axis != name else ""
    title = title.format(of=owner + axis, axis=axis) if "{" in title else title + owner + axis
    group = phase.replace("\N{DIVISION SLASH}", "/")  # see ``measures.long_phases``
    covariates = {} if task is None else task.covariates
    is_phase = any(group in covariate.group_names(key) for key, covariate in covariates.items())
    where = in_phase(group, covariates) if is_phase else f"in {group}"  # such as a component
    before, after = PHASES.get(phase, ("", f" {where}"))
    return f"{before}{title}{after}"


def sensor_of(subject: str, sensors: Iterable[str]) -> tuple[str, str]:
    """Name of the sensor that the subject of a statistic starts with, and the axis; the first word if it has none."""
    names = [name for name in sensors if f"{subject} ".startswith(f"{name} ")]
    name = max(names, key=len, default=subject.partition(" ")[0])
    return name, subject[len(name) + 1 :]


def unit_of(statistic: str, task: Task) -> tuple[str, float]:
    """Unit for display of a statistic, and its factor from the statistic's own; empty and 1 for one without a unit."""
    kind, subject, _ = statistic.split("/")
    if kind == "error":
        return task.main_error.conversion
    if kind in OF_COMPONENTS:
        ending = f" {subject}"
        return next((c.conversion for c in task.components if ending.endswith(f" {c.name}")), display_unit("m"))
    if kind in OF_READINGS:
        channel = channel_of(subject, task)
        unit, factor = channel[1].conversion if channel else ("gray levels" if subject == "image" else "", 1.0)
        return f"{unit}{OF_READINGS[kind]}" if unit else "", factor
    if kind in OF_MODALITIES:
        shapes = {key: task.observations[key] for key in task.modalities.get(subject, ())}
        channels = [task.channel(key, i) for key, shape in shapes.items() if len(shape) == 1 for i in range(shape[0])]
        units = {channel.conversion for channel in channels}
        return units.pop() if len(units) == 1 and all(len(shape) == 1 for shape in shapes.values()) else ("", 1.0)
    return OF_KINDS.get(kind, ("", 1.0))


def channel_of(subject: str, task: Task) -> tuple[str, Component] | None:
    """Name (``axis_name``) and channel of a statistic's subject, which may start with the modality; None without."""
    owners = {key: f"{modality} " for modality, keys in task.modalities.items() for key in keys}
    for key in (key for key in task.observations if key in subject):
        for i, channel in enumerate(channels := channel_names(task, key)):
            name = axis_name(key, i, len(channels))
            if subject in (name, owners[key] + name):
                return name, Component(f"{key} {channel}", "")
    for key, shape in {**task.observations, "control": (task.control_size,)}.items():
        for i in range(shape[0] if len(shape) == 1 and key in subject else 0):
            name = axis_name(key, i, shape[0])
            if subject in (name, owners.get(key, "") + name):
                return name, task.channel(key, i)
    return None
