"""Statistics that faults change downstream: sensors change modules, and modules the filter."""

from __future__ import annotations

FILTER = (
    "error/*|angle error/*|component error/*|nees/*|nis/*|autocorrelation/*|weight/*|beta/*|regret/*|ess/*|outside/*"
    "|*ancestors/*|offspring/*|updates/*|innovation bias/*|innovation std/*|innovation share/*|belief variance/*"
)
"""Belief of the filter, and the use of its modules."""

WEIGHTS = f"beta logit/*|beta spread/*|beta contact/*|{FILTER}"
"""Fusion weights."""

MODEL_KINDS = ("likelihood offset", "likelihood width", "innovation offset", "innovation drift", "innovation spread")
"""Kinds of statistics of the measurement models of external filters, at true states."""

MODELS = "|".join(f"{kind}/*" for kind in MODEL_KINDS)
"""All measurement models of external filters."""

DYNAMICS = f"dynamics */*|{MODELS}|{FILTER}"
"""The dynamics model."""

LABELS = "lag/labels*|offset/labels*"
"""Labels against the modalities."""

CONTACT_DISTANCE = "contact distance*/*"
"""Hand against the labelled object in contact, which no image and no module changes."""


def model_of(modality: str) -> str:
    """Statistics of the measurement model of a modality."""
    return "|".join(f"{kind}/*{modality}*" for kind in ("module *", *MODEL_KINDS))


IMAGE = f"{model_of('image')}|{LABELS}|{WEIGHTS}"
"""Modules that use the image."""

IMPEDANCE = "offset/control*|compliance/force*|following/control*"
"""How the measured hand follows its set point under the measured force."""

HAPTICS = f"{model_of('haptics')}|{LABELS}|{WEIGHTS}"
"""Modules that use haptics."""
