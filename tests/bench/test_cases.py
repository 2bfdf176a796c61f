"""Planted faults: they change what their cause states, and a case is a function of its specification."""

from __future__ import annotations

import copy
import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from beliefbench.cases import FILTERS, Spec, causes_of, load_case, magnitudes, plan, planted, read_truth
from beliefbench.generate import effect_of, run, write_case
from beliefbench.model_faults import MODEL_CAUSES, plant, with_equations
from beliefbench.sensor_faults import LABEL_CAUSES, SENSOR_CAUSES, inject, mislabel

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.batch import Steps
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.inspect.trace import Trace

SEED = 7


@pytest.fixture(scope="module")
def episodes() -> list[Episode]:
    with open_dataset(sample_path("push")) as data:
        return [replace(data[i]) for i in (0, 1)]


@pytest.fixture(scope="module")
def originals() -> dict[str, Checkpoint]:
    return {name: load_checkpoint(pretrained_path("push", name)) for name in ("crossmodal-ekf", "crossmodal-pf")}


def faulty(original: Checkpoint, cause: str, magnitude: float, episodes: list[Episode]) -> Checkpoint:
    filter_ = copy.deepcopy(original.filter)
    plant(filter_, cause, magnitude, episodes, np.random.default_rng(0))
    with_equations(filter_, cause, magnitude)
    return replace(original, filter=filter_)


def traces(checkpoint: Checkpoint, episodes: list[Episode]) -> list[Trace]:
    return run(checkpoint, episodes, 50, SEED)


def split_values(specs: list[Spec]) -> list[set[object]]:
    """Tasks, seeds, and causes with levels."""
    return [
        {s.task for s in specs},
        {s.seed for s in specs},
        {(p.cause, p.level) for s in specs for p in s.planted},
    ]


def test_splits_are_disjoint() -> None:
    tuning, test = plan("tuning", repeats=2), plan("test")
    for a, b in (
        ({s.task for s in tuning}, {s.task for s in test}),
        ({s.seed for s in tuning}, {s.seed for s in test}),
        (
            {(p.cause, p.level) for s in tuning for p in s.planted},
            {(p.cause, p.level) for s in test for p in s.planted},
        ),
    ):
        assert not a & b
    for specs in (tuning, test):
        assert len({s.seed for s in specs}) == len({s.name for s in specs}) == len(specs)
    single = tuning[0]
    assert replace(single, seed=single.seed + 1).split == "unused"
    assert replace(single, filter="unimodal-ekf").split == "unused"


def test_levels_differ_and_every_cause_is_planned() -> None:
    for cause, values in magnitudes().items():
        assert len(set(values)) == len(values), cause
        assert len(values) in (1, 4), cause
    for split, filters in FILTERS.items():
        specs = plan(split)
        for task, filter_ in filters:
            mine = [s for s in specs if (s.task, s.filter) == (task, filter_)]
            assert {s.planted[0].cause for s in mine if len(s.planted) == 1} == set(causes_of(task, filter_))
        assert {len(s.planted) for s in specs} == {0, 1, 2}


@pytest.mark.parametrize("cause", SENSOR_CAUSES)
def test_sensor_causes_change_data_and_keep_the_labels(cause: str, episodes: list[Episode]) -> None:
    for level in range(4):
        rng = np.random.default_rng(level)
        changed, text, affected = inject(cause, planted(cause, level).magnitude, episodes, SEED, rng)
        assert text
        for i, (before, after) in enumerate(zip(episodes, changed, strict=True)):
            assert (after is before) == (i not in affected)
            assert np.array_equal(after.states, before.states)
        keys = {k for k, v in episodes[0].observations.items() if not np.array_equal(v, changed[0].observations[k])}
        sensors = {"image": {"image"}, "force": {"force"}, "effector": {"effector_position"}, "contact": {"contact"}}
        expected = sensors.get(cause.split(".")[0], set(find_task("push").modalities["haptics"]))
        assert keys <= (set() if cause.startswith("control") else expected)
        assert keys or not np.array_equal(episodes[0].controls, changed[0].controls) or cause == "contact.stuck"


def test_label_causes_change_the_states_only(episodes: list[Episode]) -> None:
    assert set(LABEL_CAUSES) == {"labels.delay", "labels.offset"}
    late = mislabel("labels.delay", 3, episodes, np.random.default_rng(0))[0]
    assert np.array_equal(late.states[3:], episodes[0].states[:-3])
    moved = mislabel("labels.offset", 0.02, episodes, np.random.default_rng(0))[0]
    difference = moved.states - episodes[0].states
    assert np.linalg.norm(difference, axis=1) == pytest.approx(0.02, abs=1e-6)
    assert np.ptp(difference, axis=0) == pytest.approx(0.0, abs=1e-6)
    for changed in (late, moved):
        assert changed.observations is episodes[0].observations


@pytest.mark.first(1)
@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_model_causes_change_their_module_only(
    name: str, originals: dict[str, Checkpoint], episodes: list[Episode]
) -> None:
    modules = {"dynamics": "dynamics.", "process_noise": "dynamics.log_noise", "weights": "weight_model.output"}
    original = originals[name].filter.state_dict()
    for cause in set(causes_of("push", name)) & set(MODEL_CAUSES):
        checkpoint = faulty(originals[name], cause, planted(cause, 2).magnitude, episodes)
        state = checkpoint.filter.state_dict()
        changed = [key for key, value in state.items() if not torch.equal(value, original[key])]
        part = cause.rpartition(".")[0]
        prefix = modules.get(part, "") or f"{'measurement_models' if name.endswith('pf') else 'virtual_sensors'}."
        prefix += part.removeprefix("model.") + "." if part.startswith("model.") else ""
        in_equations = MODEL_CAUSES[cause].equations is not None or cause == "particles.few"
        assert bool(changed) != in_equations, cause
        assert all(key.startswith(prefix) for key in changed), cause
        assert isinstance(checkpoint.filter, type(originals[name].filter))


@pytest.mark.slow
@pytest.mark.long
def test_kalman_filter_causes(originals: dict[str, Checkpoint], episodes: list[Episode]) -> None:
    original = originals["crossmodal-ekf"]
    std = original.filter.statistics.mean_std("state")[1].numpy()
    clean = traces(original, episodes)[0]

    def trace(cause: str, magnitude: float) -> Trace:
        return traces(faulty(original, cause, magnitude, episodes), episodes)[0]

    biased = trace("model.image.bias", 0.5)
    shift = (biased.observation_mean - clean.observation_mean)[:, 0] / std
    assert np.abs(shift) == pytest.approx(0.5, abs=1e-4)
    assert np.array_equal(biased.observation_mean[:, 1], clean.observation_mean[:, 1])
    confident = trace("model.haptics.overconfident", 0.2)
    diagonal = confident.observation_covariance[..., [0, 1], [0, 1]] / clean.observation_covariance[..., [0, 1], [0, 1]]
    assert diagonal[:, 1] == pytest.approx(0.04, rel=1e-3)
    assert diagonal[:, 0] == pytest.approx(1.0)
    inverted = trace("weights.inverted", 1.0)
    np.testing.assert_allclose(inverted.weights, 1.0 - clean.weights, atol=1e-5)
    constant = trace("weights.constant", 0.3)
    np.testing.assert_allclose(constant.weights[:, 0], 0.3, atol=1e-5)
    assert (trace("weights.ignores_image", 8.0).weights[:, 0] < clean.weights[:, 0]).all()
    frozen = trace("dynamics.frozen", 0.0)
    previous = np.concatenate([frozen.start_mean[None], frozen.estimate_mean[:-1]])
    np.testing.assert_allclose(frozen.predicted_mean[:, 0], previous, atol=1e-6)
    scaled = trace("covariance.small", 0.2)
    assert np.array_equal(scaled.estimate_mean, clean.estimate_mean)
    np.testing.assert_allclose(scaled.estimate_covariance, 0.2 * clean.estimate_covariance, rtol=1e-5)
    product = trace("fusion.shared_prior", 1.0)
    precision = np.linalg.inv(product.modality_covariance.astype(float)).sum(1)
    np.testing.assert_allclose(np.linalg.inv(precision), product.estimate_covariance, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.long
def test_particle_filter_causes(originals: dict[str, Checkpoint], episodes: list[Episode]) -> None:
    original = originals["crossmodal-pf"]

    def trace(cause: str, magnitude: float) -> Trace:
        return traces(faulty(original, cause, magnitude, episodes), episodes)[0]

    kept = trace("resampling.off", 1.0)
    assert (kept.ancestors == np.arange(50)).all()
    np.testing.assert_allclose(kept.prior_log_weights[1:], kept.log_weights[:-1], atol=1e-5)
    assert kept.effective_sample_size[-1] < 3
    few = trace("particles.deprived", 3)
    assert max(len(np.unique(row)) for row in few.ancestors) == 3
    ignored = trace("resampling.biased", 0.0)
    assert (np.diff(np.sort(ignored.ancestors)) == 1).mean() > 0.9  # weights are ignored: everyone once
    clean, confident = traces(original, episodes)[0], trace("model.image.overconfident", 0.5)
    first = np.ptp(confident.log_likelihood[0], axis=-1) / np.ptp(clean.log_likelihood[0], axis=-1)
    np.testing.assert_allclose(first, [4.0, 1.0], rtol=1e-3)


def test_bias_of_a_likelihood_moves_its_argument(originals: dict[str, Checkpoint], episodes: list[Episode]) -> None:
    original, shift = originals["crossmodal-pf"], 0.5
    biased = faulty(original, "model.image.bias", shift, episodes)
    steps = Steps.from_episodes(original.task, episodes)
    evidence = original.filter.encode(steps.windows(steps.first, 5))[0]
    states = torch.randn(2, 30, original.filter.n, generator=torch.Generator().manual_seed(0))
    signs = torch.from_numpy(np.random.default_rng(0).choice([-1.0, 1.0], original.filter.n).astype(np.float32))
    moved = biased.filter.log_likelihood(evidence, states + shift * signs)
    reference = original.filter.log_likelihood(evidence, states)
    torch.testing.assert_close(moved[:, 0], reference[:, 0], rtol=1e-3, atol=1e-3)
    assert not torch.allclose(moved[:, 1], reference[:, 1], atol=1e-2)


def test_effect_of_nothing_is_invisible(originals: dict[str, Checkpoint], episodes: list[Episode]) -> None:
    clean = traces(originals["crossmodal-ekf"], episodes)
    effect = effect_of(clean, clean)
    assert effect["rmse_ratio"] == {"m": 1.0}
    assert effect["nees_ratio"] == 1.0
    assert not effect["visible"]
    overconfident = faulty(originals["crossmodal-ekf"], "covariance.small", 0.4, episodes)
    effect = effect_of(clean, traces(overconfident, episodes))
    assert effect["nees_ratio"] == pytest.approx(2.5, rel=1e-2)  # measures add a small constant
    assert effect["visible"]


@pytest.mark.long
def test_a_case_is_a_function_of_its_specification(tmp_path: Path) -> None:
    causes = (planted("force.noise", 3), planted("model.image.bias", 3))
    spec = Spec("push", "crossmodal-ekf", causes, seed=1001, episodes=1, steps=40)
    assert spec.split == "test"
    hashes = []
    for directory in (tmp_path / "a", tmp_path / "b"):
        folder = write_case(spec, directory)
        hashes.append([hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())])
    assert hashes[0] == hashes[1]
    assert len(hashes[0]) == 4
    case, truth = load_case(folder), read_truth(folder)
    assert [p["cause"] for p in truth["planted"]] == ["force.noise", "model.image.bias"]
    assert "force_noise" in truth["planted"][0]["faults"]
    assert not {"cause", "planted"} & set(json.loads((folder / "settings.json").read_text()))
    assert all(cause.cause not in spec.name for cause in causes)
    assert case.runnable
    assert case.checkpoint.healthy_profile is not None
    assert len(case.episodes) == 1


def test_every_cause_is_documented_with_its_magnitudes() -> None:
    page = (Path(__file__).parents[2] / "docs" / "beliefbench.md").read_text()
    rows = {m[1]: m[2] for m in re.finditer(r"^\| `([\w.]+)` \| .* \| ([^|]+) \|$", page, re.MULTILINE)}
    for cause, values in magnitudes().items():
        assert rows[cause] == ", ".join(v if isinstance(v, str) else f"{v:g}" for v in values)
