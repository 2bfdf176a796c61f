"""Statistics that faults change downstream: sensors change modules, and modules the filter."""

from __future__ import annotations

FILTER = "error/*|nees/*|nis/*|autocorrelation/*|weight/*|beta/*|regret/*|ess/*|outside/*|ancestors/*|offspring/*"
"""Belief of the filter, and the use of its modules."""

WEIGHTS = f"beta logit/*|beta spread/*|beta contact/*|{FILTER}"
"""Fusion weights."""

DYNAMICS = f"dynamics */*|{FILTER}"
"""The dynamics model."""

IMAGE = f"module */*image*|lag/labels *image*|{WEIGHTS}"
"""Modules that use the image."""

HAPTICS = f"module */*haptics*|lag/labels *haptics*|{WEIGHTS}"
"""Modules that use haptics."""
