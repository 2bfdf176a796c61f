"""Tests of innovations in measurement space, whose channels may be absent at any step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from beliefscope.datasets.store import open_dataset
from beliefscope.filters.checkpoint import PRETRAINED, load_checkpoint
from beliefscope.inspect.diagnostics.gates import innovations_of
from beliefscope.inspect.statistics.innovations import autocorrelations, least_certain, nis_of, whiteness_of
from beliefscope.inspect.statistics.measures import counted
from beliefscope.inspect.trace import Trace, trace


@pytest.fixture(scope="module")
def run() -> Trace:
    """White innovations of two channels of each modality; the second of haptics does not exist."""
    with open_dataset("datasets/samples/door.h5") as data:
        result = trace(load_checkpoint(PRETRAINED / "door-crossmodal-ekf.safetensors"), data[140])
    innovation = np.random.default_rng(0).normal(size=(len(result), 2, 2)).astype(np.float32)
    innovation[:, 1, 1] = np.nan
    covariance = np.broadcast_to(np.eye(2, dtype=np.float32), (len(result), 2, 2, 2)).copy()
    return replace(result, innovation=innovation, innovation_covariance=covariance)


def with_variance(trace_: Trace, variance: float) -> Trace:
    assert trace_.innovation_covariance is not None
    covariance = trace_.innovation_covariance.copy()
    covariance[:, 0, 1, 1] = variance
    return replace(trace_, innovation_covariance=covariance)


def test_channels_have_the_names_of_their_modality(run: Trace) -> None:
    image, haptics = run.modalities
    expected = [(image, "channel 0"), (image, "channel 1"), (haptics, "channel 0")]
    assert [*autocorrelations(run)] == expected
    assert [(w.modality, w.component) for w in whiteness_of([run, run])] == expected
    assert max(map(abs, autocorrelations(run).values())) < 4.0 / np.sqrt(counted(run).sum())


def test_channels_without_a_valid_variance_or_a_counted_step_have_no_test(run: Trace) -> None:
    """A filter that diverges can report negative variances; the others' results are unchanged."""
    invalid, others = with_variance(run, -1.0), autocorrelations(run)
    image, haptics = run.modalities
    assert autocorrelations(invalid) == {name: r for name, r in others.items() if name != (image, "channel 1")}
    assert run.innovation is not None
    early = run.innovation.copy()
    early[counted(run), 1] = np.nan
    assert (haptics, "channel 0") not in autocorrelations(replace(run, innovation=early))
    assert [w.component for w in whiteness_of([run, invalid])] == ["channel 0", "channel 0"]


@pytest.mark.parametrize("s", [((1e30, 1e30), (1e30, 1e30)), ((0.5, 1.0), (1.0, 0.5)), ((np.nan, 0.0), (0.0, 1.0))])
def test_a_covariance_that_is_not_positive_definite_has_no_squared_innovation(
    run: Trace, s: tuple[tuple[float, float], ...]
) -> None:
    """As that of a filter that diverges, whose large covariances are rounded."""
    assert run.innovation_covariance is not None
    covariance = run.innovation_covariance.copy()
    covariance[3, 0] = s
    invalid, usual = replace(run, innovation_covariance=covariance), nis_of(run)
    nis = nis_of(invalid)
    assert nis is not None
    assert usual is not None
    assert np.argwhere(np.isnan(nis) & ~np.isnan(usual)).tolist() == [[3, 0]]
    assert np.nanmin(nis) >= 0.0
    np.testing.assert_equal(innovations_of([invalid]).nis, nis)


def test_the_belief_before_all_updates_is_the_same_but_for_steps_that_show_another_one() -> None:
    """Sample covariances of 64 members before three updates that hardly change them: the second is one at step 5."""
    rng = np.random.default_rng(0)
    members = rng.normal(size=(20, 1, 64, 4)) * np.array([1.0, 0.98, 0.96])[:, None, None]
    members = members + 0.02 * rng.normal(size=members.shape)
    members[5] *= np.array([0.5, 1.0, 0.4])[:, None, None]
    deviation = members - members.mean(-2, keepdims=True)
    covariance = np.swapaxes(deviation, -1, -2) @ deviation / 63
    assert least_certain(covariance).tolist() == [1 if step == 5 else 0 for step in range(20)]
