"""Lags of the labels behind modalities, from innovations of single steps from true states."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.inspect.diagnosis.checks.test_innovations import Boat, loaded, sail

import beliefscope as bs
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnosis.checks.innovation_lags import innovation_lags
from beliefscope.inspect.diagnosis.checks.true_starts import with_innovations_near_truth


def lags(episode: bs.Episode) -> dict[str, float]:
    checkpoint = loaded(Boat(), every=1)
    assert isinstance(checkpoint, ExternalFilter)
    run = bs.trace(checkpoint, [episode])
    values = innovation_lags(run, with_innovations_near_truth(run, checkpoint), checkpoint)
    return {name.removeprefix("lag/labels ").removesuffix("/all"): value for name, value in values.items()}


@pytest.mark.first(3)
@pytest.mark.parametrize("delay", [0, 1, 3])
@pytest.mark.parametrize("key", ["radar", "compass"])
def test_labels_precede_a_late_sensor_by_its_delay(key: str, delay: int) -> None:
    rows = []
    for late in (sail(seed, every=1) for seed in (3, 5, 6)):
        readings = late.observations[key].copy()
        late.observations[key][delay:] = readings[: len(readings) - delay]
        rows.append(lags(late))
    (other,) = {"radar", "compass"} - {key}
    # The standard error is that of readings with noise; turns of ten steps are no line over three of them.
    assert np.mean([row[key] for row in rows]) == pytest.approx(-delay, abs=0.2 + 0.1 * delay)
    assert np.mean([row[other] for row in rows]) == pytest.approx(0.0, abs=0.2)


def test_a_bias_is_no_delay() -> None:
    biased, clean = sail(3, every=1), lags(sail(3, every=1))
    biased.observations["radar"][:, 0] += 1.0
    assert lags(biased) == pytest.approx(clean, abs=0.02)


def test_delayed_labels_are_common_to_all_modalities() -> None:
    clean = sail(3, every=1)
    assert max(map(abs, lags(replace(clean, states=np.roll(clean.states, 2, axis=0))).values())) < 0.5


class Blind(Boat):
    """Never uses the radar, whose second channel is an angle."""

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        return super().__call__(observations=observations | {"radar.present": 0.0}, controls=controls)


def test_a_filter_that_never_uses_a_sensor_has_the_innovations_of_the_others_only() -> None:
    checkpoint = loaded(Blind(), every=1)
    assert isinstance(checkpoint, ExternalFilter)
    run = bs.trace(checkpoint, [sail(3, every=1)])
    assert run.innovation is not None
    assert run.innovation.shape[-1] == 1
    assert innovation_lags(run, with_innovations_near_truth(run, checkpoint), checkpoint) == {}


def test_filters_without_innovations_have_no_such_lags() -> None:
    checkpoint = loaded(Boat(), every=1)
    assert isinstance(checkpoint, ExternalFilter)
    run = replace(bs.trace(checkpoint, [sail(3, every=1)]), innovation=None, innovation_covariance=None)
    assert innovation_lags(run, with_innovations_near_truth(run, checkpoint), checkpoint) == {}
