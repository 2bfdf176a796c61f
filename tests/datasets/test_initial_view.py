"""The episode and step at which a data set opens."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.initial_view import initial_view, outage_in_first_contact
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.trace import trace


@pytest.fixture(scope="module")
def base() -> Episode:
    with open_dataset(sample_path("push")) as data:
        return data[0]


def episode(
    base: Episode, contact: list[tuple[int, int]], black: list[tuple[int, int]], outages: bool = True
) -> Episode:
    """A test episode with these stretches of contact and of image outage."""
    touching, image = np.zeros(len(base), dtype=bool), np.maximum(base.observations["image"], 1)
    for first, last in contact:
        touching[first:last] = True
    for first, last in black:
        image[first:last] = 0
    provenance = {**base.provenance, "ingredients": {"outages": {}} if outages else {}}
    observations = {**base.observations, "image": image}
    return replace(base, contact=touching, observations=observations, split="test", provenance=provenance)


@pytest.mark.parametrize(
    ("contact", "black", "step"),
    [
        ([(20, 50)], [(30, 60)], 29),
        ([(20, 50)], [(5, 12), (30, 40)], 29),
        ([(20, 50)], [(15, 25)], None),  # the contact begins without images
        ([(20, 50)], [(22, 60)], None),  # too few steps with images
        ([(20, 50)], [(46, 60)], None),  # the contact ends too soon
        ([(20, 50)], [(30, 33)], None),  # a short outage
        ([(20, 25), (40, 80)], [(50, 70)], None),  # not the first contact
        ([(20, 50)], [], None),
        ([], [(30, 60)], None),
    ],
)
def test_outage_in_the_first_contact(
    base: Episode, contact: list[tuple[int, int]], black: list[tuple[int, int]], step: int | None
) -> None:
    assert outage_in_first_contact(episode(base, contact, black)) == step


def test_first_moment_of_a_data_set(base: Episode, tmp_path: Path) -> None:
    without, fitting = ([(20, 50)], [(0, 5)]), ([(20, 50)], [(30, 60)])
    train = replace(episode(base, *fitting), split="train")
    for name, outages, expected in (("field", True, (2, 29)), ("plain", False, (1, 0))):
        episodes = [train, *(episode(base, *stretches, outages) for stretches in (without, fitting, fitting))]
        write_dataset(tmp_path / f"{name}.h5", find_task("push"), episodes)
        with open_dataset(tmp_path / f"{name}.h5") as data:
            assert initial_view(data) == expected


def test_share_passes_from_image_to_haptics_at_the_first_moment_of_the_samples() -> None:
    checkpoint = load_checkpoint(pretrained_path("push-field", "information-ekf"))
    with open_dataset(sample_path("push-field")) as data:
        index, step = initial_view(data)
        run = trace(checkpoint, data[index], index)
    assert run.effective_weights is not None
    haptics, contact = run.effective_weights[:, 1].mean(-1), int(run.episode.contact.argmax())
    assert contact <= step
    assert haptics[:contact].mean() < 0.5 < haptics[contact : step + 1].mean() < haptics[step + 1]
    assert haptics[step + 1] > 0.95
