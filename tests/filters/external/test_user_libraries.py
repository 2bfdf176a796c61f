"""torchfilter and PyDPF on a linear-Gaussian task, whose exact answer is a Kalman filter's.

Their folders, with those of the packages that they require, are named by BELIEFSCOPE_TORCHFILTER and BELIEFSCOPE_PYDPF.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.external.pydpf_filters import PyDPF
from beliefscope.inspect.catalog import quick
from beliefscope.inspect.trace import Trace, trace

sys.path.insert(0, str(Path(__file__).parent))
import vehicle_filters as vehicle
from user_libraries import from_folder


def external(filter_: Any) -> ExternalFilter:
    return ExternalFilter(Adapter(filter_, std=(1.0,) * 4), vehicle.TASK, "own")


def float32(values: Any) -> Tensor:
    return torch.from_numpy(np.array(values)).float()


def exact(seed: int) -> Trace:
    """The Kalman filter that uses GPS and speed."""
    return trace(external(vehicle.TorchKalman()), vehicle.drive(seed))


def deviations(result: Trace, expected: Trace) -> np.ndarray:
    """(n,) root mean square difference of the estimates in standard deviations of the exact posterior."""
    std = np.sqrt(np.diagonal(expected.estimate_covariance, axis1=1, axis2=2))
    return np.sqrt(np.square((result.estimate_mean - expected.estimate_mean) / std).mean(0))


def torchfilter_models() -> tuple[Any, Any, Any]:
    torchfilter: Any = from_folder("torchfilter", "BELIEFSCOPE_TORCHFILTER")
    process, noise = (
        float32(np.linalg.cholesky(vehicle.Q)),
        torch.diag(torch.tensor([vehicle.GPS] * 2 + [vehicle.SPEED])),
    )

    class Drive(torchfilter.base.DynamicsModel):  # type: ignore[misc, name-defined]
        def forward(self, *, initial_states: Tensor, controls: Tensor) -> tuple[Tensor, Tensor]:
            return initial_states @ float32(vehicle.F).T, process.expand(len(initial_states), 4, 4)

    class Sensors(torchfilter.base.KalmanFilterMeasurementModel):  # type: ignore[misc, name-defined]
        def forward(self, *, states: Tensor) -> tuple[Tensor, Tensor]:
            return states[:, :3], noise.expand(len(states), 3, 3)

    return torchfilter, Drive(state_dim=4), Sensors(state_dim=4, observation_dim=3)


def joined(observations: dict[str, Tensor], controls: Tensor) -> tuple[Tensor, Tensor]:
    return torch.cat([observations["gps"], observations["speed"]], dim=-1), controls


@pytest.mark.parametrize(
    ("name", "limit"),
    # The weights of torchfilter's sigma points are of the order 1e4, which float32 cancels to three digits.
    [("ExtendedKalmanFilter", 0.02), ("ExtendedInformationFilter", 0.02), ("UnscentedKalmanFilter", 0.5)],
)
def test_kalman_filters_of_torchfilter(name: str, limit: float) -> None:
    torchfilter, drive, sensors = torchfilter_models()
    filter_ = getattr(torchfilter.filters, name)(dynamics_model=drive, measurement_model=sensors)
    adapter = Adapter(filter_, std=(1.0,) * 4, inputs=joined)
    result = trace(ExternalFilter(adapter, vehicle.TASK, name), vehicle.drive(1))
    assert (deviations(result, exact(1)) < limit).all()
    assert {"consistency", "errors"} <= set(quick(result))


def test_particle_filter_of_torchfilter() -> None:
    torchfilter, drive, _ = torchfilter_models()
    scale = torch.tensor([vehicle.GPS] * 2 + [vehicle.SPEED])

    class Likelihood(torchfilter.base.ParticleFilterMeasurementModel):  # type: ignore[misc, name-defined]
        def forward(self, *, states: Tensor, observations: Tensor) -> Tensor:
            return -0.5 * ((states[..., :3] - observations.unsqueeze(1)) / scale).square().sum(-1)

    filter_ = torchfilter.filters.ParticleFilter(
        dynamics_model=drive, measurement_model=Likelihood(state_dim=4), num_particles=2000
    )
    adapter = Adapter(filter_, std=(1.0,) * 4, inputs=joined)
    result = trace(ExternalFilter(adapter, vehicle.TASK, "pf"), vehicle.drive(1))
    assert (deviations(result, exact(1)) < 1.0).all()
    assert result.ancestors is not None
    assert {"consistency", "errors", "particles"} <= set(quick(result))


def pydpf_filter(seed: int) -> Any:
    pydpf: Any = from_folder("pydpf", "BELIEFSCOPE_PYDPF")
    generator = torch.Generator().manual_seed(seed)
    noise = torch.diag(torch.tensor([vehicle.GPS] * 2 + [vehicle.SPEED]))
    gaussian, zeros = pydpf.LinearGaussian, torch.zeros(4)
    model = pydpf.FilteringModel(
        dynamic_model=gaussian(float32(vehicle.F), zeros, float32(np.linalg.cholesky(vehicle.Q)), generator=generator),
        observation_model=gaussian(torch.eye(3, 4), torch.zeros(3), noise, generator=generator),
        prior_model=pydpf.MultivariateGaussian(zeros, float32(np.linalg.cholesky(vehicle.P0)), generator=generator),
    )
    return pydpf.ParticleFilter(pydpf.SystematicResampler(generator=generator), model)


def test_particle_filter_of_pydpf() -> None:
    filter_ = PyDPF(pydpf_filter(0), lambda o: torch.cat([o["gps"], o["speed"]], -1), 2000)
    result = trace(external(filter_), vehicle.drive(1))
    # PyDPF weights its initial particles by the first observation, without a prediction before it.
    assert (deviations(result, exact(1)) < 0.5).all()
    assert result.particles is not None
    np.testing.assert_allclose(np.exp(result.log_weights).sum(1), 1.0, rtol=1e-4)  # type: ignore[arg-type]
    assert "log_evidence" in result.extra
    assert {"consistency", "errors", "particles"} <= set(quick(result))


class Stops(torch.nn.Module):
    """The interface of a PyDPF filter, which stops at step 2."""

    def forward(self, *, aggregation_function: Any, observation: Tensor, **_: Any) -> None:
        n = observation.shape[1]
        for _ in range(2):
            aggregation_function(
                state=torch.zeros(n, 5, 4), weight=torch.full((n, 5), -np.log(5)), likelihood=torch.zeros(n)
            )


def test_divergence_is_one_line() -> None:
    with pytest.raises(BadInput, match=r"^own fails at all steps: ValueError: the weights diverge at step 2$"):
        trace(external(PyDPF(Stops(), lambda o: o["gps"], 5)), vehicle.drive(1))
