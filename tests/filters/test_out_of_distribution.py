"""Out-of-distribution warnings: none for clean data, one for each planted change; and alignment of a moved frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.alignment import align, move
from beliefscope.filters.checkpoint import PRETRAINED, Checkpoint, load_checkpoint, pretrained_path
from beliefscope.filters.out_of_distribution import _pretrained_summaries, data_warning, summarise, summary_key

TASKS = ("door", "push")


@pytest.fixture(scope="module", params=TASKS)
def task(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def checkpoint(task: str) -> Checkpoint:
    return load_checkpoint(pretrained_path(task, "crossmodal-ekf"))


@pytest.fixture(scope="module")
def fresh(task: str) -> list[Episode]:
    """The 50 test episodes of seed 2: the pretrained filters were trained on seed 1, the summary is of seed 0."""
    with open_dataset(sample_path(task)) as data:
        return [data[index] for index in range(140, 190)]


def with_readings(episode: Episode, key: str, change: Callable[[np.ndarray], np.ndarray]) -> Episode:
    return replace(episode, observations={**episode.observations, key: change(episode.observations[key])})


def test_no_warning_for_clean_episodes(checkpoint: Checkpoint, fresh: list[Episode]) -> None:
    """One by one, in samples of five, and all together."""
    rng = np.random.default_rng(0)
    samples = [[episode] for episode in fresh[:10]] + [fresh]
    samples += [[fresh[i] for i in rng.choice(50, 5, replace=False)] for _ in range(30)]
    samples += [fresh[first : first + 5] for first in range(0, 50, 5)]
    assert [data_warning(checkpoint, sample) for sample in samples] == [None] * len(samples)


def test_other_durations_of_steps(checkpoint: Checkpoint, fresh: list[Episode]) -> None:
    """The built-in dynamics ignore the times: jitter of 1 % has no warning, half and irregular steps have one."""
    (episode, *_), dt = fresh, checkpoint.task.dt
    jitter = np.random.default_rng(0).uniform(0.99, 1.01, len(episode))
    assert data_warning(checkpoint, [replace(episode, time=np.cumsum(dt * jitter) - dt)]) is None
    half = data_warning(checkpoint, [replace(episode, dt=dt / 2)])
    assert (
        half
        == f"steps of the data last {dt / 2:.3g} s; the filter's dynamics predict over {dt:.3g} s and ignore the times"
    )
    gap = np.arange(len(episode)) * dt + np.where(np.arange(len(episode)) < 5, 0.0, 1.0)
    assert f"last {dt:.3g} to {dt + 1:.3g} s" in (data_warning(checkpoint, [replace(episode, time=gap)]) or "")


@pytest.mark.parametrize("axes", [[1, 0, 2], [2, 1, 0], [0, 2, 1]])
def test_swapped_force_axes(checkpoint: Checkpoint, fresh: list[Episode], axes: list[int]) -> None:
    """Only relations between channels show it: each axis by itself stays within the training data."""
    swapped = [with_readings(episode, "force", lambda force: force[:, axes]) for episode in fresh]
    warning = data_warning(checkpoint, swapped)
    assert warning is not None
    assert "force" in warning


@pytest.mark.parametrize(
    ("key", "change", "words"),
    [
        ("force", lambda force: 10 * force, "times as large as in the training data"),
        ("image", lambda image: 255 - image, "brightness of the image"),
        ("image", lambda image: image // 2, "brightness of the image"),
    ],
)
def test_changed_sensor(checkpoint: Checkpoint, fresh: list[Episode], key: str, change: Callable, words: str) -> None:
    changed = [with_readings(episode, key, change) for episode in fresh[:5]]
    warning = data_warning(checkpoint, changed)
    assert warning is not None
    assert key in warning
    assert words in warning


def test_injected_faults_are_no_difference_of_the_data(checkpoint: Checkpoint, fresh: list[Episode]) -> None:
    faults = Faults.parse("blackout=0.8,force_bias:x=500,effector_offset:x=3")
    faulty = [faults.apply(episode) for episode in fresh[:5]]
    assert data_warning(checkpoint, faulty) is not None
    assert data_warning(checkpoint, faulty, faults) is None


@pytest.mark.slow
@pytest.mark.long
def test_moved_frame(checkpoint: Checkpoint, fresh: list[Episode]) -> None:
    """A single episode suffices for the warning; the alignment finds the offset without knowing it."""
    planted = np.array([0.52, -0.3])
    keys = ["effector_position", "control"]
    moved = [move(checkpoint.task, episode, planted, keys) for episode in fresh[:5]]
    warning = data_warning(checkpoint, moved[:1])
    assert warning is not None
    assert warning.endswith("try --align")
    aligned, alignment = align(checkpoint, moved)
    assert alignment is not None
    assert set(alignment.moved) == {"state", *keys}
    np.testing.assert_allclose(alignment.offset, -planted, atol=0.005)
    assert data_warning(checkpoint, aligned) is None
    _, alignment = align(checkpoint, [move(checkpoint.task, episode, planted, []) for episode in fresh[:5]])
    assert alignment is not None
    assert alignment.moved == ("state",), "the end effector was in the frame of the training data"
    same, none = align(checkpoint, fresh[:5])
    assert none is None
    assert same == fresh[:5]


@pytest.mark.first(1)
@pytest.mark.slow
def test_offset_that_is_not_constant(checkpoint: Checkpoint, fresh: list[Episode]) -> None:
    moved = [move(checkpoint.task, episode, np.array([0.4 + 0.3 * i, 0.0]), []) for i, episode in enumerate(fresh[:5])]
    with pytest.raises(BadInput, match="no constant offset"):
        align(checkpoint, moved)


@pytest.mark.long
@pytest.mark.slow
def test_pretrained_summaries_are_of_the_sample_sets() -> None:
    """As printed by the function that writes the record of new checkpoints, and available to every simulated filter."""
    for task in TASKS:
        with open_dataset(sample_path(task)) as data:
            episodes = [data[s.index] for s in data.summaries if s.split == "train"]
        statistics = load_checkpoint(pretrained_path(task, "crossmodal-ekf")).filter.statistics
        summary = _pretrained_summaries()[summary_key(statistics)]
        assert summary == {"task": task, **summarise(statistics, find_task(task), episodes)}
        for path in PRETRAINED.glob(f"{task}-*.safetensors"):
            if not any(other in path.name for other in ("real", "field")):  # whose records have it
                assert summary_key(load_checkpoint(path).filter.statistics) in _pretrained_summaries()
