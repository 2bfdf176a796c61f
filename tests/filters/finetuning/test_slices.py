"""Slices: what they select, who speaks in them, and their texts."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.faults import FAULTS, parameters
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.batch import Batch, Steps
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.filters.finetuning.slices import NOMINAL, Slice, slices_of
from beliefscope.filters.rollout import rollout, start_at_truth

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
def test_a_slice_is_read_from_its_text_and_printed_and_travels_as_json(text: str) -> None:
    slice_ = Slice.parse(text)
    assert slice_ == TEXTS[text]
    assert Slice.parse(str(slice_)) == slice_
    assert Slice.of(slice_.to_json()) == Slice.of(text) == slice_


def test_no_fault_has_a_parameter_that_a_slice_would_take_for_its_own() -> None:
    names = {key for fault in FAULTS.values() for key in parameters(fault)}
    assert not names & {"faults", "contact", "only"}


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("touching", "Available: nominal, contact, no contact"),
        ("a:contact=maybe", "yes or no"),
        ("a:contact=yes:contact=no", "'contact=no'"),
        ("a:where=x", "'where=x'"),
        ("a:faults=blackot=1", "blackout"),
        (":contact=yes", "a slice's name is ''"),
    ],
)
def test_what_is_wrong_is_said_with_what_is_right(text: str, told: str) -> None:
    with pytest.raises(BadInput, match=told):
        Slice.parse(text, slices_of(find_task("door")))


@pytest.mark.parametrize(
    "value",
    ["contact", {"contact": True}, {"name": "a", "where": 1}, {"name": "a", "contact": 1}, {"name": "a", "only": "x"}],
)
def test_json_that_is_no_slice_is_refused(value: object) -> None:
    with pytest.raises(BadInput, match="slice"):
        Slice.of(value)


def test_a_modality_or_sensor_that_is_not_there_is_refused() -> None:
    task = find_task("door")
    with pytest.raises(BadInput, match="Available: image, haptics"):
        Slice("a", only=("touch",)).check(task, ("image", "haptics"))
    with pytest.raises(BadInput):
        Slice("a", Faults.parse("delay=sonar:steps=2")).check(task, ("image", "haptics"))


def test_contact_and_the_rest_share_out_all_steps(window: Callable[..., Batch]) -> None:
    batch = window(6, 3)
    batch.contact[2:4, 1] = True
    inside, outside = (Slice("a", contact=contact).mask(batch) for contact in (True, False))
    assert torch.equal(inside, batch.contact)
    assert torch.equal(inside ^ outside, NOMINAL.mask(batch))
    assert NOMINAL.mask(batch).all()


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_one_modality_alone_is_beta_one_hot_on_it(name: str) -> None:
    filter_ = load_checkpoint(shipped("door", name)).filter
    with open_dataset(sample_path("door")) as data:
        batch = Steps.of(filter_.task, [data[9]]).windows(torch.tensor([0]), 12)

    def means(evidence: object) -> torch.Tensor:
        generator = torch.Generator().manual_seed(0)
        return rollout(filter_, evidence, start_at_truth(filter_, batch), generator, 20).estimate.mean  # type: ignore[arg-type]

    with torch.no_grad():
        evidence = filter_.encode(batch)
        for k, model in enumerate(filter_.names):
            alone = means(Slice("a", only=(model,)).heard(evidence, filter_.names))
            # Beta is 1 either way, but here as a share of itself: rounding of float32.
            torch.testing.assert_close(alone, means(evidence.only(k)), atol=1e-5, rtol=0.0)
            assert not torch.allclose(alone, means(evidence), atol=1e-4)


def test_the_standard_slices_are_those_that_the_task_has_the_sensors_for() -> None:
    names = [one.name for one in slices_of(find_task("push"))]
    assert names == ["nominal", "contact", "no contact", "blackout 0.8", "image alone", "haptics alone"]
