"""Faults of the controls, and exchanged, scaled or constant readings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults

Array = np.ndarray[Any, Any]


def inject(text: str, episode: Episode) -> Episode:
    return Faults.parse(text).apply(episode)


def force(episode: Episode) -> Array:
    return episode.observations["force"]


def test_force_axes_and_sign(episode: Episode) -> None:
    clean = force(episode)
    assert np.array_equal(force(inject("force_gain=-1", episode)), -clean)
    assert inject("force_gain=0.5,force_gain=2", episode).digest() == episode.digest()
    assert np.array_equal(force(inject("force_axes=yxz", episode)), clean[:, [1, 0, 2]])
    assert np.array_equal(force(inject("force_axes=yzx", episode)), clean[:, [1, 2, 0]])
    assert inject("force_axes=yzx,force_axes=yzx,force_axes=yzx", episode).digest() == episode.digest()
    stuck = force(inject("force_stuck=all:from=20", episode))
    assert (stuck[20:] == clean[20]).all()
    assert np.array_equal(stuck[:20], clean[:20])


def test_faults_of_controls_follow_those_of_readings(episode: Episode) -> None:
    late = inject("control_delay=3", episode).controls
    assert np.array_equal(late[3:], episode.controls[:-3])
    assert (late[:3] == episode.controls[0]).all()
    scaled = inject("control_scale=0.5", episode).controls
    assert np.array_equal(scaled[:, 3:6], 0.5 * episode.controls[:, 3:6])
    assert np.array_equal(scaled[:, [0, 1, 2, 6]], episode.controls[:, [0, 1, 2, 6]])
    reading, control = "effector_offset:x=0.02,delay=haptics:steps=2", "control_delay=3,control_scale=2"
    both = inject(f"{reading},{control}", episode)
    assert not np.array_equal(both.controls, inject(control, episode).controls)
    assert np.array_equal(both.controls[:, 3:6], 2 * inject(reading, episode).controls[late_index(100, 3), 3:6])
    assert both.digest() == inject(f"{control},{reading}", episode).digest()
    velocity = replace(episode, controls=episode.controls[:, 3:5])
    assert np.array_equal(inject("control_scale=0.5", velocity).controls, 0.5 * velocity.controls)
    assert np.array_equal(inject("control_scale=-1:channel=1", velocity).controls, velocity.controls * [1, -1])
    with pytest.raises(BadInput, match=r"scales a channel that the controls do not have\. Available: 0 to 1\."):
        inject("control_scale=-1:channel=2", velocity)


def late_index(count: int, steps: int) -> Array:
    return np.maximum(np.arange(count) - steps, 0)


def test_stuck_contact_misleads_the_controls(episode: Episode) -> None:
    for value in (0, 1):
        stuck = inject(f"contact_stuck={value}", episode)
        assert (stuck.observations["contact"] == value).all()
        assert (stuck.controls[:, 6] == value).all()
        assert stuck.contact is episode.contact
