"""Fine-tuning of an external torch module on a loss of its own file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import write_dataset
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.external.load import ExternalFilter, load_external
from beliefscope.filters.external.module_weights import save_weights
from beliefscope.filters.finetuning.choices import choices
from beliefscope.filters.finetuning.external import finetune_external, loss_of
from beliefscope.filters.finetuning.finetune import Callbacks
from beliefscope.filters.finetuning.settings import FineTune

FILE = """
import torch
from torch import nn
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.external.adapter import Adapter

TASK = Task("cart", (Component("x", "m"),), {"gps": (1,)}, {"gps": ("gps",)}, 1, 0.1, warmup=0)

class Observer(nn.Module):
    task = TASK
    def __init__(self):
        super().__init__()
        self.dynamics, self.sensor = nn.Linear(1, 1, bias=False), nn.Linear(1, 1)
        nn.init.constant_(self.dynamics.weight, 0.1)
        nn.init.ones_(self.sensor.weight)
        nn.init.zeros_(self.sensor.bias)
    def initialize_beliefs(self, *, mean, covariance):
        self.x = mean
    def forward(self, *, observations, controls):
        predicted = self.x + self.dynamics(controls)
        self.x = predicted + 0.3 * (self.sensor(observations["gps"]) - predicted)
        return self.x

def build():
    return Adapter(Observer(), initial_std=(0.1,))

def loss(module, windows):
    module.initialize_beliefs(mean=windows.mean, covariance=windows.covariance)
    total = 0.0
    for t in range(len(windows.states)):
        keys = {key: values[t] for key, values in windows.observations.items()}
        estimate = module(observations=keys, controls=windows.controls[t])
        total = total + (estimate - windows.states[t]).square().mean()
    return total / len(windows.states)

"""

SETTINGS = FineTune(train=("sensor",), steps=40, length=20, windows=8, rate=0.05, check=10, l2_sp=0.0)


@pytest.fixture
def base(tmp_path: Path) -> ExternalFilter:
    (tmp_path / "own.py").write_text(FILE)
    return load_external(f"{tmp_path / 'own.py'}:build")


@pytest.fixture
def episodes(base: ExternalFilter) -> list[Episode]:
    """Carts whose GPS has an offset of 0.5 m, which the filter does not know."""
    rng = np.random.default_rng(0)
    result = []
    for split in ("train", "train", "val", "test"):
        speed = rng.normal(0.5, 0.3, (60, 1))
        x = np.cumsum(0.1 * speed, axis=0)
        gps = x + 0.5 + rng.normal(0, 0.02, x.shape)
        result.append(Episode(base.task, x, speed, {"gps": gps}, split=split))
    return result


def tune(base, episodes, settings=SETTINGS, stop=lambda: False, partial=None, loss="loss"):  # type: ignore[no-untyped-def]
    callbacks = Callbacks(lambda *_: None, lambda _: None, lambda _: None, stop)
    function = loss_of(base.source) if loss == "loss" else loss
    return finetune_external(
        base, function, episodes, data_hash="", settings=settings, command="", callbacks=callbacks, partial=partial
    )


@pytest.mark.slow
def test_a_selected_module_learns_and_the_others_stay(
    base: ExternalFilter, episodes: list[Episode], tmp_path: Path
) -> None:
    """The weights are loaded by ``FILE.py:FUNCTION@WEIGHTS``; an interrupted run ends with the same ones."""
    tensors, record = tune(base, episodes)
    save_weights(tensors, tmp_path / "tuned.safetensors")
    tuned = load_external(f"{base.source}@{tmp_path / 'tuned.safetensors'}")
    before, after = (evaluate(filter_, episodes[3:]).rmse["x_cm"] for filter_ in (base, tuned))
    assert before > 40.0
    assert after < 0.25 * before
    assert record["held_out"]["after"]["clean"]["rmse"]["x_cm"] == pytest.approx(after)
    assert tuned.hash != base.hash
    assert tuned.name == "own-build-tuned"
    assert torch.equal(tensors["dynamics.weight"], torch.tensor([[0.1]]))
    assert record["frozen"]["tensors"] == 1
    calls = iter(range(100))
    assert tune(base, episodes, stop=lambda: next(calls) == 25, partial=tmp_path / "partial") is None
    again, _ = tune(base, episodes, partial=tmp_path / "partial")
    assert all(torch.equal(again[name], tensors[name]) for name in tensors)
    assert load_file(tmp_path / "tuned.safetensors").keys() == tensors.keys()


def test_invalid_losses_modules_and_weights_are_refused(
    base: ExternalFilter, episodes: list[Episode], tmp_path: Path
) -> None:
    with pytest.raises(BadInput, match=r"is 1\.0, expected a finite scalar with gradients"):
        tune(base, episodes, loss=lambda module, windows: 1.0)
    with pytest.raises(BadInput, match="fails: KeyError"):
        tune(base, episodes, loss=lambda module, windows: windows.observations["image"])
    with pytest.raises(BadInput, match="pattern 'sensr' matches no module"):
        tune(base, episodes, FineTune(train=("sensr",)))
    with pytest.raises(BadInput, match=r"no training episode has 80 steps"):
        tune(base, episodes, FineTune(length=80))
    save_weights({"sensor.weight": torch.zeros(1, 1)}, tmp_path / "other.safetensors")
    with pytest.raises(BadInput, match=r"weights .*other.* do not fit"):
        load_external(f"{base.source}@{tmp_path / 'other.safetensors'}")
    (tmp_path / "plain.py").write_text(FILE.replace("def loss", "def cost"))
    with pytest.raises(BadInput, match=r"has no function loss\(module, windows\)"):
        loss_of(f"{tmp_path / 'plain.py'}:build")


@pytest.mark.slow
def test_the_command_writes_logs(
    run: Callable[..., tuple[int, str, str]], base: ExternalFilter, episodes: list[Episode], tmp_path: Path
) -> None:
    write_dataset(tmp_path / "own.h5", base.task, episodes)
    output, log = tmp_path / "tuned.safetensors", tmp_path / "log"
    line = f"finetune cart --filter {base.source} --train sensor --steps 5 --length 20"
    code, out, error = run(line, "--data", tmp_path / "own.h5", "--log", log, "-o", output)
    assert code == 0, error
    assert f"beliefscope change {base.source} {base.source}@{output} --task cart" in out
    assert list(log.glob("*.rrd"))


def test_page_names_the_command() -> None:
    external = load_external("examples/04_own_filter.py:build")
    assert "beliefscope finetune door --filter FILE.py:FUNCTION" in (choices(external).why_not or "")
