"""The commands ``calibrate`` and ``slices`` over a small data set, and the use of a calibration file."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.calibration import load_calibration
from beliefscope.filters.external.load import load_external
from beliefscope.inspect.trace import trace

Run = Callable[..., tuple[int, str, str]]
FILTER = f"{Path(__file__).parents[3] / 'examples' / '04_own_filter.py'}:build"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "door.h5"
    with open_dataset(sample_path("door")) as sample:
        write_dataset(path, sample.task, [sample[index] for index in sample.held_out()[:8]])
    return path


@pytest.mark.slow
def test_a_wrapped_filter_is_calibrated(run: Run, data: Path, tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    line = ["calibrate", "door", "--filter", FILTER, "--data", data]
    code, out, _ = run(*line, "--level", 0.7, "-o", path, "--json", "-")
    assert code == 0
    document = json.loads(out)
    assert (document["fitted"], document["tested"]) == ([0, 2, 4, 6], [1, 3, 5, 7])
    scale = load_calibration(path).layers["fused"].scale
    assert document["calibration"]["layers"]["fused"]["scale"] == scale

    file = tmp_path / "wrapped.py"
    file.write_text(
        "from beliefscope.filters.calibration import load_calibration\n"
        "from beliefscope.filters.external.load import load_external\n"
        f"def build():\n    module = load_external({FILTER!r}).adapter.module\n"
        f"    return load_calibration({str(path)!r}).wrap(module)\n"
    )
    with open_dataset(data) as episodes:
        before, after = (trace(load_external(source), episodes[0]) for source in (FILTER, f"{file}:build"))
    assert (after.estimate_mean == before.estimate_mean).all()
    assert after.estimate_covariance == pytest.approx(scale * before.estimate_covariance, rel=1e-5)
    assert not np.isclose(scale, 1.0)


def test_too_few_episodes_write_no_file(run: Run, data: Path, tmp_path: Path) -> None:
    code, _, err = run("calibrate", "door", "--filter", FILTER, "--data", data, "-o", tmp_path / "calibration.json")
    assert code == 2
    assert "4 episodes to fit and 4 to test: regions of level 0.95 need at least 19" in err
    assert not list(tmp_path.iterdir())


def test_slices_of_a_data_set(run: Run, data: Path) -> None:
    code, out, _ = run("slices", "door", "--filter", FILTER, "--data", data, "--alpha", 0.2, "--json", "-")
    assert code == 0
    document = json.loads(out)
    assert (document["episodes"], document["by"], document["alpha"]) == (8, "error", 0.2)
    assert {"contact", "angle speed", "policy"} <= set(document["covariates"])
    assert all(0.0 < s["p_value"] <= 0.2 and s["ratio"] > 1.0 for s in document["slices"])
