"""Diagnostic of updates and standalone runs: equal to separate runs, and a verdict based on standalone errors only."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics.standalone_modalities import (
    PhaseErrors,
    StandaloneModalities,
    standalone_modalities,
)
from beliefscope.inspect.standalone import standalone
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import trace


def test_errors_are_those_of_the_separate_runs() -> None:
    checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
    with open_dataset(sample_path("door")) as data:
        run = trace(checkpoint, data[9], 9)
    shares: list[float] = []
    result = standalone_modalities([run], checkpoint, shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    runs = [standalone(checkpoint, run, name) for name in run.modalities]
    alone = np.stack([measures.main_error(other)[:, -1] for other in runs], axis=1)
    np.testing.assert_array_equal(result.standalone, alone)
    np.testing.assert_allclose(np.column_stack([result.updates, result.fused]), measures.main_error(run))
    keep = measures.counted(run)
    total = result.phases[0]
    np.testing.assert_allclose(total.standalone[:, 0], np.sqrt(np.square(alone[keep]).mean(0)))
    np.testing.assert_allclose(total.ratio, total.fused[0] / total.standalone[:, 0])
    assert [curve.name for curve in result.curves()] == [
        "fused",
        "image-only update",
        "image standalone",
        "haptics-only update",
        "haptics standalone",
    ]
    for name in ("cm for the haptics-only update", "cm for haptics standalone", "at least 5 needed"):
        assert name in result.verdict


def result(update: float, alone: float, low: float, high: float) -> StandaloneModalities:
    """A fused error of 1 cm; haptics is always 3 cm off."""
    column = np.ones((2, 4)) * 0.01
    phase = PhaseErrors(
        phase="all",
        trajectories=14,
        steps=100,
        fused=column[0],
        updates=column * np.array([[update], [3.0]]),
        standalone=column * np.array([[alone], [3.0]]),
        ratio=1.0 / np.array([alone, 3.0]),
        low=np.array([low, 0.3]),
        high=np.array([high, 0.4]),
    )
    none, mask = np.zeros((0, 2)), np.zeros(0, dtype=bool)
    run = {"task": DOOR, "filter": "f", "trajectories": 14, "contact": mask, "blackout": mask}
    return StandaloneModalities(("image", "haptics"), (phase,), none[:, 0], none, none, **run)


@pytest.mark.parametrize(
    ("alone", "low", "high", "expected"),
    [
        (2.0, 0.4, 0.6, "Fusion is more accurate than image, the best standalone modality"),
        (0.5, 1.8, 2.2, "Standalone image is more accurate than fusion"),
        (1.0, 0.9, 1.1, "Fusion and image standalone do not differ significantly"),
    ],
)
def test_verdict_depends_on_standalone_errors_not_on_updates(
    alone: float, low: float, high: float, expected: str
) -> None:
    for update in (0.2, 5.0):
        verdict = result(update, alone, low, high).verdict
        assert expected in verdict
        assert f"{update:.2f} cm for the image-only update and {alone:.2f} cm for image standalone" in verdict


def test_filters_without_separate_updates_have_standalone_errors_only() -> None:
    checkpoint = Checkpoint(build(architecture("door", "feature-ekf")).eval().requires_grad_(False), "f", "0" * 64, {})
    with open_dataset(sample_path("door")) as data:
        run = trace(checkpoint, data[9], 9)
    modalities = standalone_modalities([run], checkpoint)
    assert modalities.modalities == ("image", "haptics")
    assert np.isnan(modalities.updates).all()
    assert np.isfinite(modalities.standalone).all()
    assert "update" not in modalities.verdict
    assert all(row[4] is None and not math.isnan(float(row[5] or 0.0)) for row in modalities.tables()[0].rows)


def test_single_modalities_are_refused() -> None:
    checkpoint = Checkpoint(build(architecture("door", "image-ekf")).eval().requires_grad_(False), "f", "0" * 64, {})
    with open_dataset(sample_path("door")) as data:
        run = trace(checkpoint, data[9], 9)
    entry = DIAGNOSTICS["standalone"]
    assert entry.refusal(run, checkpoint) == "filter f has one modality: it is the standalone filter"
    assert "standalone run of image" in str(
        entry.refusal(replace(run, settings={**run.settings, "standalone": "image"}), checkpoint)
    )
