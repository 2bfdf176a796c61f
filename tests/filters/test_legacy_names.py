"""Records and settings with the keys of earlier versions."""

from __future__ import annotations

from beliefscope.filters.finetuning.settings import FineTune, StepRange
from beliefscope.filters.finetuning.slices import Slice
from beliefscope.filters.legacy_names import failure_result, training_record

OLD_SETTINGS = {
    "nominal": 0.2,
    "pull": 3.0,
    "moments": ["9:10-30"],
    "mix": [
        {"slice": {"name": "no contact", "recipe": [], "contact": False, "only": []}, "share": 1},
        {"slice": {"name": "haptics alone", "recipe": [], "contact": None, "only": ["haptics"]}, "share": 1},
    ],
}


def test_old_settings_are_read() -> None:
    settings = FineTune.from_json(OLD_SETTINGS)
    assert (settings.clean_weight, settings.l2_sp, settings.events) == (0.2, 3.0, (StepRange(9, 10, 30),))
    slices = [slice_ for slice_, _ in settings.mix]
    assert slices == [Slice("free motion", contact=False), Slice("haptics only", only=("haptics",))]


def test_old_records_are_read() -> None:
    metrics = {"rmse": {"position_cm": 1.0}}
    record = training_record(
        {
            "seed": 0,
            "parent": {"hash": "0" * 64, "settings": OLD_SETTINGS},
            "looks": [{"step": 0, "slices": {"nominal": metrics, "image alone": metrics}}],
            "held_out": {"before": {"nominal": metrics}, "after": {"no contact": metrics}},
        }
    )
    assert record.keys() == {"seed", "base", "validations", "held_out"}
    assert record["base"]["hash"] == "0" * 64
    assert FineTune.from_json(record["base"]["settings"]) == FineTune.from_json(OLD_SETTINGS)
    assert record["validations"] == [{"step": 0, "slices": {"clean": metrics, "image only": metrics}}]
    assert record["held_out"] == {"before": {"clean": metrics}, "after": {"free motion": metrics}}
    assert training_record(record) == record


def test_scores_of_old_failure_results_are_renamed() -> None:
    score = {"name": "error", "unit": "m"}
    old = {"filter": "pf", "scores": [{**score, "shown": "cm"}]}
    new = {"filter": "pf", "scores": [{**score, "display_unit": "cm"}]}
    assert failure_result(old) == failure_result(new) == new
