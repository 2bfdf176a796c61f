"""Outlines of simulated and recorded objects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Outline:
    """Outline of the object at true or estimated states, for drawing.

    Attributes:
        position: (..., 3) m, world: centre of the object. wxyz: (..., 4) orientation, quaternion.
        size: (3,) m, along the object's axes.
        anchor: (..., 3) m, world: visible point whose x and y are the map components (the hinge).
        shape: a cylinder's axis is z and its first two sizes are the diameter.
    """

    position: Array
    wxyz: Array
    size: tuple[float, float, float]
    anchor: Array
    shape: Literal["box", "cylinder"] = "box"
