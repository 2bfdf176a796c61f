"""The gallery: published numbers are reproduced, and the recurrent filter learns.

KalmanNet4SensorFusion has no licence: its folder, with those of the packages that it requires, is named by
BELIEFSCOPE_KALMANNET.
"""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from beliefscope.datasets.store import write_dataset
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.catalog import quick
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import load_trace, trace

sys.path.insert(0, str(Path(__file__).parent / "filters" / "external"))
from user_libraries import from_folder

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def test_recorded_ensemble_reproduces_the_published_run(tmp_path: Path, run: Any) -> None:
    folder, path = EXAMPLES / "denkf", tmp_path / "denkf.trace"
    assert run("import", folder / "eval-13920.npz", "--map", folder / "map.toml", "-o", path)[0] == 0
    recorded = load_trace(path)
    results: dict[str, Any] = quick(recorded)
    assert measures.nees(recorded)[:, -1].mean() == pytest.approx(0.0747, rel=0.01)
    assert results["errors"].groups[0].rmse == pytest.approx([0.063, 0.052, 0.052, 0.054], rel=0.02)
    assert results["ensemble"].status == "over-dispersed"
    assert {"consistency", "errors", "ensemble"} <= set(results)


@pytest.mark.long
def test_recurrent_gain_learns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES / "gallery"))
    example = runpy.run_path(str(EXAMPLES / "gallery" / "recurrent_gain.py"))
    data = runpy.run_path(str(EXAMPLES / "gallery" / "vehicle.py"))
    errors = []
    for steps in (1, 40):
        torch.manual_seed(0)
        adapter = Adapter(example["train"](steps, episodes=16, length=40))
        run = trace(ExternalFilter(adapter, data["TASK"], "gain"), data["drive"](5, 40))
        errors.append(measures.main_error(run)[:, -1].mean())
        assert set(quick(run)) == {"errors"}
        assert "gain" in run.extra
    assert errors[1] < errors[0]


@pytest.mark.long
@pytest.mark.parametrize(("name", "published"), [("test", 5.606), ("test_rtk", None)])
def test_kalmannet_on_nclt(tmp_path: Path, run: Any, name: str, published: float | None) -> None:
    folder = Path(from_folder("Net.models", "BELIEFSCOPE_KALMANNET").__file__ or "").parents[2]
    script, data, path = EXAMPLES / "gallery" / "kalmannet_nclt.py", tmp_path / "nclt.h5", tmp_path / "nclt.trace"
    example = runpy.run_path(str(script))
    write_dataset(data, example["TASK"], example["episodes"](folder / "data" / "NCLT" / "processed" / f"{name}.pt"))
    options = ("--data", data, "--filter", f"{script}:kalmannet", "--episode", 1, "-o", path)
    assert run("trace", "nclt", *options)[0] == 0
    errors: Any = quick(load_trace(path))["errors"]
    per_axis = np.sqrt(np.square(errors.groups[0].rmse[:2]).mean())
    (outage,) = errors.outages
    assert (outage.modality, outage.dominant.low) == ("gps", 60.0)
    if published is None:
        assert errors.worse == ("gps",)  # RTK readings
        assert outage.dominant.share > 0.7
    else:
        assert per_axis == pytest.approx(published, rel=0.01)  # nclt_predict.ipynb, 2012-11-16
        assert errors.worse == ()
