"""The condition under which the steps of an external filter are wrong."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.inspect.diagnosis.test_external_dynamics import SENSORS, Cart, drive, loaded, profile

from beliefscope.inspect.diagnosis.cause import Cause
from beliefscope.inspect.diagnosis.diagnose import diagnose
from beliefscope.inspect.diagnosis.error_conditions import error_condition
from beliefscope.inspect.trace import Trace, trace

EPISODES = range(20, 40)


class ForwardOnly(Cart):
    """Moves forward along x, whatever the sign of the control."""

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        forward = np.array([abs(controls[0]), controls[1]])
        return super().__call__(observations=observations, controls=forward)


class Saturated(Cart):
    """Expects readings of the sensor ``front`` that do not exceed a limit, which they do."""

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        values = super().__call__(observations=observations, controls=controls)
        expected = dict.fromkeys(SENSORS, values["predicted_mean"][0])
        expected["front"] = np.minimum(expected["front"], [0.1, np.inf])
        innovation = np.stack([observations[key] - expected[key] for key in SENSORS])
        size = np.stack([values["predicted_covariance"][0] + std**2 * np.eye(2) for std in SENSORS.values()])
        return values | {"innovation": innovation, "innovation_covariance": size}


def runs(filter_: Cart) -> list[Trace]:
    return [trace(loaded(filter_), drive(seed), seed) for seed in EPISODES]


def condition(filter_: Cart, name: str) -> str:
    cause = Cause(name, "", (), "", "")
    return error_condition(runs(filter_), loaded(filter_), cause)  # type: ignore[arg-type]


def test_the_controls_with_wrong_predictions_are_named() -> None:
    text = condition(ForwardOnly(), "dynamics.broken")
    found = re.match(
        r"Start with the steps where control x <= (-?[\d.]+): their prediction errors are ([\d.]+) times", text
    )
    assert found, text
    assert -0.05 < float(found[1]) <= 0.0
    assert float(found[2]) > 2.0


def test_the_errors_of_exact_predictions_have_no_number() -> None:
    """Without process noise, only the faulty steps have errors."""
    still = []
    for seed in EPISODES:
        episode = drive(seed)
        controls = np.where(episode.controls > 0.02, episode.controls, 0.1).astype(np.float32)
        controls[episode.controls[:, 0] < -0.02, 0] = -0.1
        still.append(replace(episode, controls=controls, states=np.cumsum(controls, 0, dtype=np.float32)))
    traces = [trace(loaded(ForwardOnly()), episode, seed) for seed, episode in zip(EPISODES, still, strict=True)]
    text = error_condition(traces, loaded(ForwardOnly()), Cause("dynamics.broken", "", (), "", ""))  # type: ignore[arg-type]
    assert "their prediction errors are more than 100 times those of the other steps." in text


def test_the_states_with_wrong_innovations_are_named() -> None:
    text = condition(Saturated(), "measurement.front.function")
    assert re.match(
        r"Start with the steps where true [xy] > [\d.]+ cm: their innovations of front are [\d.]+ times", text
    )


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("filter_", "name"),
    [
        (Cart(), "dynamics.broken"),
        (Saturated(), "measurement.rear.function"),
        (ForwardOnly(), "process_noise.small"),
        (ForwardOnly(), "measurement.front.function"),  # reports no innovations
    ],
)
def test_no_condition_without_reason(filter_: Cart, name: str) -> None:
    assert condition(filter_, name) == ""


@pytest.mark.slow
@pytest.mark.long
def test_the_next_action_names_the_condition() -> None:
    result = diagnose(loaded(ForwardOnly()), {seed: drive(seed) for seed in EPISODES}, profile=profile())
    assert result.causes[0].cause.name.startswith("dynamics.")
    assert " Start with the steps where control x <= " in result.causes[0].next
    assert "Start with" not in result.headline
