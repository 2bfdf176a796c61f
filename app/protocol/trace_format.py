"""Traces as the page reads them: a JSON header and little-endian float32 columns (docs/api.md)."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.app.protocol.messages import LAYERS, SceneLayer
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.evaluate import nees_bounds
from beliefscope.inspect.maps.likelihood_map import Quantity
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.innovations import channels_of, reported_innovations, virtual_innovations
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.sensors import camera_images, displayed_sensors

SENSORS = ("effector_position", "force")
"""Observations from which the 3D scene draws the force."""

MAX_CHANNELS = 16
"""Largest number of channels of a sensor or an innovation that has columns; more, as those of a lidar, are no chart."""

FloatArray = NDArray[np.floating[Any]]


def columns(trace: Trace) -> tuple[list[dict[str, Any]], bytes]:
    """The trace's time series: descriptions ``{"name", "shape", "offset"}``, offset in bytes, and a float32 buffer.

    Descriptions of columns (T, d) of channels also have ``channels``: names and units of at most d channels.
    """
    reported, groups = _reported_innovations(trace), measures.shaded_groups(trace)
    innovation = None if reported else virtual_innovations(trace)
    unimodal, faulty = bool(trace.modalities_with_posterior), measures.faulty(trace)
    arrays: dict[str, NDArray[Any] | None] = {
        "time": trace.episode.time,
        "truth": trace.episode.states,
        "estimate_mean": trace.task.near(trace.estimate_mean, trace.episode.states),
        "estimate_sigma": measures.deviations(trace.estimate_covariance) if trace.has_covariance else None,
        "modality_mean": trace.task.near(trace.modality_mean, trace.episode.states[:, None]) if unimodal else None,
        "modality_sigma": measures.deviations(trace.modality_covariance) if unimodal else None,
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
    of_channels = _readings(trace) | reported
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


def _readings(trace: Trace) -> dict[str, tuple[FloatArray, list[Component]]]:
    """Column -> readings (T, d) of a vector sensor as the filter received them, or the controls, and their channels.

    NaN at steps without a reading. Scans, which are drawn, and vectors of more than ``MAX_CHANNELS`` have no column.
    """
    task, episode = trace.task, trace.episode
    result = {}
    for key, values in {**episode.observations, "control": episode.controls}.items():
        if values.ndim == 2 and 1 <= values.shape[1] <= MAX_CHANNELS and key not in task.scans:
            present = episode.present(key)[:, None]
            channels = [task.channel(key, i) for i in range(values.shape[1])]
            result[f"readings/{key}"] = (np.where(present, values, np.nan).astype(np.float32), channels)
    return result


def _reported_innovations(trace: Trace) -> dict[str, tuple[FloatArray, list[Component]]]:
    """Column -> innovation of a modality (T, d) in the space of its measurements, or its standard deviation.

    NaN without a measurement; empty if the filter does not report them.
    """
    if (pair := reported_innovations(trace)) is None:
        return {}
    innovation, deviations = pair[0], measures.deviations(pair[1])
    result = {}
    for k, (modality, channels) in enumerate(zip(trace.modalities, channels_of(trace, innovation), strict=True)):
        if not np.isfinite(innovation[:, k, MAX_CHANNELS:]).any():
            for name, values in (("innovation", innovation), ("innovation_sigma", deviations)):
                # The width does not depend on the steps, so that those of blocks of a live run agree.
                result[f"{name}/{modality}"] = (values[:, k, :MAX_CHANNELS], channels[:MAX_CHANNELS])
    return result


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
