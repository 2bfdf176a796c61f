"""A training and a fine-tuning run interrupted by SIGTERM resume to identical weights."""

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
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.finetune import finetune
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.training.plan import PLANS
from beliefscope.filters.training.train import train

pytestmark = pytest.mark.slow

MAKE = """
import sys, torch
from pathlib import Path
sys.path.insert(0, sys.argv[1])
torch.set_num_threads(1)
import test_sigterm_resume
getattr(test_sigterm_resume, sys.argv[2])(Path(sys.argv[3]))
"""


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def trained(partial: Path | None) -> Filter:
    plan = replace(PLANS["smoke"], dynamics=10, models=12, single=3)
    return train(
        architecture("door", "haptics-ekf"), episodes(steps=20), data_hash="0", plan=plan, partial=partial
    ).filter


def tuned(partial: Path | None) -> Filter:
    settings = FineTune(train=("haptics-only",), length=8, windows=4, steps=6, check=1, patience=6, particles=8)
    base = load_checkpoint(pretrained_path("door", "crossmodal-pf"))
    result = finetune(base, episodes(steps=20), data_hash="0", settings=settings, partial=partial)
    assert result is not None
    return result.filter


@pytest.mark.long  # test_finetune.py and test_train.py resume in their own process
@pytest.mark.parametrize("make", [trained, tuned])
def test_sigterm_resumes_to_identical_weights(make: Callable[[Path | None], Filter], tmp_path: Path) -> None:
    partial = tmp_path / "x.partial"
    command = [sys.executable, "-c", MAKE, str(Path(__file__).parent), make.__name__, str(partial)]
    with subprocess.Popen(command, env=os.environ | {"OMP_NUM_THREADS": "1"}) as process:
        end = time.monotonic() + 120
        while not partial.exists() and process.poll() is None and time.monotonic() < end:
            time.sleep(0.005)
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == -signal.SIGTERM, "terminates before it is finished"
    assert partial.exists(), "state to resume from"
    resumed, uninterrupted = make(partial).state_dict(), make(None).state_dict()
    for name, value in uninterrupted.items():
        assert torch.equal(value, resumed[name]), name
