"""Sources of the error: the closed form of the first step, and sums over sources."""

import numpy as np
import pytest

from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnosis.largest_error import largest_error
from beliefscope.inspect.diagnostics.error_sources import DYNAMICS, START, parts_of_error
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace, trace

FLOAT32 = 2e-5
"""m, rad: rounding of states of about 1 m, over the steps of a run."""


def traced(task: str, name: str, index: int, faults: Faults = NO_FAULTS, steps: int = 60) -> tuple:
    checkpoint = load_checkpoint(pretrained_path(task, name))
    with open_dataset(sample_path(task)) as data:
        episode = data[index].part(0, steps)
    return checkpoint, trace(checkpoint, episode, index, faults=faults)


def gains(run: Trace) -> np.ndarray:
    """(K, n, n): Kalman gains ``P' (P' + R)^-1`` of the virtual sensors at step 0."""
    prior, noise = run.predicted_covariance[0].astype(float), run.observation_covariance[0].astype(float)
    return prior @ np.linalg.inv(prior + noise)


@pytest.mark.parametrize("name", ["crossmodal-ekf", "image-ekf"])
def test_the_first_step_has_its_closed_form(name: str) -> None:
    """Sensor k causes ``beta_k K_k (z_k - x)``, and the prediction ``sum_k beta_k (I - K_k) e'``."""
    checkpoint, run = traced("door", name, 9)
    parts = parts_of_error(checkpoint, run)[0]
    truth, k = run.episode.states[0], gains(run)
    beta = np.ones((len(k), 1)) if run.weights is None else run.weights[0]
    sensors = beta * np.einsum("kij,kj->ki", k, run.observation_mean[0] - truth)
    np.testing.assert_allclose(parts[: len(k)], sensors, atol=FLOAT32)
    np.testing.assert_allclose(parts[len(k)], 0.0, atol=0.0)  # the start is the true state
    prediction = run.predicted_mean[0] - truth
    rest = (beta * np.einsum("kij,kj->ki", np.eye(k.shape[-1]) - k, prediction)).sum(0)
    np.testing.assert_allclose(parts[-1], rest, atol=FLOAT32)


@pytest.mark.parametrize(("task", "name"), [("push-field", "information-ekf"), ("door", "unimodal-ekf")])
def test_parts_add_up_to_the_error(task: str, name: str) -> None:
    checkpoint, run = traced(task, name, 13)
    result = DIAGNOSTICS["sources"]([run], checkpoint)
    error = measures.main_error(run)[:, -1]
    np.testing.assert_allclose(result.parts.sum(1), error, atol=FLOAT32)
    assert result.worst_step == int(error.argmax())
    for phase in result.phases:
        assert phase.shares.sum() == pytest.approx(1.0)
    assert (START in result.sources) == (task == "push-field")  # which starts beside the true state
    assert result.sources[-1] == DYNAMICS
    assert len(result.curves()) == 1 + len(result.sources)
    (plot,) = result.plots()
    assert plot.names == tuple(entry.phase for entry in result.phases)


def test_a_wrong_start_is_a_source_until_the_sensors_correct_it() -> None:
    checkpoint, run = traced("push-field", "information-ekf", 13)
    start = np.linalg.norm(parts_of_error(checkpoint, run)[:, -2], axis=-1)
    assert start[0] > 0.01 > 2.0 * start[-1]


def test_a_shifted_image_is_the_source_of_the_error() -> None:
    checkpoint, run = traced("push", "crossmodal-ekf", 9, Faults.parse("image_shift=6"))
    result = DIAGNOSTICS["sources"]([run], checkpoint)
    total = dict(zip(result.sources, result.phases[0].shares, strict=True))
    assert total["image"] > 0.8
    assert "image" in result.verdict
    found = largest_error(checkpoint, [run])
    assert found is not None
    assert found.sources.startswith("image ")
    counted = np.where(measures.counted(run), measures.main_error(run)[:, -1], -1.0)
    assert (found.episode, found.step) == (9, int(counted.argmax()))
    assert found.step >= run.task.warmup > result.worst_step, "the diagnostic also describes the start"


def test_filters_without_virtual_observations_have_a_reason() -> None:
    checkpoint, run = traced("push", "crossmodal-pf", 9)
    assert "no virtual observations" in str(DIAGNOSTICS["sources"].refusal(run, checkpoint))
    found = largest_error(checkpoint, [run])
    assert found is not None
    assert not found.sources
    assert "standard deviations" in found.size


def test_long_runs_are_not_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint, run = traced("push", "crossmodal-ekf", 9)
    monkeypatch.setattr("beliefscope.inspect.diagnostics.error_sources.MAX_STEPS", 59)
    assert "60 steps; at most 59" in str(DIAGNOSTICS["sources"].refusal(run, checkpoint))
