"""Filters from outside: what they are asked, what is captured of them, and that nothing of it stays behind."""

from __future__ import annotations

import sys
from collections.abc import Callable
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
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.likelihood import MapEngine, no_maps
from beliefscope.inspect.trace import Trace, load_trace, save_trace, trace

sys.path.insert(0, str(Path(__file__).parent))
import torchfilter_stubs as alike

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


def particle_filter() -> alike.Particles:
    image = alike.Likelihood(alike.Sensor("effector_position", 3, 0.1, seed=1))
    return alike.Particles(alike.CrossmodalLikelihood(image, alike.Likelihood(alike.Sensor("force", 3, 0.08, seed=2))))


def kalman_filters() -> alike.CrossmodalKalman:
    sensors = alike.Sensor("effector_position", 3, 0.5, seed=1), alike.Sensor("force", 3, 0.4, seed=2)
    return alike.CrossmodalKalman(*(alike.VirtualSensorKalman(sensor) for sensor in sensors))


LOOKALIKES: list[Callable[[], nn.Module]] = [
    particle_filter,
    kalman_filters,
    lambda: alike.VirtualSensorKalman(alike.Sensor("force", 3, 0.4, seed=2)),
]


class Ours(nn.Module):
    """A filter of this project as a stranger would write it: SI units, one step at a time, by name."""

    def __init__(self) -> None:
        super().__init__()
        self.own = load_checkpoint(shipped("door", "crossmodal-ekf")).filter

    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        si = self.own.statistics
        std = si.get_buffer("state_std")
        start = Gaussian(si.standardise("state", mean), covariance / std / std[:, None])
        self.belief = self.own.start(start, 1, torch.Generator())

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> dict[str, Tensor]:
        si = self.own.statistics
        parts = {name: [observations[key] for key in keys] for name, keys in DOOR.modalities.items()}
        joined = {name: (one[0] if len(one) == 1 else torch.cat(one, -1))[None] for name, one in parts.items()}
        nothing = torch.zeros(1, len(controls), 3)
        batch = Batch(joined, controls[None], nothing, nothing[..., 0] > 0, nothing[0])
        evidence = self.own.encode(batch)
        self.belief, knew = self.own.step(self.belief, evidence[0], torch.Generator())
        assert evidence.log_weights is not None
        assert isinstance(knew.modality, Gaussian)
        return {
            "estimate_mean": si.state_to_si(knew.estimate.mean),
            "estimate_covariance": si.covariance_to_si(knew.estimate.covariance),
            "modality_mean": si.state_to_si(knew.modality.mean),
            "modality_covariance": si.covariance_to_si(knew.modality.covariance),
            "weights": evidence.log_weights[0].exp(),
        }


def test_our_own_filter_from_outside_is_the_native_one(episode: Episode, tmp_path: Path) -> None:
    native = trace(load_checkpoint(shipped("door", "crossmodal-ekf")), episode)
    made = trace(external(Ours()), episode)
    assert (made.kind, made.modalities) == ("external", native.modalities)
    for name in ("start_mean", "start_covariance", "estimate_mean", "estimate_covariance", "modality_mean", "weights"):
        # Networks over one step instead of all at once, and to SI units and back: float32 to some digits.
        np.testing.assert_allclose(getattr(made, name), getattr(native, name), rtol=2e-3, atol=1e-5, err_msg=name)
    checkpoint = external(Ours())
    assert no_maps(checkpoint, made) is None
    ours = MapEngine(load_checkpoint(shipped("door", "crossmodal-ekf")), native).map(50, size=41)
    theirs = MapEngine(checkpoint, made).map(50, size=41)
    assert theirs.layers == ours.layers
    np.testing.assert_allclose(theirs.normalised(), ours.normalised(), atol=6)  # of 255
    save_trace(made, tmp_path / "made.trace")
    again = load_trace(tmp_path / "made.trace")
    np.testing.assert_array_equal(again.estimate_mean, made.estimate_mean)


def test_evaluation_is_that_of_the_native_filter(episodes: list[Episode]) -> None:
    native = evaluate(load_checkpoint(shipped("door", "crossmodal-ekf")).filter, episodes).to_dict()
    made = evaluate(external(Ours()), episodes).to_dict()
    assert made["rmse"] == pytest.approx(native["rmse"], rel=2e-3)
    assert made["nees"] == pytest.approx(native["nees"], rel=2e-3)
    with pytest.raises(BadInput, match="only 'image': mine is from outside"):
        evaluate(external(Ours()), episodes, only="image")


class Turned(nn.Module):
    """Another filter, in standardised units and another order of components."""

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
        said = self.inner(observations={"force": observations["sensors"]}, controls=controls)
        covariance = self.inner.belief_covariance[:, self.ORDER][:, :, self.ORDER]  # type: ignore[index]
        return (said[:, self.ORDER] - self.mean) / self.std, covariance / self.std / self.std[:, None]


def test_units_and_order_are_the_adapters_to_say(episode: Episode) -> None:
    inner = LOOKALIKES[2]()
    plain = external(inner)
    adapted = external(
        Turned(inner),
        components=("angle", "hinge_x", "hinge_y"),
        mean=Turned.MEAN,
        std=Turned.STD,
        inputs=lambda observations, controls: ({"sensors": observations["force"]}, controls),
    )
    start = adapted.start([episode])
    std = torch.tensor(Turned.STD)[[1, 2, 0]]
    torch.testing.assert_close(start.covariance[0], torch.diag(0.1 * std**2))
    object.__setattr__(plain, "start", adapted.start)
    one, other = trace(plain, episode), trace(adapted, episode)
    np.testing.assert_allclose(other.estimate_mean, one.estimate_mean, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(other.estimate_covariance, one.estimate_covariance, rtol=1e-4, atol=1e-7)


def hooks(module: nn.Module) -> list[Any]:
    """All that a hook, or a method put in another's place, would leave on a module and its parts."""
    kinds = ("_forward_hooks", "_forward_pre_hooks", "_forward_hooks_with_kwargs", "_backward_hooks")
    return [
        (name, type(part), "forward" in vars(part), [dict(getattr(part, kind)) for kind in kinds])
        for name, part in module.named_modules()
    ]


def bare(module: Any, subject: ExternalFilter, episode: Episode) -> Tensor:
    """The estimates (T, n) of a module that nobody listens to."""
    start = subject.start([episode])
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(SEED)
        module.initialize_beliefs(mean=start.mean, covariance=start.covariance)
        seen = {key: torch.from_numpy(value)[:, None] for key, value in episode.observations.items()}
        controls = torch.from_numpy(episode.controls)[:, None]
        steps = ({key: value[t] for key, value in seen.items()} for t in range(len(episode)))
        return torch.cat([module(observations=one, controls=controls[t]) for t, one in enumerate(steps)])


@pytest.mark.parametrize("make", LOOKALIKES)
def test_listening_changes_no_bit_and_leaves_nothing(make: Callable[[], nn.Module], episode: Episode) -> None:
    module = make().eval()
    before, random = hooks(module), torch.get_rng_state()
    subject = external(module)
    made = trace(subject, episode, seed=SEED)
    assert hooks(module) == before
    assert torch.equal(torch.get_rng_state(), random)
    np.testing.assert_array_equal(made.estimate_mean, bare(module, subject, episode).numpy())
    assert np.linalg.eigvalsh(made.estimate_covariance.astype(np.float64)).min() > 0.0


def test_nothing_stays_after_a_failure(episode: Episode) -> None:
    module = particle_filter().eval()
    before, calls = hooks(module), iter(range(100))

    def fail() -> None:
        if next(calls) == 7:
            assert hooks(module) != before  # we are listening
            raise RuntimeError("out of\nluck")

    module.at_end = fail
    with pytest.raises(BadInput, match=r"^mine fails at step 7: RuntimeError: out of$"):
        trace(external(module), episode)
    assert hooks(module) == before


@pytest.fixture(scope="module")
def particles(episode: Episode) -> Trace:
    return trace(external(particle_filter()), episode, seed=SEED)


def test_posterior_is_that_before_resampling(particles: Trace) -> None:
    made = particles
    assert made.particles is not None
    assert made.log_weights is not None
    assert made.prior_log_weights is not None
    assert made.log_likelihood is not None
    assert made.modalities == ("image", "haptics")
    assert made.settings["particles"] == 80
    weights = np.exp(made.log_weights.astype(np.float64))
    np.testing.assert_allclose(weights.sum(1), 1.0, atol=1e-5)
    assert weights.max(1).min() > 1.5 / 80  # after resampling all would be 1 / 80
    np.testing.assert_allclose(np.exp(made.prior_log_weights), 1.0 / 80, rtol=1e-5)
    np.testing.assert_allclose(np.einsum("tm,tmn->tn", weights, made.particles), made.estimate_mean, atol=1e-5)
    # Of the two measurement models and their weights the posterior follows, as the filter fuses them.
    assert made.weights is not None
    fused = np.logaddexp.reduce(np.log(made.weights) + made.log_likelihood, axis=1)
    posterior = fused - np.logaddexp.reduce(fused, axis=1, keepdims=True)
    np.testing.assert_allclose(posterior, made.log_weights, atol=1e-4)


def test_ancestors_and_shares_of_particles(particles: Trace) -> None:
    assert particles.ancestors is not None
    assert particles.effective_weights is not None
    assert particles.log_weights is not None
    weights = np.exp(particles.log_weights)
    drawn = np.stack([np.bincount(row, minlength=80) for row in particles.ancestors])
    assert (drawn.sum(1) == 80).all()
    # Multinomial draws: in each step and particle within 6 standard deviations of what its weight makes expect.
    assert (np.abs(drawn - 80 * weights) < 6 * np.sqrt(80 * weights) + 1).all()
    np.testing.assert_allclose(particles.effective_weights.sum(1), 1.0, atol=1e-5)
    held = external(particle_filter())
    assert "cannot be asked about states that none of them visited" in (no_maps(held, particles) or "")


def test_kalman_filters_show_prediction_observation_and_weights(episode: Episode) -> None:
    made = trace(external(kalman_filters(), modalities=("camera", "touch")), episode)
    assert made.modalities == made.modalities_with_posterior == ("camera", "touch")
    assert made.predicted_covariance is not None
    assert made.observation_mean is not None
    assert made.observation_covariance is not None
    assert made.predicted_mean is not None
    assert made.effective_weights is not None
    invert = np.linalg.inv
    prior, sensor = (invert(one.astype(np.float64)) for one in (made.predicted_covariance, made.observation_covariance))
    np.testing.assert_allclose(invert(prior + sensor), made.modality_covariance, rtol=1e-3, atol=1e-6)
    both = prior @ made.predicted_mean[..., None] + sensor @ made.observation_mean[..., None]
    np.testing.assert_allclose((invert(prior + sensor) @ both)[..., 0], made.modality_mean, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose((made.effective_weights * made.modality_mean).sum(1), made.estimate_mean, atol=1e-5)


class Whole(nn.Module):
    """A model of whole sequences: it has nothing that starts it."""

    def __init__(self, **extra: Tensor) -> None:
        super().__init__()
        self.extra = extra

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> Tensor | dict[str, Tensor]:
        mean = observations["effector_position"].cumsum(0)
        return {"estimate_mean": mean, **self.extra} if self.extra else mean


def test_a_model_of_sequences_has_what_it_says(episode: Episode) -> None:
    made = trace(external(Whole()), episode)
    np.testing.assert_allclose(made.estimate_mean, episode.observations["effector_position"].cumsum(0), rtol=1e-5)
    assert (made.modalities, made.modalities_with_posterior, made.has_covariance) == ((), (), False)
    assert no_maps(external(Whole()), made) == (
        "filter 'mine' has no likelihood maps: it estimates the state, but does not say how likely others are"
    )
    with pytest.raises(BadInput, match="does not say how likely"):
        MapEngine(external(Whole()), made)
    weighed = trace(external(Whole(weights=torch.full((len(episode), 1, 2, 1), 0.5))), episode)
    assert (weighed.modalities, weighed.modalities_with_posterior) == (("image", "haptics"), ())
    assert evaluate(external(Whole()), [episode]).to_dict()["nees"] is None


T = 100
WRONG = {
    "estimate_covariance of shape (2, 3), expected (100, 1, 3, 3)": {"estimate_covariance": torch.zeros(2, 3)},
    "weights of shape (100, 1, 2, 2), expected (100, 1, K, W)": {"weights": torch.zeros(T, 1, 2, 2)},
    "log_likelihood of shape (100, 1, 3, 9), expected (100, 1, 2, M)": {
        "weights": torch.zeros(T, 1, 2, 1),
        "log_likelihood": torch.zeros(T, 1, 3, 9),
    },
    "estimate_covariance with a number that is not finite": {"estimate_covariance": torch.full((T, 1, 3, 3), np.nan)},
    "returns particles alone, expected both particles and log_weights, or neither": {
        "particles": torch.ones(T, 1, 4, 3)
    },
    "value of a filter 'wieghts' does not exist. Available: estimate_mean, ": {"wieghts": torch.zeros(1)},
    "returns weights as a float, expected a Tensor": {"weights": 0.5},
}


@pytest.mark.parametrize("message", WRONG)
def test_what_it_says_must_fit(episode: Episode, message: str) -> None:
    with pytest.raises(BadInput) as error:
        trace(external(Whole(**WRONG[message])), episode)  # type: ignore[arg-type]
    assert message in str(error.value)


def test_torchfilter_itself(episode: Episode) -> None:
    torchfilter = pytest.importorskip("torchfilter", reason="torchfilter is not installed")

    class Walk(torchfilter.base.DynamicsModel):  # type: ignore[misc, name-defined]
        def forward(self, *, initial_states: Tensor, controls: Tensor) -> tuple[Tensor, Tensor]:
            return initial_states, 0.01 * torch.eye(3).expand(len(initial_states), 3, 3)

    class Likelihood(torchfilter.base.ParticleFilterMeasurementModel):  # type: ignore[misc, name-defined]
        def forward(self, *, states: Tensor, observations: dict[str, Tensor]) -> Tensor:
            return -50.0 * (states - observations["effector_position"].unsqueeze(1)).square().sum(-1)

    class Sensor(torchfilter.base.VirtualSensorModel):  # type: ignore[misc, name-defined]
        def forward(self, *, observations: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
            seen = observations["effector_position"]
            return seen, 0.1 * torch.eye(3).expand(len(seen), 3, 3)

    walk = Walk(state_dim=3)
    filters = torchfilter.filters
    made = trace(
        external(filters.ParticleFilter(dynamics_model=walk, measurement_model=Likelihood(state_dim=3))), episode
    )
    assert made.particles is not None
    assert made.log_weights is not None
    assert made.ancestors is not None
    weights = np.exp(made.log_weights)
    assert weights.max() > 2.0 / weights.shape[1]
    np.testing.assert_allclose(np.einsum("tm,tmn->tn", weights, made.particles), made.estimate_mean, atol=1e-4)
    sensor = Sensor(state_dim=3)
    kalman = filters.VirtualSensorExtendedKalmanFilter(dynamics_model=walk, virtual_sensor_model=sensor)
    made = trace(external(kalman), episode)
    assert made.predicted_covariance is not None
    assert made.observation_covariance is not None
    prior, seen = (np.linalg.inv(one) for one in (made.predicted_covariance, made.observation_covariance))
    np.testing.assert_allclose(np.linalg.inv(prior + seen)[:, 0], made.estimate_covariance, rtol=1e-2, atol=1e-6)
