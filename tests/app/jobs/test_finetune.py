"""The fine-tuning job: its result precedes the healthy record, and then has the name of the checkpoint."""

from __future__ import annotations

import json
from typing import Any

import pytest

from beliefscope.app.jobs.finetune import run
from beliefscope.app.runs.settings import Settings
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.checkpoint import load_checkpoint
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.inspect.compare.checkpoints import compare_checkpoints
from beliefscope.inspect.diagnostics.views import as_json

pytestmark = pytest.mark.slow

TUNING = FineTune(train=("haptics-only",), steps=2, check=2, length=8, windows=2)


def test_result_precedes_the_healthy_record_and_the_checkpoint(settings: Settings) -> None:
    folder = settings.workspace / "finetune" / "0123"
    folder.mkdir(parents=True)
    path, result_path = folder / "finetuned.safetensors", folder / "result.json"
    result_path.write_text("{}")  # of an earlier job
    early: list[Any] = []

    def report(progress: float, message: str) -> None:
        if message.startswith("healthy record") and not early:
            assert not path.exists()
            early.append(json.loads(result_path.read_text()))
        elif not early:
            assert not result_path.exists()

    names = {"run": "0123", "task": "door", "filter": "crossmodal-ekf", "data": "mine"}
    run({**names, "tuning": TUNING.to_json(), "settings": settings.to_json()}, report)
    result, checkpoint = json.loads(result_path.read_text()), load_checkpoint(path)
    assert (early[0]["finetuned"]["hash"], result["finetuned"]["hash"]) == ("", checkpoint.hash)
    assert result["finetuned"]["name"] == f"crossmodal-ekf-{checkpoint.hash[:6]}"
    assert checkpoint.healthy_profile
    base = load_checkpoint(settings.checkpoints["crossmodal-ekf"])  # type: ignore[arg-type]
    with open_dataset(settings.data["mine"]) as data:
        of_files = compare_checkpoints(base, checkpoint, data, particles=settings.particles, seed=settings.seed)
    for document in (*early, result):  # the comparison does not depend on the file
        assert document["comparison"]["verdict"] == of_files.verdict
        assert document["comparison"]["plots"] == as_json(of_files.views())["plots"]
