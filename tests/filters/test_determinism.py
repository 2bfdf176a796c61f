"""The same seed gives identical traces: repeated, in another process, and up to rounding with another thread count."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.batch import Steps
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.filters.evaluate import run
from beliefscope.inspect.trace import save_trace, trace

pytestmark = pytest.mark.slow

MAKE = """
import sys, torch
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_determinism import write_trace
torch.set_num_threads(1)
write_trace("crossmodal-pf", Path(sys.argv[2]))
"""


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def write_trace(name: str, path: Path) -> bytes:
    """The file of a trace of a pretrained filter."""
    with open_dataset(sample_path("door")) as data:
        filter_ = load_checkpoint(pretrained_path("door", name))
        save_trace(trace(filter_, data[9], episode_index=9, seed=5, particles=100), path)
    return path.read_bytes()


@pytest.mark.parametrize("name", [pytest.param("crossmodal-ekf", marks=pytest.mark.long), "crossmodal-pf"])
def test_repeated_runs_are_identical_and_threads_only_change_rounding(
    name: str, tmp_path: Path, short_episodes: Callable[..., list[Episode]]
) -> None:
    assert write_trace(name, tmp_path / "one") == write_trace(name, tmp_path / "again")
    filter_, episodes = load_checkpoint(pretrained_path("door", name)).filter, short_episodes("door", [9], 25)
    batch, errors = Steps.from_episodes(filter_.task, episodes).episode(0), []
    for threads in (1, 2):  # two wait for each other while other programs run: few steps. A trace always uses one.
        torch.set_num_threads(threads)
        errors.append(run(filter_, batch, None, particles=100, seed=5)[0].numpy())
        assert torch.get_num_threads() == threads
    # A sum in two parts rounds differently: float32 has 7 digits, some of which are lost over the steps.
    np.testing.assert_allclose(errors[1], errors[0], atol=2e-3)


@pytest.mark.long  # two processes
def test_another_process_gives_an_identical_trace(tmp_path: Path) -> None:
    command = [sys.executable, "-c", MAKE, str(Path(__file__).parent), str(tmp_path / "other")]
    subprocess.run(command, check=True, env=os.environ | {"OMP_NUM_THREADS": "1"}, timeout=300)
    assert (tmp_path / "other").read_bytes() == write_trace("crossmodal-pf", tmp_path / "here")
