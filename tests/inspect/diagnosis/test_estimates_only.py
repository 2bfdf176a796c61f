"""External filters that report estimates and covariances only, such as recurrent networks."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest
from tests.inspect.diagnosis.test_external_dynamics import Cart, drive, loaded

from beliefscope.inspect.diagnosis.diagnose import diagnose
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.healthy import profile_of


class Network(Cart):
    """A filter whose equations nobody sees. size: of its reported covariance."""

    def __init__(self, size: float = 1.0, **settings: Any) -> None:
        super().__init__(**settings)
        self.size = size

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        result = super().__call__(observations=observations, controls=controls)
        return {
            "estimate_mean": result["estimate_mean"],
            "estimate_covariance": self.size * result["estimate_covariance"],
        }


@cache
def profile() -> HealthyProfile:
    return profile_of(loaded(Network(weight=0.85)), [drive(seed) for seed in range(12)], "cart")


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("filter_", "cause"),
    [
        (Network(weight=0.85, size=0.1), "filter.overconfident"),
        (Network(weight=0.85, size=10.0), "filter.underconfident"),
        (Network(weight=0.85, gain=0.3), "filter.changed"),
        (Network(weight=0.85, ignores_start=True), "start.ignored"),
        (Network(weight=0.85), ""),
    ],
)
def test_the_fault_of_a_filter_without_visible_equations_is_named(filter_: Network, cause: str) -> None:
    episodes = {seed: drive(seed) for seed in range(20, 26)}
    result = diagnose(loaded(filter_), episodes, profile=profile())
    assert [c.cause.name for c in result.causes[:1]] == ([cause] if cause else [])
    assert any("reports no predicted_mean" in text for text in result.unmeasured)
    if cause.startswith("filter."):
        assert "version of the healthy record" in result.causes[0].next


@pytest.mark.long
def test_a_filter_that_reports_predictions_has_the_causes_of_its_equations() -> None:
    checkpoint = loaded(Cart(weight=0.85))
    record = profile_of(checkpoint, [drive(seed) for seed in range(12)], "cart")
    assert "belief variance//all" not in record.statistics
    result = diagnose(loaded(Cart(weight=0.85, gain=0.3)), {s: drive(s) for s in range(20, 26)}, profile=record)
    assert not any(c.cause.name.startswith("filter.") for c in result.causes)
    assert not any("predicted_mean" in text for text in result.unmeasured)
