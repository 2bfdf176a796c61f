"""Tables of a diagnosis."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.catalog import CAUSES
from beliefscope.inspect.diagnosis.cause import Candidate, Diagnosis, Evidence


def test_largest_deviations_take_the_place_of_causes_without_evidence() -> None:
    deviation = Evidence("NEES/n is 9, healthy 1 (0.5 to 2)", 9.0, 0.5, 2.0)
    cause = next(iter(CAUSES))
    alone = Candidate(cause, 0.06, (0,), None, (), None, "Diagnose more episodes.")
    supported = Candidate(cause, 0.06, (0,), None, (deviation,), None, "Diagnose more episodes.")

    def titles(candidate: Candidate) -> list[str]:
        return [table.title for table in Diagnosis("unsure", False, "", (candidate,), (deviation,)).tables()]

    assert titles(alone) == ["Largest deviations"]
    assert titles(supported) == ["Causes", "Evidence", "Next"]


def test_tables_name_causes_by_title_and_have_all_digits_of_a_probability() -> None:
    cause = next(cause for cause in CAUSES if cause.name == "image.noise")
    deviation = Evidence("noise of image is 40, healthy 1 (0.5 to 2)", 40.0, 0.5, 2.0)
    candidate = Candidate(cause, 0.9987, (0,), None, (deviation,), None, "Check the camera.")
    causes, evidence, actions = Diagnosis("fault", False, "", (candidate,), (deviation,)).tables()
    assert causes.rows[0][:3] == ("Image noisy", "image.noise", 0.9987)
    assert str(causes.rows[0][2]) == "0.9987"  # as in CSV files
    assert "above 0.99" in str(causes)
    assert evidence.rows[0][0] == actions.rows[0][0] == "Image noisy"
