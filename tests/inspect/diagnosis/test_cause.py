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
