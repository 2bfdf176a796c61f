"""Definition of a task: state, sensors and replay."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefscope.datasets import rotations
from beliefscope.datasets.covariate import Covariate
from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.ingredient import Ingredient
from beliefscope.datasets.simulation.camera import Camera
from beliefscope.datasets.simulation.outline import Outline
from beliefscope.datasets.text import capitalised

SENSOR_UNITS = {"force": "N", "torque": "N m", "effector_position": "m"}
"""Observation key -> unit of its channels, for sensors that several tasks have."""

DISPLAY_UNITS = {"m": ("cm", 100.0), "rad": ("deg", 180.0 / np.pi), "1": ("", 1.0)}
"""SI unit -> unit for display, and the factor; none for the unit 1."""

HALF_WIDTHS = {"m": 0.135, "rad": 0.5}
"""Unit -> default of ``Task.map_half_width``; 1 in other units."""

LARGE = 5.0  # m: half width of a map from which lengths are displayed in m instead of cm

LENGTHS = ("m", "km", "dm", "cm", "mm", "um", "nm", "px")
"""Units of a position."""

Array = NDArray[np.float64]


def display_unit(unit: str) -> tuple[str, float]:
    """Unit for display, and the factor from the SI unit: cm, degrees, else the unit itself."""
    return DISPLAY_UNITS.get(unit, (unit, 1.0))


def with_unit(title: str, unit: str) -> str:
    """A title followed by its unit: ``speed (m/s)``; the title itself without a unit."""
    return f"{title} ({unit})" if unit else title


def display_name(name: str) -> str:
    """A name with spaces instead of underscores: ``hinge x``."""
    return name.replace("_", " ")


def axis_name(key: str, i: int, count: int) -> str:
    """Name of a channel: ``force x``, or a number from 0 where there are more than three; of a scalar, the key."""
    return key if count == 1 else f"{key} {'xyz'[i] if count <= 3 else i}"


@dataclass(frozen=True)
class Component:
    """A state component, or a channel of a sensor.

    Attributes:
        unit: of its values: ``rad`` for an angle, ``m``, or any other text, such as ``m/s``.
        static: whether it is constant in every episode.
        display: unit for display and its factor, such as ``("km/h", 3.6)``. Default: cm, degrees, else the unit; m
            instead of cm in a task with a map of 10 m or more.
        rotation: name of the rotation whose vector it is a component of; see ``rotation``.
        wraps: whether an angle's values jump by a turn, such as a heading from -pi to pi. Built-in filters then
            estimate its sine and cosine; other angles are numbers to them, such as the opening angle of a door.
    """

    name: str
    unit: str
    static: bool = False
    display: tuple[str, float] | None = None
    rotation: str = ""
    wraps: bool = False

    @property
    def conversion(self) -> tuple[str, float]:
        """Unit for display, and the factor from ``unit``."""
        return self.display or display_unit(self.unit)

    @property
    def key(self) -> str:
        """Name with the unit for display, such as ``hinge_x_cm``."""
        return f"{self.name}_{self.conversion[0]}".rstrip("_")

    @property
    def label(self) -> str:
        """Display name, such as ``hinge x``."""
        return display_name(self.name)

    def to_json(self) -> dict[str, Any]:
        """Name, unit, and unit for display with its factor, for displays."""
        unit, scale = self.conversion
        return {"name": self.name, "unit": self.unit, "display_unit": unit, "scale": scale}


def rotation(name: str) -> tuple[Component, Component, Component]:
    """Three components of a rotation in space: its rotation vector in rad, body to world (``datasets/rotations.py``).

    States and estimates may have its unit quaternion (w, x, y, z) in their place. Errors and covariances of the
    components are those of the rotation from the true to the estimated orientation, in the true body axes.
    """
    x, y, z = (Component(f"{name}_{axis}", "rad", rotation=name) for axis in "xyz")
    return x, y, z


@dataclass(frozen=True)
class MainError:
    """The one error that a run is summarised by: that of the position, or of another map component.

    Attributes:
        name: ``position``, the name of a rotation, or the labels of the components.
        unit, factor: for display, and the factor from the unit of the components.
        indices: of the components in the state: those of the map if they share a unit, else the first one; all three
            of a rotation that the first one belongs to.
    """

    name: str
    unit: str
    factor: float
    indices: tuple[int, ...]

    @property
    def key(self) -> str:
        """Name in metrics, such as ``position_cm``."""
        return f"{self.name.replace(' ', '_')}_{self.unit}".rstrip("_")

    @property
    def label(self) -> str:
        """Title with the unit, such as ``position (cm)``."""
        return with_unit(self.name, self.unit)

    def norm(self, difference: NDArray[Any]) -> NDArray[Any]:
        """(...) length of differences of states (..., n), not in units for display."""
        return np.asarray(np.linalg.norm(difference[..., list(self.indices)], axis=-1))

    @property
    def conversion(self) -> tuple[str, float]:
        """Unit for display, and its factor."""
        return self.unit, self.factor

    @property
    def title(self) -> str:
        """Name at the start of a sentence."""
        return capitalised(self.name)

    def text(self, value: float, digits: int = 2) -> str:
        """A value as displayed: ``1.25 cm``."""
        return f"{self.factor * value:z.{digits}f} {self.unit}".rstrip()


def _in_metres(components: Iterable[Component]) -> tuple[Component, ...]:
    """Lengths in m, which are displayed in m unless they have a unit for display."""
    return tuple(replace(c, display=c.display or ("m", 1.0)) if c.unit == "m" else c for c in components)


@dataclass(frozen=True)
class Task:
    """A state-estimation task. Tasks with the same definition and functions are equal.

    Attributes:
        name: without spaces, colons and slashes.
        components: n state components, in order.
        observations: observation key -> shape per step, e.g. ``{"image": (32, 32), "force": (3,)}``: (d,) a vector,
            (H, W) a gray and (H, W, 3) an RGB image.
        modalities: modality -> its observation keys. The built-in networks take one gray image, or vectors.
        control_size: length of the control vector; 0 without controls.
        dt: seconds per step.
        map_components: the two components of the likelihood map (x to the right, y up), or one, whose map is a curve.
            ``main_error`` is the error in them. Default: the first two if they have the same unit, else the first.
        map_half_width: half the extent of the map, in the unit of the first of them. Default: ``HALF_WIDTHS``.
        positions: observation key or ``control`` -> its two channels that are x and y in the frame of the map
            components. Shifting them together with the map components leaves all other readings unchanged.
        replay: builds the ``mujoco.MjModel`` for the ``qpos`` of an episode; None without replay.
        outline: states (..., n) -> ``Outline`` of the object; None if it cannot be drawn.
        camera: camera of the images; None if unknown.
        ridge_direction: states (..., n) -> (...,) rad from the x axis of the map: direction along which the vectors
            (haptics) in contact do not determine the position, so that their likelihood has a ridge; None if there is
            no such direction.
        simulate: (seed, index, steps) -> episode ``index`` of the collection with this seed; None for recorded tasks.
            With ingredients, it also takes ``without``: names of those to switch off.
        ingredients: name -> what varies between simulated episodes; their values are in each episode's provenance.
        start_distance: unit -> range of the distance between the first belief's mean and the true state; units that
            are missing start at the truth. An episode's provenance has the difference, ``start_offset``.
        covariates: name -> what is known about each step besides state and sensors; metrics are grouped by it. The
            values of ``contact`` are in ``Episode.contact``, others in ``Episode.covariates``.
        arrays: observation keys with several axes that are arrays of numbers instead of images, such as depth, tactile
            grids and spectrograms.
        scans: observation key -> angles of the first and the last of the ranges (d,) of a planar lidar, in rad and m;
            beams are equally spaced, from x towards y of the sensor's frame.
        clouds: observation keys of point clouds (P, 2) or (P, 3), in m, which may have more columns. Points at zero are
            absent, as are ranges of scans that are not above 0.
        channels: observation key of a vector (d,) or ``control`` -> names and units of its d channels, such as
            ``(Component("range", "m"), Component("bearing", "rad"))``. Default: x, y and z, or numbers, without a unit.
        periods: observation key -> s between the readings of a sensor that is slower than the steps and repeats its
            last reading, so that these repetitions are no fault.
        masks: observation key -> boolean covariate that is 1 at the steps with a reading, of a sensor whose readings
            are absent at other steps, which repeat the last one (``Episode.present``).
        warmup: first steps that are excluded from metrics, because runs start at the truth.
    """

    name: str
    components: tuple[Component, ...]
    observations: Mapping[str, tuple[int, ...]]
    modalities: Mapping[str, tuple[str, ...]]
    control_size: int
    dt: float
    map_components: tuple[str, ...] = ()
    map_half_width: float = math.nan
    positions: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    replay: Callable[[Any], Any] | None = None
    outline: Callable[[ArrayLike], Outline] | None = None
    camera: Camera | None = None
    ridge_direction: Callable[[ArrayLike], Array] | None = None
    simulate: Callable[..., Any] | None = None
    ingredients: Mapping[str, Ingredient] = field(default_factory=dict)
    start_distance: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    warmup: int = 30
    covariates: Mapping[str, Covariate] = field(default_factory=dict)
    arrays: tuple[str, ...] = ()
    periods: Mapping[str, float] = field(default_factory=dict)
    masks: Mapping[str, str] = field(default_factory=dict)
    scans: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    clouds: tuple[str, ...] = ()
    channels: Mapping[str, tuple[Component, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Fill in the default map, and the unit for display of lengths in a large space."""
        if wrong := [c for c in chain(self.components, *self.channels.values()) if not isinstance(c, Component)]:
            raise BadInput(f'task {self.name!r:.200}: component {wrong[0]!r:.200}, expected Component("x", "m").')
        if not self.map_components:
            first = self.components[:2]
            alike = [c.name for c in first if c.unit == first[0].unit]
            object.__setattr__(self, "map_components", tuple(alike))  # tasks are frozen
        if math.isnan(self.map_half_width) and self.map_components:
            units = [c.unit for c in self.components if c.name == self.map_components[0]]
            object.__setattr__(self, "map_half_width", HALF_WIDTHS.get(units[0], 1.0) if units else 1.0)
        lengths = [c.name for c in self.components if c.unit == "m"]
        if self.map_half_width >= LARGE and any(name in lengths for name in self.map_components):
            object.__setattr__(self, "components", _in_metres(self.components))
            object.__setattr__(self, "channels", {key: _in_metres(each) for key, each in self.channels.items()})

    def __hash__(self) -> int:
        return hash(self.name)

    def __deepcopy__(self, memo: Mapping[int, Any]) -> Task:
        """The task itself, which never changes."""
        return self

    def dtype(self, key: str) -> type[np.uint8] | type[np.float32]:
        """Type of an observation's values: uint8 for images, else float32."""
        is_array = len(self.observations[key]) == 1 or key in (*self.arrays, *self.clouds)
        return np.float32 if is_array else np.uint8

    def channel(self, key: str, i: int) -> Component:
        """Channel i of a vector observation or the controls, with its unit; its name starts with the key."""
        size = self.control_size if key == "control" else self.observations[key][0]
        if key not in self.channels:
            return Component(axis_name(key, i, size), SENSOR_UNITS.get(key, ""))
        channel = self.channels[key][i]
        return replace(channel, name=key if size == 1 else f"{key} {channel.name}")

    def vector_channels(self) -> list[Component]:
        """All channels of vector observations."""
        sizes = {key: shape[0] for key, shape in self.observations.items() if len(shape) == 1}
        return [self.channel(key, i) for key, size in sizes.items() for i in range(size)]

    @property
    def images(self) -> tuple[str, ...]:
        """Keys of the observations that are images."""
        return tuple(key for key in self.observations if self.dtype(key) is np.uint8)

    def held_steps(self, key: str) -> int:
        """Consecutive repetitions of an observation that its period explains: one missed reading included."""
        return math.ceil(2.0 * self.periods.get(key, 0.0) / self.dt)

    def index(self, component: str) -> int:
        """Index of a component in the state vector. Raises BadInput for an unknown name."""
        names = [c.name for c in self.components]
        if component not in names:
            raise unknown_name(f"component of task {self.name!r}", component, names)
        return names.index(component)

    @property
    def angles(self) -> tuple[int, ...]:
        """Indices of the components in rad, whose differences are modulo a turn; those of rotations too."""
        return tuple(i for i, component in enumerate(self.components) if component.unit == "rad")

    @property
    def rotations(self) -> tuple[slice, ...]:
        """Where the vector of each rotation is in the state."""
        names = [component.rotation for component in self.components]
        return tuple(slice(names.index(name), names.index(name) + 3) for name in dict.fromkeys(names) if name)

    def states(self, values: NDArray[Any]) -> NDArray[Any]:
        """States (..., n) of values that may have a unit quaternion (w, x, y, z) in place of each rotation vector.

        Values (..., n) are returned unchanged, others have one number more for each rotation. Raises BadInput for a
        quaternion whose norm is not 1 within 1 %.
        """
        if not self.rotations or np.ndim(values) == 0 or values.shape[-1] != len(self.components) + len(self.rotations):
            return values
        parts: list[NDArray[Any]] = []
        start = 0
        for where in self.rotations:
            first = where.start + len(parts) // 2  # each rotation before has one number more
            quaternion = values[..., first : first + 4]
            norm = np.linalg.norm(quaternion, axis=-1)
            if (np.abs(norm - 1.0) > 0.01).any():
                worst = norm.flat[np.nanargmax(np.abs(norm - 1.0))]
                name = self.components[where.start].rotation
                raise BadInput(f"quaternion of {name!r} has norm {worst:.4g}, expected 1: (w, x, y, z)")
            parts += [values[..., start:first], rotations.to_vector(quaternion)]
            start = first + 4
        return np.concatenate([*parts, values[..., start:]], axis=-1)

    def difference(self, states: NDArray[Any], reference: NDArray[Any]) -> Array:
        """(..., n) differences of states, angles wrapped to -pi..pi; of rotations, see ``rotations.difference``."""
        change = np.array(states - reference, dtype=np.float64)
        angles = list(self.angles)
        change[..., angles] = (change[..., angles] + np.pi) % (2.0 * np.pi) - np.pi
        for where in self.rotations:
            change[..., where] = rotations.difference(states[..., where], reference[..., where])
        return change

    def moved(self, states: NDArray[Any], change: NDArray[Any]) -> Array:
        """(..., n) states whose ``difference`` from these is the change; angles are not wrapped."""
        result = np.array(states + change, dtype=np.float64)
        for where in self.rotations:
            result[..., where] = rotations.add(states[..., where], change[..., where])
        return result

    def near(self, states: NDArray[Any], reference: NDArray[Any]) -> NDArray[Any]:
        """States (..., n) to display beside a reference: angles of the same turn, rotation vectors plus the difference.

        So states do not jump where the reference does not, and their errors are those of ``difference``. Where the
        reference is unknown, and without angles, states are unchanged.
        """
        if not self.angles:
            return states
        angles = [i for i in self.angles if not self.components[i].rotation]
        result = np.array(states)
        turns = np.nan_to_num(np.rint((reference[..., angles] - result[..., angles]) / (2.0 * np.pi)))
        result[..., angles] += 2.0 * np.pi * turns
        for where in self.rotations:
            base = np.broadcast_to(reference[..., where], result[..., where].shape)
            moved = base + rotations.difference(result[..., where], base)
            result[..., where] = np.where(np.isnan(base), result[..., where], moved)
        return result

    def start_variance(self) -> Array:
        """(n,) mean square of each component's start offset, SI units; NaN for components that start at the truth.

        A uniform distance from a to b has the mean square (a^2 + a b + b^2) / 3, shared by the d components of a unit.
        """
        units = [component.unit for component in self.components]
        ends = np.array([self.start_distance.get(unit, (np.nan, np.nan)) for unit in units])
        a, b = ends.T
        return (a**2 + a * b + b**2) / 3.0 / [units.count(unit) for unit in units]

    def first_counted(self, steps: int) -> int:
        """First step that metrics of an episode of this length include: at least its last one."""
        return min(self.warmup, steps - 1)

    @property
    def map_indices(self) -> tuple[int, ...]:
        """Indices of the map components in the state vector."""
        return tuple(map(self.index, self.map_components))

    @property
    def main_error(self) -> MainError:
        """The error that runs are summarised by."""
        parts = [self.components[i] for i in self.map_indices]
        for where in self.rotations:
            if where.start <= self.map_indices[0] < where.stop:
                indices = tuple(range(where.start, where.stop))
                return MainError(display_name(parts[0].rotation), *parts[0].conversion, indices)
        if any((c.unit, c.conversion) != (parts[0].unit, parts[0].conversion) for c in parts):
            parts = parts[:1]
        is_position = len(parts) == 2 and parts[0].unit in LENGTHS
        name = "position" if is_position else " and ".join(c.label for c in parts)
        return MainError(name, *parts[0].conversion, self.map_indices[: len(parts)])

    @property
    def floor(self) -> tuple[int, int] | None:
        """Indices of the map components if they are a position in m, which a view of the world can contain."""
        if [self.components[i].unit for i in self.map_indices] != ["m", "m"]:
            return None
        x, y = self.map_indices
        return x, y
