"""External filters: inputs, captured values, and removal of hooks."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.maps.availability import no_maps
from beliefscope.inspect.maps.map_engine import MapEngine
from beliefscope.inspect.trace import Trace, load_trace, save_trace, trace

sys.path.insert(0, str(Path(__file__).parent))
import torchfilter_stubs as stubs

sys.path.insert(0, str(Path(__file__).parents[2] / "filters" / "external"))
from user_libraries import from_folder

SEED = 3


@pytest.fixture(scope="module")
def episodes() -> list[Episode]:
    with open_dataset(sample_path("door")) as data:
        return [data[index] for index in data.held_out()[:2]]


@pytest.fixture(scope="module")
def episode(episodes: list[Episode]) -> Episode:
    return episodes[0]


def external(module: nn.Module, **adapter: Any) -> ExternalFilter:
    return ExternalFilter(Adapter(module, **adapter), DOOR, "mine")


def particle_filter() -> stubs.Particles:
    image = stubs.Likelihood(stubs.Sensor("effector_position", 3, 0.1, seed=1))
    return stubs.Particles(stubs.CrossmodalLikelihood(image, stubs.Likelihood(stubs.Sensor("force", 3, 0.08, seed=2))))


def kalman_filters() -> stubs.CrossmodalKalman:
    sensors = stubs.Sensor("effector_position", 3, 0.5, seed=1), stubs.Sensor("force", 3, 0.4, seed=2)
    return stubs.CrossmodalKalman(*(stubs.VirtualSensorKalman(sensor) for sensor in sensors))


STUBS: list[Callable[[], nn.Module]] = [
    particle_filter,
    kalman_filters,
    lambda: stubs.VirtualSensorKalman(stubs.Sensor("force", 3, 0.4, seed=2)),
]


class PlainFilter(nn.Module):
    """A built-in filter with the external interface: SI units, one step at a time, results by name."""

    def __init__(self) -> None:
        super().__init__()
        self.filter = load_checkpoint(pretrained_path("door", "crossmodal-ekf")).filter

    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        si = self.filter.statistics
        std = si.get_buffer("state_std")
        start = Gaussian(si.standardise("state", mean), covariance / std / std[:, None])
        self.belief = self.filter.start(start, 1, torch.Generator())

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> dict[str, Tensor]:
        si = self.filter.statistics
        parts = {name: [observations[key] for key in keys] for name, keys in DOOR.modalities.items()}
        batch_observations = {
            name: (value[0] if len(value) == 1 else torch.cat(value, -1))[None] for name, value in parts.items()
        }
        zeros = torch.zeros(1, len(controls), 3)
        batch = Batch(batch_observations, controls[None], zeros, zeros[..., 0] > 0, zeros[0])
        evidence = self.filter.encode(batch)
        self.belief, step = self.filter.step(self.belief, evidence[0], torch.Generator())
        assert evidence.log_weights is not None
        assert isinstance(step.modality, Gaussian)
        return {
            "estimate_mean": si.state_to_si(step.estimate.mean),
            "estimate_covariance": si.covariance_to_si(step.estimate.covariance),
            "modality_mean": si.state_to_si(step.modality.mean),
            "modality_covariance": si.covariance_to_si(step.modality.covariance),
            "weights": evidence.log_weights[0].exp(),
        }


def test_external_interface_reproduces_the_built_in_filter(episode: Episode, tmp_path: Path) -> None:
    native = trace(load_checkpoint(pretrained_path("door", "crossmodal-ekf")), episode)
    result = trace(external(PlainFilter()), episode)
    assert (result.kind, result.modalities) == ("external", native.modalities)
    for name in ("start_mean", "start_covariance", "estimate_mean", "estimate_covariance", "modality_mean", "weights"):
        # Tolerance for single-step evaluation and unit conversion in float32.
        np.testing.assert_allclose(getattr(result, name), getattr(native, name), rtol=2e-3, atol=1e-5, err_msg=name)
    checkpoint = external(PlainFilter())
    assert no_maps(checkpoint, result) is None
    native_maps = MapEngine(load_checkpoint(pretrained_path("door", "crossmodal-ekf")), native)
    expected = native_maps.map(50, size=41, quantity="posterior")
    engine = MapEngine(checkpoint, result)
    actual = engine.map(50, size=41)
    assert (engine.quantities, actual.quantity) == (("posterior",), "posterior")
    assert actual.rule == "posterior reported by the filter"
    with pytest.raises(BadInput, match="has no likelihood maps: it reports no virtual observations"):
        engine.map(50, size=41, quantity="likelihood")
    sensors = {name: getattr(native, name) for name in ("observation_mean", "observation_covariance")}
    both = MapEngine(checkpoint, replace(result, **sensors))
    assert both.quantities == ("likelihood", "posterior")
    likelihood, reference = both.map(50, size=41), native_maps.map(50, size=41)
    np.testing.assert_array_equal(likelihood.log_likelihood[:2], reference.log_likelihood[:2])
    assert likelihood.rule == "product of likelihoods (the filter's own rule is unknown)"
    product = likelihood.log_likelihood[:2].sum(axis=0)
    np.testing.assert_allclose(np.ptp(likelihood.log_likelihood[2] - product), 0.0, atol=1e-2)
    assert actual.layers == expected.layers
    np.testing.assert_allclose(actual.normalised(), expected.normalised(), atol=6)  # out of 255
    save_trace(result, tmp_path / "made.trace")
    again = load_trace(tmp_path / "made.trace")
    np.testing.assert_array_equal(again.estimate_mean, result.estimate_mean)


def test_evaluation_equals_the_built_in_filter(episodes: list[Episode]) -> None:
    native = evaluate(load_checkpoint(pretrained_path("door", "crossmodal-ekf")).filter, episodes).to_dict()
    result = evaluate(external(PlainFilter()), episodes).to_dict()
    assert result["rmse"] == pytest.approx(native["rmse"], rel=2e-3)
    assert result["nees"] == pytest.approx(native["nees"], rel=2e-3)


class ReorderedUnits(nn.Module):
    """A filter in standardised units and another order of components."""

    ORDER = (2, 0, 1)
    MEAN, STD = (0.6, 0.8, -0.3), (0.4, 0.05, 0.06)

    def __init__(self, inner: nn.Module) -> None:
        super().__init__()
        self.inner = inner
        self.back = [self.ORDER.index(i) for i in range(3)]
        self.mean, self.std = torch.tensor(self.MEAN), torch.tensor(self.STD)

    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        back = (covariance * self.std * self.std[:, None])[:, self.back][:, :, self.back]
        self.inner.initialize_beliefs(mean=(mean * self.std + self.mean)[:, self.back], covariance=back)  # type: ignore[operator]

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> tuple[Tensor, Tensor]:
        output = self.inner(observations={"force": observations["sensors"]}, controls=controls)
        covariance = self.inner.belief_covariance[:, self.ORDER][:, :, self.ORDER]  # type: ignore[index]
        return (output[:, self.ORDER] - self.mean) / self.std, covariance / self.std / self.std[:, None]


def test_adapter_converts_units_and_order(episode: Episode) -> None:
    inner = STUBS[2]()
    plain = external(inner)
    adapted = external(
        ReorderedUnits(inner),
        components=("angle", "hinge_x", "hinge_y"),
        mean=ReorderedUnits.MEAN,
        std=ReorderedUnits.STD,
        inputs=lambda observations, controls: ({"sensors": observations["force"]}, controls),
    )
    start = adapted.start([episode])
    std = torch.tensor(ReorderedUnits.STD)[[1, 2, 0]]
    torch.testing.assert_close(start.covariance[0], torch.diag(0.1 * std**2))
    object.__setattr__(plain, "start", adapted.start)
    value, adapted_trace = trace(plain, episode), trace(adapted, episode)
    np.testing.assert_allclose(adapted_trace.estimate_mean, value.estimate_mean, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(adapted_trace.estimate_covariance, value.estimate_covariance, rtol=1e-4, atol=1e-7)


def hooks(module: nn.Module) -> list[Any]:
    """Hooks and replaced methods of a module and its submodules."""
    kinds = ("_forward_hooks", "_forward_pre_hooks", "_forward_hooks_with_kwargs", "_backward_hooks")
    return [
        (name, type(part), "forward" in vars(part), [dict(getattr(part, kind)) for kind in kinds])
        for name, part in module.named_modules()
    ]


def run_without_hooks(module: Any, filter_: ExternalFilter, episode: Episode) -> Tensor:
    """Estimates (T, n) of a module without hooks."""
    start = filter_.start([episode])
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(SEED)
        module.initialize_beliefs(mean=start.mean, covariance=start.covariance)
        inputs = {key: torch.from_numpy(value)[:, None] for key, value in episode.observations.items()}
        controls = torch.from_numpy(episode.controls)[:, None]
        steps = ({key: value[t] for key, value in inputs.items()} for t in range(len(episode)))
        return torch.cat([module(observations=value, controls=controls[t]) for t, value in enumerate(steps)])


@pytest.mark.parametrize("make", STUBS)
def test_hooks_do_not_change_results_and_are_removed(make: Callable[[], nn.Module], episode: Episode) -> None:
    module = make().eval()
    hooks_before, random = hooks(module), torch.get_rng_state()
    filter_ = external(module)
    result = trace(filter_, episode, seed=SEED)
    assert hooks(module) == hooks_before
    assert torch.equal(torch.get_rng_state(), random)
    np.testing.assert_array_equal(result.estimate_mean, run_without_hooks(module, filter_, episode).numpy())
    assert np.linalg.eigvalsh(result.estimate_covariance.astype(np.float64)).min() > 0.0


def test_hooks_are_removed_after_a_failure(episode: Episode) -> None:
    module = particle_filter().eval()
    hooks_before, calls = hooks(module), iter(range(100))

    def fail() -> None:
        if next(calls) == 7:
            assert hooks(module) != hooks_before  # hooks are installed
            raise RuntimeError("out of\nluck")

    module.at_end = fail
    with pytest.raises(BadInput, match=r"^mine fails at step 7: RuntimeError: out of$"):
        trace(external(module), episode)
    assert hooks(module) == hooks_before


@pytest.fixture(scope="module")
def particles(episode: Episode) -> Trace:
    return trace(external(particle_filter()), episode, seed=SEED)


def test_posterior_before_resampling(particles: Trace) -> None:
    result = particles
    assert result.particles is not None
    assert result.log_weights is not None
    assert result.prior_log_weights is not None
    assert result.log_likelihood is not None
    assert result.modalities == ("image", "haptics")
    assert result.settings["particles"] == 80
    weights = np.exp(result.log_weights.astype(np.float64))
    np.testing.assert_allclose(weights.sum(1), 1.0, atol=1e-5)
    assert weights.max(1).min() > 1.5 / 80  # uniform after resampling
    np.testing.assert_allclose(np.exp(result.prior_log_weights), 1.0 / 80, rtol=1e-5)
    np.testing.assert_allclose(np.einsum("tm,tmn->tn", weights, result.particles), result.estimate_mean, atol=1e-5)
    # The posterior follows from the measurement models and their weights.
    assert result.weights is not None
    fused = np.logaddexp.reduce(np.log(result.weights) + result.log_likelihood, axis=1)
    posterior = fused - np.logaddexp.reduce(fused, axis=1, keepdims=True)
    np.testing.assert_allclose(posterior, result.log_weights, atol=1e-4)


def test_ancestors_and_effective_weights_of_particles(particles: Trace) -> None:
    assert particles.ancestors is not None
    assert particles.effective_weights is not None
    assert particles.log_weights is not None
    weights = np.exp(particles.log_weights)
    counts = np.stack([np.bincount(row, minlength=80) for row in particles.ancestors])
    assert (counts.sum(1) == 80).all()
    # Multinomial counts within 6 standard deviations of the expectation.
    assert (np.abs(counts - 80 * weights) < 6 * np.sqrt(80 * weights) + 1).all()
    np.testing.assert_allclose(particles.effective_weights.sum(1), 1.0, atol=1e-5)


def test_kalman_filters_provide_prediction_observation_and_weights(episode: Episode) -> None:
    result = trace(external(kalman_filters(), modalities=("camera", "touch")), episode)
    assert result.modalities == result.modalities_with_posterior == ("camera", "touch")
    assert result.predicted_covariance is not None
    assert result.observation_mean is not None
    assert result.observation_covariance is not None
    assert result.predicted_mean is not None
    assert result.effective_weights is not None
    invert = np.linalg.inv
    prior, sensor = (
        invert(value.astype(np.float64)) for value in (result.predicted_covariance, result.observation_covariance)
    )
    np.testing.assert_allclose(invert(prior + sensor), result.modality_covariance, rtol=1e-3, atol=1e-6)
    information = prior @ result.predicted_mean[..., None] + sensor @ result.observation_mean[..., None]
    np.testing.assert_allclose(
        (invert(prior + sensor) @ information)[..., 0], result.modality_mean, rtol=1e-3, atol=1e-5
    )
    np.testing.assert_allclose(
        (result.effective_weights * result.modality_mean).sum(1), result.estimate_mean, atol=1e-5
    )


class SequenceModel(nn.Module):
    """A model of complete sequences, without an initial belief."""

    def __init__(self, **extra: Tensor) -> None:
        super().__init__()
        self.extra = extra

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> Tensor | dict[str, Tensor]:
        mean = observations["effector_position"].cumsum(0)
        return {"estimate_mean": mean, **self.extra} if self.extra else mean


def test_sequence_model(episode: Episode) -> None:
    result = trace(external(SequenceModel()), episode)
    np.testing.assert_allclose(result.estimate_mean, episode.observations["effector_position"].cumsum(0), rtol=1e-5)
    assert (result.modalities, result.modalities_with_posterior, result.has_covariance) == ((), (), False)
    assert no_maps(external(SequenceModel()), result) == (
        "filter 'mine' has no likelihood maps: it reports no covariance"
    )
    with pytest.raises(BadInput, match="it reports no covariance"):
        MapEngine(external(SequenceModel()), result)
    weighted = trace(external(SequenceModel(weights=torch.full((len(episode), 1, 2, 1), 0.5))), episode)
    assert (weighted.modalities, weighted.modalities_with_posterior) == (("image", "haptics"), ())
    assert evaluate(external(SequenceModel()), [episode]).to_dict()["nees"] is None


T = 100
INVALID = {
    "estimate_covariance of shape (2, 3), expected (100, 1, 3, 3)": {"estimate_covariance": torch.zeros(2, 3)},
    "weights of shape (100, 1, 2, 2), expected (100, 1, K, W)": {"weights": torch.zeros(T, 1, 2, 2)},
    "log_likelihood of shape (100, 1, 3, 9), expected (100, 1, 2, M)": {
        "weights": torch.zeros(T, 1, 2, 1),
        "log_likelihood": torch.zeros(T, 1, 3, 9),
    },
    "estimate_covariance with a number that is not finite": {"estimate_covariance": torch.full((T, 1, 3, 3), np.nan)},
    "returns only particles, expected both particles and log_weights, or neither": {
        "particles": torch.ones(T, 1, 4, 3)
    },
    "filter output 'wieghts' does not exist. Did you mean weights or log_weights? ": {"wieghts": torch.zeros(1)},
    "returns weights as a float, expected an array or a Tensor": {"weights": 0.5},
}


@pytest.mark.first(4)
@pytest.mark.parametrize("message", INVALID)
def test_invalid_results_are_refused(episode: Episode, message: str) -> None:
    with pytest.raises(BadInput) as error:
        trace(external(SequenceModel(**INVALID[message])), episode)  # type: ignore[arg-type]
    assert message in str(error.value)


def test_torchfilter(episode: Episode) -> None:
    torchfilter: Any = from_folder("torchfilter", "BELIEFSCOPE_TORCHFILTER")

    class Walk(torchfilter.base.DynamicsModel):  # type: ignore[misc, name-defined]
        def forward(self, *, initial_states: Tensor, controls: Tensor) -> tuple[Tensor, Tensor]:
            return initial_states, 0.01 * torch.eye(3).expand(len(initial_states), 3, 3)

    class Likelihood(torchfilter.base.ParticleFilterMeasurementModel):  # type: ignore[misc, name-defined]
        def forward(self, *, states: Tensor, observations: dict[str, Tensor]) -> Tensor:
            return -50.0 * (states - observations["effector_position"].unsqueeze(1)).square().sum(-1)

    class Sensor(torchfilter.base.VirtualSensorModel):  # type: ignore[misc, name-defined]
        def forward(self, *, observations: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
            inputs = observations["effector_position"]
            return inputs, 0.1 * torch.eye(3).expand(len(inputs), 3, 3)

    walk = Walk(state_dim=3)
    filters = torchfilter.filters
    result = trace(
        external(filters.ParticleFilter(dynamics_model=walk, measurement_model=Likelihood(state_dim=3))), episode
    )
    assert result.particles is not None
    assert result.log_weights is not None
    assert result.ancestors is not None
    weights = np.exp(result.log_weights)
    assert weights.max() > 2.0 / weights.shape[1]
    np.testing.assert_allclose(np.einsum("tm,tmn->tn", weights, result.particles), result.estimate_mean, atol=1e-4)
    sensor = Sensor(state_dim=3)
    kalman = filters.VirtualSensorExtendedKalmanFilter(dynamics_model=walk, virtual_sensor_model=sensor)
    result = trace(external(kalman), episode)
    assert result.predicted_covariance is not None
    assert result.observation_covariance is not None
    prior, inputs = (np.linalg.inv(value) for value in (result.predicted_covariance, result.observation_covariance))
    np.testing.assert_allclose(np.linalg.inv(prior + inputs)[:, 0], result.estimate_covariance, rtol=1e-2, atol=1e-6)
