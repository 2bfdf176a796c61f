"""External filters of any kind: NumPy objects, functions, one trajectory at a time, own starts, devices and states."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.evaluate import evaluate, external_run
from beliefscope.filters.external.ablation import without
from beliefscope.filters.external.adapter import Adapter, FailedStep, check_values
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.finetuning.slices import Slice
from beliefscope.inspect.statistics.episode_sums import measures_of, sum_episodes
from beliefscope.inspect.statistics.innovations import nis_of
from beliefscope.inspect.trace import load_trace, save_trace, trace

sys.path.insert(0, str(Path(__file__).parent))
import vehicle_filters as vehicle

STD = tuple(np.sqrt(10 * np.diag(vehicle.P0)))


def external(filter_: Any, **adapter: Any) -> ExternalFilter:
    return ExternalFilter(Adapter(filter_, **adapter), vehicle.TASK, "mine")


def test_numpy_filter_of_one_trajectory_equals_the_batched_torch_filter() -> None:
    episodes = [vehicle.drive(seed) for seed in (1, 2)]
    single, batched = external(vehicle.NumpyKalman(), batched=False), external(vehicle.TorchKalman(), std=STD)
    single_trace, batched_trace = trace(single, episodes[1]), trace(batched, episodes[1])
    np.testing.assert_allclose(single_trace.estimate_mean, batched_trace.estimate_mean, atol=1e-4)
    np.testing.assert_allclose(single_trace.estimate_covariance, batched_trace.estimate_covariance, atol=1e-6)
    assert evaluate(single, episodes).nees == pytest.approx(evaluate(batched, episodes).nees, rel=1e-4)


def test_measurements_and_scalars_are_stored(tmp_path: Path) -> None:
    result = trace(external(vehicle.NumpyKalman(), batched=False), vehicle.drive(3, gap=(40, 60)))
    assert result.modalities == ("gps", "speed")
    assert result.innovation is not None
    assert result.accepted is not None
    assert result.innovation.shape == (120, 2, 2)
    assert np.isnan(result.innovation[:, 1, 1]).all()  # the speed has one channel
    assert np.isnan(result.accepted[40:60, 0]).all()
    assert (result.accepted[:, 1] == 1.0).all()
    np.testing.assert_allclose(result.extra["trace"], np.trace(result.estimate_covariance, axis1=1, axis2=2), rtol=1e-5)
    save_trace(result, tmp_path / "run.trace")
    again = load_trace(tmp_path / "run.trace")
    np.testing.assert_array_equal(again.innovation_covariance, result.innovation_covariance)
    np.testing.assert_array_equal(again.extra["trace"], result.extra["trace"])


@pytest.mark.slow
def test_nis_of_a_matched_filter_is_one_and_of_a_wrong_noise_its_ratio() -> None:
    episodes = [vehicle.drive(seed, 400) for seed in range(5)]

    def nis(scale: float) -> np.ndarray:
        filter_ = external(vehicle.NumpyKalman(scale=scale), batched=False)
        return np.nanmean([nis_of(trace(filter_, episode))[20:] for episode in episodes], axis=(0, 1))

    # 2000 steps of 2 and 1 channels: a standard deviation of 0.022 and 0.032; 5 of them.
    np.testing.assert_allclose(nis(1.0), 1.0, atol=0.16)
    assert (nis(9.0) < 0.3).all()


def test_filter_supplies_its_own_start() -> None:
    result = trace(
        external(vehicle.NumpyKalman(), batched=False), replace(vehicle.drive(4), states=vehicle.drive(4).states + 5)
    )
    np.testing.assert_array_equal(result.start_mean, np.zeros(4))
    np.testing.assert_allclose(result.start_covariance, vehicle.P0)

    class Silent(vehicle.NumpyKalman):
        def initialize_beliefs(self) -> None:  # type: ignore[override]
            super().initialize_beliefs()

    assert np.isnan(trace(external(Silent(), batched=False), vehicle.drive(4)).start_mean).all()


def test_function_of_whole_sequences() -> None:
    def mean(observations: dict[str, np.ndarray], controls: np.ndarray) -> np.ndarray:
        assert isinstance(observations["gps"], np.ndarray)
        assert observations["gps"].ndim == 2  # no axis N
        return np.concatenate([observations["gps"], np.zeros_like(observations["gps"])], axis=-1)

    episode = vehicle.drive(5)
    result = trace(external(mean, batched=False), episode)
    np.testing.assert_allclose(result.estimate_mean[:, :2], episode.observations["gps"], rtol=1e-6)


class TurnCounter:
    """Reports its readings with an offset of 0.1, and an angle that counts turns, with unit covariance."""

    def initialize_beliefs(self) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((1, 2)), np.eye(2)[None]

    def forward(self, observations: dict[str, Any], controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return observations["pose"] + np.array([0.1, 0.1 + 6.0 * np.pi]), np.eye(2)[None]


def test_evaluation_and_sums_of_episodes_wrap_angles() -> None:
    """Both give the errors of 0.1, whatever the number of turns."""
    components = (Component("x", "m"), Component("heading", "rad"))
    task = Task("turns", components, {"pose": (2,)}, {"pose": ("pose",)}, 0, 0.1, warmup=0)
    heading = np.linspace(-3.0, 3.0, 50)
    pose = np.stack([np.arange(50) / 50, heading], axis=1)
    episode = Episode(task, pose, observations={"pose": pose})
    counter = ExternalFilter(Adapter(TurnCounter(), task=task), task, "turns")
    values, _ = counter.run([episode])
    errors, covariance = external_run(task, values, torch.from_numpy(episode.states)[:, None])
    np.testing.assert_allclose(errors.numpy(), 0.1, rtol=1e-4)
    assert covariance.shape == (50, 1, 2, 2)
    metrics = evaluate(counter, [episode])
    sums = sum_episodes([counter], [Slice("all")], [episode]).sums[:, 0, 0]
    by_name = {measure.name: float(measure.value(sums)[0]) for measure in measures_of(task)}
    assert metrics.rmse["heading_deg"] == pytest.approx(np.degrees(0.1), rel=1e-5)
    assert by_name["heading"] == pytest.approx(0.1, rel=1e-5)
    assert by_name["nees"] == pytest.approx(metrics.nees, rel=1e-6) == pytest.approx(0.01, rel=1e-4)


def test_an_error_names_the_removed_readings() -> None:
    def repeated(observations: dict[str, Any], controls: np.ndarray) -> np.ndarray:
        return np.concatenate([observations["gps"], *[observations["speed"]] * 2], axis=-1)

    filter_, episode = ExternalFilter(Adapter(repeated, absent="nan"), vehicle.TASK, "repeated"), vehicle.drive(6)
    filter_.run([episode])
    with pytest.raises(BadInput, match="not finite; the removed readings of speed are NaN, by Adapter"):
        filter_.run([without(episode, ["speed"], "nan")])


def test_global_generators_are_seeded_and_restored() -> None:
    def noise(observations: dict[str, Any], controls: np.ndarray) -> np.ndarray:
        return np.random.standard_normal((*controls.shape[:-1], 4))  # noqa: NPY002

    filter_, episode = external(noise), vehicle.drive(6)
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    first, again, other = (trace(filter_, episode, seed=seed).estimate_mean for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    np.testing.assert_array_equal(before, np.random.get_state()[1])  # noqa: NPY002


class Counting(nn.Module):
    """State in an attribute, in a buffer, in a submodule and in a generator."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(1, 1)
        self.register_buffer("count", torch.zeros(1))
        self.generator = np.random.default_rng(0)

    def initialize_beliefs(self, *, mean: torch.Tensor, covariance: torch.Tensor) -> None:
        self.mean = mean

    def forward(self, *, observations: dict[str, Any], controls: torch.Tensor) -> torch.Tensor:
        self.count += 1
        self.layer.last = self.count.clone()
        self.mean = self.mean + self.count + self.layer.last + self.generator.standard_normal()
        return self.mean


class WithState:
    """A filter with get_state and set_state; its other attribute cannot be copied."""

    def __init__(self) -> None:
        self.value, self.file = 0.0, (i for i in range(3))

    def get_state(self) -> float:
        return self.value

    def set_state(self, state: float) -> None:
        self.value = state


def test_states_are_restored() -> None:
    module = Counting()
    module.initialize_beliefs(mean=torch.zeros(1, 4), covariance=torch.eye(4)[None])
    filter_, inputs = external(module, std=STD), {"observations": {}, "controls": torch.zeros(1, 1)}
    module(**inputs)
    state, weight = filter_.snapshot(), module.layer.weight
    runs = []
    for _ in range(2):
        filter_.restore(state)
        runs.append([module(**inputs).clone() for _ in range(3)])
    assert all(torch.equal(a, b) for a, b in zip(*runs, strict=True))
    assert module.layer.weight is weight  # parameters are not copied
    own = WithState()
    filter_ = external(own)
    state = filter_.snapshot()
    own.value = 3.0
    filter_.restore(state)
    assert own.value == 0.0


def test_filters_that_cannot_be_copied_are_named() -> None:
    filter_ = vehicle.NumpyKalman()
    filter_.file = (i for i in range(3))  # type: ignore[attr-defined]
    with pytest.raises(BadInput, match=r"mine cannot be copied .*: give it get_state and set_state"):
        external(filter_, batched=False).snapshot()


def test_hash_of_an_object_covers_its_arrays() -> None:
    hashes = {external(vehicle.NumpyKalman(gate)).hash for gate in (1.0, 1.0, 2.0)}
    assert len(hashes) == 2


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"accepted": np.ones((2, 2))}, r"accepted of shape \(2, 2\), expected \(K\)"),
        ({"innovation": [np.ones(2)]}, "returns only innovation, expected both innovation and innovation_covariance"),
        (
            {"innovation": [np.ones(2), None], "innovation_covariance": [np.ones(2), None]},
            r"innovation_covariance of measurement 1 of shape \(2,\), expected \(m, m\)",
        ),
        ({"innovation": [None, np.ones((2, 1))]}, r"innovation of measurement 2 of shape \(2, 1\), expected \(m\)"),
        ({"extra": {"a b": 1.0}}, r"extra value 'a b': a name has up to 80 letters, digits, - and _$"),
        ({"extra": {"a" * 81: 1.0}}, r"extra value 'a{81}': a name has up to 80 letters"),
        ({"extra": {"a": np.inf}}, "extra/a with a number that is not finite"),
        (
            {"effective_weights": np.array([[0.9], [0.9]])},
            "effective_weights with the sum 1.8 over the K models, expected",
        ),
        ({"extra": {"a": [1.0]}}, "returns extra/a as a list, expected an array or a Tensor"),
    ],
)
def test_invalid_measurements_are_refused(values: dict[str, Any], message: str) -> None:
    class Invalid(vehicle.NumpyKalman):
        def forward(self, **inputs: Any) -> dict[str, Any]:
            return {"estimate_mean": np.zeros(4)} | values

    with pytest.raises(BadInput, match=message):
        trace(external(Invalid(), batched=False), vehicle.drive(7, 10))


def test_the_step_of_a_number_that_is_not_finite_is_known() -> None:
    values = torch.tensor([[0.0, 0.0], [0.0, np.nan], [np.nan, 0.0]])
    with pytest.raises(FailedStep) as error:
        check_values({"extra/a": values}, (3, 2), {"n": 1}, "f")
    assert error.value.step == 1
    with pytest.raises(FailedStep) as error:
        check_values({"extra/a": values[1]}, (2,), {"n": 1}, "f", 7)
    assert error.value.step == 7


def test_names_of_other_measurement_models_are_refused() -> None:
    names = ("gps", "speed", "compass")
    with pytest.raises(BadInput, match="names 3 modalities, gps, speed, compass, but has 2"):
        trace(external(vehicle.NumpyKalman(), batched=False, modalities=names), vehicle.drive(7, 10))


def test_a_filter_of_one_trajectory_without_batched_false_is_told_of_the_axis() -> None:
    with pytest.raises(BadInput, match=r"fails at step 0: .*; the first axis of its inputs is that of N episodes"):
        trace(external(vehicle.NumpyKalman()), vehicle.drive(7, 10))


class Single(vehicle.TorchKalman):
    """Multiplies by a matrix of the default type."""

    def forward(
        self, *, observations: dict[str, torch.Tensor], controls: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        controls = controls @ torch.eye(controls.shape[-1])
        return super().forward(observations=observations, controls=controls)


def test_an_error_of_types_names_those_of_inputs_and_new_tensors() -> None:
    filter_ = external(Single().double(), std=STD)
    with pytest.raises(BadInput, match=r"float64 as its parameters, images uint8; tensors .* are float32$"):
        evaluate(filter_, [vehicle.drive(1)])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_module_on_a_gpu_gets_its_inputs_there() -> None:
    module, episode = vehicle.TorchKalman().cuda(), vehicle.drive(8)
    result = trace(external(module, std=STD), episode)
    assert module.devices == {"cuda"}
    expected = trace(external(vehicle.TorchKalman(), std=STD), episode)
    np.testing.assert_allclose(result.estimate_mean, expected.estimate_mean, atol=1e-5)


def test_first_belief_has_the_given_deviations() -> None:
    """In the filter's units and order: those of SI are multiplied by ``std``."""
    adapter = Adapter(
        lambda *, observations, controls: None,
        components=("vy", "vx", "y", "x"),
        std=(0.5, 0.5, 2.0, 2.0),
        initial_std=(1.0, 2.0, 3.0, 4.0),
    )
    start = ExternalFilter(adapter, vehicle.TASK, "mine").start([vehicle.drive(0, 5)])
    deviations = start.covariance[0].diagonal().sqrt()
    torch.testing.assert_close(deviations, torch.tensor([8.0, 6.0, 1.0, 0.5]))
    with pytest.raises(BadInput, match=r"initial_std has 2 numbers, expected 4"):
        ExternalFilter(Adapter(adapter.module, initial_std=(1.0, 1.0)), vehicle.TASK, "mine")
