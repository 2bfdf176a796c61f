"""A run as one HTML file that works offline: timeline, maps, scene, images and diagnosis under one cursor."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup
from numpy.typing import NDArray

from beliefscope import __version__
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.text import typeset
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnosis.cause import probability_text
from beliefscope.inspect.diagnosis.diagnose import preliminary
from beliefscope.inspect.figures.top_view import scene_footprints
from beliefscope.inspect.maps.availability import no_maps
from beliefscope.inspect.maps.map_engine import COARSE, MapEngine
from beliefscope.inspect.palette import colour, colour_table
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.provenance import describe
from beliefscope.inspect.traces.sensors import displayed_sensors, sensor_pixels

FOLDER = Path(__file__).parent

MAP_BYTES = 4_000_000
"""Maximum size of all maps; longer runs have maps of every second step, of every third, ..."""

SCENE_STEPS = 400
"""Maximum number of steps with a drawing of the scene."""

MOMENTS = 5
"""Number of listed steps with the largest errors."""


def write_interactive(
    trace: Trace,
    path: Path,
    checkpoint: Checkpoint | None = None,
    size: int = COARSE,
    progress: Callable[[float], None] | None = None,
) -> None:
    """Write the file. Maps and diagnosis need the checkpoint; what is missing is left out, with the reason.

    Args:
        size: cells per side of a map. progress: called with the completed fraction.
    """
    report = progress or (lambda fraction: None)
    run = run_document(trace, checkpoint, size, report)
    script = f"{(FOLDER / 'viewer.js').read_text()}\nopenPage();\n"
    page = _template("page.html.j2").render(
        title=run["title"],
        style=Markup(style()),
        script=Markup(script),
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        run=Markup(as_text(run).replace("<", "\\u003c")),
        **_texts(trace, checkpoint),
    )
    write_atomically(path, page.encode())
    report(1.0)


def run_document(
    trace: Trace, checkpoint: Checkpoint | None, size: int, progress: Callable[[float], None]
) -> dict[str, Any]:
    """Everything that ``viewer.js`` draws, as JSON values: type ``Run`` there."""
    maps, reason = _maps(trace, checkpoint, size, progress)
    return {
        "title": _title(trace),
        "dt": trace.episode.dt,
        "times": None if trace.episode.time is None else trace.episode.time.round(4).tolist(),
        "steps": len(trace),
        "layers": [_layer(trace, name) for name in measures.layers(trace)],
        "truth": colour("truth", trace.modalities),
        "components": _components(trace),
        "error": _error(trace),
        "weights": _weights(trace),
        "bands": [{"name": name, "mask": _packed(mask)} for name, mask in measures.shaded_groups(trace).items()]
        + [{"name": "blackout", "mask": _packed(measures.blackout(trace))}],
        "images": _images(trace),
        "scene": _scene(trace),
        "maps": maps,
        "no_maps": reason,
        "palette": _packed(colour_table("viridis")),
        "moments": _moments(trace),
    }


def as_text(run: dict[str, Any]) -> str:
    """JSON of ``run_document``."""
    return json.dumps(run, separators=(",", ":"), allow_nan=False)


def body(trace: Trace, checkpoint: Checkpoint | None) -> str:
    """HTML of the elements that ``viewer.js`` fills."""
    return _template("body.html.j2").render(title=_title(trace), **_texts(trace, checkpoint))


def style() -> str:
    """Style sheet of the elements."""
    return (FOLDER / "viewer.css").read_text()


def _title(trace: Trace) -> str:
    return repr(trace)[len("<Trace: ") : -1]


def _texts(trace: Trace, checkpoint: Checkpoint | None) -> dict[str, Any]:
    provenance = describe(trace) | {"faults": str(trace.faults) or "none"}
    return {"version": __version__, "diagnosis": _diagnosis(trace, checkpoint), "provenance": provenance}


def write_index(files: Sequence[tuple[Path, Trace]], path: Path) -> None:
    """Write a page that lists files of ``write_interactive`` in the same folder, with the error of each run."""
    rows = []
    for file, trace in files:
        error, main = measures.main_error(trace)[measures.counted(trace), -1], trace.task.main_error
        rows.append(
            {
                "file": file.name,
                "run": describe(trace) | {"faults": str(trace.faults)},
                "rmse": main.text(float(np.sqrt(np.mean(error**2)))),
                "worst": main.text(float(error.max())),
            }
        )
    write_atomically(path, _template("index.html.j2").render(rows=rows, version=__version__).encode())


def _template(name: str) -> Template:
    environment = Environment(loader=FileSystemLoader(FOLDER), autoescape=True, undefined=StrictUndefined)
    environment.filters["typeset"] = typeset
    return environment.get_template(name)


def _layer(trace: Trace, name: str) -> dict[str, str]:
    return {"name": name, "label": measures.layer_label(name), "colour": colour(name, trace.modalities)}


def _components(trace: Trace) -> list[dict[str, Any]]:
    """Truth, and mean and standard deviation (T, L) of each component, in units for display."""
    means = trace.task.near(measures.means(trace), trace.episode.states[:, None])
    covariances = measures.covariances(trace)
    std = measures.root(np.diagonal(covariances, axis1=-2, axis2=-1))
    return [
        {
            "label": component.label,
            "unit": component.conversion[0],
            "truth": _numbers(component.conversion[1] * trace.episode.states[:, i]),
            "mean": _numbers(component.conversion[1] * means[..., i].T),
            "std": _numbers(component.conversion[1] * std[..., i].T),
        }
        for i, component in enumerate(trace.task.components)
    ]


def _error(trace: Trace) -> dict[str, Any]:
    main = trace.task.main_error
    return {"label": main.name, "unit": main.unit, "values": _numbers(main.factor * measures.main_error(trace).T)}


def _weights(trace: Trace) -> dict[str, Any] | None:
    """Effective weights (K, T), else raw ones; None for filters that do not fuse."""
    weights = trace.effective_weights if trace.effective_weights is not None else trace.weights
    if weights is None or not trace.modalities:
        return None
    kind = "effective weight" if trace.effective_weights is not None else "weight beta"
    colours = [colour(name, trace.modalities) for name in trace.modalities]
    values = _numbers(weights.mean(-1).T)
    return {"label": kind, "names": list(trace.modalities), "colours": colours, "values": values}


def _images(trace: Trace) -> list[dict[str, Any]]:
    """Images as the filter received them, gray or RGB, and arrays as gray levels, T x H x W x channels."""
    images = []
    for sensor in displayed_sensors(trace):
        if not sensor.points:
            size = {"height": sensor.height, "width": sensor.width, "channels": sensor.channels}
            name = sensor.name if sensor.low is None else f"{sensor.name}, {sensor.low:.3g} to {sensor.high:.3g}"
            images.append({"name": name, **size, "data": _packed(sensor_pixels(trace, sensor.name))})
    return images


def _scene(trace: Trace) -> dict[str, Any] | None:
    """Footprints of robot and objects in cm, and the estimates there; None if the episode cannot be replayed."""
    task = trace.task
    if task.floor is None or not scene_footprints(trace, task, 0):
        return None
    stride = -(-len(trace) // SCENE_STEPS)
    steps = []
    for step in range(0, len(trace), stride):
        shapes = scene_footprints(trace, task, step)
        steps.append([[_hex(shape.rgb), np.round(shape.outline, 1).ravel().tolist()] for shape in shapes])
    places = 100.0 * measures.means(trace)[..., list(task.floor)]
    truth = 100.0 * trace.episode.states[:, list(task.floor)]
    return {"stride": stride, "steps": steps, "places": _numbers(places), "truth": _numbers(truth)}


def _maps(
    trace: Trace, checkpoint: Checkpoint | None, size: int, progress: Callable[[float], None]
) -> tuple[dict[str, Any] | None, str]:
    """Maps as bytes (steps, L, R, S) relative to the maximum of each layer; None with the reason if there are none.

    A step without a map has zeros.
    """
    if checkpoint is None:
        return None, "maps need the filter: its checkpoint, or --filter FILE.py:FUNCTION"
    if reason := no_maps(checkpoint, trace):
        return None, reason
    engine = MapEngine(checkpoint, trace)
    first = next(engine.maps(range(len(trace)), size))
    stride = -(-len(trace) * first.log_likelihood.size // MAP_BYTES)
    layers, centres = [], []
    for step in range(0, len(trace), stride):
        maps = [*engine.maps([step], size)]
        layers += [map_.normalised() for map_ in maps] or [np.zeros(first.log_likelihood.shape, np.uint8)]
        centres.append(trace.anchors[step][list(first.components)])
        progress(step / len(trace))
    components = [trace.task.components[i] for i in first.components]
    factors = np.array([component.conversion[1] for component in components])
    places = factors * measures.means(trace)[..., list(first.components)]
    sides = [first.offsets_x] if first.is_curve else [first.offsets_x, first.offsets_y]
    return {
        "title": first.title,
        "stride": stride,
        "layers": [_layer(trace, name) for name in first.layers],
        "shape": list(first.log_likelihood.shape),
        "axes": [f"{c.label} ({c.conversion[0]})" for c in components],
        "reach": [float(f * 0.5 * (o[-1] - o[0]) * len(o) / (len(o) - 1)) for f, o in zip(factors, sides, strict=True)],
        "centres": _numbers(factors * np.stack(centres)),
        "places": _numbers(places),
        "truth": _numbers(factors * trace.episode.states[:, list(first.components)]),
        "data": _packed(np.stack(layers)),
    }, ""


def _moments(trace: Trace) -> list[dict[str, Any]]:
    """Steps with the largest errors of the fused estimate, at least a twentieth of the run apart, largest first."""
    main, error = trace.task.main_error, measures.main_error(trace)[:, -1].copy()
    apart = max(1, len(trace) // 20)
    moments: list[dict[str, Any]] = []
    while len(moments) < MOMENTS and np.isfinite(error).any():
        step = int(np.nanargmax(error))
        moments.append({"step": step, "error": main.text(float(error[step]))})
        error[max(0, step - apart) : step + apart + 1] = np.nan
    return moments


def _diagnosis(trace: Trace, checkpoint: Checkpoint | None) -> dict[str, Any]:
    """Preliminary headline, and causes with probability and evidence; a filter without a healthy record has neither."""
    if checkpoint is None or trace.settings.get("edits") or trace.settings.get("standalone"):
        return {"headline": "", "causes": []}
    try:
        result = preliminary(checkpoint, trace)
    except BadInput:
        return {"headline": "", "causes": []}
    causes = [
        {
            "title": candidate.cause.title,
            "name": candidate.cause.name,
            "probability": probability_text(candidate.probability),
            "evidence": [{"text": e.text, "step": e.step} for e in candidate.evidence],
        }
        for candidate in result.listed[:MOMENTS]
    ]
    return {"headline": result.headline, "causes": causes}


def _packed(values: NDArray[Any]) -> str:
    """Bytes in base64."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=np.uint8).tobytes()).decode()


def _numbers(values: NDArray[Any]) -> Any:
    """Nested lists with five digits; None for missing numbers."""
    rounded = np.array([f"{value:.5g}" for value in values.ravel()], dtype=np.float64).reshape(values.shape)
    plain = np.where(np.isfinite(rounded), rounded.astype(object), np.array(None))
    return plain.tolist()


def _hex(rgb: NDArray[Any]) -> str:
    return "#" + bytes(np.rint(255 * np.clip(rgb, 0, 1)).astype(np.uint8)).hex()
