"""Traces as the page reads them: a JSON header and little-endian float32 columns (docs/api.md)."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.app.protocol.messages import LAYERS, SceneLayer
from beliefscope.datasets.task import Task
from beliefscope.filters.evaluate import nees_bounds
from beliefscope.inspect.maps.likelihood_map import Quantity
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.channels import innovation_channels, reading_channels, residual_channels
from beliefscope.inspect.statistics.innovations import update_sizes, virtual_innovations
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.sensors import camera_images, displayed_sensors

SENSORS = ("effector_position", "force")
"""Observations from which the 3D scene draws the force."""


def columns(trace: Trace) -> tuple[list[dict[str, Any]], bytes]:
    """The trace's time series: descriptions ``{"name", "shape", "offset"}``, offset in bytes, and a float32 buffer.

    Descriptions of columns (T, d) of channels also have ``channels``: names and units of at most d channels.
    """
    reported, groups = innovation_channels(trace), measures.shaded_groups(trace)
    innovation = None if reported else virtual_innovations(trace)
    unimodal, faulty = bool(trace.modalities_with_posterior), measures.faulty(trace)
    arrays: dict[str, NDArray[Any] | None] = {
        "time": trace.episode.time,
        "truth": trace.episode.states,
        "estimate_mean": trace.task.near(trace.estimate_mean, trace.episode.states),
        "estimate_sigma": measures.deviations(trace.estimate_covariance) if trace.has_covariance else None,
        "modality_mean": trace.task.near(trace.modality_mean, trace.episode.states[:, None]) if unimodal else None,
        "modality_sigma": measures.deviations(trace.modality_covariance) if unimodal else None,
        "update_size": update_sizes(trace) if unimodal else None,
        "nees": measures.nees(trace) if trace.has_covariance else None,
        "innovation": None if innovation is None else innovation[0],
        "innovation_sigma": None if innovation is None else measures.deviations(innovation[1]),
        "weights": trace.weights,
        "effective_weights": trace.effective_weights,
        "contact": trace.episode.contact,
        "groups": np.stack(list(groups.values()), axis=1) if groups else None,
        "effective_sample_size": trace.effective_sample_size,
        "blackout": measures.blackout(trace) if camera_images(trace) is not None else None,
        "faulty": faulty if faulty.any() else None,
    }
    arrays |= {f"extra/{name}": values for name, values in trace.extra.items()}
    of_channels = reading_channels(trace) | residual_channels(trace) | reported
    arrays |= {name: values for name, (values, _) in of_channels.items()}
    descriptions: list[dict[str, Any]] = []
    buffers: list[bytes] = []
    offset = 0
    for name, array in arrays.items():
        if array is not None:
            description = {"name": name, "shape": list(array.shape), "offset": offset}
            if name in of_channels:
                description["channels"] = [channel.to_json() for channel in of_channels[name][1]]
            descriptions.append(description)
            buffers.append(np.ascontiguousarray(array, dtype="<f4").tobytes())
            offset += len(buffers[-1])
    return descriptions, b"".join(buffers)


def scene_layers(task: Task, trace: Trace, no_maps: str | None) -> list[SceneLayer]:
    """The layers that the 3D scene of a trace has."""
    on_floor = task.floor is not None
    present = {
        "replay": task.replay is not None and trace.episode.qpos.shape[1] > 0,
        "objects": task.outline is not None,
        "estimates": on_floor or task.outline is not None,
        "contours": on_floor and trace.has_covariance,
        "particles": on_floor and trace.particles is not None and trace.log_weights is not None,
        "force": trace.episode.observations.keys() >= set(SENSORS),
        "map": on_floor and no_maps is None,
        "camera": task.camera is not None and camera_images(trace) is not None,
    }
    return [layer for layer in LAYERS if present[layer]]


def header(
    trace: Trace,
    column_descriptions: list[dict[str, Any]],
    task: Task,
    no_maps: str | None,
    missing: Mapping[Quantity, str],
) -> dict[str, Any]:
    """Metadata of a trace, as in ``api.traces.TraceHeader``.

    no_maps: why there are no maps, or None. missing: quantities without maps, and the reasons.
    """
    components = [component.to_json() for component in task.components]
    return {
        "steps": len(trace),
        "first_counted": task.first_counted(len(trace)),
        "dt": trace.episode.dt,
        "kind": trace.kind,
        "filter": trace.filter,
        "episode": trace.episode_index,
        "components": components,
        "modalities": list(trace.modalities),
        "groups": list(measures.shaded_groups(trace)),
        "weight_width": 0 if trace.weights is None else trace.weights.shape[-1],
        "checkpoint_hash": trace.checkpoint_hash,
        "data_hash": trace.data_hash,
        "seed": trace.seed,
        "faults": str(trace.faults),
        "settings": dict(trace.settings),
        "nees_bounds": nees_bounds(len(components), 1) if trace.has_covariance else None,
        "no_maps": no_maps,
        "missing_quantities": dict(missing),
        "sensors": displayed_sensors(trace),
        "columns": column_descriptions,
        "scene": scene_layers(task, trace, no_maps),
    }
