"""Innovations in the spaces of the measurements, gates and own scalars in recordings, exports and live files."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.trace import trace
from beliefscope.inspect.traces.live_file import load_live
from beliefscope.recordings.live import LiveRecorder
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.rerun_log.columns import columns
from beliefscope.recordings.write import write_recording

sys.path.insert(0, str(Path(__file__).parents[1] / "filters" / "external"))
import vehicle_filters as vehicle

NAMES = ("innovation", "innovation_covariance", "accepted")


def test_recording_and_export_contain_measurements(tmp_path: Path) -> None:
    filter_ = ExternalFilter(Adapter(vehicle.NumpyKalman(gate=9.0), batched=False), vehicle.TASK, "mine")
    result = trace(filter_, vehicle.drive(3, 40, gap=(10, 15)))
    again = read_recording(write_recording(result, tmp_path / "run.rrd"))
    for name in NAMES:
        np.testing.assert_array_equal(getattr(again, name), getattr(result, name))
    np.testing.assert_array_equal(again.extra["trace"], result.extra["trace"])
    exported = {column.name: column.values for column in columns(result)}
    np.testing.assert_array_equal(exported["accepted.gps"], result.accepted[:, 0])  # type: ignore[index]
    np.testing.assert_array_equal(exported["extra.trace"], result.extra["trace"])


@pytest.mark.parametrize("gap", [(10, 15), (0, 8)])
def test_live_run_contains_measurements(tmp_path: Path, gap: tuple[int, int]) -> None:
    """Also if the first steps have fewer measurements than later ones."""
    filter_, episode = vehicle.NumpyKalman(), vehicle.drive(3, 30, gap=gap)
    filter_.initialize_beliefs()
    with LiveRecorder("run", task=vehicle.TASK, folder=tmp_path, views=False) as live:
        for t in range(len(episode)):
            inputs = {key: value[t].astype(np.float64) for key, value in episode.observations.items()}
            live.step(filter_.forward(observations=inputs, controls=episode.controls[t]), inputs)
    recorded = load_live(live.path)
    expected = trace(ExternalFilter(Adapter(vehicle.NumpyKalman(), batched=False), vehicle.TASK, "mine"), episode)
    for name in NAMES:
        np.testing.assert_allclose(getattr(recorded, name), getattr(expected, name), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(recorded.extra["trace"], expected.extra["trace"], rtol=1e-5)
