"""Calibrations: conformal guarantee, files and the wrapper of a module."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.calibration import (
    Calibration,
    Layer,
    conformal_radius,
    load_calibration,
    save_calibration,
)

CALIBRATION = Calibration(
    task="door",
    filter="mine",
    checkpoint_hash="0",
    data_hash="1",
    episodes=30,
    level=0.9,
    layers={
        "image": Layer(2.0, 1.5, {"position": 0.1, "angle": 0.2}),
        "haptics": Layer(3.0, 1.5, {"position": 0.1, "angle": 0.2}),
        "fused": Layer(4.0, 1.0, {"position": 0.05, "angle": 0.1}),
    },
)


def test_one_step_per_episode_is_split_conformal() -> None:
    """The order statistic of rank ceil((R + 1) level)."""
    values = np.random.default_rng(0).permutation(np.arange(1.0, 31.0))
    for level in (0.5, 0.8, 0.9, 0.95):
        assert conformal_radius([np.array([v]) for v in values], level) == math.ceil(31 * level)
    assert conformal_radius([np.array([v]) for v in values], 0.97) == math.inf  # 30 / 31 is less


def test_episodes_have_equal_weight() -> None:
    long, short = np.zeros(1000), np.full(3, 5.0)
    assert conformal_radius([long, short], 1 / 3) == 0.0
    assert conformal_radius([long, short], 0.34) == 5.0


def test_coverage_of_new_episodes_with_dependent_steps() -> None:
    """The share of covered steps of a new episode is at least the level on average, though episodes differ by scale."""
    rng, level, episodes = np.random.default_rng(1), 0.8, 20
    shares = []
    for _ in range(2000):
        scores = np.exp(rng.standard_normal((episodes + 1, 1))) * np.abs(rng.standard_normal((episodes + 1, 15)))
        shares.append(np.mean(scores[-1] <= conformal_radius(list(scores[:-1]), level)))
    error = np.std(shares) / np.sqrt(len(shares))
    assert level - 3 * error <= np.mean(shares) <= level + 2 / (episodes + 1) + 3 * error


def test_file_round_trip(tmp_path: Path) -> None:
    save_calibration(CALIBRATION, tmp_path / "c.json")
    assert load_calibration(tmp_path / "c.json") == CALIBRATION


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 2}, "format 1"),
        ({"level": 1.5}, "1.5"),
        ({"task": 3}, "task is 3"),
        ({"episodes": None}, "integer"),
        ({"layers": {"fused": {"scale": -1.0, "ellipsoid": 1.0, "distances": {}}}}, "'fused'"),
        ({"layers": {"fused": {"scale": 1.0}}}, "'fused'"),
        ({"layers": {"fused": []}}, "'fused'"),
    ],
)
def test_invalid_files_are_refused(tmp_path: Path, change: dict[str, object], message: str) -> None:
    path = tmp_path / "c.json"
    path.write_text(json.dumps(CALIBRATION.to_json() | change))
    with pytest.raises(BadInput, match=message):
        load_calibration(path)


def test_files_that_are_no_json(tmp_path: Path) -> None:
    (tmp_path / "c.json").write_bytes(b"\x80\x04.")
    for path in (tmp_path / "c.json", tmp_path / "missing.json", tmp_path):
        with pytest.raises(BadInput):
            load_calibration(path)


class Module(nn.Module):
    def __init__(self, output: object) -> None:
        super().__init__()
        self.output = output

    def initialize_beliefs(self, mean: Tensor, covariance: Tensor) -> None:
        self.start = mean

    def forward(self, observations: object, controls: object) -> object:
        return self.output


def test_wrapped_module_returns_scaled_covariances() -> None:
    mean, covariance = torch.randn(5, 3), torch.eye(3).repeat(5, 1, 1)
    pair = CALIBRATION.wrap(Module((mean, covariance)))
    pair.initialize_beliefs(mean=mean, covariance=covariance)
    assert pair.module.start is mean
    result = pair(observations={}, controls=None)
    assert result[0] is mean
    assert torch.equal(result[1], 4.0 * covariance)
    modalities = torch.ones(5, 2, 3, 3)
    values = {"estimate_mean": mean, "estimate_covariance": covariance, "modality_covariance": modalities}
    result = CALIBRATION.wrap(Module(values))(observations={}, controls=None)
    assert torch.equal(result["estimate_covariance"], 4.0 * covariance)
    assert result["modality_covariance"][0, :, 0, 0].tolist() == [2.0, 3.0]
    assert torch.equal(values["modality_covariance"], torch.ones(5, 2, 3, 3))  # the module's own are unchanged
    assert CALIBRATION.wrap(Module(mean))(observations={}, controls=None) is mean
    with pytest.raises(BadInput, match="2 modalities, not of 3"):
        CALIBRATION.wrap(Module(values | {"modality_covariance": torch.ones(5, 3, 3, 3)}))({}, None)


def test_numpy_covariances_and_unknown_layers() -> None:
    assert (CALIBRATION.covariance(np.eye(2), "image") == 2.0 * np.eye(2)).all()
    with pytest.raises(BadInput, match="touch"):
        CALIBRATION.covariance(np.eye(2), "touch")
    with pytest.raises(BadInput, match="no covariance"):
        Calibration("door", "lstm", "", "", 30, 0.9, {"fused": Layer(None, None, {})}).covariance(np.eye(2))
