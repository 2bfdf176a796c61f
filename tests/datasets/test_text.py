"""Numbers in sentences."""

from beliefscope.datasets.text import percent, plural, typeset


def test_nouns_have_a_singular() -> None:
    assert [plural(count, "step") for count in (0, 1, 2)] == ["0 steps", "1 step", "2 steps"]


def test_shares_are_given_in_percent() -> None:
    assert (percent(0.376), percent(0.376, ".1f"), percent(-0.02, "+.1f")) == ("38 %", "37.6 %", "-2.0 %")


def test_numbers_are_typeset_as_on_the_page() -> None:
    assert typeset("dynamics -0.20 cm, angle 1.67 -> 1.95 deg") == "dynamics \N{MINUS SIGN}0.20 cm, angle 1.67 → 1.95°"
    assert typeset("angle error (deg)") == "angle error (°)"
    for text in ("steps 3-5", "image-only", "2026-11-25", "1e-05", "force_bias:x=-3", "--seed"):
        assert typeset(text) == text
