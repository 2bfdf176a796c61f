"""The case of docs/finetune.md in miniature: a haptics model learned on biased forces is found wrong, and mended."""

from __future__ import annotations

from pathlib import Path

import pytest

from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, shipped
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.finetuning.finetune import FineTune, finetune
from beliefscope.filters.finetuning.slices import Slice

BIAS = Slice("bias", Faults.parse("force_bias=5:y=5"), only=("haptics",))
DARK = Slice("dark", Faults.parse("blackout=0.95"))
BREAK = FineTune(train=("haptics-only",), mix=((BIAS, 1.0),), nominal=0.0, pull=0.0, rate=1e-3, steps=300)
MEND = FineTune(train=("haptics-only", "weights-only"), mix=((DARK, 1.0),), rate=1e-3, steps=100)


@pytest.mark.long
def test_a_made_failure_is_mended_and_the_rest_is_held_in_place(tmp_path: Path) -> None:
    with open_dataset(sample_path("push")) as data:
        episodes = list(data)
        held_out = [episodes[i] for i in data.held_out()]

    def child(parent: Checkpoint, settings: FineTune, name: str) -> Checkpoint:
        found = finetune(parent, episodes, data_hash="-", settings=settings)
        assert found is not None
        save_checkpoint(found.filter, parent.name, found.record, tmp_path / name)
        return load_checkpoint(tmp_path / name)

    def error(checkpoint: Checkpoint, faults: Faults) -> float:
        return evaluate(checkpoint.filter, held_out, faults=faults).rmse["position_cm"]

    ships = load_checkpoint(shipped("push", "crossmodal-ekf"))
    broken = child(ships, BREAK, "broken.safetensors")
    assert error(broken, DARK.faults) > 2.0 * error(ships, DARK.faults), "the failure is there"
    mended = child(broken, MEND, "mended.safetensors")
    assert error(mended, DARK.faults) < 0.5 * error(broken, DARK.faults)
    assert error(mended, Faults()) < 1.05 * error(broken, Faults())
    assert mended.record["parent"]["hash"] == broken.hash
    assert FineTune.of(mended.record["parent"]["settings"]) == MEND
