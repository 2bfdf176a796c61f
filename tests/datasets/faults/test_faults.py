"""Sensor faults: effects, unaffected data, and conversion to text and JSON."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import beliefscope
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.fault import Fault, parameters
from beliefscope.datasets.faults.faults import FAULTS
from beliefscope.datasets.faults.injection import FAULT_PRESETS, NO_FAULTS, Faults, fault_catalog, faulty_copies
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.simulation.simulate import hand_controls

Array = np.ndarray[Any, Any]
SPAN = ":from=20:to=60"
AFFECTED = {
    "blackout": {"image"},
    "force_bias=5": {"force"},
    "force_drift=1": {"force"},
    "torque_bias=0.3": {"torque"},
    "torque_noise": {"torque"},
    "effector_offset=0.02": {"effector_position"},
    "effector_noise": {"effector_position"},
    "contact_inverted": {"contact"},
    "contact_delayed": {"contact"},
    "delay=haptics": {"effector_position", "force", "torque", "contact"},
    "delay=image": {"image"},
    "drop=haptics": {"effector_position", "force", "torque", "contact"},
    "drop=image": {"image"},
    "force_noise": {"force"},
    "force_saturation": {"force"},
    "force_stuck": {"force"},
    "force_stuck=all": {"force"},
    "force_gain": {"force"},
    "force_axes": {"force"},
    "contact_stuck": {"contact"},
    **{f"sensor_{name}=torque": {"torque"} for name in ("bias", "drift", "gain", "noise", "frozen", "swapped")},
    "control_delay": set(),
    "control_scale": set(),
} | {name: {"image"} for name in FAULTS if name.startswith("image_")}
"""Fault -> observations it changes."""


def inject(text: str, episode: Episode, seed: int = 0) -> Episode:
    return Faults.parse(text).apply(episode, seed)


def force(episode: Episode) -> Array:
    return episode.observations["force"].astype(np.float64)


def images(episode: Episode) -> Array:
    return episode.observations["image"].astype(np.float64)


def test_all_faults_are_covered() -> None:
    assert {text.split("=")[0] for text in AFFECTED} == set(FAULTS)


@pytest.mark.parametrize("text", AFFECTED)
def test_fault_changes_only_its_sensors_within_its_span(text: str, episode: Episode) -> None:
    before = episode.digest()
    after = inject(text + SPAN, episode)
    assert episode.digest() == before, "modified in place"
    changed = {k for k, v in episode.observations.items() if not np.array_equal(v, after.observations[k])}
    assert changed == AFFECTED[text]
    for key, values in episode.observations.items():
        assert after.observations[key].dtype == values.dtype
        assert after.observations[key].shape == values.shape
        assert np.array_equal(after.observations[key][:20], values[:20])
        assert np.array_equal(after.observations[key][60:], values[60:])
    for field in fields(Episode):
        if field.name not in ("observations", "controls"):
            assert getattr(after, field.name) is getattr(episode, field.name)
    if text.startswith("control_"):
        differs = (after.controls != episode.controls).any(1)
        assert differs[20:60].any()
        assert not differs[:20].any()
        assert not differs[60:].any()


@pytest.mark.parametrize("text", [*AFFECTED, "drop=haptics:probability=0.1:steps=4", "blackout=0.4"])
def test_faults_are_deterministic(text: str, episode: Episode) -> None:
    assert inject(text, episode, 3).digest() == inject(text, episode, 3).digest()


@pytest.mark.parametrize(
    "text",
    ["blackout=0.5", "image_noise", "image_occluded", "force_noise", "contact_inverted=0.5", "drop:probability=0.1"],
)
def test_randomness_depends_on_seed_episode_and_position(text: str, episode: Episode) -> None:
    key = Faults.parse(text).sequence[0].keys(DOOR)[0]
    first = inject(text, episode, 0).observations[key]
    assert not np.array_equal(first, inject(text, episode, 1).observations[key])
    other = inject(text, replace(episode, seed=episode.seed + 1)).observations[key]
    assert not np.array_equal(first, other)
    assert not np.array_equal(first, inject(f"effector_offset=1,{text}", episode).observations[key])


def test_controls_follow_the_readings(episode: Episode) -> None:
    assert np.array_equal(
        hand_controls(episode.observations["effector_position"], episode.observations["contact"]), episode.controls
    )
    offset = inject("effector_offset:x=0.02,contact_inverted", episode)
    np.testing.assert_allclose(offset.controls[:, 0] - episode.controls[:, 0], 0.02, atol=1e-6)
    np.testing.assert_allclose(offset.controls[:, 3:6], episode.controls[:, 3:6], atol=1e-6)
    assert np.array_equal(offset.controls[:, 6], 1 - episode.controls[:, 6])
    jump = inject("effector_offset:x=0.02:from=20", episode)
    assert jump.controls[20, 3] - episode.controls[20, 3] == pytest.approx(0.02, abs=1e-6)
    external = replace(episode, controls=episode.controls + 1)
    assert inject("effector_offset=1", external).controls is external.controls


def test_blackout_probability(episode: Episode) -> None:
    long = replace(episode, observations={"image": np.full((20_000, 4, 4), 7, np.uint8)})
    for p in (0.0, 0.4, 0.8, 1.0):
        observed = inject(f"blackout={p}", long).observations["image"]
        black = ~observed.any(axis=(1, 2))
        assert abs(black.mean() - p) < 4 * np.sqrt(p * (1 - p) / 20_000) + 1e-12
        assert (observed[~black] == 7).all()
    # Steps are independent: the probability of two in a row is 0.4 ** 2.
    black = ~inject("blackout=0.4", long).observations["image"].any(axis=(1, 2))
    assert abs((black[1:] & black[:-1]).mean() - 0.16) < 0.015


def test_gray_level_of_a_blackout(episode: Episode) -> None:
    """The same steps are lost, with another level; texts and JSON without a level stay as they were."""
    black, gray = (images(inject(text, episode)) for text in ("blackout=0.5", "blackout=0.5:gray=128"))
    lost = ~black.any(axis=(1, 2))
    assert 0 < lost.sum() < len(lost)
    assert (gray[lost] == 128).all()
    assert (gray[~lost] == black[~lost]).all()
    faults = Faults.parse("blackout=0.5:gray=128")
    assert str(faults) == "blackout=0.5:gray=128"
    assert Faults.from_json(faults.to_json()) == faults
    assert Faults.parse("blackout=0.5").to_json() == [{"fault": "blackout", "probability": 0.5}]
    with pytest.raises(BadInput, match="gray"):
        Faults.parse("blackout:gray=256")


def test_image_faults(episode: Episode) -> None:
    clean = images(episode)
    assert (images(inject("image_frozen=30", episode))[30:] == clean[30]).all()
    assert np.array_equal(images(inject("image_underexposed=0.4", episode)), np.rint(0.4 * clean))
    assert images(inject("image_underexposed=100", episode)).max() == 255
    gray = replace(episode, observations={"image": np.full((400, 32, 32), 128, np.uint8)})
    noise = images(inject("image_noise=20", gray)) - 128
    assert abs(noise.mean()) < 0.2
    assert noise.std() == pytest.approx(20, rel=0.01)
    occluded = inject("image_occluded=10:x=3:y=20:gray=9", episode).observations["image"]
    assert (occluded[:, 20:30, 3:13] == 9).all()
    outside = np.ones((32, 32), bool)
    outside[20:30, 3:13] = False
    assert np.array_equal(occluded[:, outside], clean[:, outside])


def test_position_of_an_occlusion_is_random_but_constant(episode: Episode) -> None:
    white = replace(episode, observations={"image": np.full((5, 32, 32), 255, np.uint8)})
    positions = set()
    for seed in range(40):
        occluded = inject("image_occluded=12", white, seed).observations["image"] == 0
        assert (occluded == occluded[0]).all()
        assert occluded[0].sum() == 144
        positions.add(tuple(np.argwhere(occluded[0])[0]))
    assert len(positions) > 20


def test_force_faults(episode: Episode) -> None:
    clean = force(episode)
    np.testing.assert_allclose(force(inject("force_bias:x=5:z=-2", episode)) - clean, [[5, 0, -2]] * 100, atol=1e-5)
    drift = force(inject("force_drift:x=0.5:y=-1:from=20", episode)) - clean
    np.testing.assert_allclose(drift[20:, 0], 0.5 * 0.1 * np.arange(80), atol=1e-5)
    np.testing.assert_allclose(drift[:, 1], -2 * drift[:, 0], atol=1e-5)
    limited = inject("force_saturation=5", episode)
    assert np.abs(clean).max() > 5
    assert np.abs(force(limited)).max() == 5
    assert inject("force_saturation=5", limited).digest() == limited.digest()
    inside = np.abs(clean) <= 5
    assert np.array_equal(force(limited)[inside], clean[inside])
    stuck = force(inject("force_stuck=y:from=20", episode))
    assert (stuck[20:, 1] == clean[20, 1]).all()
    assert np.array_equal(stuck[:, [0, 2]], clean[:, [0, 2]])
    noise = [force(inject("force_noise=3", episode, seed)) - clean for seed in range(30)]
    assert np.std(noise) == pytest.approx(3, rel=0.05)
    assert abs(np.mean(noise)) < 0.15


def test_delays_shift_readings(episode: Episode) -> None:
    delayed = inject("delay=haptics:steps=3", episode)
    for key in ("force", "torque", "effector_position", "contact"):
        assert np.array_equal(delayed.observations[key][3:], episode.observations[key][:-3])
        assert (delayed.observations[key][:3] == episode.observations[key][0]).all()
    twice = inject("delay=image:steps=2,delay=image:steps=3", episode)
    assert np.array_equal(twice.observations["image"], inject("delay=image:steps=5", episode).observations["image"])
    flag = inject("contact_delayed=4", episode).observations["contact"]
    assert np.array_equal(flag[4:], episode.observations["contact"][:-4])
    assert np.array_equal(delayed.controls[3:], episode.controls[:-3])


def test_flipping_contact_twice_restores_it(episode: Episode) -> None:
    flipped = inject("contact_inverted", episode)
    assert np.array_equal(flipped.observations["contact"], 1 - episode.observations["contact"])
    assert inject("contact_inverted", flipped).digest() == episode.digest()
    fraction = (
        inject("contact_inverted=0.3", episode).observations["contact"] != episode.observations["contact"]
    ).mean()
    assert 0.1 < fraction < 0.5


def test_dropped_images_are_black_and_other_readings_constant(episode: Episode) -> None:
    dropped = inject("drop=haptics:from=20:to=40", episode).observations
    for key in ("force", "torque", "effector_position", "contact"):
        assert (dropped[key][20:40] == episode.observations[key][19]).all()
    assert not inject("drop=image:from=20:to=40", episode).observations["image"][20:40].any()
    assert (inject("drop=haptics", episode).observations["force"] == episode.observations["force"][0]).all()


def test_dropouts_have_the_given_length_and_affect_all_sensors(episode: Episode) -> None:
    count = 4000
    ramp = np.arange(count, dtype=np.float32)[:, None]
    keys = DOOR.modalities["haptics"]
    long = replace(episode, observations=dict.fromkeys(keys, ramp))
    dropped = inject("drop=haptics:probability=0.02:steps=5", long).observations
    assert all(np.array_equal(dropped[key], dropped[keys[0]]) for key in keys)
    lost = (dropped[keys[0]] != ramp)[:, 0]
    assert lost.mean() == pytest.approx(1 - 0.98**5, rel=0.25)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], lost, [0]])))
    lengths = edges[1::2] - edges[::2]
    assert lengths[:-1].min() == 5
    assert np.bincount(lengths).argmax() == 5


def test_fault_after_the_end_changes_nothing(episode: Episode) -> None:
    for text in AFFECTED:
        assert inject(f"{text}:from=5000", episode).digest() == episode.digest()


def test_faults_are_applied_in_order(episode: Episode) -> None:
    saturated = inject("force_bias:x=100,force_saturation=5", episode)
    biased = inject("force_saturation=5,force_bias:x=100", episode)
    assert force(saturated).max() == 5
    assert force(biased).max() > 95
    both = Faults.parse("force_bias:x=100") + Faults.parse("force_saturation=5")
    assert both == Faults.parse("force_bias:x=100,force_saturation=5")
    assert both.apply(episode).digest() == saturated.digest()


def test_no_faults_return_the_same_episode(episode: Episode) -> None:
    assert not NO_FAULTS
    assert NO_FAULTS.apply(episode) is episode
    assert (
        Faults.parse("")
        == Faults.parse(" ")
        == Faults.parse("[]")
        == Faults.parse("{}")
        == Faults.from_json([])
        == NO_FAULTS
    )


def test_only_training_episodes_are_copied(episode: Episode) -> None:
    some = [replace(episode, split=split) for split in ("train", "val", "test", "train")]
    copies = faulty_copies(Faults.parse("force_bias:x=5"), some, 0)
    assert [copy.split for copy in copies] == ["train", "train"]
    assert all(force(copy)[:, 0].mean() > force(episode)[:, 0].mean() + 4 for copy in copies)


@pytest.mark.parametrize("fault", FAULTS.values(), ids=list(FAULTS))
def test_fault_round_trips_as_text_and_json(fault: type[Fault]) -> None:
    unusual = {float: 0.37, int: 3}
    values = {p.name: unusual.get(p.metadata["kind"], p.default) for p in parameters(fault).values()}
    values |= {"value": 1} if "value" in values else {}
    values |= {"from_": 2, "to": 9}
    for faults in (Faults((fault(),)), Faults((fault(**values), fault()))):
        assert Faults.parse(str(faults)) == faults
        assert Faults.from_json(json.loads(json.dumps(faults.to_json()))) == faults
        assert Faults.parse(json.dumps(faults.to_json())) == faults
        assert {faults: 1}[Faults.parse(str(faults))] == 1
    assert Faults((fault(**values),)).to_json()[0].items() >= {"fault": fault.name, "from": 2, "to": 9}.items()


def test_short_forms() -> None:
    faults = Faults((FAULTS["blackout"](probability=0.4),))
    for text in ('{"blackout": 0.4}', '[{"fault": "blackout", "probability": 0.4}]', "blackout:probability=0.4"):
        assert Faults.parse(text) == faults
    assert Faults.parse(" blackout=0.4 , force_bias:x=5 ") == faults + Faults.from_json({"fault": "force_bias", "x": 5})
    assert str(faults) == "blackout=0.4"
    assert str(Faults.parse("force_bias=0:y=2:from=20:to=60")) == "force_bias:y=2:from=20:to=60"
    assert str(Faults.parse("delay:steps=3,blackout=1,image_frozen=7")) == "delay=image:steps=3,blackout,image_frozen=7"
    assert faults.to_json() == [{"fault": "blackout", "probability": 0.4}]


def test_fault_names_of_earlier_versions_are_read() -> None:
    old = Faults.from_json(
        [{"fault": "image_darker", "factor": 0.5}, {"fault": "image_patch"}, {"fault": "contact_late"}]
    )
    assert str(old) == "image_underexposed=0.5,image_occluded,contact_delayed"
    assert Faults.parse("image_darker=0.5,image_patch,contact_late") == old
    assert str(Faults.parse("contact_flipped=0.5")) == "contact_inverted=0.5"


def test_presets_fit_the_door_and_change_the_episode(episode: Episode) -> None:
    for text in FAULT_PRESETS.values():
        faults = Faults.parse(text)
        faults.check(DOOR)
        assert faults.apply(episode).digest() != episode.digest()


def test_catalog_describes_all_parameters() -> None:
    for fault in fault_catalog():
        assert fault.meaning.endswith(".")
        assert all(p.unit and p.meaning for p in fault.parameters)
        assert json.dumps(asdict(fault))


def test_every_fault_is_documented() -> None:
    page = (Path(beliefscope.__file__).resolve().parents[2] / "docs" / "data.md").read_text()
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*\.) \|$", page.split("## Sensor faults")[1], re.MULTILINE))
    assert list(rows) == list(FAULTS)
    for fault in fault_catalog():
        names = [p.name for p in fault.parameters[:-2]]
        documented = rows[fault.fault].split("`")[1].split() if names else []
        assert [text.split("=")[0] for text in documented] == names
        assert rows[fault.fault].endswith(f"| {fault.meaning}")


BAD = {
    "blakout": r"fault 'blakout' does not exist\. Did you mean blackout\? Available: blackout, .*control_scale\.",
    "blackout,,": r"fault '' does not exist\. Available",
    "blackout:chance=1": r"parameter 'chance' of blackout does not exist\. Available: probability, gray, key, from, ",
    "blackout=1.5": r"blackout's 'probability' is 1\.5, not a number from 0 to 1",
    "blackout=nan": r"blackout's 'probability' is nan, not a number from 0 to 1",
    "blackout=much": r"blackout's 'probability' is 'much', not a number from 0 to 1",
    "blackout:from=2.5": r"blackout's 'from' is 2\.5, not a whole number from 0 to 1e\+06",
    "blackout:from=5:to=5": r"blackout's 'to' is 5, not a step after 'from', which is 5",
    "blackout=0.4:probability=0.4": r"blackout's 'probability' is given twice",
    "blackout:from": r"'from' in 'blackout:from' is not parameter=value, each parameter once",
    "blackout:from=1:from=2": r"'from=2' in 'blackout:from=1:from=2' is not parameter=value, each parameter once",
    "force_bias=1e9": r"force_bias's 'x' is 1000000000\.0, not a number from -1e\+06 to 1e\+06",
    "force_stuck=w": r"axis 'w' of force_stuck does not exist\. Available: x, y, z, all\.",
    "force_axes=xyz": r"order 'xyz' of force_axes does not exist\. Available: xzy, yxz, yzx, zxy, zyx\.",
    "contact_stuck=2": r"contact_stuck's 'value' is 2, not a whole number from 0 to 1",
    "control_scale=0.5:axis=x": r"'axis' of control_scale does not exist\. Available: factor, channel, from, to\.",
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
    '{"force_bias": 1' + "0" * 500 + "}": r"faults is not JSON: a number of 501 digits is beyond the range of floats",
    "force_bias=1" + "0" * 500: r"force_bias's 'x' is 10+, not a number",
    "delay=\ud800:steps=1": r"delay's 'modality' is '\\ud800', not a name",
}


@pytest.mark.parametrize("text", BAD, ids=lambda text: text[:40])
def test_invalid_faults_are_rejected_in_one_line(text: str) -> None:
    with pytest.raises(BadInput, match=BAD[text]) as error:
        Faults.parse(text)
    assert "\n" not in str(error.value)


def test_faults_of_missing_sensors_are_rejected(episode: Episode) -> None:
    with pytest.raises(BadInput, match=r"modality 'touch' of task 'door' does not exist\. Available: image, haptics\."):
        Faults.parse("delay=touch").check(DOOR)
    no_image = replace(DOOR, observations={"force": (3,)})
    with pytest.raises(BadInput, match=r"blackout needs an image sensor; task 'door' has none\. Its sensors: force\."):
        Faults.parse("force_bias,blackout").check(no_image)
    flat = replace(episode, observations=dict(episode.observations) | {"force": np.zeros((100, 2), np.float32)})
    with pytest.raises(BadInput, match=r"z=1 uses an axis that the sensor does not have\. Available: x, y\."):
        inject("force_bias:z=1", flat)
    with pytest.raises(BadInput, match=r"axis 'z' of the force does not exist\. Available: x, y\."):
        inject("force_stuck=z", flat)
    with pytest.raises(BadInput, match=r"axis 'z' of the force does not exist\. Available: x, y\."):
        inject("force_axes=zyx", flat)


def test_description_has_the_values_of_defaults() -> None:
    for text, description in {
        "image_noise": "image_noise (std 40 gray levels)",
        "image_noise=20:from=3:to=60": "image_noise (std 20 gray levels, from step 3, to step 59)",
        "delay=image:steps=5": "delay (modality image, steps 5)",
        "image_underexposed=0": "image_underexposed (factor 0)",
        "image_frozen": "image_frozen",
    }.items():
        assert [fault.describe() for fault in Faults.parse(text)] == [description]
