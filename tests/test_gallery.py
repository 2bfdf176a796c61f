"""The gallery: the recorded ensemble reproduces its published numbers, and the recurrent filter learns."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest
import torch

from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.catalog import quick
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import load_trace, trace

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
