"""Causes in external filters that report predictions, innovations or likelihoods, by the names of the modalities."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Literal

from beliefscope.datasets.task import Task, display_name
from beliefscope.inspect.diagnosis.cause import Cause, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import DYNAMICS, FILTER, LABELS, MODELS, model_of
from beliefscope.inspect.diagnosis.causes.own_sensors import offset_of


def _dynamics(*kinds: str) -> str:
    """Patterns of statistics of the dynamics."""
    return "|".join(f"dynamics {kind}/*" for kind in kinds)


JACOBIANS = "prediction jacobian/*|measurement jacobian/*|correction slope/*|component correction/*|covariance update/*"
"""Statistics of repeated steps (``RepeatedSteps``)."""

EFFECTS = "dynamics effect/*"
"""Effects of the controls on the state, relative to the predicted ones."""

AT_TRUTH = "|".join(f"innovation {kind}/*" for kind in ("offset", "drift", "spread"))
"""Innovations of steps from true states, after one prediction."""

OF_TRUE_STATES = (
    *(f"dynamics {kind}/" for kind in ("bias", "effect", "error", "nis", "slope", "spread")),
    "process noise/",
)
"""Statistics of predictions that start at true states."""

UNCHANGED_BY_DRIFT = ("dynamics spread/", "measurement function/", "process noise/")
"""Statistics that a bias of the dynamics does not change."""

OF_DYNAMICS = ("dynamics.", "process_noise.", "control.", "labels.", "data.", "particles.few")
"""Starts of the names of causes that change them as well: moments of few particles are not exact."""

RESAMPLING = ("particles.deprived", "resampling.biased")
"""Causes that show in the share of particles with offspring, of an external filter relative to that by its weights."""

DRIFT = Cause(
    "dynamics.drift",
    "Dynamics biased, differently in each episode",
    (Symptom("dynamics scatter/*"),),
    f"{_dynamics('bias', 'error', 'nis', 'offset', 'spread')}|process noise/*|{FILTER}",
    "Check the bias of its inputs that the filter should estimate, and its sign in the dynamics.",
    raises="measurement noise/*",
    prior=-0.1,
)
"""A bias that the filter does not estimate, such as that of a gyroscope.

If it has a state for it and no gain, its updates are smaller than those from which the measurement noise is determined.
"""

JACOBIAN = Cause(
    "dynamics.jacobian",
    "Jacobian of the dynamics wrong",
    (Symptom("prediction jacobian/*"),),
    f"{_dynamics('error', 'nis', 'slope', 'spread')}|process noise/*|{FILTER}",
    "Compare the Jacobian of the dynamics with finite differences: signs, columns, the time step.",
    prior=-0.1,  # another gain or sign of the predicted mean also changes its derivative
)
"""A derivative in the prediction of the covariance, other than that of the predicted mean."""

COVARIANCE = Cause(
    "updates.covariance",
    "Covariance of the updates wrong",
    (Symptom("covariance update/*", 0),),
    f"measurement noise/*|{FILTER}",
    "Compare the covariance after an update with P - K H P: the signs, and the P, H and K that it uses.",
)
"""The update of the mean is correct, that of the covariance is not."""

CONSIDERED = Cause(
    "updates.component",
    "Updates correct a component too little",
    (Symptom("component correction/*", -1, target="shrunk"),),
    f"{JACOBIANS}|dynamics offset/*|dynamics scatter/*|measurement noise/*|{FILTER}",
    "Check the rows of the gain, and the cross-covariances of the component: biases and parameters need them.",
    prior=-0.3,  # a gain of one sensor that is too small also corrects some components too little
)
"""Such as a bias without a row of the gain, which keeps its first value."""

WEIGHTS = Cause(
    "weights.lost",
    "Particle weights not kept without resampling",
    (Symptom("lost weights/*", 1),),
    f"*ancestors/*|offspring/*|prior ess/*|likelihood share/*|{FILTER}",
    "Multiply the likelihood by the weights of the previous step; make them equal only after resampling.",
)

LATE = Cause(
    "updates.late",
    "Updates use earlier readings",
    (Symptom("late readings/*", 1),),
    f"{JACOBIANS}|{DYNAMICS}|lag/dynamics/*|measurement noise/*|measurement function/*|{MODELS}",
    "Check which reading the filter uses: a buffer or a queue may return the one before.",
)

START = Cause(
    "start.ignored",
    "Filter ignores the belief that it starts at",
    (Symptom("ignored start/*", 1),),
    f"{JACOBIANS}|{DYNAMICS}|lag/dynamics/*|process noise/*|measurement noise/*|measurement function/*|{FILTER}",
    "Use the mean and covariance that initialize_beliefs receives, or omit its parameters if the filter has its own "
    "start.",
)

ESTIMATE = Cause(
    "estimate.mean",
    "Estimate is not the mean of the particles",
    (Symptom("estimate mean/*"),),
    f"reported variance/*|{FILTER}",
    "Compare the estimate with the sum of the particles times their weights; average angles by their differences.",
)
"""Such as their mean without weights, after the resampling, or with angles that are not wrapped."""

LARGE = Cause(
    "dynamics.large",
    "Predicted changes too large",
    (Symptom("dynamics slope/*"), Symptom(EFFECTS, -1, target="shrunk", optional=True)),
    f"{_dynamics('error', 'nis', 'spread')}|prediction jacobian/*|process noise/*|{FILTER}",
    "Check the time step, units and gains of the dynamics.",
)
"""The opposite of ``dynamics.frozen``, such as with a time step that is too long."""


def external_causes(task: Task) -> tuple[Cause, ...]:
    """Causes that show in the predictions and innovations of an external filter only."""
    return (
        DRIFT,
        JACOBIAN,
        LARGE,
        COVARIANCE,
        CONSIDERED,
        ESTIMATE,
        START,
        LATE,
        WEIGHTS,
        *([_wrong_sign(tuple(task.modalities))] if len(task.modalities) > 1 else []),
        *(cause for modality, keys in task.modalities.items() for cause in _of_measurement(modality, keys)),
        *(cause for modality in task.modalities for cause in _of_updates(modality)),
    )


def _wrong_sign(modalities: Sequence[str]) -> Cause:
    """Of a single modality, it is called a wrong Jacobian."""
    return Cause(
        "updates.sign",
        "Corrections by all sensors have the wrong sign",
        tuple(Symptom(f"correction slope/{modality}/*", -1, target="mirrored") for modality in modalities),
        f"{JACOBIANS}|measurement function/*|measurement noise/*|{FILTER}",
        "Check the sign of the innovations, reading minus expected reading, and that the corrections are added.",
        prior=0.5,  # each wrong Jacobian explains those of the other modalities as well
    )


def in_predictions(cause: Cause, has_true_starts: bool, inputs: Collection[str], images: Mapping[str, str]) -> Cause:
    """A cause with its consequences in the predictions of an external filter, which start at its estimates.

    Whether the offspring agrees with the weights depends on the resampling alone.

    Args:
        has_true_starts: most statistics of the dynamics are of predictions that start at true states, which other parts
            of the filter, and the sensors, do not change.
        inputs: components of causes in vector sensors and labels. Their symptoms are in the readings, which no equation
            changes, and a wrong update moves the state before that by the next sensor, also in steps from true states.
        images: modality by the component of causes in image sensors, whose networks have another R for other images.
    """
    cause = _in_predictions_of_run(cause)
    if cause.name in RESAMPLING:
        own = (replace(s, statistics=s.statistics.replace("ancestors/", "relative ancestors/")) for s in cause.symptoms)
        cause = replace(cause, symptoms=tuple(own))
    if has_true_starts:
        cause = _with_true_starts(cause)
    if cause.component in inputs:
        cause = replace(cause, consequences=f"{cause.consequences}|{JACOBIANS}|{AT_TRUTH}")
    if (modality := images.get(cause.component)) is not None:
        noise = f"measurement noise//*|measurement noise/{modality}/*"
        cause = replace(cause, consequences=f"{cause.consequences}|{noise}")
    return replace(cause, consequences=cause.consequences.replace("|offspring/*", ""))


def _with_true_starts(cause: Cause) -> Cause:
    if cause.name == "dynamics.broken":  # a gain of the predicted changes is one of their spread about the slope, too
        first, _ = cause.symptoms
        return replace(cause, symptoms=(first, Symptom("dynamics spread/*", 1)))
    if cause.name == "dynamics.inverted":  # of one control, such as one of two
        return replace(cause, symptoms=(Symptom(EFFECTS, target="mirrored", otherwise=cause.symptoms),))
    if cause.name == "control.bias":  # not the expected controls alone, which are extrapolated to other motions
        symptom = Symptom("dynamics bias/*|dynamics offset/*", 0, optional=True)
        return replace(cause, symptoms=(*cause.symptoms, symptom))
    if cause.name.startswith("dynamics.") and cause.name != JACOBIAN.name:  # a lost state may have another R
        cause = replace(cause, consequences=f"{cause.consequences}|{AT_TRUTH}", raises="measurement noise/*")
    if cause.name.startswith(OF_DYNAMICS) and cause.name not in (DRIFT.name, JACOBIAN.name):
        return cause
    unchanged = UNCHANGED_BY_DRIFT if cause.name == DRIFT.name else OF_TRUE_STATES
    patterns = cause.consequences.replace(DYNAMICS, f"{_dynamics('offset', 'scatter')}|{FILTER}").split("|")
    return replace(cause, consequences="|".join(p for p in patterns if not p.startswith(unchanged)))


def _in_predictions_of_run(cause: Cause) -> Cause:
    others = f"{DYNAMICS}|process noise/*|measurement function/*"
    changed = {
        "weights": f"{others}|correction slope/*|component correction/*|covariance update/*|measurement noise/*",
        "dynamics": "dynamics bias/*|dynamics offset/*|dynamics scatter/*|measurement function/*",
        "process_noise": _dynamics("bias", "error", "offset", "scatter", "spread"),
        "measurement_noise": f"{DYNAMICS}|process noise/*",
        "measurement": f"{_dynamics('bias', 'error', 'nis', 'offset', 'scatter', 'slope', 'spread')}|process noise/*",
    }
    # The labels are compared with updates of the belief, which mean nothing once the filter has lost the state.
    consequences = f"{cause.consequences}|{changed.get(cause.name.partition('.')[0], others)}|{LABELS}"
    # Predicted changes that are too small, such as those of a shorter time step, add too little noise as well.
    if cause.name == "dynamics.frozen":  # the spread of predictions depends on the process noise of particles
        cause = replace(cause, symptoms=(Symptom("dynamics slope/*", -1, target="shrunk"),))
        consequences += f"|dynamics spread/*|{EFFECTS}"
    if cause.name not in ("dynamics.frozen", "dynamics.inverted"):
        return replace(cause, consequences=consequences)
    consequences += "|prediction jacobian/*"
    return replace(cause, consequences=consequences, lowers=f"{cause.lowers}|process noise/*")


def _of_measurement(modality: str, keys: Sequence[str]) -> tuple[Cause, ...]:
    """Causes in the measurement noise, measurement function and Jacobian of a modality.

    Where modalities are always used together, only the mean of their measurement noise is known, and the innovations
    show whose it is.
    """
    name = display_name(modality)
    sizes: tuple[tuple[str, Literal[-1, 1]], ...] = (("small", -1), ("large", 1))
    noise = (
        Cause(
            f"measurement_noise.{modality}.{size}",
            f"Measurement noise of {name} too {size}",
            (
                Symptom(
                    f"measurement noise/{modality}/*|likelihood width/{modality}/*",
                    direction,
                    otherwise=(Symptom(f"innovation share/{modality}/*", direction),),
                ),
                Symptom("measurement noise//*", direction, optional=True),
            ),
            FILTER,
            f"Compare R of {name}, or the width of its likelihood, with the variance of its readings.",
        )
        for size, direction in sizes
    )
    return (
        *noise,
        Cause(
            f"measurement.{modality}.function",
            f"Measurement function of {name} wrong",
            (
                Symptom(
                    "|".join(f"measurement function/{key}/*|measurement function/{key} */*" for key in keys),
                    unmeasured=(Symptom(f"innovation spread/{modality} *"),),  # of learned sensors
                ),
            ),
            # A likelihood of a wrong scale has another width.
            f"measurement noise/{modality}/*|{model_of(modality)}|{FILTER}",
            f"Compare h of {name} at the true states with its readings: positions of landmarks, units, signs; or check "
            "the inputs and weights of its network.",
        ),
        Cause(
            f"measurement.{modality}.bias",
            f"Measurement function of {name} biased",
            (replace(offset_of(modality), unmeasured=(Symptom(f"innovation bias/{modality} *", 0),), optional=False),),
            f"likelihood width/{modality}/*|innovation spread/{modality} *|{FILTER}",
            f"Compare h of {name} at the true states with its readings: offsets, positions of landmarks; or check the "
            "inputs and weights of its network.",
            prior=-0.6,
        ),
        Cause(
            f"measurement.{modality}.jacobian",
            f"Jacobian of the measurement function of {name} wrong",
            (
                Symptom(
                    f"measurement jacobian/{modality}/*",
                    otherwise=(Symptom(f"correction slope/{modality}/*", -1, target="mirrored"),),
                ),
            ),
            f"{JACOBIANS}|dynamics slope/*|measurement function/*|process noise/*|{FILTER}",
            f"Compare the Jacobian of {name} with finite differences of h: signs, columns, units; and its gain's sign.",
        ),
    )


def _of_updates(modality: str) -> tuple[Cause, ...]:
    """Causes in the updates with a modality: their innovations, gains and steps."""
    name = display_name(modality)
    return (
        Cause(
            f"updates.{modality}.gain",
            f"Gain of updates with {name} too small",
            (Symptom(f"correction slope/{modality}/*", -1, target="shrunk"),),
            f"{JACOBIANS}|process noise/*|{FILTER}",
            f"Compare the gain of {name} with P Hᵀ S⁻¹.",
            raises="measurement noise/*",
        ),
        Cause(
            f"likelihood.{modality}.inverted",
            f"Likelihood of {name} inverted: it grows with the error",
            (Symptom(f"inverted likelihood/{modality}/*"),),
            f"measurement noise/{modality}/*|measurement function/*|{FILTER}",
            f"Check the sign of the log-likelihood of {name}.",
        ),
        Cause(
            f"innovation.{modality}.turns",
            f"Innovations of {name} not wrapped",
            (Symptom(f"innovation turns/{modality}/*"),),
            # A turn moves the state, at which the updates with other sensors and the next step then are.
            f"{JACOBIANS}|{DYNAMICS}|innovation spread/*|innovation offset/*|innovation drift/*"
            "|measurement function/*|measurement noise/*",
            "Wrap differences of angles to -180 to 180 degrees.",
        ),
        Cause(
            f"updates.{modality}.missing",
            f"Updates with {name} missing",
            (Symptom(f"updates/{modality}/*", -1),),
            f"covariance update/*|measurement noise//*|measurement noise/{modality}/*|{FILTER}",
            "Check the gate of the filter, and when it updates.",
        ),
        Cause(
            f"updates.{modality}.absent",
            f"Updates with {name} where it has no reading",
            (Symptom(f"absent updates/{modality}/*", 1),),
            f"{JACOBIANS}|{DYNAMICS}|lag/dynamics/*|process noise/*|measurement noise/*|measurement function/*"
            f"|{FILTER}",
            f"Update with {name} only at steps with a reading: observations of a masked sensor have its mask.",
        ),
    )
