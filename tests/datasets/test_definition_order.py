"""Files keep the order of a task's modalities and sensors, which is that of the K values of a filter."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import beliefscope as bs
from beliefscope.datasets.task import Task
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import load_checkpoint, save_checkpoint
from beliefscope.inspect.trace import load_trace, save_trace
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.write import write_recording

TASK = Task(
    name="van",
    components=(bs.Component("x", "m"), bs.Component("y", "m")),
    observations={"gps": (2,), "flow": (2,), "baro": (1,)},
    modalities={"gps": ("gps",), "flow": ("flow",), "baro": ("baro",)},
    control_size=0,
    dt=0.1,
    warmup=0,
    covariates={"night": bs.Covariate("boolean"), "fog": bs.Covariate("boolean")},
)


def order(task: Task) -> list[list[str]]:
    return [list(task.observations), list(task.modalities), list(task.covariates)]


def still(*, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
    """Innovations of three measurements, in the order of the task."""
    innovations = [observations[key] for key in ("gps", "flow", "baro")]
    covariances = [np.broadcast_to(np.eye(v.shape[-1]), (*v.shape, v.shape[-1])) for v in innovations]
    return {"estimate_mean": observations["gps"], "innovation": innovations, "innovation_covariance": covariances}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    sensors = {key: np.zeros((5, *shape), np.float32) for key, shape in TASK.observations.items()}
    flags = {name: np.zeros(5, np.float32) for name in TASK.covariates}
    episode = bs.Episode(TASK, np.zeros((5, 2), np.float32), observations=sensors, covariates=flags)
    return bs.save_dataset([episode], tmp_path_factory.mktemp("data") / "van.h5")


def test_data_sets_traces_and_recordings(data: Path, tmp_path: Path) -> None:
    with bs.open_dataset(data) as episodes:
        assert order(episodes[0].task) == order(TASK)
        run = bs.trace(bs.load_filter(still, episodes[0].task), episodes, 0)
    assert run.modalities == ("gps", "flow", "baro")
    save_trace(run, tmp_path / "run.trace")
    assert order(load_trace(tmp_path / "run.trace").task) == order(TASK)
    assert order(read_recording(write_recording(run, tmp_path / "run.rrd")).task) == order(TASK)


def test_checkpoints(tmp_path: Path) -> None:
    save_checkpoint(build(architecture(TASK, "unimodal-ekf")), "mine", {}, tmp_path / "mine.safetensors")
    assert order(load_checkpoint(tmp_path / "mine.safetensors").task) == order(TASK)
