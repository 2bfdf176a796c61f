"""What a task is: the state, the sensors, and how a trajectory is shown again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import one_of

if TYPE_CHECKING:
    from beliefscope.datasets.simulation.camera import Camera

Unit = Literal["m", "rad"]
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Component:
    """One component of the state; those in rad are angles."""

    name: str
    unit: Unit


@dataclass(frozen=True)
class Ghost:
    """The object at given states, to draw: true or estimated.

    Attributes:
        position: (..., 3) m, world: the object's centre. wxyz: (..., 4) its orientation.
        size: (3,) m, along its own axes.
        anchor: (..., 3) m, world: the point whose x and y are the map components (the hinge), where it is best seen.
        shape: a cylinder stands along its own z; the first two sizes are its diameter.
    """

    position: Array
    wxyz: Array
    size: tuple[float, float, float]
    anchor: Array
    shape: Literal["box", "cylinder"] = "box"


@dataclass(frozen=True)
class Task:
    """A state-estimation task.

    Attributes:
        name: key in ``TASKS``.
        components: of the state, in order; n of them.
        observations: observation key -> shape of one step, e.g. ``{"image": (32, 32), "force": (3,)}``.
        modalities: modality -> its observation keys. A modality is either one picture or vectors to be joined.
        control_size: length of the control vector.
        dt: seconds a step.
        map_components: the two components that span the likelihood map (x to the right, y up).
        map_half_width: half the side of the map, m.
        positions: observation key, or ``control`` -> the two channels that are x and y of a place in the frame of the
            map components: shift these and the map components alike, and nothing else that is felt changes.
        replay: builds the ``mujoco.MjModel`` of an episode, whose ``qpos`` it replays; None where there is no replay.
        ghost: states (..., n) -> ``Ghost``, to draw true and estimated objects; None where there is nothing to draw.
        camera: which took the pictures; None where that is not known.
        simulate: (seed, index, steps) -> that episode of the collection with that seed; None where the task cannot be
            simulated.
    """

    name: str
    components: tuple[Component, ...]
    observations: Mapping[str, tuple[int, ...]]
    modalities: Mapping[str, tuple[str, ...]]
    control_size: int
    dt: float
    map_components: tuple[str, str]
    map_half_width: float
    positions: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    replay: Callable[[Episode], Any] | None = None
    ghost: Callable[[ArrayLike], Ghost] | None = None
    camera: Camera | None = None
    simulate: Callable[[int, int, int], Episode] | None = None

    def index(self, component: str) -> int:
        """Position of a component in the state vector. Raises BadInput for an unknown name."""
        names = [c.name for c in self.components]
        if component not in names:
            raise one_of(f"component of task {self.name!r}", component, names)
        return names.index(component)

    @property
    def map_indices(self) -> tuple[int, int]:
        """Positions of the two map components in the state vector."""
        return self.index(self.map_components[0]), self.index(self.map_components[1])
