"""A training and a fine-tuning that are told to end (SIGTERM) go on, when run again, to the bits of unbroken ones."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "fuzz"))

from valid_files import episodes

from beliefscope.filters.catalog import architecture
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.finetune import FineTune, finetune
from beliefscope.filters.training.train import PLANS, train

MAKE = """
import sys, torch
from pathlib import Path
sys.path.insert(0, sys.argv[1])
torch.set_num_threads(1)
import test_terminated
getattr(test_terminated, sys.argv[2])(Path(sys.argv[3]))
"""


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def trained(partial: Path | None) -> Filter:
    plan, some = replace(PLANS["smoke"], dynamics=10, models=12, alone=3), episodes(steps=20)
    return train(architecture("door", "haptics-ekf"), some, data_hash="0", plan=plan, partial=partial).filter


def tuned(partial: Path | None) -> Filter:
    asked = FineTune(train=("haptics-only",), length=8, windows=4, steps=6, check=1, patience=6, particles=8)
    parent = load_checkpoint(shipped("door", "crossmodal-pf"))
    found = finetune(parent, episodes(steps=20), data_hash="0", settings=asked, partial=partial)
    assert found is not None
    return found.filter


@pytest.mark.parametrize("make", [pytest.param(trained, marks=pytest.mark.long), tuned])
def test_what_was_told_to_end_goes_on_to_the_same_bits(make: Callable[[Path | None], Filter], tmp_path: Path) -> None:
    partial = tmp_path / "x.partial"
    command = [sys.executable, "-c", MAKE, str(Path(__file__).parent), make.__name__, str(partial)]
    with subprocess.Popen(command, env=os.environ | {"OMP_NUM_THREADS": "1"}) as process:
        end = time.monotonic() + 120
        while not partial.exists() and process.poll() is None and time.monotonic() < end:
            time.sleep(0.005)
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == -signal.SIGTERM, "it ends at once, and before it is done"
    assert partial.exists(), "with something to go on from"
    resumed, whole = make(partial).state_dict(), make(None).state_dict()
    for name, value in whole.items():
        assert torch.equal(value, resumed[name]), name
    assert not partial.exists()
