"""The arrow of the measured force in the 3D scene."""

from __future__ import annotations

import numpy as np

from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.figures.force_arrow import MAX_RINGS, RING_DISTANCE, DrawnForce, ring_spacing
from beliefscope.inspect.trace import trace


def test_the_rings_of_the_force_arrow_are_round_numbers() -> None:
    largest = np.geomspace(0.02, 5000.0, 200)
    spacing = np.array([ring_spacing(newtons) for newtons in largest])
    assert (largest / spacing <= MAX_RINGS * (1 + 1e-9)).all()
    assert (largest / spacing > MAX_RINGS / 2.5 - 1e-9).all(), "the next smaller spacing has too many rings"
    assert {f"{value:.0e}"[0] for value in spacing} == {"1", "2", "5"}


def test_the_arrow_of_a_step_ends_at_the_hand_and_has_the_length_of_its_rings() -> None:
    with open_dataset(sample_path("push")) as data:
        episode = data[9]
    drawn = DrawnForce(trace(load_checkpoint(pretrained_path("push", "crossmodal-ekf")), episode, 9))
    contact = np.flatnonzero(episode.contact)
    free = np.flatnonzero(~episode.contact.astype(bool))
    assert len(contact)
    assert len(free)
    assert all(drawn.at(step) is None for step in free[:3])
    for step in contact[:5]:
        arrow = drawn.at(step)
        assert arrow is not None
        hand = episode.observations["effector_position"][step]
        distances = np.linalg.norm(arrow.arrow - hand, axis=1)
        assert distances.min() < 1e-6, "one end is at the hand, up to the rounding of float32"
        length = np.linalg.norm(arrow.arrow[1] - arrow.arrow[0])
        rings = int((arrow.rings[2][:, 0] > 0.0).sum())
        assert rings == int(length / RING_DISTANCE + 1e-9)
