"""The case study of docs/finetune.md, shortened: a haptics model trained on biased forces is repaired."""

from __future__ import annotations

from pathlib import Path

import pytest

from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path, save_checkpoint
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.finetuning.finetune import finetune
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.finetuning.slices import Slice

pytestmark = pytest.mark.slow

BIAS = Slice("bias", Faults.parse("force_bias=5:y=5"), only=("haptics",))
DARK = Slice("dark", Faults.parse("blackout=0.95"))
DAMAGE = FineTune(train=("haptics-only",), mix=((BIAS, 1.0),), clean_weight=0.0, l2_sp=0.0, rate=1e-3, steps=300)
REPAIR = FineTune(train=("haptics-only", "weights-only"), mix=((DARK, 1.0),), rate=1e-3, steps=100)


@pytest.mark.long
def test_finetuning_repairs_a_failure_and_preserves_accuracy(tmp_path: Path) -> None:
    with open_dataset(sample_path("push")) as data:
        episodes = [data[i] for i in range(140)]
        held_out = [episode for episode in episodes if episode.split == "test"]

    def tune(base: Checkpoint, settings: FineTune, name: str) -> Checkpoint:
        result = finetune(base, episodes, data_hash="-", settings=settings)
        assert result is not None
        save_checkpoint(result.filter, base.name, result.record, tmp_path / name)
        return load_checkpoint(tmp_path / name)

    def error(checkpoint: Checkpoint, faults: Faults) -> float:
        return evaluate(checkpoint.filter, held_out, faults=faults).rmse["position_cm"]

    pretrained = load_checkpoint(pretrained_path("push", "crossmodal-ekf"))
    damaged = tune(pretrained, DAMAGE, "damaged.safetensors")
    assert error(damaged, DARK.faults) > 2.0 * error(pretrained, DARK.faults)
    repaired = tune(damaged, REPAIR, "repaired.safetensors")
    assert error(repaired, DARK.faults) < 0.5 * error(damaged, DARK.faults)
    assert error(repaired, Faults()) < 1.05 * error(damaged, Faults())
    assert repaired.record["base"]["hash"] == damaged.hash
    assert FineTune.from_json(repaired.record["base"]["settings"]) == REPAIR
