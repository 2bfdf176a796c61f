"""Metrics of errors drawn from a known covariance, and of an estimator without a covariance."""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.filters.evaluate import CONSISTENCY, evaluate, metrics, nees_bounds
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import as_external
from beliefscope.filters.filter import Filter
from beliefscope.filters.rollout import first_belief
from beliefscope.filters.start_offset import NO_OFFSET, StartOffset, offset_start
from beliefscope.inspect.sweep import summary
from beliefscope.inspect.trace import trace

DOOR = find_task("door")


def test_errors_drawn_from_their_covariance_are_consistent() -> None:
    generator = torch.Generator().manual_seed(0)
    root = torch.tensor([[0.03, 0.0, 0.0], [0.01, 0.02, 0.0], [0.05, 0.0, 0.1]], dtype=torch.float64)
    error = torch.randn(40_000, 3, generator=generator, dtype=torch.float64) @ root.T
    covariance = root @ root.T
    result = metrics(DOOR, error, covariance.expand(len(error), 3, 3))
    assert result.nees == pytest.approx(1.0, abs=0.02)
    assert result.coverage95 == pytest.approx(0.95, abs=0.005)
    gaussian = torch.distributions.MultivariateNormal(torch.zeros(3, dtype=torch.float64), covariance)
    assert result.nll == pytest.approx(float(-gaussian.log_prob(error).mean()), abs=0.01)
    assert result.rmse["hinge_x_cm"] == pytest.approx(3.0, rel=0.02)
    assert result.rmse["angle_deg"] == pytest.approx(math.degrees(math.sqrt(0.05**2 + 0.1**2)), rel=0.02)
    assert result.rmse["position_cm"] == pytest.approx(100 * math.sqrt(0.03**2 + 0.01**2 + 0.02**2), rel=0.02)
    # Half the standard deviation: four times the squared error relative to the variance.
    assert metrics(DOOR, error, covariance.expand(len(error), 3, 3) / 4).nees == pytest.approx(4.0, abs=0.08)


def test_full_turns_are_no_error() -> None:
    """An external filter whose angle counts turns: the same metrics, up to the rounding of 2 pi in float32."""

    class Truth:
        task = "door"
        turns = 0.0

        def __call__(self, *, observations: dict[str, np.ndarray], controls: np.ndarray) -> dict[str, np.ndarray]:
            mean = episode.states[:, None] + np.array([0.01, 0.0, 0.02 + 2.0 * np.pi * self.turns], np.float32)
            return {"estimate_mean": mean, "estimate_covariance": np.broadcast_to(1e-3 * np.eye(3), (*mean.shape, 3))}

    with open_dataset(sample_path("door")) as dataset:
        episode = dataset[9]
    model = Truth()
    results = []
    for model.turns in (0.0, 1.0, -3.0):
        results.append(evaluate(as_external(model, "turning"), [episode]))
        assert results[-1].rmse["angle_deg"] == pytest.approx(math.degrees(0.02), rel=1e-4)
        assert results[-1].nees == pytest.approx(results[0].nees, rel=1e-3)


def test_consistency_is_null_without_a_covariance() -> None:
    with open_dataset(sample_path("door")) as dataset:
        episodes = [dataset[0]]
    filter_ = build(architecture("door", "lstm"))
    filter_.statistics.fit(Steps.from_episodes(DOOR, episodes))
    document = evaluate(filter_.eval(), episodes).to_dict()
    assert (document["nll"], document["nees"], document["coverage95"]) == (None, None, None)
    assert all(math.isfinite(value) and value > 0 for value in document["rmse"].values())
    json.dumps(document, allow_nan=False)


@pytest.mark.slow
def test_metrics_do_not_depend_on_the_number_of_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three blocks, of two lengths; the particle filter draws random numbers."""
    monkeypatch.setattr("beliefscope.filters.evaluate.BLOCK", 2)
    with open_dataset(sample_path("push")) as dataset:
        episodes = [shortened(dataset[i], 36 if i == 0 else 40) for i in range(4)]
    filter_ = load_checkpoint(pretrained_path("push", "crossmodal-pf")).filter
    shares: list[float] = []
    serial, parallel = (
        evaluate(filter_, episodes, particles=20, baselines=True, modalities=True, workers=n, progress=shares.append)
        for n in (1, 2)
    )
    assert serial.to_dict() == parallel.to_dict()
    np.testing.assert_array_equal(serial.squares, parallel.squares)
    end = shares.index(1.0)
    assert shares[: end + 1] == sorted(shares[: end + 1]), "progress of one process"
    assert sorted(shares[-3:]) == shares[-3:]
    assert shares[-1] == 1.0


def test_nees_bounds_contain_95_percent_of_consistent_filters() -> None:
    low, high = nees_bounds(3, 14)
    errors = np.random.default_rng(0).standard_normal((20_000, 14, 3))
    nees = (errors**2).sum(-1).mean(-1) / 3
    assert np.mean((nees > low) & (nees < high)) == pytest.approx(0.95, abs=0.006)


def short(count: int = 4, steps: int = 40, first: int = 0) -> list[Episode]:
    with open_dataset(sample_path("door")) as dataset:
        return [shortened(dataset[i], steps) for i in range(first, first + count)]


def shortened(episode: Episode, steps: int) -> Episode:
    observations = {key: values[:steps] for key, values in episode.observations.items()}
    arrays = {key: getattr(episode, key)[:steps] for key in ("states", "controls", "contact", "qpos")}
    return replace(episode, observations=observations, **arrays)


def fitted(name: str, episodes: list[Episode]) -> Filter:
    filter_ = build(architecture("door", name), seed=0)
    filter_.statistics.fit(Steps.from_episodes(DOOR, episodes))
    return filter_.eval()


def test_stay_is_the_distance_from_the_start() -> None:
    episodes = short()
    result = evaluate(fitted("crossmodal-ekf", episodes), episodes, baselines=True)
    stay = result.baselines["stay"]
    assert stay is not None
    assert stay.rmse["position_cm"] == pytest.approx(0.0, abs=1e-4), "the hinge does not move"
    for rmse, first in ((stay.rmse, 30), (stay.rmse_from_step_0, 0)):
        moved = np.concatenate([(e.states[:, 2] - e.states[0, 2])[first:] for e in episodes])
        assert rmse["angle_deg"] == pytest.approx(math.degrees(math.sqrt((moved**2).mean())), rel=1e-4)


@pytest.mark.first(2)
@pytest.mark.parametrize("name", ["crossmodal-ekf", "unimodal-ekf", "image-ekf", "crossmodal-pf"])
def test_dynamics_uses_no_observation(name: str) -> None:
    """Other images change the filter, but not the filter with all observations masked; nor does the fusion."""
    episodes = short()
    filter_ = fitted(name, episodes)
    dark = [
        replace(e, observations={**e.observations, "image": np.zeros_like(e.observations["image"])}) for e in episodes
    ]
    clean, black = (evaluate(filter_, data, particles=30, baselines=True) for data in (episodes, dark))
    assert clean.rmse != black.rmse
    first, second = clean.baselines["dynamics"], black.baselines["dynamics"]
    assert first is not None
    assert second is not None
    assert first.rmse == pytest.approx(second.rmse, rel=1e-5), "equal up to the rounding of the fusion"
    assert first.rmse_from_step_0 == pytest.approx(second.rmse_from_step_0, rel=1e-5)


def test_lstm_has_no_dynamics_baseline() -> None:
    episodes = short(2)
    document = evaluate(fitted("lstm", episodes), episodes, baselines=True).to_dict()
    assert document["baselines"]["dynamics"] is None
    assert document["baselines"]["stay"]["rmse"].keys() == document["rmse"].keys()


@pytest.mark.slow
def test_start_offset_has_its_length_and_covariance() -> None:
    """Distances are exact, directions uniform, and the variance of each component is that of the offsets."""
    offset = StartOffset.parse("3cm,20deg", DOOR)
    (episode,) = short(1, 1)
    episodes = [replace(episode, seed=seed) for seed in range(2000)]
    vectors = offset.vectors(DOOR, episodes, 0).astype(float)
    np.testing.assert_allclose(np.linalg.norm(vectors[:, :2], axis=1), 0.03, rtol=1e-5)
    np.testing.assert_allclose(np.abs(vectors[:, 2]), np.deg2rad(20.0), rtol=1e-5)
    np.testing.assert_allclose(np.cov(vectors.T), np.diag(offset.variances(DOOR)), atol=0.1 * np.deg2rad(20.0) ** 2)
    np.testing.assert_allclose(np.cov(vectors.T)[:2, :2], np.diag(offset.variances(DOOR)[:2]), atol=0.1 * 0.03**2)
    np.testing.assert_array_equal(offset.vectors(DOOR, episodes[5:7], 0), offset.vectors(DOOR, episodes, 0)[5:7])
    assert (offset.vectors(DOOR, episodes, 1) != offset.vectors(DOOR, episodes, 0)).any(axis=1).all()


def test_offset_start_is_where_stay_stays() -> None:
    episodes = short()
    filter_ = fitted("crossmodal-ekf", episodes)
    result = evaluate(filter_, episodes, start_offset=StartOffset.parse("3cm", DOOR), baselines=True)
    stay = result.baselines["stay"]
    assert stay is not None
    assert stay.rmse["position_cm"] == pytest.approx(3.0, rel=1e-3)
    assert evaluate(filter_, episodes, start_offset=NO_OFFSET).to_dict() == evaluate(filter_, episodes).to_dict()
    batch = Steps.from_episodes(DOOR, episodes[:1]).episode(0)
    offset = StartOffset.parse("3cm", DOOR)
    start = offset_start(
        filter_,
        batch,
        torch.from_numpy(offset.vectors(DOOR, episodes[:1], 0)),
        torch.from_numpy(offset.variances(DOOR)),
    )
    covariance = filter_.statistics.covariance_to_si(start.covariance)[0]
    truth = filter_.statistics.covariance_to_si(first_belief(filter_, batch).covariance)[0]
    np.testing.assert_allclose(covariance[:2, :2], np.eye(2) * 0.03**2 / 2, rtol=1e-4, atol=1e-12)
    assert covariance[2, 2] == pytest.approx(float(truth[2, 2])), "no offset of the angle"


def field_episodes() -> list[Episode]:
    task = find_task("door-field")
    assert task.simulate is not None
    return [task.simulate(3, index, 12) for index in (0, 1, 3)]


def test_field_tasks_start_where_their_episodes_say_and_count_from_step_0() -> None:
    episodes = field_episodes()
    task = find_task("door-field")
    filter_ = build(architecture("door-field", "crossmodal-ekf"), seed=0).eval()
    filter_.statistics.fit(Steps.from_episodes(task, episodes))
    offsets = np.array([episode.provenance["start_offset"] for episode in episodes])
    stay = evaluate(filter_, episodes, baselines=True).baselines["stay"]
    assert stay is not None
    hinge = np.sqrt((offsets[:, :2] ** 2).sum(1).mean()) * 100
    assert stay.rmse["position_cm"] == pytest.approx(hinge, rel=1e-4)
    assert stay.rmse == stay.rmse_from_step_0
    batch = Steps.from_episodes(task, episodes).windows(torch.tensor([0, 5, 12]), 4)
    start = first_belief(filter_, batch)
    mean, covariance = filter_.statistics.state_to_si(start.mean), filter_.statistics.covariance_to_si(start.covariance)
    truth = [episodes[0].states[0] + offsets[0], episodes[0].states[4], episodes[1].states[0] + offsets[1]]
    np.testing.assert_allclose(mean, np.array(truth, np.float32), atol=1e-5)
    variance = [np.mean(np.linspace(*task.start_distance[u], 10_001) ** 2) / d for u, d in (("m", 2), ("rad", 1))]
    np.testing.assert_allclose(torch.diagonal(covariance[0]), [variance[0], *variance], rtol=1e-3)
    # An explicit offset replaces that of the episode.
    moved = evaluate(filter_, episodes, start_offset=StartOffset.parse("1cm", task), baselines=True).baselines["stay"]
    assert moved is not None
    assert moved.rmse["position_cm"] == pytest.approx(1.0, rel=1e-3)


def test_invalid_start_offset_in_provenance() -> None:
    episode = field_episodes()[0]
    for value in ([1.0], "x", [0.0, float("nan"), 0.0]):
        with pytest.raises(BadInput, match="'start_offset' in the provenance"):
            Steps.from_episodes(find_task("door-field"), [replace(episode, provenance={"start_offset": value})])


def test_errors_before_and_after_first_contact_make_up_the_total() -> None:
    episodes = short(count=4, steps=80, first=33)  # number 36 makes contact at step 42
    filter_ = fitted("image-ekf", episodes)
    result = evaluate(filter_, episodes)
    touched = np.concatenate([np.maximum.accumulate(episode.contact)[DOOR.warmup :] for episode in episodes])
    share = touched.mean()
    assert 0 < share < 1
    for key, rmse in result.rmse.items():
        parts = (1 - share) * result.rmse_before_contact[key] ** 2 + share * result.rmse_after_contact[key] ** 2
        assert rmse**2 == pytest.approx(parts)


@pytest.mark.parametrize("text", ["3", "3N", "cm", "-3cm", "3cm,4cm", "nancm"])
def test_invalid_start_offset(text: str) -> None:
    with pytest.raises(BadInput, match="start offset"):
        StartOffset.parse(text, DOOR)


def test_start_offset_of_another_task() -> None:
    offset = StartOffset.parse("3cm,20deg", DOOR)
    assert str(offset) == "3cm,20deg"
    assert str(offset.for_task(find_task("push"))) == "3cm"
    with pytest.raises(BadInput, match=r"'20deg' is not in a unit of task 'push': cm"):
        StartOffset.parse("3cm,20deg", find_task("push"))


def test_squares_give_the_rmse() -> None:
    episodes = [*short(2, 40), *short(1, 35)]
    result = evaluate(fitted("crossmodal-ekf", episodes), episodes)
    steps, *squares = result.squares.sum(0)
    assert steps == 10 + 10 + 5
    assert list(result.rmse.values()) == pytest.approx(np.sqrt(np.array(squares) / steps))


def test_updates_and_standalone_filters_are_reported_separately() -> None:
    checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
    with open_dataset(sample_path("door")) as dataset:
        episodes = [dataset[i] for i in dataset.held_out()[:3]]
    document = evaluate(checkpoint.filter, episodes, modalities=True).to_dict()
    assert set(document["updates"]) == set(document["standalone"]) == {"image", "haptics"}
    update, alone = (document[key]["haptics"]["rmse"]["position_cm"] for key in ("updates", "standalone"))
    assert update < 1.0
    assert alone > 2.0 * update
    single = evaluate(checkpoint.filter, episodes, only="haptics").to_dict()
    assert single["rmse"] == document["standalone"]["haptics"]["rmse"]
    assert "updates" not in single
    assert document["rmse"] == evaluate(checkpoint.filter, episodes).rmse


def test_only_applies_to_filters_without_a_weight_model() -> None:
    filter_ = build(architecture("door", "unimodal-ekf")).eval().requires_grad_(False)
    with open_dataset(sample_path("door")) as dataset:
        episodes = [dataset[9]]
    fused, image = evaluate(filter_, episodes), evaluate(filter_, episodes, only="image")
    assert fused.rmse != image.rmse
    with pytest.raises(BadInput, match=r"Modality 'touch' is not in this filter"):
        evaluate(filter_, episodes, only="touch")


TAG = Task(
    name="tag",
    components=(Component("x", "m"), Component("y", "m")),
    observations={"gps": (2,)},
    modalities={"gps": ("gps",)},
    control_size=0,
    dt=0.1,
    warmup=0,
)


class Constant:
    """Follows the readings; its covariance is invalid from step 30 on."""

    def __init__(self, invalid: list[list[float]]) -> None:
        self.invalid = torch.tensor(invalid)

    def initialize_beliefs(self, *, mean: torch.Tensor, covariance: torch.Tensor) -> None:
        self.step = 0

    def __call__(
        self, *, observations: dict[str, torch.Tensor], controls: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        covariance = 0.01 * torch.eye(2) if self.step < 30 else self.invalid
        self.step += 1
        return observations["gps"], covariance.expand(len(controls), 2, 2)


@pytest.mark.parametrize(
    "invalid", [[[-0.01, 0.0], [0.0, -0.01]], [[0.0, 0.0], [0.0, 0.0]], [[0.01, 0.008], [0.0, 0.01]]]
)
def test_invalid_covariances_are_unknown(invalid: list[list[float]]) -> None:
    rng = np.random.default_rng(0)
    states = np.cumsum(rng.normal(0.0, 0.05, (40, 2)), axis=0)
    episode = Episode(TAG, states, np.zeros((40, 0)), {"gps": states + rng.normal(0.0, 0.1, (40, 2))})
    filter_ = as_external(Adapter(Constant(invalid), initial_std=(0.1, 0.1), task=TAG), "tag")
    with pytest.warns(UserWarning, match="not symmetric and positive definite in 25 % of the steps.*the other steps"):
        result = evaluate(filter_, [episode], modalities=True)
    with warnings.catch_warnings(action="error"):
        valid = evaluate(filter_, [episode.part(0, 30)])
    assert (result.nll, result.nees, result.coverage95) == pytest.approx((valid.nll, valid.nees, valid.coverage95))
    row = next(summary(trace(filter_, episode)))
    assert np.isnan([row[name] for name in CONSISTENCY]).all()


def test_without_any_valid_covariance_consistency_is_unknown() -> None:
    states = np.cumsum(np.random.default_rng(0).normal(0.0, 0.05, (40, 2)), axis=0)
    episode = Episode(replace(TAG, warmup=30), states, np.zeros((40, 0)), {"gps": states})
    filter_ = as_external(Adapter(Constant([[0.0, 0.0], [0.0, 0.0]]), initial_std=(0.1, 0.1), task=episode.task), "tag")
    with pytest.warns(UserWarning, match="in 100 % of the steps; NLL, NEES/n and 95 % coverage are unknown"):
        result = evaluate(filter_, [episode])
    assert np.isnan([result.nll, result.nees, result.coverage95]).all()
