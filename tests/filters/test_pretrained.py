"""The shipped weights: where they come from is written in them, and they do what is claimed."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import PRETRAINED, Checkpoint, load_checkpoint
from beliefscope.filters.evaluate import evaluate
from beliefscope.inspect.trace import trace


@pytest.fixture(scope="module")
def held_out() -> list[Episode]:
    with open_dataset(sample_path("door")) as dataset:
        return [dataset[s.index] for s in dataset.summaries if s.split == "test"]


SHIPPED = sorted(path.stem for path in PRETRAINED.glob("*.safetensors"))


def test_to_open_them_needs_no_compiler() -> None:
    code = (
        "import sys; from beliefscope.filters.checkpoint import *; "
        "[load_checkpoint(path) for path in PRETRAINED.glob('*.safetensors')]; "
        "assert 'torch._dynamo' not in sys.modules, 'it takes seconds of every process'"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


@pytest.fixture(scope="module", params=[name for name in SHIPPED if name.startswith("door-crossmodal")])
def checkpoint(request: pytest.FixtureRequest) -> Checkpoint:
    return load_checkpoint(PRETRAINED / f"{request.param}.safetensors")


@pytest.mark.parametrize("name", SHIPPED)
def test_the_record_says_how_to_make_it_again(name: str) -> None:
    checkpoint = load_checkpoint(PRETRAINED / f"{name}.safetensors")
    record = checkpoint.record
    assert name == f"{checkpoint.task.name}-{checkpoint.name}"
    assert record["command"].startswith(f"beliefscope train {checkpoint.task.name} --filter {checkpoint.name}")
    written = (PRETRAINED / "README.md").read_text()
    assert checkpoint.hash in written
    assert record["data_hash"] in written
    assert record["command"] in written
    assert {"seed", "plan", "metrics", "versions", "seconds"} <= record.keys()


def test_recorded_metrics_are_those_of_these_weights(checkpoint: Checkpoint, held_out: list[Episode]) -> None:
    """Recorded on 60 episodes that do not ship; on the sample set's 14 they come out alike."""
    again = evaluate(checkpoint.filter, held_out)
    recorded = checkpoint.record["metrics"]["0"]["fused"]
    # The root mean square of 14 episodes' errors spreads by some 20 % around that of 60.
    assert again.rmse["position_cm"] == pytest.approx(recorded["rmse"]["position_cm"], rel=0.5)
    assert again.rmse["angle_deg"] == pytest.approx(recorded["rmse"]["angle_deg"], rel=0.5)


@pytest.mark.parametrize("faults", ["", "blackout=0.4", "blackout=0.8"])
def test_fused_is_no_worse_than_the_better_modality(
    checkpoint: Checkpoint, held_out: list[Episode], faults: str
) -> None:
    """By more than 5 %, which 14 episodes cannot tell apart; on what moves, with most pictures black, it is better."""
    fused = evaluate(checkpoint.filter, held_out, faults=Faults.parse(faults)).rmse
    for name in checkpoint.filter.names:
        alone = evaluate(checkpoint.filter, held_out, faults=Faults.parse(faults), only=name).rmse
        assert fused["angle_deg"] < (1.0 if "0.8" in faults else 1.05) * alone["angle_deg"]
        assert fused["position_cm"] < 1.05 * alone["position_cm"]


def test_blackout_moves_beta_away_from_the_image(checkpoint: Checkpoint, held_out: list[Episode]) -> None:
    """On what moves, the angle: of the hinge, which stands still, an EKF remembers what the picture said."""
    traces = [trace(checkpoint, e, particles=50, faults=Faults.parse("blackout=0.5")) for e in held_out[:6]]
    pictures = np.concatenate([t.episode.observations["image"] for t in traces])
    beta = np.concatenate([t.weights[..., -1] for t in traces if t.weights is not None])
    black = ~pictures.any(axis=(1, 2))
    image = traces[0].modalities.index("image")
    assert beta[black, image].mean() < beta[~black, image].mean()
