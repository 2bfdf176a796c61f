"""Traces of built-in filters: identical to untraced runs, and lossless on disk."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import safetensors.numpy
import torch

from beliefscope.datasets import episode_parts, store
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.episode_parts import EpisodeParts
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.datasets.readers import episode_file
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.batch import Steps
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.filters.evaluate import run as run_batch
from beliefscope.inspect.diagnostics import particle_health
from beliefscope.inspect.standalone import standalone
from beliefscope.inspect.trace import (
    ARRAYS,
    Trace,
    arrays_of,
    header_of,
    load_trace,
    save_trace,
    save_trace_parts,
    trace,
    trace_from_arrays,
    trace_parts,
)
from beliefscope.inspect.traces import run as run_module
from beliefscope.inspect.traces.replay import Replay


@pytest.fixture(scope="module")
def episode() -> Episode:
    with open_dataset(sample_path("door")) as dataset:
        index = next(s.index for s in dataset.summaries if s.split == "test")
        return dataset[index]


@pytest.fixture(scope="module", params=("crossmodal-ekf", "crossmodal-pf"))
def checkpoint(request: pytest.FixtureRequest) -> Checkpoint:
    return load_checkpoint(pretrained_path("door", request.param))


@pytest.mark.first(1)
@pytest.mark.slow
def test_runs_over_one_episode_use_one_thread(checkpoint: Checkpoint, traced: Trace, episode: Episode) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        for run in (
            lambda progress: trace(checkpoint, episode, particles=10, progress=progress),
            lambda progress: Replay(checkpoint, traced, progress),
            lambda progress: standalone(checkpoint, traced, "image", progress),
            lambda progress: list(trace_parts(checkpoint, episode, particles=10, progress=progress)),
        ):
            threads: set[int] = set()
            run(lambda _, threads=threads: threads.add(torch.get_num_threads()))
            assert (threads, torch.get_num_threads()) == ({1}, 2)
    finally:
        torch.set_num_threads(before)


@pytest.fixture(scope="module")
def traced(checkpoint: Checkpoint, episode: Episode) -> Trace:
    return trace(checkpoint, episode, seed=7, particles=100)


def test_tracing_does_not_change_the_estimates(checkpoint: Checkpoint, episode: Episode, traced: Trace) -> None:
    filter_ = checkpoint.filter
    batch = Steps.from_episodes(filter_.task, [episode]).episode(0)
    error, covariance = run_batch(filter_, batch, only=None, particles=100, seed=7)
    si = torch.from_numpy(traced.estimate_mean)
    assert torch.equal(si - batch.states[:, 0], error[:, 0])
    assert torch.equal(torch.from_numpy(traced.estimate_covariance), covariance[:, 0])


def test_saved_and_loaded_without_loss(traced: Trace, tmp_path: Path) -> None:
    path = tmp_path / "run.trace"
    save_trace(traced, path)
    loaded = load_trace(path)
    for name in ARRAYS:
        before, after = getattr(traced, name), getattr(loaded, name)
        assert (before is None) == (after is None), name
        if before is not None:
            assert before.dtype == after.dtype
            np.testing.assert_array_equal(before, after, err_msg=name)
    assert loaded.episode.digest() == traced.episode.digest() == traced.data_hash
    for name in ("modalities", "kind", "filter", "checkpoint_hash", "episode_index", "seed", "settings"):
        assert getattr(loaded, name) == getattr(traced, name), name


def test_weights_sum_to_one_and_covariances_are_definite(traced: Trace) -> None:
    assert traced.weights is not None
    assert traced.effective_weights is not None
    np.testing.assert_allclose(traced.weights.sum(1), 1.0, atol=1e-6)
    np.testing.assert_allclose(traced.effective_weights.sum(1), 1.0, atol=1e-6)
    # Scaled to unit diagonal because of different units; a particle set may be degenerate up to rounding.
    scale = np.sqrt(np.diagonal(traced.estimate_covariance, axis1=1, axis2=2)) + 1e-9
    correlation = traced.estimate_covariance / scale[:, :, None] / scale[:, None]
    # Tolerance for float32 sums over particles.
    np.testing.assert_allclose(correlation, correlation.swapaxes(1, 2), atol=1e-5)
    assert np.linalg.eigvalsh(correlation).min() > -1e-5


def test_particle_weights_match_the_estimate_and_the_ancestors(traced: Trace) -> None:
    if traced.kind != "pf":
        pytest.skip("an EKF has no particles")
    assert traced.particles is not None
    assert traced.log_weights is not None
    assert traced.ancestors is not None
    weights = np.exp(traced.log_weights.astype(np.float64))
    np.testing.assert_allclose(weights.sum(1), 1.0, atol=1e-5)
    mean = np.einsum("tm,tmn->tn", weights, traced.particles)
    np.testing.assert_allclose(mean, traced.estimate_mean, atol=1e-5)
    # Weights before resampling are not uniform. Systematic resampling keeps counts within one of the expectation.
    assert (weights.std(1) > 1e-6).mean() > 0.9
    counts = np.stack([np.bincount(row, minlength=100) for row in traced.ancestors])
    assert np.abs(counts - 100 * weights).max() < 1.001


def test_episode_of_the_trace_has_injected_faults(
    checkpoint: Checkpoint, episode: Episode, traced: Trace, tmp_path: Path
) -> None:
    faults = Faults.parse("blackout,force_noise=3,contact_inverted:from=20")
    faulty = trace(checkpoint, episode, seed=7, particles=100, faults=faults)
    assert not faulty.episode.observations["image"].any()
    assert faulty.episode.digest() == faults.apply(episode, 7).digest() != episode.digest()
    assert faulty.data_hash == episode.digest()
    np.testing.assert_array_equal(faulty.start_mean, traced.start_mean)
    assert not np.array_equal(faulty.estimate_mean, traced.estimate_mean)
    assert np.array_equal(faulty.episode.states, traced.episode.states)
    save_trace(faulty, tmp_path / "run.trace")
    assert load_trace(tmp_path / "run.trace").faults == faults
    assert traced.faults == NO_FAULTS


@pytest.mark.parametrize(("probability", "faults"), [(0.0, ""), (0.4, "blackout=0.4")])
def test_blackout_setting_of_an_earlier_version(
    traced: Trace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, probability: float, faults: str
) -> None:
    earlier = replace(traced, settings={"particles": 100, "blackout": probability})
    dumps = json.dumps

    def without_faults(header: Any, **options: Any) -> str:
        return dumps({key: value for key, value in header.items() if key != "faults"}, **options)

    with monkeypatch.context() as before:
        before.setattr(json, "dumps", without_faults)
        save_trace(earlier, tmp_path / "old.trace")
    assert b'"faults' not in (tmp_path / "old.trace").read_bytes()
    loaded = load_trace(tmp_path / "old.trace")
    assert loaded.faults == Faults.parse(faults)
    np.testing.assert_array_equal(loaded.estimate_mean, traced.estimate_mean)


def test_invalid_settings(checkpoint: Checkpoint, episode: Episode) -> None:
    with pytest.raises(BadInput, match="particles must be at least 1, not 0"):
        trace(checkpoint, episode, particles=0)
    with pytest.raises(BadInput, match=r"modality 'touch' of task 'door' does not exist"):
        trace(checkpoint, episode, faults=Faults.parse("drop=touch"))


def test_invalid_trace_files(traced: Trace, tmp_path: Path) -> None:
    complete = tmp_path / "whole.trace"
    save_trace(traced, complete)
    with pytest.raises(BadInput, match="does not exist"):
        load_trace(tmp_path / "none.trace")
    with pytest.raises(BadInput, match=r"is a folder; give its traces, such as .*/\*\.trace$"):
        load_trace(tmp_path)
    with pytest.raises(BadInput, match="is the trace of a run, not a filter; `beliefscope inspect`, "):
        load_checkpoint(complete)
    truncated = tmp_path / "cut.trace"
    truncated.write_bytes(complete.read_bytes()[:-1000])
    with pytest.raises(BadInput, match="not a readable trace"):
        load_trace(truncated)
    with pytest.raises(BadInput, match="not a Beliefscope trace"):
        load_trace(pretrained_path("door", "crossmodal-pf"))
    with pytest.raises(BadInput, match=r"folder .* does not exist"):
        save_trace(traced, tmp_path / "no" / "folder.trace")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cut.trace", "whole.trace"]


def test_names_of_an_earlier_version(traced: Trace) -> None:
    header = header_of(replace(traced, kind="external", faults=Faults.parse("blackout=0.4")))
    header |= {"kind": "foreign", "recipe": header.pop("faults")}
    arrays = arrays_of(traced)
    arrays["acting"] = arrays.pop("effective_weights")
    loaded = trace_from_arrays(header, arrays)
    assert (loaded.kind, str(loaded.faults)) == ("external", "blackout=0.4")
    np.testing.assert_array_equal(loaded.effective_weights, traced.effective_weights)


@pytest.mark.first(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", ["door/crossmodal-ekf", "door-field/information-ekf", "push-field/information-ekf"])
def test_evidence_in_blocks_gives_the_same_trace(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    task, filter_name = name.split("/")
    checkpoint = load_checkpoint(pretrained_path(task, filter_name))
    with open_dataset(sample_path(task)) as dataset:
        episode = dataset[dataset.held_out()[0]]
    whole = trace(checkpoint, episode)
    monkeypatch.setattr(run_module, "STEPS_PER_PART", 37)
    in_blocks = trace(checkpoint, episode)
    for key, values in arrays_of(whole).items():
        # Products of matrices with fewer rows round differently.
        np.testing.assert_allclose(arrays_of(in_blocks)[key], values, rtol=2e-3, atol=2e-5, err_msg=key)


@pytest.mark.slow
@pytest.mark.long
def test_kept_particles_are_a_sample_of_all(episode: Episode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-pf"))
    whole = trace(checkpoint, episode, particles=2000)
    monkeypatch.setattr(run_module, "PARTICLES_AT_ONCE", 7 * 2000)
    sample = trace(checkpoint, episode, particles=2000, particles_kept=200)
    for name in ("estimate_mean", "estimate_covariance", "modality_mean", "effective_weights"):
        # Sums over the particles of seven steps and of all round differently.
        np.testing.assert_allclose(getattr(sample, name), getattr(whole, name), rtol=1e-3, atol=1e-6, err_msg=name)
    assert sample.effective_sample_size is not None
    np.testing.assert_allclose(sample.effective_sample_size, whole.effective_sample_size, rtol=1e-4)
    assert sample.particles is not None
    assert sample.log_weights is not None
    assert (sample.particle_count, sample.particles.shape[1], sample.ancestors) == (2000, 200, None)
    weights = np.exp(sample.log_weights.astype(np.float64))
    np.testing.assert_allclose(weights.sum(1), 1.0, atol=1e-5)
    # The kept particles' mean is within its sampling error; 5 is far in the tail of a normal distribution.
    mean = np.einsum("tm,tmn->tn", weights, sample.particles)
    error = np.sqrt(sample.estimate_covariance.diagonal(axis1=1, axis2=2) * np.square(weights).sum(1)[:, None])
    assert (np.abs(mean - sample.estimate_mean) < 5.0 * error + 1e-5).mean() > 0.99

    save_trace(sample, tmp_path / "run.trace")
    loaded = load_trace(tmp_path / "run.trace")
    assert (loaded.particle_count, loaded.effective_sample_size.tolist()) == (2000, sample.all_particles_ess.tolist())  # type: ignore[union-attr]
    assert "--particles-kept 2000" in (particle_health.why_not(sample) or "")
    assert Replay(checkpoint, sample).original.particles.shape == sample.particles.shape  # type: ignore[union-attr]
    assert standalone(checkpoint, sample, "image").particle_count == 2000
    with pytest.raises(BadInput, match="particles kept must be at least 1"):
        trace(checkpoint, episode, particles_kept=0)


@pytest.mark.first(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", ["door/crossmodal-ekf", "door/crossmodal-pf", "push-field/information-ekf"])
def test_trace_in_parts_has_the_same_bytes(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The evidence of the last filter depends on several steps."""
    task, filter_name = name.split("/")
    with open_dataset(sample_path(task)) as dataset:
        episode = dataset[dataset.held_out()[0]]
    for module in (store, episode_file, episode_parts, run_module):
        monkeypatch.setattr(module, "STEPS_PER_PART", 30)
    path = tmp_path / "long.h5"
    write_dataset(path, episode.task, [episode])
    checkpoint = load_checkpoint(pretrained_path(task, filter_name))
    settings = {"seed": 3, "particles": 40, "particles_kept": 11}
    save_trace(trace(checkpoint, episode, 0, **settings), tmp_path / "whole.trace")
    progress: list[float] = []
    with open_dataset(path, episode.task) as dataset:
        parts = dataset.in_parts(0)
        assert isinstance(parts, EpisodeParts)
        written = list(trace_parts(checkpoint, parts, 0, progress=progress.append, **settings))
    assert len(written) >= 4
    assert max(map(len, written)) <= 30
    first = save_trace_parts(written, len(episode), tmp_path / "parts.trace")
    assert first.data_hash == episode.digest()
    assert (progress[-1], len(progress)) == (1.0, len(episode))
    assert (tmp_path / "parts.trace").read_bytes() == (tmp_path / "whole.trace").read_bytes()


def test_trace_file_is_that_of_safetensors(traced: Trace, tmp_path: Path) -> None:
    save_trace(traced, tmp_path / "run.trace")
    arrays = {key: np.ascontiguousarray(array) for key, array in arrays_of(traced).items()}
    arrays |= {"episode/time": np.arange(len(traced), dtype=np.float64)}
    timed = replace(traced, episode=replace(traced.episode, time=arrays["episode/time"]))
    save_trace(timed, tmp_path / "timed.trace")
    metadata = {"beliefscope-trace": json.dumps(header_of(timed))}
    assert (tmp_path / "timed.trace").read_bytes() == safetensors.numpy.save(arrays, metadata)


@pytest.mark.slow
def test_modified_parts_are_refused(episode: Episode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (store, episode_file, episode_parts):
        monkeypatch.setattr(module, "STEPS_PER_PART", 30)
    path = tmp_path / "long.h5"
    write_dataset(path, episode.task, [episode])
    with h5py.File(path, "r+") as file:
        file["trajectory0/states"][40] += np.float32(0.1)
    checkpoint = load_checkpoint(pretrained_path("door", "haptics-ekf"))
    with open_dataset(path) as dataset:
        parts = dataset.in_parts(0)
        assert isinstance(parts, EpisodeParts)
        with pytest.raises(BadInput, match=r"trajectory0 in .* do not match its digest"):
            next(trace_parts(checkpoint, parts))


def test_file_with_large_chunks_is_read_at_once(
    episode: Episode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As earlier versions wrote them: each part would decompress all steps."""
    write_dataset(tmp_path / "long.h5", episode.task, [episode])
    monkeypatch.setattr(episode_file, "STEPS_PER_PART", 30)
    with open_dataset(tmp_path / "long.h5") as dataset:
        assert isinstance(dataset.in_parts(0), Episode)


def test_command_reads_long_episodes_in_parts(
    run: Callable[..., tuple[int, str, str]], episode: Episode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    line = "trace door --filter crossmodal-pf --particles 20 --data long.h5 --episode 0 --json - -o"
    with monkeypatch.context() as patch:
        for module in (store, episode_file, episode_parts, run_module):
            patch.setattr(module, "STEPS_PER_PART", 30)
        write_dataset(tmp_path / "long.h5", episode.task, [episode])
        parts = run(f"{line} parts.trace")
    monkeypatch.setattr(run_module, "STEPS_PER_PART", 30)  # the same blocks of evidence, and so the same bits
    whole = run(f"{line} whole.trace --faults image_shift=0")
    assert (parts[0], whole[0]) == (0, 0), parts[2] + whole[2]
    assert json.loads(parts[1])["steps"] == len(episode)
    run_of_parts, run_of_whole = load_trace(tmp_path / "parts.trace"), load_trace(tmp_path / "whole.trace")
    assert run_of_parts.data_hash == run_of_whole.data_hash == episode.digest()
    for name, values in arrays_of(run_of_whole).items():
        np.testing.assert_array_equal(arrays_of(run_of_parts)[name], values, err_msg=name)
