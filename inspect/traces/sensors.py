"""Readings of the sensors of a trace that are drawn as images: cameras, arrays of numbers, scans and point clouds."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import is_image
from beliefscope.datasets.point_clouds import extent_of, point_sensors, points_of
from beliefscope.inspect.traces.data import Trace


def camera_images(trace: Trace) -> NDArray[np.uint8] | None:
    """(T, H, W) or (T, H, W, 3) the first image observation, as the filter received it; None if there is none."""
    return next((readings for readings in trace.episode.observations.values() if is_image(readings)), None)


@dataclass(frozen=True)
class DisplayedSensor:
    """A sensor that is drawn.

    channels: 1, or 3 for RGB. low, high: range of an array's values in the run, from the first to the last colour; None
    for images. points: per step, of a scan or a point cloud, else 0. Its ``high`` is the extent in m: 99 % of the
    points are in the square of twice this side around the sensor.
    """

    name: str
    height: int
    width: int
    channels: int
    low: float | None
    high: float | None
    points: int


def displayed_sensors(trace: Trace) -> list[DisplayedSensor]:
    """Sensors that the page draws: images first, then arrays of numbers with two axes, scans and point clouds."""
    observations = trace.episode.observations
    images = [key for key, readings in observations.items() if is_image(readings)]
    clouds = [key for key in point_sensors(trace.task) if key in observations]
    arrays = [key for key, values in observations.items() if values.ndim == 3 and key not in (*images, *clouds)]
    sensors = []
    for key in images + arrays:
        height, width, *channels = observations[key].shape[1:]
        low = high = None
        if key in arrays and len(trace):
            low, high = float(observations[key].min()), float(observations[key].max())
        sensors.append(DisplayedSensor(key, height, width, channels[0] if channels else 1, low, high, 0))
    for key in clouds:
        points = points_of(trace.task, key, observations[key])
        sensors.append(DisplayedSensor(key, 1, 1, 1, 0.0, extent_of(points), points.shape[1]))
    return sensors


def sensor_pixels(trace: Trace, key: str) -> NDArray[np.uint8] | NDArray[np.float32]:
    """A sensor of ``displayed_sensors``: (T, H, W) or (T, H, W, 3) uint8, arrays of numbers scaled to 0..255.

    Of scans and point clouds, (T, P, 2) float32, in m: x and y in the frame of the sensor, NaN for absent points.
    """
    sensor = next(sensor for sensor in displayed_sensors(trace) if sensor.name == key)
    readings = trace.episode.observations[key]
    if sensor.points:
        return points_of(trace.task, key, readings)[..., :2]
    if sensor.low is None or sensor.high is None:
        return np.asarray(readings, np.uint8)
    span = max(sensor.high - sensor.low, 1e-12)
    return np.rint(255.0 * (readings - sensor.low) / span).astype(np.uint8)
