"""Every fault keeps its law, breaks what it should and nothing else, and travels as text and as JSON."""

from __future__ import annotations

import json
import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import beliefscope
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.faults import FAULTS, Fault, parameters
from beliefscope.datasets.faults.injection import FAULT_PRESETS, WHOLE, Faults, broken_copies, described
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.simulation.simulate import hand_controls
from beliefscope.datasets.store import open_dataset, sample_path

Array = np.ndarray[Any, Any]
SPAN = ":from=20:to=60"
BREAKS = {
    "blackout": {"image"},
    "force_bias=5": {"force"},
    "force_drift=1": {"force"},
    "effector_offset=0.02": {"effector_position"},
    "contact_flipped": {"contact"},
    "contact_late": {"contact"},
    "delay=haptics": {"effector_position", "force", "torque", "contact"},
    "delay=image": {"image"},
    "drop=haptics": {"effector_position", "force", "torque", "contact"},
    "drop=image": {"image"},
    "force_noise": {"force"},
    "force_saturation": {"force"},
    "force_stuck": {"force"},
} | {name: {"image"} for name in FAULTS if name.startswith("image_")}
"""Fault -> observations it breaks."""


@pytest.fixture(scope="module")
def episode() -> Episode:
    """A push: it makes and breaks contact."""
    with open_dataset(sample_path("door")) as data:
        index = next(s.index for s in data.summaries if s.policy == "push" and 0.2 < s.contact_fraction < 0.8)
        return data[index]


def broken(text: str, episode: Episode, seed: int = 0) -> Episode:
    return Faults.parse(text).apply(episode, seed)


def force(episode: Episode) -> Array:
    return episode.observations["force"].astype(np.float64)


def pictures(episode: Episode) -> Array:
    return episode.observations["image"].astype(np.float64)


def test_every_fault_is_looked_at() -> None:
    assert {text.split("=")[0] for text in BREAKS} == set(FAULTS)


@pytest.mark.parametrize("text", BREAKS)
def test_a_fault_breaks_its_sensors_in_its_span_and_nothing_else(text: str, episode: Episode) -> None:
    before = episode.digest()
    after = broken(text + SPAN, episode)
    assert episode.digest() == before, "changed in place"
    changed = {k for k, v in episode.observations.items() if not np.array_equal(v, after.observations[k])}
    assert changed == BREAKS[text]
    for key, values in episode.observations.items():
        assert after.observations[key].dtype == values.dtype
        assert after.observations[key].shape == values.shape
        assert np.array_equal(after.observations[key][:20], values[:20])
        assert np.array_equal(after.observations[key][60:], values[60:])
    for field in fields(Episode):
        if field.name not in ("observations", "controls"):
            assert getattr(after, field.name) is getattr(episode, field.name)


@pytest.mark.parametrize("text", [*BREAKS, "drop=haptics:probability=0.1:steps=4", "blackout=0.4"])
def test_the_same_seed_gives_the_same_bits(text: str, episode: Episode) -> None:
    assert broken(text, episode, 3).digest() == broken(text, episode, 3).digest()


@pytest.mark.parametrize(
    "text", ["blackout=0.5", "image_noise", "image_patch", "force_noise", "contact_flipped=0.5", "drop:probability=0.1"]
)
def test_draws_differ_by_seed_episode_and_place(text: str, episode: Episode) -> None:
    key = Faults.parse(text).faults[0].keys(DOOR)[0]
    first = broken(text, episode, 0).observations[key]
    assert not np.array_equal(first, broken(text, episode, 1).observations[key])
    other = broken(text, replace(episode, seed=episode.seed + 1)).observations[key]
    assert not np.array_equal(first, other)
    assert not np.array_equal(first, broken(f"effector_offset=1,{text}", episode).observations[key])


def test_controls_follow_what_is_reported(episode: Episode) -> None:
    assert np.array_equal(
        hand_controls(episode.observations["effector_position"], episode.observations["contact"]), episode.controls
    )
    off = broken("effector_offset:x=0.02,contact_flipped", episode)
    np.testing.assert_allclose(off.controls[:, 0] - episode.controls[:, 0], 0.02, atol=1e-6)
    np.testing.assert_allclose(off.controls[:, 3:6], episode.controls[:, 3:6], atol=1e-6)
    assert np.array_equal(off.controls[:, 6], 1 - episode.controls[:, 6])
    jump = broken("effector_offset:x=0.02:from=20", episode)
    assert jump.controls[20, 3] - episode.controls[20, 3] == pytest.approx(0.02, abs=1e-6)
    others = replace(episode, controls=episode.controls + 1)
    assert broken("effector_offset=1", others).controls is others.controls


def test_a_share_of_the_pictures_is_black_and_the_others_untouched(episode: Episode) -> None:
    long = replace(episode, observations={"image": np.full((20_000, 32, 32), 7, np.uint8)})
    for share in (0.0, 0.4, 0.8, 1.0):
        dark = broken(f"blackout={share}", long).observations["image"]
        black = ~dark.any(axis=(1, 2))
        assert abs(black.mean() - share) < 4 * np.sqrt(share * (1 - share) / 20_000) + 1e-12
        assert (dark[~black] == 7).all()
    # Each step on its own: two in a row are as rare as chance has it.
    black = ~broken("blackout=0.4", long).observations["image"].any(axis=(1, 2))
    assert abs((black[1:] & black[:-1]).mean() - 0.16) < 0.015


def test_pictures(episode: Episode) -> None:
    seen = pictures(episode)
    assert (pictures(broken("image_frozen=30", episode))[30:] == seen[30]).all()
    assert np.array_equal(pictures(broken("image_darker=0.4", episode)), np.rint(0.4 * seen))
    assert pictures(broken("image_darker=100", episode)).max() == 255
    gray = replace(episode, observations={"image": np.full((400, 32, 32), 128, np.uint8)})
    noise = pictures(broken("image_noise=20", gray)) - 128
    assert abs(noise.mean()) < 0.2
    assert noise.std() == pytest.approx(20, rel=0.01)
    hidden = broken("image_patch=10:x=3:y=20:gray=9", episode).observations["image"]
    assert (hidden[:, 20:30, 3:13] == 9).all()
    outside = np.ones((32, 32), bool)
    outside[20:30, 3:13] = False
    assert np.array_equal(hidden[:, outside], seen[:, outside])


def test_a_patch_without_a_place_stays_where_the_seed_puts_it(episode: Episode) -> None:
    white = replace(episode, observations={"image": np.full((5, 32, 32), 255, np.uint8)})
    places = set()
    for seed in range(40):
        dark = broken("image_patch=12", white, seed).observations["image"] == 0
        assert (dark == dark[0]).all()
        assert dark[0].sum() == 144
        places.add(tuple(np.argwhere(dark[0])[0]))
    assert len(places) > 20


def test_forces(episode: Episode) -> None:
    felt = force(episode)
    np.testing.assert_allclose(force(broken("force_bias:x=5:z=-2", episode)) - felt, [[5, 0, -2]] * 100, atol=1e-5)
    drift = force(broken("force_drift:x=0.5:y=-1:from=20", episode)) - felt
    np.testing.assert_allclose(drift[20:, 0], 0.5 * 0.1 * np.arange(80), atol=1e-5)
    np.testing.assert_allclose(drift[:, 1], -2 * drift[:, 0], atol=1e-5)
    limited = broken("force_saturation=5", episode)
    assert np.abs(felt).max() > 5
    assert np.abs(force(limited)).max() == 5
    assert broken("force_saturation=5", limited).digest() == limited.digest()
    inside = np.abs(felt) <= 5
    assert np.array_equal(force(limited)[inside], felt[inside])
    stuck = force(broken("force_stuck=y:from=20", episode))
    assert (stuck[20:, 1] == felt[20, 1]).all()
    assert np.array_equal(stuck[:, [0, 2]], felt[:, [0, 2]])
    noise = [force(broken("force_noise=3", episode, seed)) - felt for seed in range(30)]
    assert np.std(noise) == pytest.approx(3, rel=0.05)
    assert abs(np.mean(noise)) < 0.15


def test_what_is_late_is_shifted(episode: Episode) -> None:
    late = broken("delay=haptics:steps=3", episode)
    for key in ("force", "torque", "effector_position", "contact"):
        assert np.array_equal(late.observations[key][3:], episode.observations[key][:-3])
        assert (late.observations[key][:3] == episode.observations[key][0]).all()
    twice = broken("delay=image:steps=2,delay=image:steps=3", episode)
    assert np.array_equal(twice.observations["image"], broken("delay=image:steps=5", episode).observations["image"])
    flag = broken("contact_late=4", episode).observations["contact"]
    assert np.array_equal(flag[4:], episode.observations["contact"][:-4])
    assert np.array_equal(late.controls[3:], episode.controls[:-3])


def test_contact_flipped_twice_is_as_it_was(episode: Episode) -> None:
    flipped = broken("contact_flipped", episode)
    assert np.array_equal(flipped.observations["contact"], 1 - episode.observations["contact"])
    assert broken("contact_flipped", flipped).digest() == episode.digest()
    share = (broken("contact_flipped=0.3", episode).observations["contact"] != episode.observations["contact"]).mean()
    assert 0.1 < share < 0.5


def test_what_is_dropped_stays_or_is_black(episode: Episode) -> None:
    gone = broken("drop=haptics:from=20:to=40", episode).observations
    for key in ("force", "torque", "effector_position", "contact"):
        assert (gone[key][20:40] == episode.observations[key][19]).all()
    assert not broken("drop=image:from=20:to=40", episode).observations["image"][20:40].any()
    assert (broken("drop=haptics", episode).observations["force"] == episode.observations["force"][0]).all()


def test_gaps_have_their_length_and_take_all_sensors_of_the_modality(episode: Episode) -> None:
    count = 4000
    ramp = np.arange(count, dtype=np.float32)[:, None]
    keys = DOOR.modalities["haptics"]
    long = replace(episode, observations=dict.fromkeys(keys, ramp))
    gone = broken("drop=haptics:probability=0.02:steps=5", long).observations
    assert all(np.array_equal(gone[key], gone[keys[0]]) for key in keys)
    lost = (gone[keys[0]] != ramp)[:, 0]
    assert lost.mean() == pytest.approx(1 - 0.98**5, rel=0.25)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], lost, [0]])))
    lengths = edges[1::2] - edges[::2]
    assert lengths[:-1].min() == 5
    assert np.bincount(lengths).argmax() == 5


def test_a_fault_that_begins_after_the_end_changes_nothing(episode: Episode) -> None:
    for text in BREAKS:
        assert broken(f"{text}:from=5000", episode).digest() == episode.digest()


def test_faults_act_in_their_order(episode: Episode) -> None:
    there = broken("force_bias:x=100,force_saturation=5", episode)
    back = broken("force_saturation=5,force_bias:x=100", episode)
    assert force(there).max() == 5
    assert force(back).max() > 95
    both = Faults.parse("force_bias:x=100") + Faults.parse("force_saturation=5")
    assert both == Faults.parse("force_bias:x=100,force_saturation=5")
    assert both.apply(episode).digest() == there.digest()


def test_no_fault_is_no_copy(episode: Episode) -> None:
    assert not WHOLE
    assert WHOLE.apply(episode) is episode
    assert Faults.parse("") == Faults.parse(" ") == Faults.parse("[]") == Faults.parse("{}") == Faults.of([]) == WHOLE


def test_copies_of_training_episodes(episode: Episode) -> None:
    some = [replace(episode, split=split) for split in ("train", "val", "test", "train")]
    copies = broken_copies(Faults.parse("force_bias:x=5"), some, 0)
    assert [copy.split for copy in copies] == ["train", "train"]
    assert all(force(copy)[:, 0].mean() > force(episode)[:, 0].mean() + 4 for copy in copies)


@pytest.mark.parametrize("fault", FAULTS.values(), ids=list(FAULTS))
def test_a_fault_prints_and_travels(fault: type[Fault]) -> None:
    odd = {float: 0.37, int: 3}
    given = {one.name: odd.get(one.metadata["kind"], one.default) for one in parameters(fault).values()} | {
        "from_": 2,
        "to": 9,
    }
    for faults in (Faults((fault(),)), Faults((fault(**given), fault()))):
        assert Faults.parse(str(faults)) == faults
        assert Faults.of(json.loads(json.dumps(faults.to_json()))) == faults
        assert Faults.parse(json.dumps(faults.to_json())) == faults
        assert {faults: 1}[Faults.parse(str(faults))] == 1
    assert Faults((fault(**given),)).to_json()[0].items() >= {"fault": fault.name, "from": 2, "to": 9}.items()


def test_short_forms() -> None:
    asked = Faults((FAULTS["blackout"](probability=0.4),))
    for text in ('{"blackout": 0.4}', '[{"fault": "blackout", "probability": 0.4}]', "blackout:probability=0.4"):
        assert Faults.parse(text) == asked
    assert Faults.parse(" blackout=0.4 , force_bias:x=5 ") == asked + Faults.of({"fault": "force_bias", "x": 5})
    assert str(asked) == "blackout=0.4"
    assert str(Faults.parse("force_bias=0:y=2:from=20:to=60")) == "force_bias:y=2:from=20:to=60"
    assert str(Faults.parse("delay:steps=3,blackout=1,image_frozen=7")) == "delay=image:steps=3,blackout,image_frozen=7"
    assert asked.to_json() == [{"fault": "blackout", "probability": 0.4}]


def test_ready_faults_are_of_the_door_and_each_does_something(episode: Episode) -> None:
    for text in FAULT_PRESETS.values():
        faults = Faults.parse(text)
        faults.check(DOOR)
        assert faults.apply(episode).digest() != episode.digest()


def test_every_parameter_is_described() -> None:
    for fault in described():
        assert fault["meaning"].endswith(".")
        assert all(p["unit"] and p["meaning"] for p in fault["parameters"])
    assert json.dumps(described())


def test_every_fault_is_documented() -> None:
    page = (Path(beliefscope.__file__).resolve().parents[2] / "docs" / "data.md").read_text()
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*\.) \|$", page.split("## Broken sensors")[1], re.MULTILINE))
    assert list(rows) == list(FAULTS)
    for fault in described():
        own = [p["name"] for p in fault["parameters"][:-2]]
        shown = rows[fault["fault"]].split("`")[1].split() if own else []
        assert [one.split("=")[0] for one in shown] == own
        assert rows[fault["fault"]].endswith(f"| {fault['meaning']}")


BAD = {
    "blakout": r"fault 'blakout' does not exist\. Available: blackout, image_frozen, .*drop\.",
    "blackout,,": r"fault '' does not exist\. Available",
    "blackout:chance=1": r"parameter of blackout 'chance' does not exist\. Available: probability, from, to\.",
    "blackout=1.5": r"blackout's 'probability' is 1\.5, not a number from 0 to 1",
    "blackout=nan": r"blackout's 'probability' is nan, not a number from 0 to 1",
    "blackout=much": r"blackout's 'probability' is 'much', not a number from 0 to 1",
    "blackout:from=2.5": r"blackout's 'from' is 2\.5, not a whole number from 0 to 1e\+06",
    "blackout:from=5:to=5": r"blackout's 'to' is 5, not a step after 'from', which is 5",
    "blackout=0.4:probability=0.4": r"blackout's 'probability' is given twice",
    "blackout:from": r"'from' in 'blackout:from' is not a new parameter=value",
    "blackout:from=1:from=2": r"'from=2' in 'blackout:from=1:from=2' is not a new parameter=value",
    "force_bias=1e9": r"force_bias's 'x' is 1000000000\.0, not a number from -1e\+06 to 1e\+06",
    "force_stuck=w": r"axis of force_stuck 'w' does not exist\. Available: x, y, z\.",
    "delay=3": r"delay's 'modality' is 3, not a name",
    "delay:steps=-1": r"delay's 'steps' is -1, not a whole number",
    "[1]": r"faults is \[1\], not a list of objects",
    "[": r"faults is not JSON: Expecting value",
    "[" * 100_000: r"faults is not JSON",
    '{"fault": 3}': r"fault '3' does not exist",
    '{"blackout": "0.4"}': r"blackout's 'probability' is '0\.4', not a number",
    '{"blackout": true}': r"blackout's 'probability' is True, not a number",
    '{"delay": ""}': r"delay's 'modality' is '', not a name",
    '{"delay": "a,b"}': r"delay's 'modality' is 'a,b', not a name",
    '{"force_bias": 1' + "0" * 500 + "}": r"faults is not JSON: a number of 501 digits is beyond all floats",
    "force_bias=1" + "0" * 500: r"force_bias's 'x' is 10+, not a number",
    "delay=\ud800:steps=1": r"delay's 'modality' is '\\ud800', not a name",
}


@pytest.mark.parametrize("text", BAD, ids=lambda text: text[:40])
def test_a_bad_faults_is_one_line_that_names_what_exists(text: str) -> None:
    with pytest.raises(BadInput, match=BAD[text]) as caught:
        Faults.parse(text)
    assert "\n" not in str(caught.value)


def test_a_fault_of_what_a_task_has_not(episode: Episode) -> None:
    with pytest.raises(BadInput, match=r"modality of task 'door' 'touch' does not exist\. Available: image, haptics\."):
        Faults.parse("delay=touch").check(DOOR)
    blind = replace(DOOR, observations={"force": (3,)})
    with pytest.raises(BadInput, match=r"sensor of task 'door' 'image' does not exist\. Available: force\."):
        Faults.parse("force_bias,blackout").check(blind)
    flat = replace(episode, observations=dict(episode.observations) | {"force": np.zeros((100, 2), np.float32)})
    with pytest.raises(BadInput, match=r"force_bias:z=1 is of an axis that the sensor has not\. Available: x, y\."):
        broken("force_bias:z=1", flat)
    with pytest.raises(BadInput, match=r"axis of the force 'z' does not exist\. Available: x, y\."):
        broken("force_stuck=z", flat)
