"""Filters that break a law in their own healthy record, too, from which they do not deviate."""

from __future__ import annotations

import numpy as np
import pytest
from tests.inspect.diagnosis.test_external_dynamics import Cart, drive, loaded
from tests.inspect.diagnosis.test_external_particles import Particles, filter_of, ride

import beliefscope as bs
from beliefscope.inspect.diagnosis.case import compared
from beliefscope.inspect.diagnosis.conclusion import healthy
from beliefscope.inspect.diagnosis.diagnose import diagnose
from beliefscope.inspect.diagnosis.undo.run_inputs import RunInputs
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.healthy import profile_of


def headline(statistics: dict[str, float], spread: float = 0.01, weighted: bool = False) -> str:
    """Of a run and a record with these statistics, and a spread of the record around them."""
    checkpoint = loaded(Cart()) if weighted else filter_of(Particles())
    trace = bs.trace(checkpoint, [drive(0) if weighted else ride(0)], 0)
    around = spread * np.linspace(-1.0, 1.0, 20)
    record = HealthyProfile("test", 20, None, {name: value + around for name, value in statistics.items()})
    inputs = RunInputs(checkpoint, {}, 300, frozenset())
    return healthy(compared(inputs, [trace], [statistics], [{}], record, 0.05)).headline


@pytest.mark.parametrize(
    ("statistics", "start"),
    [
        ({"dynamics effect/control/x": -1.0}, "True effect of control relative to the predicted one in x is -1, in a"),
        ({"likelihood offset/near x/all": -0.6}, "Offset of the particles by the likelihood, in their standard dev"),
        ({"absent updates/near/all": 1.0}, "The filter updates with near where it has no reading; "),
        ({"dynamics effect/control/x": 1.2, "lost weights//all": 0.1}, "Healthy: "),
        ({"dynamics effect/control/x": 0.1}, "True effect of control"),
        ({"dynamics effect/control/x": 0.1, "dynamics nis/x/all": 1.1}, "Healthy: "),  # a control that is noise
        ({"dynamics effect/control/x": 0.1, "dynamics nis/x/all": 9.0}, "True effect of control"),
        ({"dynamics effect/control/x": -1.0, "dynamics nis/x/all": 1.1}, "True effect of control"),
        (
            {"dynamics effect/control/x": 0.4, "lost weights//all": 1.0},
            "Particle weights are not kept without resampling; ",
        ),
    ],
)
def test_the_first_broken_law_is_the_headline(statistics: dict[str, float], start: str) -> None:
    assert headline(statistics).startswith(start)


def test_a_law_is_broken_if_the_mean_of_the_record_is_far_from_it() -> None:
    effect = {"dynamics effect/control/x": 1.4}
    assert headline(effect).startswith("True effect")
    assert headline(effect, spread=2.0).startswith("Healthy")


def test_updates_with_fusion_weights_are_no_kalman_updates() -> None:
    slope = {"correction slope/front/all": 0.5}
    assert headline(slope, weighted=True).startswith("Healthy")
    assert headline(slope).startswith("Slope of the corrections")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("filter_", "start"),
    [
        (Particles(keeps_weights=False), "Particle weights are not kept without resampling; "),
        pytest.param(Particles(offset=0.15), "Offset of the particles by the likelihood", marks=pytest.mark.long),
        pytest.param(Particles(), "Healthy", marks=pytest.mark.long),
        pytest.param(Cart(gain=-1.0), "True effect of control (", marks=pytest.mark.long),
        pytest.param(Cart(), "Healthy", marks=pytest.mark.long),
    ],
    ids=["weights", "offset", "right particles", "sign", "right Kalman filter"],
)
def test_a_mistake_is_named_without_a_record_of_a_right_filter(filter_: Particles | Cart, start: str) -> None:
    is_cart = isinstance(filter_, Cart)
    checkpoint = loaded(filter_) if is_cart else filter_of(filter_)
    episodes = {seed: drive(seed) if is_cart else ride(seed) for seed in range(14)}
    record = profile_of(checkpoint, list(episodes.values()), "own")
    result = diagnose(checkpoint, {seed: episodes[seed] for seed in range(3)}, profile=record)
    assert result.headline.startswith(start)
