"""Steps of a trace as Rerun columns for display, derived from its arrays (``schema.SCHEMA``)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.point_clouds import point_sensors, points_of
from beliefscope.datasets.simulation.outline import Outline
from beliefscope.datasets.task import Component, Task, with_unit
from beliefscope.datasets.text import plural
from beliefscope.inspect.palette import colour
from beliefscope.inspect.statistics.measures import contours, deviations, layer_label, starts_at_truth
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.schema import STEP, TIME

Array = NDArray[Any]

CONTACT_NAMES = ("free motion", "contact")
SIGMAS = 2.0
PARTICLE_GRID, SHADES = 2.0**-13, 32
"""m and number of colours to which displayed particles are rounded: invisible, and halves the file size. The exact
particles are under ``trace/``."""

GRAY = 150.0  # of a particle without weight
ROBOT_COLOUR = "#B0B0B0"
MODALITY = "update of the fused filter's prior with this modality only, not a standalone filter; fusion weight"
KINDS = {
    "ekf": "An extended Kalman filter for each measurement model",
    "ukf": "An unscented Kalman filter for each measurement model",
    "pf": "A particle filter",
    "lstm": "An LSTM without covariance and likelihood",
    "transformer": "A transformer without covariance and likelihood",
    "external": "An external filter",
}
MEANINGS = {"truth": "true state", "fused": "estimate from all modalities", "contact": "the robot touches the object"}


def sources(trace: Trace) -> tuple[str, ...]:
    """Sources of estimates: ``fused``, then the modalities with estimates of their own."""
    return ("fused", *trace.modalities_with_posterior)


def angles(task: Task) -> tuple[Component, ...]:
    """The components that are angles."""
    return tuple(component for component in task.components if component.unit == "rad")


def positions(trace: Trace) -> Array:
    """(T, n) true states, or estimated states if unknown."""
    return trace.episode.states if has_truth(trace) else trace.estimate_mean


def has_truth(trace: Trace, steps: slice = slice(None)) -> bool:
    """Whether the true state is known at all of the steps; on a robot it may be unknown."""
    return not np.isnan(trace.episode.states[steps]).any()


def plane_height(trace: Trace, task: Task) -> float:
    """World height (m) of the plane of the displayed belief: of the object's anchor, else of the end effector."""
    if task.outline is not None:
        return float(task.outline(positions(trace)[0]).anchor[2])
    effector = trace.episode.observations.get("effector_position")
    return 0.0 if effector is None else float(effector[0, 2])


def columns(trace: Trace, task: Task, steps: slice) -> Iterator[tuple[str, Any]]:
    """Every displayed path over some steps, except maps and contact changes."""
    yield from _world(trace, task, steps)
    yield from _states(trace, task, steps)
    yield from _errors(trace, task, steps)
    for name in ("weights", "effective_weights"):
        values = getattr(trace, name)
        if values is not None:
            for k, modality in enumerate(trace.modalities):
                yield f"{name}/{modality}", series(values[steps, k])
    for key in point_sensors(task):
        if key in trace.episode.observations:
            points = points_of(task, key, trace.episode.observations[key][steps])
            present = np.isfinite(points[..., 0])
            columns_ = rr.Points3D.columns(positions=points[present])
            yield f"points/{key}", columns_.partition(present.sum(1))
    if trace.effective_sample_size is not None:
        yield "diagnostics/effective_sample_size", series(trace.effective_sample_size[steps])


def series(values: Array) -> Any:
    """Columns of (T,) or (T, S) numbers, S series in one entity, as float64."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    return rr.Scalars.columns(scalars=rows.ravel()).partition([rows.shape[1]] * len(rows))


def time_columns(episode: Episode, steps: NDArray[np.int64], offset: int = 0) -> list[rr.TimeColumn]:
    """Both timelines at some steps of an episode, whose first step is step ``offset`` of the run."""
    seconds = (steps + offset) * episode.dt if episode.time is None else episode.time[steps]
    nanoseconds, steps = np.rint(seconds * 1e9).astype("timedelta64[ns]"), steps + offset
    return [rr.TimeColumn(STEP, sequence=steps), rr.TimeColumn(TIME, duration=nanoseconds)]


def style(trace: Trace, task: Task) -> Iterator[tuple[str, Any]]:
    """Static properties: names, colours and widths of every series and marker."""
    yield "world", rr.ViewCoordinates.RIGHT_HAND_Z_UP
    on_floor = task.floor is not None
    yield "world/effector", _marker(ROBOT_COLOUR, 3.0)
    if on_floor:
        yield "world/plane", rr.Transform3D(translation=[0.0, 0.0, plane_height(trace, task)])
        yield "world/plane/truth", _marker(_hex("truth", trace), 4.0)
    if task.outline is not None:
        outline = task.outline(positions(trace)[0])
        for name in ("truth", "fused") if has_truth(trace) else ("fused",):
            yield f"world/object/{name}", _object(_hex(name, trace), outline, filled=name == "truth")
    if "contact" in task.covariates:
        colours = np.full(2, rgba(_hex("contact", trace)), np.uint32)
        yield "contact", rr.StateConfiguration(values=CONTACT_NAMES, colors=colours, visible=[False, True])
    for source in sources(trace):
        hue, width, label = _hex(source, trace), 2.5 if source == "fused" else 1.2, layer_label(source)
        if on_floor:
            yield f"world/plane/{source}/mean", _marker(hue, 3.5 if source == "fused" else 2.5)
        if on_floor and trace.has_covariance:
            yield (
                f"world/plane/{source}/ellipse",
                rr.Ellipsoids3D.from_fields(
                    colors=rgba(hue), line_radii=rr.Radius.ui_points(width), fill_mode="MajorWireframe"
                ),
            )
        yield f"errors/position/{source}", line(hue, width, with_unit(label, task.main_error.unit))
        for component in angles(task):
            yield f"errors/{component.name}/{source}", line(hue, width, f"{label} (deg)")
        for component in task.components:
            yield f"states/{component.name}/{source}", line(hue, width, label)
    for component in task.components:
        truth = line(_hex("truth", trace), 2.0, "truth")
        yield f"states/{component.name}/truth", truth
        if trace.has_covariance:
            band = ["fused - 2 sigma", "fused + 2 sigma"]
            yield f"states/{component.name}/two_sigma", line(_hex("fused", trace), 1.0, *band, opacity=0.5)
    for name in ("weights", "effective_weights"):
        values = getattr(trace, name)
        if values is None:
            continue
        for modality in trace.modalities:
            names = [modality]
            if values.shape[2] > 1:
                names = [f"{modality}, {component.label}" for component in task.components]
            # Components of a modality share its colour and differ in opacity.
            opacity = np.linspace(1.0, 0.35, len(names))
            yield f"{name}/{modality}", line(_hex(modality, trace), 2.0, *names, opacity=opacity)
    for key in point_sensors(task):
        if key in trace.episode.observations:
            yield f"points/{key}", _marker("#56b4e9", 2.0)
    if trace.log_weights is not None:
        yield "diagnostics/effective_sample_size", line(_hex("fused", trace), 1.5, "effective particles")


def contact_changes(trace: Trace, span: slice) -> tuple[NDArray[np.int64], Any]:
    """Steps at which contact begins or ends, including the trace's first step, and the columns of the states.

    None for a task without the covariate contact.
    """
    contact = trace.episode.contact
    if "contact" not in trace.task.covariates:
        return np.zeros(0, np.int64), ()
    steps = span.start + np.flatnonzero(np.concatenate([[True], contact[1:] != contact[:-1]])[span])
    return steps, rr.StateChange.columns(state=[CONTACT_NAMES[int(contact[step])] for step in steps])


def _world(trace: Trace, task: Task, steps: slice) -> Iterator[tuple[str, Any]]:
    plane = list(task.floor or ())
    truth = has_truth(trace, steps)
    if truth and plane:
        yield "world/plane/truth", rr.Points3D.columns(positions=_lift(trace.episode.states[steps][:, plane]))
    effector = trace.episode.observations.get("effector_position")
    if effector is not None:
        yield "world/effector", rr.Points3D.columns(positions=effector[steps])
    for source, mean, covariance in _estimates(trace, steps) if plane else ():
        centre = mean[:, plane]
        yield f"world/plane/{source}/mean", rr.Points3D.columns(positions=_lift(centre))
        if trace.has_covariance:
            axes, quaternions = _ellipses(covariance[:, plane][:, :, plane])
            yield (
                f"world/plane/{source}/ellipse",
                rr.Ellipsoids3D.columns(centers=_lift(centre), half_sizes=_lift(axes), quaternions=quaternions),
            )
    if task.outline is not None:
        states_by_name = {"fused": trace.estimate_mean} | ({"truth": trace.episode.states} if truth else {})
        for name, states in states_by_name.items():
            outline = task.outline(states[steps])
            archetype = rr.Cylinders3D if outline.shape == "cylinder" else rr.Boxes3D
            quaternions = np.roll(outline.wxyz, -1, axis=-1)
            yield f"world/object/{name}", archetype.columns(centers=outline.position, quaternions=quaternions)
    if plane and trace.particles is not None and trace.log_weights is not None:
        order, shades = _shades(trace.log_weights[steps], _hex("fused", trace))
        points = np.take_along_axis(trace.particles[steps][:, :, plane], order[..., None], axis=1)
        points = _lift(np.round(points / PARTICLE_GRID) * PARTICLE_GRID)
        rows, count = shades.shape
        particles = rr.Points3D.columns(positions=points.reshape(-1, 3), colors=shades.ravel())
        yield "world/plane/particles", particles.partition([count] * rows)


def _states(trace: Trace, task: Task, steps: slice) -> Iterator[tuple[str, Any]]:
    for i, component in enumerate(task.components):
        scale = component.conversion[1]
        yield f"states/{component.name}/truth", series(trace.episode.states[steps, i] * scale)
        for source, raw, covariance in _estimates(trace, steps):
            mean = task.near(raw, trace.episode.states[steps])
            yield f"states/{component.name}/{source}", series(mean[:, i] * scale)
            if source == "fused" and trace.has_covariance:
                sigma = SIGMAS * deviations(covariance)[:, i]
                band = np.stack([mean[:, i] - sigma, mean[:, i] + sigma], axis=1)
                yield f"states/{component.name}/two_sigma", series(band * scale)


def _errors(trace: Trace, task: Task, steps: slice) -> Iterator[tuple[str, Any]]:
    main = task.main_error
    for source, mean, _ in _estimates(trace, steps):
        error = task.difference(mean, trace.episode.states[steps])
        yield f"errors/position/{source}", series(main.norm(error) * main.factor)
        for component in angles(task):
            angle = np.abs(error[:, task.index(component.name)])
            yield f"errors/{component.name}/{source}", series(angle * component.conversion[1])


def _estimates(trace: Trace, steps: slice) -> Iterator[tuple[str, Array, Array]]:
    """(source, mean (T, n), covariance (T, n, n)) of the fused estimate and of each modality."""
    yield "fused", trace.estimate_mean[steps], trace.estimate_covariance[steps]
    for k, modality in enumerate(trace.modalities_with_posterior):
        yield modality, trace.modality_mean[steps, k], trace.modality_covariance[steps, k]


def _ellipses(covariance: Array) -> tuple[Array, Array]:
    """Half axes (T, 2) at ``SIGMAS`` standard deviations and quaternions (T, 4, xyzw) of covariances (T, 2, 2)."""
    axes, angle = contours(covariance)
    zero = np.zeros_like(angle)
    return SIGMAS * axes, np.stack([zero, zero, np.sin(angle / 2.0), np.cos(angle / 2.0)], axis=1)


def _lift(points: Array) -> Array:
    """(..., 2) points on the plane as (..., 3)."""
    return np.concatenate([points, np.zeros_like(points[..., :1])], axis=-1).astype(np.float32)


def _shades(log_weights: Array, hue: str) -> tuple[NDArray[np.int64], NDArray[np.uint32]]:
    """Order (T, M) of ascending weight, and RGBA (T, M) in this order.

    Colours go from gray (zero weight) to the colour (largest weight of the step).
    """
    order = np.argsort(log_weights, axis=1)
    ordered = np.take_along_axis(log_weights, order, axis=1)
    share = np.rint(SHADES * np.sqrt(np.exp(ordered - ordered[:, -1:]))).astype(np.intp)
    full = np.array([int(hue[i : i + 2], 16) for i in (1, 3, 5)], float)
    red, green, blue = np.rint(np.linspace(np.full(3, GRAY), full, SHADES + 1)).astype(np.uint32).T
    return order, (red << 24 | green << 16 | blue << 8 | np.uint32(255))[share]


def _hex(source: str, trace: Trace) -> str:
    return colour(source, trace.modalities)


def rgba(hue: str, opacity: float = 1.0) -> int:
    """``#RRGGBB`` as Rerun's 0xRRGGBBAA."""
    return int(hue[1:], 16) << 8 | round(255 * opacity)


def line(hue: str, width: float, *names: str, opacity: Array | float = 1.0) -> rr.SeriesLines:
    """Style of the series of an entity: one colour, and a name and opacity per series."""
    count = len(names)
    colours = np.array([rgba(hue, alpha) for alpha in np.broadcast_to(opacity, count)], np.uint32)
    return rr.SeriesLines(colors=colours, widths=[width] * count, names=list(names))


def _object(hue: str, outline: Outline, filled: bool) -> rr.Boxes3D | rr.Cylinders3D:
    style: dict[str, Any] = {
        "colors": rgba(hue),
        "fill_mode": "TransparentFillMajorWireframe" if filled else "MajorWireframe",
    }
    x, _, z = outline.size
    if outline.shape == "cylinder":
        return rr.Cylinders3D.from_fields(lengths=[z], radii=[x / 2.0], line_radii=rr.Radius.ui_points(1.5), **style)
    return rr.Boxes3D.from_fields(half_sizes=[np.array(outline.size) / 2.0], radii=rr.Radius.ui_points(1.5), **style)


def _marker(hue: str, points: float) -> rr.Points3D:
    return rr.Points3D.from_fields(colors=rgba(hue), radii=rr.Radius.ui_points(points))


def about(trace: Trace, task: Task, steps: int) -> rr.TextDocument:
    """Description of the recording for its viewers.

    Args:
        trace: some steps of the run.
        steps: number of all steps; negative if not known yet.
    """
    modalities = " and ".join(task.modalities if not trace.modalities else trace.modalities).replace("+", " with ")
    weighted = ". It weights its modalities at every step" if trace.weights is not None else ""
    components = ", ".join(component.label for component in task.components)
    main = task.main_error
    mapped = [task.components[i] for i in task.map_indices]
    extent = " and ".join(f"{c.label} {main.text(2 * task.map_half_width, 0)}" for c in mapped[: len(main.indices)])
    units = ", ".join(with_unit(c.label, c.conversion[0]) for c in task.components)
    contours_of = " and ".join(c.label for c in mapped)
    names = ("truth", "fused", *trace.modalities, "contact")
    legend = "\n".join(f"| {name} | {_hex(name, trace)} | {MEANINGS.get(name, MODALITY)} |" for name in names)
    length = plural(steps, "step") if steps >= 0 else "a live run, in steps"
    start = "The true state is unknown"
    if has_truth(trace):
        start = f"It starts {'at the true state' if starts_at_truth(trace) else 'at an offset from the true state'}"
    faults = f"\nSensor faults: `{trace.faults}`.\n" if trace.faults else ""
    text = f"""# {task.name}, episode {trace.episode_index}, {trace.filter}

{KINDS[trace.kind]} estimates {components} from {modalities}: {length} of
{trace.episode.dt:g} s. {start}{weighted}.
{faults}
| name | colour | meaning |
| --- | --- | --- |
{legend}

* **Scene**: the true and the estimated pose of the object. Contours are 2 sigma in
  {contours_of}. Brighter particles have larger weights. Gray: the end
  effector and its recent path.
* **Likelihood maps**: likelihood or posterior (see the titles) of states around the true one, relative to the
  maximum of each map; {mapped[0].label} to the right. Extent: {extent}. Squares
  frame the true state (large) and the estimate (small).
* **Plots**: {units}. Thin lines around the fused estimate are the 2 sigma band.

* checkpoint `{trace.checkpoint_hash or "unknown"}`
* data `{trace.data_hash or "unknown"}`
* seed {trace.seed}
"""
    return rr.TextDocument(text, media_type="text/markdown")
