"""Numbers in sentences."""

from beliefscope.datasets.text import percent, plural


def test_nouns_have_a_singular() -> None:
    assert [plural(count, "step") for count in (0, 1, 2)] == ["0 steps", "1 step", "2 steps"]


def test_shares_are_given_in_percent() -> None:
    assert (percent(0.376), percent(0.376, ".1f"), percent(-0.02, "+.1f")) == ("38 %", "37.6 %", "-2.0 %")
