"""Causes in the arrays of a user's task, such as depth images and tactile grids, by their elements and channels."""

from __future__ import annotations

from functools import partial

from beliefscope.datasets.task import display_name
from beliefscope.inspect.diagnosis.cause import Cause, Symptom
from beliefscope.inspect.statistics.array_channels import CHANNELS

BIASED = "level|drift|saturation|reading bias|reading ratio"
"""Kinds of statistics of a channel that a bias changes."""

NOISES = "noise|roughness|change|reading noise"
"""Kinds of statistics of a channel that noise changes."""

EXACT = 0.1
"""Prior of the opposite sign: a bias rarely has twice the size of the mean."""

TEXTS = {
    "noise": ("Sensor {} noisy", "Check the cable and the exposure or filter of the sensor."),
    "bias": ("Sensor {} biased", "Tare the sensor, or register the frame of the labels with it."),
    "drift": ("Sensor {} drifting", "Let the sensor warm up and tare it before each episode."),
    "gain": ("Sensor {} has a wrong gain", "Check the unit and the gain of the sensor."),
    "dead": ("Elements of sensor {} dead", "Replace the elements, or mask them in training as well."),
    "holes": ("Elements of sensor {} without a value", "Check the light, the range and the surfaces that it sees."),
    "shift": ("Sensor {} moved", "Calibrate the pose of the sensor again."),
    "sign": ("Values of sensor {} inverted", "Check the sign of the sensor."),
    "axes": ("Array of sensor {} mirrored or transposed", "Check the order of the rows and columns of the sensor."),
}
"""Mechanism -> title, next action."""

UNDO = {"bias": "level", "gain": "divide", "sign": "negate", "axes": "reorder"}
"""Mechanism -> intervention that brings back the values of the sensor."""


def of_channels(key: str, kinds: str, *channels: str) -> str:
    """Patterns of the statistics of these kinds, joined by ``|``, about channels of an array; of all by default."""
    indices = [CHANNELS.index(channel) for channel in channels or CHANNELS]
    return "|".join(f"{kind}/{key} {i}/*" for kind in kinds.split("|") for i in indices)


def array_causes(key: str, downstream: str, undo: str) -> list[Cause]:
    """Causes of the array sensor with this key: values, elements, its place and the order of rows and columns.

    A bias moves the mean only, a gain scales mean and spread, and another place of the sensor moves the centre. Noise
    increases the spread as well and draws the centre to the middle.

    Args:
        downstream: patterns of what a fault of the sensor changes downstream.
        undo: intervention that undoes any of them, by dropping the sensor.
    """
    name, of, elements = display_name(key), partial(of_channels, key), f"size/{key}/*|roughness/{key}/*"
    mean, size, centre = ("mean",), ("mean", "spread"), ("row", "column")
    lags = f"reading lag/{key}/*|reading lag scatter/{key}/*|contact lag/{key}/*"
    noises = f"{of(NOISES)}|noise/{key}/all|reading outliers/{key}/*"
    limits = f"saturation/{key}/*|{of('saturation')}"
    line = Symptom(of("drift", *mean), 0)
    level = Symptom(of("level", *mean), 0, otherwise=(Symptom(of("reading bias", *mean), 0), line))
    slopes = Symptom(of("reading gain|reading ratio", *size), 0)
    scaled = Symptom(of("size", *mean), 0, otherwise=(slopes, Symptom(of("level", *size), 0)))
    louder = Symptom(f"noise/{key}/all", 0, otherwise=(Symptom(f"size/{key}/*", 0),))
    negated = Symptom(of("level", *mean), 0, target="mirrored")
    moved = Symptom(of("reading bias", *centre), 0, otherwise=(Symptom(of("level", *centre), 0),))
    rough = (Symptom(f"noise/{key}/all"), Symptom(f"roughness/{key}/all"))
    blurred = f"{of('*', 'spread', *centre)}|{of(BIASED, *mean)}|stuck/{key}/*|dead/{key}/*"
    drifted = f"{BIASED}|reading scatter|size|roughness"
    entries: dict[str, tuple[tuple[Symptom, ...], str]] = {
        "noise": (rough, f"{noises}|{blurred}|{elements}|{limits}"),
        "bias": ((level,), f"{of(BIASED, *mean)}|{limits}"),
        "drift": (
            (Symptom(of("reading drift", *mean), 0, otherwise=(line,)),),
            f"{of(drifted, *mean)}|{elements}|{limits}",
        ),
        "gain": ((scaled, louder), f"{of('[!ie]*', *size)}|{noises}|{limits}"),
        "dead": ((Symptom(f"dead/{key}/all"),), f"*/{key}/*|*/{key} */*"),
        "holes": ((Symptom(f"holes/{key}/all"),), f"{of('*')}|noise/{key}/all|{elements}|{limits}"),
        "shift": ((moved,), f"{of(f'{BIASED}|reading scatter|size|change')}|{elements}"),
        "sign": ((Symptom(of("inverted", *mean), otherwise=(negated,)),), f"{of('*', *mean)}|{limits}"),
        "axes": ((Symptom(of("inverted|exchanged", *centre)),), of("*", *centre)),
    }
    return [
        Cause(
            f"{key}.{mechanism}",
            title.format(name),
            entries[mechanism][0],
            f"{entries[mechanism][1]}|{lags}|lag/*|{downstream}",
            action,
            f"{UNDO[mechanism]} {key}|{undo}" if mechanism in UNDO else undo,
            prior=EXACT if mechanism == "sign" else 0.0,
        )
        for mechanism, (title, action) in TEXTS.items()
    ]
