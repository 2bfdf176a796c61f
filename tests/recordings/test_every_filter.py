"""Every filter of the catalog, untrained, on a simulated episode: trace, maps, recording, and import."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import build, filters_of
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from beliefscope.inspect.maps.map_engine import MapEngine
from beliefscope.inspect.trace import Trace, load_trace, save_trace, trace
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.write import write_recording


@pytest.fixture(scope="module")
def episode() -> Episode:
    assert DOOR.simulate is not None
    return DOOR.simulate(3, 0, 24)


@pytest.fixture(scope="module", params=filters_of(DOOR))
def checkpoint(
    request: pytest.FixtureRequest, episode: Episode, tmp_path_factory: pytest.TempPathFactory
) -> Checkpoint:
    filter_ = build(filters_of(DOOR)[request.param])
    filter_.statistics.fit(Steps.from_episodes(DOOR, [episode]))
    path = tmp_path_factory.mktemp("checkpoint") / f"{request.param}.safetensors"
    save_checkpoint(filter_, request.param, {}, path)
    return load_checkpoint(path)


@pytest.fixture(scope="module")
def traced(checkpoint: Checkpoint, episode: Episode) -> Trace:
    return trace(checkpoint, episode, particles=40)


@pytest.mark.first(5)
def test_trace_has_the_fields_of_its_kind(checkpoint: Checkpoint, traced: Trace) -> None:
    kind, names = checkpoint.kind, checkpoint.filter.names
    sequence = kind in ("lstm", "transformer")
    n, k = 3, 0 if sequence else len(names)
    assert traced.modalities == (() if sequence else names)
    assert traced.modality_mean.shape == (24, k, n)
    assert traced.modality_covariance.shape == (24, k, n, n)
    assert np.isfinite(traced.estimate_mean).all()
    assert (np.isnan if sequence else np.isfinite)(traced.estimate_covariance).all()
    assert (traced.observation_mean is not None) == (kind in ("ekf", "ukf") or "information" in checkpoint.name)
    assert (traced.log_likelihood is not None) == (kind == "pf")
    # Effective weights sum to one.
    assert (traced.weights is not None) == checkpoint.name.startswith(("crossmodal", "information"))
    assert (traced.effective_weights is not None) == (k > 1)
    if traced.effective_weights is not None:
        np.testing.assert_allclose(traced.effective_weights.sum(1), 1.0, atol=1e-5)
    if k == 1 and kind != "pf":
        np.testing.assert_array_equal(traced.modality_mean[:, 0], traced.estimate_mean)


@pytest.mark.first(5)
def test_maps_and_recording_round_trip(
    checkpoint: Checkpoint, traced: Trace, assert_same: Callable[[Trace, Trace], None], tmp_path: Path
) -> None:
    maps = None
    if checkpoint.kind in ("lstm", "transformer"):
        with pytest.raises(BadInput, match=f"'{checkpoint.kind}' has no likelihood maps: an? "):
            MapEngine(checkpoint, traced)
    else:
        maps = list(MapEngine(checkpoint, traced).maps([0, 12], size=21))
        assert maps[0].layers == (*traced.modalities, "fused")
        assert np.isfinite(maps[1].log_likelihood).all()
        if len(traced.modalities) == 1:
            unimodal, fused = maps[1].normalised().astype(int)
            assert np.abs(unimodal - fused).max() <= 1
    save_trace(traced, tmp_path / "run.trace")
    assert_same(traced, load_trace(tmp_path / "run.trace"))
    path = write_recording(traced, tmp_path / "run.rrd", maps)
    assert_same(traced, read_recording(path))
    paths = {chunk.entity_path for chunk in RrdReader(path).stream()}
    assert ("/world/plane/fused/ellipse" in paths) == traced.has_covariance
    assert ("/states/hinge_x/two_sigma" in paths) == traced.has_covariance
    assert ("/maps/fused" in paths) == (maps is not None)
