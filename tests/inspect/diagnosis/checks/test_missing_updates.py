"""Updates that an external Kalman filter lacks: of one component, and with a whole modality."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from tests.inspect.diagnosis.checks.test_innovations import Boat, loaded, profile, run, sail

import beliefscope as bs
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnosis.checks.innovations import innovation_statistics
from beliefscope.inspect.diagnosis.diagnose import diagnose
from beliefscope.inspect.diagnostics.kalman_equations import jacobian_statistics


class Considered(Boat):
    """Its updates do not correct the bias of the turn rate."""

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        bias = float(self.mean[3])
        values = super().__call__(observations=observations, controls=controls)
        values["estimate_mean"][3] = self.mean[3] = bias
        return values


@pytest.mark.first(2)
@pytest.mark.parametrize("boat", [Boat(), Boat(gain=0.4), Considered()], ids=["right", "gain", "considered"])
def test_slopes_of_the_corrections_by_component(boat: Boat) -> None:
    checkpoint = loaded(boat, every=1)
    assert isinstance(checkpoint, ExternalFilter)
    values = jacobian_statistics(bs.trace(checkpoint, [sail(3, every=1)]), checkpoint)
    slopes = [values[f"component correction/{name}/all"] for name in ("x", "y", "heading", "bias")]
    if isinstance(boat, Considered):
        assert slopes == pytest.approx([1.0, 1.0, 1.0, 0.0], abs=0.05)
    elif boat.gain == 1.0:
        assert slopes == pytest.approx([1.0] * 4, abs=0.05)
    else:  # the radar alone corrects the position
        assert slopes[:2] == pytest.approx([0.4, 0.4], abs=0.1)


def test_a_component_that_is_not_corrected_is_the_cause() -> None:
    result = diagnose(loaded(Considered()), {seed: sail(seed) for seed in range(20, 26)}, profile=profile())
    assert result.causes[0].cause.name == "updates.component"


def test_a_modality_that_the_filter_lacks_is_never_used() -> None:
    whole = run(Boat())
    assert whole.innovation is not None
    assert whole.innovation_covariance is not None
    assert whole.predicted_mean is not None
    assert whole.predicted_covariance is not None
    part = replace(
        whole,
        modalities=("radar",),
        innovation=whole.innovation[:, :1],
        innovation_covariance=whole.innovation_covariance[:, :1],
        predicted_mean=whole.predicted_mean[:, :1],
        predicted_covariance=whole.predicted_covariance[:, :1],
    )
    assert innovation_statistics(part)["updates/compass/all"] == 0.0
    others = innovation_statistics(replace(part, modalities=("range",)))
    assert "updates/compass/all" not in others, "the names of the filter's models are not those of the task"
