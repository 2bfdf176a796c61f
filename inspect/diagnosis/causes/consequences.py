"""Statistics that faults change downstream: sensors change modules, and modules the filter."""

from __future__ import annotations

FILTER = (
    "error/*|angle error/*|component error/*|nees/*|nis/*|autocorrelation/*|weight/*|beta/*|regret/*|ess/*|outside/*"
    "|ancestors/*|offspring/*|updates/*|innovation bias/*|innovation std/*|innovation share/*|likelihood offset/*"
)
"""Belief of the filter, and the use of its modules."""

WEIGHTS = f"beta logit/*|beta spread/*|beta contact/*|{FILTER}"
"""Fusion weights."""

DYNAMICS = f"dynamics */*|{FILTER}"
"""The dynamics model."""

LABELS = "lag/labels*|offset/labels*"
"""Labels against the modalities."""

CONTACT_DISTANCE = "contact distance*/*"
"""Hand against the labelled object in contact, which no image and no module changes."""

IMAGE = f"module */*image*|{LABELS}|{WEIGHTS}"
"""Modules that use the image."""

IMPEDANCE = "offset/control*|compliance/force*|following/control*"
"""How the measured hand follows its set point under the measured force."""

HAPTICS = f"module */*haptics*|{LABELS}|{WEIGHTS}"
"""Modules that use haptics."""
