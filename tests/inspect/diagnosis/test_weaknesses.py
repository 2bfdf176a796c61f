"""Weaknesses that fine-tuning can address."""

from dataclasses import replace

from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.diagnosis.weaknesses import untrained


def test_a_fault_that_a_filter_was_fine_tuned_on_is_not_offered_again() -> None:
    checkpoint = load_checkpoint(pretrained_path("push-field", "information-ekf"))
    (weakness,) = untrained(checkpoint)
    settings = weakness.settings.to_json()
    assert [item["slice"]["faults"][0]["fault"] for item in settings["mix"]] == ["image_noise"]
    assert not list(untrained(replace(checkpoint, record={"base": {"settings": settings}})))
