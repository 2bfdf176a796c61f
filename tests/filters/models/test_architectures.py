"""Properties of every filter and option that hold for any weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Evidence, Gaussian, Particles
from beliefscope.filters.catalog import architecture, build, filters_of
from beliefscope.filters.filter import Architecture, Filter
from beliefscope.filters.models.ekf import ExtendedKalmanFilter
from beliefscope.filters.models.lstm import Lstm
from beliefscope.filters.models.networks import ImageEncoder, SpatialSoftmax
from beliefscope.filters.models.pf import MixtureParticleFilter
from beliefscope.filters.models.ukf import sigma_points, unscented
from beliefscope.filters.rollout import Rollout, first_belief, rollout

MakeWindow = Callable[..., Batch]
NAMES = tuple(filters_of(DOOR))
FUSED = [name for name in NAMES if name.startswith("crossmodal")]


def run(filter_: Filter, batch: Batch, evidence: Evidence | None = None, keep: bool = False) -> Rollout:
    evidence = filter_.encode(batch) if evidence is None else evidence
    start = first_belief(filter_, batch)
    return rollout(filter_, evidence, start, torch.Generator().manual_seed(0), particles=20, keep=keep)


def randomise(filter_: Filter) -> Filter:
    """Initial weights with larger outputs of the dynamics and weight models."""
    torch.manual_seed(1)
    for name, module in filter_.named_modules():
        if isinstance(module, nn.Linear) and name in ("dynamics.output", "weight_model.output"):
            nn.init.normal_(module.weight, std=0.5)
    return filter_


# The catalog.


def test_catalog_has_the_filters_of_the_paper_and_a_ukf() -> None:
    fused = {f"{how}-{kind}" for how in ("feature", "unimodal", "crossmodal") for kind in ("ekf", "pf")}
    single = {f"{modality}-{kind}" for modality in ("image", "haptics") for kind in ("ekf", "pf")}
    assert set(NAMES) == fused | single | {"lstm", "transformer", "crossmodal-ukf", "information-ekf", "information-pf"}


@pytest.fixture
def custom_task() -> Task:
    """A custom task with two state components and three modalities, without images."""
    return Task(
        name="custom",
        components=(Component("x", "m"), Component("y", "m")),
        observations={"depth": (4,), "sound": (2,), "skin": (3,), "heat": (1,)},
        modalities={"sight": ("depth",), "hearing": ("sound",), "touch": ("skin", "heat")},
        control_size=2,
        dt=0.1,
        map_components=("x", "y"),
        map_half_width=0.1,
    )


def test_custom_task_has_all_filters_over_its_modalities(custom_task: Task) -> None:
    filters = filters_of(custom_task)
    assert {"sight-ekf", "hearing-pf", "touch-ekf"} <= filters.keys()
    assert "image-ekf" not in filters
    assert filters["crossmodal-pf"].models == ("sight", "hearing", "touch")
    assert filters["feature-ekf"].models == ("sight+hearing+touch",)
    sizes = {"sight": 4, "hearing": 2, "touch": 4}
    observations = {m: torch.randn(5, 2, size) for m, size in sizes.items()}
    states = torch.randn(5, 2, 2)
    batch = Batch(observations, torch.randn(5, 2, 2), states, torch.zeros(5, 2, dtype=torch.bool), states[0])
    for name in filters:
        result = run(build(architecture(custom_task, name)), batch, keep=True)
        assert torch.isfinite(result.estimate.mean).all(), name
        if name.startswith("crossmodal"):
            modality = result.steps[0].modality
            assert modality is None or modality.mean.shape == (2, 3, 2)


def test_unknown_names_are_rejected_with_the_available_ones(custom_task: Task) -> None:
    with pytest.raises(BadInput, match=r"filter 'image-ekf' does not exist\..* Available: .*sight-ekf.*lstm"):
        architecture(custom_task, "image-ekf")
    with pytest.raises(BadInput, match=r"task 'dor' does not exist\. Available: door"):
        architecture("dor", "lstm")


# JSON.


def test_architectures_survive_json() -> None:
    unusual = Architecture(
        DOOR, "pf", "unimodal", ("image",), 32, 1, "authors", "mean", "moments", True, "raw", "soft", soft_share=0.25
    )
    for each in (*filters_of(DOOR).values(), unusual):
        assert Architecture.from_json(each.to_json()) == each


def test_missing_keys_of_older_checkpoints_take_their_default() -> None:
    older = {"task": "door", "kind": "pf", "fusion": "crossmodal", "models": ["image", "haptics"], "units": 64}
    assert Architecture.from_json(older) == Architecture(DOOR, "pf")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "kf"}, "filter kind 'kf' does not exist. Available: ekf, ukf, pf, lstm."),
        ({"pooling": "max"}, "filter pooling 'max' does not exist. Available: flatten, spatial-softmax, mean."),
        ({"resampling": "none"}, "filter resampling 'none' does not exist. Available: systematic, hard, soft."),
        ({"soft_share": 0.0}, "soft_share must be above 0 and at most 1, not 0.0"),
        ({"colour": "red"}, "not an architecture of this version: .*'colour'"),
        ({"task": ["door"]}, "incomplete definition of a task"),
        ({"task": "dor"}, "task 'dor' does not exist"),
        ({"models": ["smell"]}, r"Modality 'smell' is not in task 'door'\. Available: image, haptics\."),
    ],
)
def test_invalid_architectures_are_rejected(change: dict, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        build(Architecture.from_json(Architecture(DOOR, "ekf").to_json() | change))


# Properties of all filters.


@pytest.mark.first(5)
@pytest.mark.parametrize("name", NAMES)
def test_gradients_flow_through_16_steps_to_every_weight(name: str, window: MakeWindow) -> None:
    filter_, batch = build(architecture("door", name)), window(16, 2)
    estimate = run(filter_, batch).estimate
    loss = (estimate.mean - batch.states).square().mean()
    if filter_.has_covariance:
        loss = loss + estimate.covariance.square().mean()
    loss.backward()
    for parameter_name, parameter in filter_.named_parameters():
        assert parameter.grad is not None, parameter_name
        assert torch.isfinite(parameter.grad).all(), parameter_name
        assert parameter.grad.abs().sum() > 0, parameter_name


@pytest.mark.parametrize("name", [name for name in NAMES if name.startswith(("crossmodal", "unimodal"))])
def test_order_of_modalities_does_not_matter(name: str, window: MakeWindow) -> None:
    filter_, batch = randomise(build(architecture("door", name))), window(8, 3)
    reversed_ = build(replace(filter_.architecture, models=filter_.names[::-1]))
    state = {key: value for key, value in filter_.state_dict().items() if not key.startswith("weight_model.")}
    reversed_.load_state_dict(state, strict=False)
    with torch.no_grad():
        evidence = filter_.encode(batch)
        flip = {"control": evidence.control, "observation": evidence.observation.flip(2)}
        noise, weights = evidence.noise, evidence.log_weights
        flipped = Evidence(
            **flip,
            noise=None if noise is None else noise.flip(2),
            log_weights=None if weights is None else weights.flip(2),
        )
        original, swapped = run(filter_, batch, evidence).estimate, run(reversed_, batch, flipped).estimate
    # Sums are taken in another order; this could change an ancestor, but does not for this seed.
    torch.testing.assert_close(swapped.mean, original.mean, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(swapped.covariance, original.covariance, rtol=1e-4, atol=1e-5)


@pytest.mark.first(4)
@pytest.mark.parametrize("feedback", [False, True])
@pytest.mark.parametrize("k", [0, 1])
@pytest.mark.parametrize("name", FUSED)
def test_one_hot_beta_equals_the_unimodal_filter(name: str, k: int, feedback: bool, window: MakeWindow) -> None:
    filter_ = randomise(build(replace(architecture("door", name), feedback=feedback)))
    unimodal = build(replace(filter_.architecture, fusion="none", models=(filter_.names[k],)))
    unimodal.load_state_dict({key: filter_.state_dict()[key] for key in unimodal.state_dict()})
    batch = window(8, 3)
    with torch.no_grad():
        fused, single = run(filter_, batch, filter_.encode(batch).only(k)).estimate, run(unimodal, batch).estimate
    torch.testing.assert_close(fused.mean, single.mean, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(fused.covariance, single.covariance, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("lstm", "transformer")])
def test_covariances_are_positive_definite(name: str, window: MakeWindow) -> None:
    with torch.no_grad():
        covariance = run(randomise(build(architecture("door", name))), window(12, 4)).estimate.covariance
    torch.testing.assert_close(covariance, covariance.transpose(-1, -2))
    assert torch.linalg.eigvalsh(covariance.double()).min() > 0


# Options.


def banks(feedback: bool, window: MakeWindow) -> tuple[Gaussian, Gaussian]:
    """The bank after one step, and the fused belief."""
    filter_ = randomise(build(replace(architecture("door", "crossmodal-ekf"), feedback=feedback)))
    assert isinstance(filter_, ExtendedKalmanFilter)
    batch = window(1, 3)
    with torch.no_grad():
        start = filter_.start(first_belief(filter_, batch), 0, torch.Generator())
        bank, trace = filter_.step(start, filter_.encode(batch)[0], torch.Generator())
    return bank, trace.estimate


def test_feedback_replaces_every_belief_by_the_fused_one(window: MakeWindow) -> None:
    bank, fused = banks(True, window)
    assert torch.equal(bank.mean, fused.mean.unsqueeze(1))
    assert torch.equal(bank.covariance, fused.covariance.unsqueeze(1))
    bank, fused = banks(False, window)
    assert (bank.mean[:, 0] - bank.mean[:, 1]).abs().min() > 1e-3


def posterior(likelihoods: str, offset: float, window: MakeWindow) -> Tensor:
    """Log-weights after a step with a constant added to the haptics log-likelihood."""

    class Shifted(MixtureParticleFilter):
        def log_likelihood(self, evidence: Evidence, states: Tensor) -> Tensor:
            return super().log_likelihood(evidence, 20.0 * states) + torch.tensor([0.0, offset]).unsqueeze(-1)

    torch.manual_seed(0)
    options = replace(architecture("door", "crossmodal-pf"), likelihoods=likelihoods)  # type: ignore[arg-type]
    filter_, batch = Shifted(options), window(1, 2)
    with torch.no_grad():
        step = run(filter_, batch, keep=True).steps[0].posterior
    assert isinstance(step, Particles)
    return step.log_weights


def test_only_raw_likelihoods_depend_on_their_scale(window: MakeWindow) -> None:
    torch.testing.assert_close(
        posterior("normalised", 9.0, window), posterior("normalised", 0.0, window), rtol=1e-4, atol=1e-4
    )
    assert (posterior("raw", 9.0, window) - posterior("raw", 0.0, window)).abs().max() > 0.01


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("pooling", ["flatten", "spatial-softmax", "mean"])
def test_encoders_of_every_pooling_have_gradients(pooling: str, stride: int) -> None:
    encoder = ImageEncoder((32, 32), 16, stride, pooling)  # type: ignore[arg-type]
    features = encoder(torch.randn(3, 32, 32))
    assert features.shape == (3, 16)
    features.square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in encoder.parameters())


def test_spatial_softmax_returns_the_position_of_activation() -> None:
    channels = torch.zeros(1, 2, 5, 9)
    channels[0, 0, 1, 6] = 100.0  # row 1 of 0..4 is y = -0.5, column 6 of 0..8 is x = 0.5
    torch.testing.assert_close(SpatialSoftmax()(channels), torch.tensor([[0.5, 0.0, -0.5, 0.0]]))


# The unscented transform.


def test_sigma_points_have_the_moments_of_the_belief() -> None:
    root = torch.randn(4, 3, 3, dtype=torch.float64)
    belief = Gaussian(torch.randn(4, 3, dtype=torch.float64), root @ root.transpose(-1, -2))
    result = unscented(sigma_points(belief))
    torch.testing.assert_close(result.mean, belief.mean)
    torch.testing.assert_close(result.covariance, belief.covariance)


def test_unscented_square_of_a_gaussian() -> None:
    # x ~ N(m, s^2): x^2 has mean m^2 + s^2 and variance 4 m^2 s^2 + 2 s^4; here m = 3, s = 2: 13 and 176.
    belief = Gaussian(torch.tensor([[3.0]]), torch.tensor([[[4.0]]]))
    squared = unscented(sigma_points(belief).square())
    assert squared.mean.item() == pytest.approx(13.0)
    assert squared.covariance.item() == pytest.approx(176.0)


# The LSTM.


@pytest.fixture
def lstm() -> Lstm:
    filter_ = build(architecture("door", "lstm"))
    assert isinstance(filter_, Lstm)
    return filter_.requires_grad_(False)


def test_lstm_equals_pytorchs(lstm: Lstm, window: MakeWindow) -> None:
    reference = nn.LSTM(64, 512, 2).requires_grad_(False)
    for i, cell in enumerate(lstm.layers):
        getattr(reference, f"weight_ih_l{i}").copy_(cell.weight_x.T)
        getattr(reference, f"weight_hh_l{i}").copy_(cell.weight_h.T)
        getattr(reference, f"bias_ih_l{i}").copy_(cell.bias)
        getattr(reference, f"bias_hh_l{i}").zero_()
    batch = window(10, 3)
    evidence = lstm.encode(batch)
    hidden = lstm.start(first_belief(lstm, batch), 0, torch.Generator()).hidden
    first = tuple(hidden[:, :, i].transpose(0, 1).contiguous() for i in range(2))
    expected = lstm.output(reference(evidence.observation.squeeze(2), first)[0])
    torch.testing.assert_close(run(lstm, batch, evidence).estimate.mean, expected, rtol=1e-5, atol=1e-6)


def test_lstm_steps_equal_the_batched_ones(lstm: Lstm, window: MakeWindow) -> None:
    batch, generator = window(10, 3), torch.Generator()
    evidence = lstm.encode(batch)
    belief = lstm.start(first_belief(lstm, batch), 0, generator)
    batched = [step for _, step in lstm.steps(belief, evidence, generator)]
    for t, trace in enumerate(batched):
        assert trace.predicted.hidden.equal(belief.hidden)  # type: ignore[union-attr]
        belief, step = lstm.step(belief, evidence[t], generator)
        assert step.estimate.mean.equal(trace.estimate.mean)
        assert step.posterior.hidden.equal(trace.posterior.hidden)  # type: ignore[union-attr]


def test_lstm_depends_on_the_first_belief_and_has_no_covariance(lstm: Lstm, window: MakeWindow) -> None:
    batch = window(3, 2)
    shifted = run(lstm, replace(batch, previous=batch.previous + 1.0)).estimate
    assert (shifted.mean[0] - run(lstm, batch).estimate.mean[0]).abs().max() > 1e-4
    assert shifted.covariance.shape == (3, 2, 3, 3)
    assert torch.isnan(shifted.covariance).all()
