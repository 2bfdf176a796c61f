"""Slices: their steps, modalities, and text and JSON forms."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.fault import parameters
from beliefscope.datasets.faults.faults import FAULTS
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.batch import Batch, Steps
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.filters.finetuning.slices import CLEAN, Slice, standard_slices
from beliefscope.filters.rollout import first_belief, rollout

TEXTS = {
    "black-in-contact:faults=blackout=1:contact=yes:only=haptics": Slice(
        "black-in-contact", Faults.parse("blackout=1"), True, ("haptics",)
    ),
    "biased:faults=force_bias:x=5:from=20,blackout=0.4": Slice(
        "biased", Faults.parse("force_bias:x=5:from=20,blackout=0.4")
    ),
    "both:only=image+haptics:contact=no": Slice("both", contact=False, only=("image", "haptics")),
    "all:faults=": Slice("all"),
}


@pytest.mark.parametrize("text", TEXTS)
def test_slices_survive_text_and_json(text: str) -> None:
    slice_ = Slice.parse(text)
    assert slice_ == TEXTS[text]
    assert Slice.parse(str(slice_)) == slice_
    assert Slice.from_json(slice_.to_json()) == Slice.from_json(text) == slice_


def test_fault_parameters_differ_from_slice_keys() -> None:
    names = {key for fault in FAULTS.values() for key in parameters(fault)}
    assert not names & {"faults", "contact", "only"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("touching", "Available: clean, contact, free motion"),
        ("a:contact=maybe", "yes or no"),
        ("a:contact=yes:contact=no", "'contact=no'"),
        ("a:where=x", "'where=x'"),
        ("a:faults=blackot=1", "blackout"),
        (":contact=yes", "a slice's name is ''"),
    ],
)
def test_invalid_text_is_rejected(text: str, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        Slice.parse(text, standard_slices(find_task("door")))


@pytest.mark.parametrize(
    "value",
    ["contact", {"contact": True}, {"name": "a", "where": 1}, {"name": "a", "contact": 1}, {"name": "a", "only": "x"}],
)
def test_invalid_json_is_rejected(value: object) -> None:
    with pytest.raises(BadInput, match="slice"):
        Slice.from_json(value)


def test_unknown_modality_or_sensor_is_rejected() -> None:
    task = find_task("door")
    with pytest.raises(BadInput, match="Available: image, haptics"):
        Slice("a", only=("touch",)).check(task, ("image", "haptics"))
    with pytest.raises(BadInput):
        Slice("a", Faults.parse("delay=sonar:steps=2")).check(task, ("image", "haptics"))


def test_contact_and_free_motion_partition_all_steps(window: Callable[..., Batch]) -> None:
    batch = window(6, 3)
    batch.contact[2:4, 1] = True
    inside, outside = (Slice("a", contact=contact).mask(batch) for contact in (True, False))
    assert torch.equal(inside, batch.contact)
    assert torch.equal(inside ^ outside, CLEAN.mask(batch))
    assert CLEAN.mask(batch).all()


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_single_modality_equals_one_hot_beta(name: str) -> None:
    filter_ = load_checkpoint(pretrained_path("door", name)).filter
    with open_dataset(sample_path("door")) as data:
        batch = Steps.from_episodes(filter_.task, [data[9]]).windows(torch.tensor([0]), 12)

    def means(evidence: object) -> torch.Tensor:
        generator = torch.Generator().manual_seed(0)
        return rollout(filter_, evidence, first_belief(filter_, batch), generator, 20).estimate.mean  # type: ignore[arg-type]

    with torch.no_grad():
        evidence = filter_.encode(batch)
        for k, model in enumerate(filter_.names):
            single = means(Slice("a", only=(model,)).select_evidence(evidence, filter_.names))
            # Beta is 1 in both cases, but normalised here: float32 rounding.
            torch.testing.assert_close(single, means(evidence.only(k)), atol=1e-5, rtol=0.0)
            assert not torch.allclose(single, means(evidence), atol=1e-4)


def test_standard_slices_of_a_task() -> None:
    names = [slice_.name for slice_ in standard_slices(find_task("push"))]
    assert names == ["clean", "contact", "free motion", "blackout 0.8", "image only", "haptics only"]
