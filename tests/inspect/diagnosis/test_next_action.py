"""Commands of next actions can be run: they name the file or source of the filter, and the data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from torch import Tensor, nn

from beliefscope.datasets.task import Component, Task
from beliefscope.filters.checkpoint import PRETRAINED, load_checkpoint
from beliefscope.filters.external.load import ExternalFilter, as_external
from beliefscope.inspect.diagnosis.catalog import causes_of
from beliefscope.inspect.diagnosis.next_action import next_action, search_action

TASK = Task("peg", (Component("x", "m"),), {"wrench": (2,)}, {"touch": ("wrench",)}, 0, 0.1)


def test_of_checkpoints() -> None:
    checkpoint = load_checkpoint(PRETRAINED / "door-crossmodal-ekf.safetensors")
    (cause,) = (cause for cause in causes_of(checkpoint.task) if cause.name == "model.haptics.bias")
    command = "`beliefscope finetune door --filter {} --train haptics-only -o tuned.safetensors`"
    assert command.format("crossmodal-ekf") in next_action(cause, checkpoint)
    own = replace(checkpoint, path=Path("runs/mine.safetensors"))
    assert command.format("mine.safetensors") in next_action(cause, own)


def test_of_an_external_filter_whose_loss_selects_what_is_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Still(nn.Linear):
        def forward(self, *, observations: object, controls: Tensor) -> Tensor:
            return self.weight.expand(*controls.shape[:-1], 1)

    adapter = as_external(Still(1, 1), "still", TASK).adapter
    external = ExternalFilter(adapter, TASK, "own-still", "own.py:still")
    (cause,) = (cause for cause in causes_of(TASK) if cause.name == "model.touch.bias")
    command = "`beliefscope finetune peg --filter own.py:still --data DATA -o tuned.safetensors`"
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text("def loss(module, windows):\n    return module.weight.sum()\n")
    assert command in next_action(cause, external)
    Path("other.py").write_text("")
    other = ExternalFilter(adapter, TASK, "own-still", "other.py:still")
    assert next_action(cause, other).endswith("Correct it in the filter's own code.")
    assert "`beliefscope slices peg --filter own.py:still --data DATA`" in search_action(external, 6)


def test_of_a_filter_without_parameters() -> None:
    def still(*, observations: object, controls: np.ndarray) -> np.ndarray:
        return np.zeros((*controls.shape[:-1], 1))

    external = as_external(still, "still", TASK)
    actions = {cause.name: next_action(cause, external) for cause in causes_of(TASK)}
    assert actions["dynamics.broken"] == "Check the equations of the dynamics."
    assert actions["model.touch.bias"].endswith("same symptoms. Correct it in the filter's own code.")
    assert actions["data.shift"] == "Collect data of these conditions."
    assert not [action for action in actions.values() if "finetune" in action or "`" in action]


def test_a_command_follows_its_action_or_another_one_is_given() -> None:
    for cause in causes_of(TASK):
        assert cause.next.endswith(".") == (cause.command is None), cause.name
        assert cause.by_hand.endswith(".") == (cause.command is not None), cause.name
