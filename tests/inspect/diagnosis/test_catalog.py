"""The catalog of causes: complete, documented and separable."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.diagnosis.catalog import CAUSES
from beliefscope.inspect.diagnosis.cause import Cause, Symptom, index_ranges, probability_text
from beliefscope.inspect.diagnosis.checks.episode_statistics import with_scatter
from beliefscope.inspect.diagnosis.next_action import is_unused, next_action
from beliefscope.inspect.diagnosis.scoring import (
    Explanation,
    applicable,
    burden,
    explain,
    probabilities,
    strength,
    support,
)
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile

PAGE = Path(__file__).parents[3] / "docs" / "diagnose.md"

REQUIRED = {
    "image": ("blackout", "frozen", "delay", "shift", "noise", "exposure", "occlusion", "blur"),
    "force": ("bias", "drift", "gain", "sign", "axes", "noise", "stuck", "saturation"),
    "torque": ("bias", "noise"),
    "effector": ("offset", "noise"),
    "contact": ("stuck", "inverted", "delay"),
    "haptics": ("delay", "dropout"),
    "control": ("delay", "scale"),
    "labels": ("delay", "offset"),
    "model.image": ("bias", "overconfident", "underconfident", "broken"),
    "model.haptics": ("bias", "overconfident", "underconfident", "broken"),
    "dynamics": ("bias", "frozen", "broken"),
    "process_noise": ("small", "large"),
    "covariance": ("small", "large"),
    "weights": ("constant", "inverted", "ignores_image", "ignores_haptics"),
    "particles": ("few", "deprived"),
    "resampling": ("off", "biased"),
    "fusion": ("shared_prior", "miscalibrated"),
    "data": ("shift",),
}
"""Component -> mechanisms."""


def deviation(statistic: str, t: float, value: float = 0.0, healthy: float = 0.0) -> Deviation:
    return Deviation(statistic, value, healthy, healthy, healthy, 0.0, abs(t) > 1.0, t)


def row(cause: Cause) -> str:
    """Row of a cause in the table of the documentation."""
    sign = {-1: "decreases", 0: "deviates", 1: "increases"}

    def text(s: Symptom) -> str:
        own = f"`{s.statistics.replace('|', '`, `')}` {'is ' + s.target if s.target else sign[s.direction]}"
        return " or ".join([own, *map(text, s.otherwise)]) + (", if known" if s.optional else "")

    symptoms = "; ".join(map(text, cause.symptoms))
    return f"| `{cause.name}` | {cause.title} | {symptoms} | {cause.undo.replace('|', ', or ') or 'none'} |"


def test_no_probability_is_certain() -> None:
    assert [probability_text(p) for p in (0.05, 0.994, 0.9951, 1.0)] == ["0.05", "0.99", "above 0.99", "above 0.99"]


def test_the_catalog_has_every_required_cause_once() -> None:
    names = [cause.name for cause in CAUSES]
    assert len(names) == len(set(names))
    assert not {f"{part}.{mechanism}" for part, group in REQUIRED.items() for mechanism in group} - set(names)


@pytest.mark.parametrize("cause", CAUSES, ids=lambda cause: cause.name)
def test_the_catalog_is_documented(cause: Cause) -> None:
    assert row(cause) in PAGE.read_text().splitlines()


def ideal(cause: Cause) -> list[Deviation]:
    """Deviations of exactly the first statistic of each symptom, in the right direction."""
    result = {}
    for symptom in cause.symptoms:
        name = symptom.statistics.split("|")[0].replace("*", "x")
        value = -3.0 if symptom.target == "mirrored" else 8.0
        sign = symptom.direction or 1
        if name not in result or symptom.target:
            result[name] = deviation(name, (-10.0 if symptom.target == "mirrored" else 10.0) * sign, value, 3.0)
    return list(result.values())


@pytest.mark.parametrize("cause", CAUSES, ids=lambda cause: cause.name)
def test_a_cause_explains_its_own_symptoms_best(cause: Cause) -> None:
    deviations = ideal(cause)
    scores = {other.name: explain(other, deviations).score for other in CAUSES}
    assert scores[cause.name] == max(scores.values())
    assert scores[cause.name] > 0.5


def test_an_unexplained_deviation_upstream_excludes_a_cause() -> None:
    overconfident = next(cause for cause in CAUSES if cause.name == "model.image.overconfident")
    module, camera = deviation("module power/image/all", 10.0), deviation("shift/image x/all", 10.0)
    belief = deviation("nees/fused/all", 10.0)
    alone, with_belief, with_camera = (
        explain(overconfident, deviations).score for deviations in ([module], [module, belief], [module, camera])
    )
    assert alone == with_belief > 0.9  # the filter follows from its modules
    assert with_camera < 0.1


def test_the_wrong_direction_counts_against_a_cause() -> None:
    symptom = Symptom("module power/*", 1)
    assert support(symptom, [deviation("module power/image/all", 10.0)]) > 0.9
    assert support(symptom, [deviation("module power/image/all", -10.0)]) == -1.0
    assert support(symptom, []) == -1.0


def test_mirrored_and_shifted_statistics_are_told_apart_by_their_values() -> None:
    mirrored, shifted = (Symptom("beta logit/*", target=target) for target in ("mirrored", "shifted"))

    def deviations(values: tuple[float, float]) -> list[Deviation]:
        healthy = (11.0, 5.0)
        return [
            deviation(f"beta logit/image {c}/all", -10.0, v, h) for c, v, h in zip("xy", values, healthy, strict=True)
        ]

    assert support(mirrored, deviations((-11.0, -5.0))) > 0.9 > 0.0 > support(shifted, deviations((-11.0, -5.0)))
    shrunk = Symptom("beta logit/*", target="shrunk")
    assert support(shrunk, deviations((1.0, 0.5))) > 0.9 > 0.0 > support(shrunk, deviations((-11.0, -5.0)))
    assert support(shifted, deviations((3.0, -3.0))) > 0.9 > 0.0 > support(mirrored, deviations((3.0, -3.0)))


def test_exchanged_statistics_have_the_healthy_values_of_each_other() -> None:
    exchanged = Symptom("beta logit/*", target="exchanged")
    names, healthy = ("camera", "sonar", "touch"), np.array([9.0, -4.0, 2.0])

    def deviations(values: NDArray[np.float64]) -> list[Deviation]:
        changes = zip(names, values - healthy, values, healthy, strict=True)
        return [deviation(f"beta logit/{name}/all", t, value, h) for name, t, value, h in changes]

    for order in ([1, 0, 2], [1, 2, 0]):
        assert support(exchanged, deviations(healthy[order])) > 0.9
    for others in (-healthy, healthy + 13.0, 0.0 * healthy):
        assert support(exchanged, deviations(others)) < 0.5


def test_strength_grows_from_insignificance_to_one() -> None:
    ratios = np.linspace(0.0, 20.0, 50)
    values = [strength(ratio) for ratio in ratios]
    assert values[0] == 0.0
    assert np.all(np.diff(values) >= 0.0)
    assert 0.99 < values[-1] <= 1.0


def test_probabilities_include_an_unknown_cause() -> None:
    def alone(**supports: float) -> dict[str, float]:
        return probabilities({name: Explanation(name, support, {}) for name, support in supports.items()})

    assert alone(a=-2.0)["a"] < 0.01
    assert alone(a=1.0)["a"] > 0.99
    both = alone(a=0.5, b=0.5)
    assert both["a"] == both["b"] == pytest.approx(0.5, abs=0.1)


def test_two_causes_are_probable_if_each_explains_what_the_other_does_not() -> None:
    first, second = Explanation("b", 1.0, {"noise/force x": 1.0}), Explanation("c", 1.0, {"black/image": 1.0})
    other = Explanation("d", 1.0, {"black/image": 1.0, "noise/force x": 1.0})
    result = probabilities({"first": first, "second": second, "other": other})
    assert min(result["first"], result["second"]) > 0.9
    assert result["other"] < 0.1
    single = probabilities({"first": Explanation("b", 1.0, {}), "second": second, "other": other})
    assert single["first"] > 0.99
    assert max(single["second"], single["other"]) < 0.2


def test_causes_that_cannot_be_observed_are_left_out() -> None:
    names = {cause.name for cause in applicable(CAUSES, ["black/image/all", "particles//all"])}
    assert names == {"image.blackout", "particles.few"}


def test_an_optional_symptom_counts_only_where_it_is_observed() -> None:
    """Labels offset and a biased image model: the object in the images agrees with the labels only in the latter."""
    labels, model = (next(c for c in CAUSES if c.name == name) for name in ("labels.offset", "model.image.bias"))
    bias = deviation("module bias/image x/all", 10.0)
    unknown = applicable((labels,), ["module bias/image x/all"])
    assert unknown == [labels]
    agrees, differs = (deviation("object offset/image x/all", t) for t in (0.0, 10.0))
    assert explain(model, [bias, agrees]).score > explain(labels, [bias, agrees]).score
    assert explain(labels, [bias, differs]).score > explain(model, [bias, differs]).score


def test_the_distance_in_contact_separates_the_object_from_the_image_model() -> None:
    """A larger puck biases the image model, too, but only the puck changes where the hand touches it."""
    data, model = (next(c for c in CAUSES if c.name == name) for name in ("data.shift", "model.image.bias"))
    deviations = [deviation(f"module {kind}/image x/all", 10.0) for kind in ("bias", "error")]
    same, larger = (deviation("contact distance/labels/contact", t) for t in (0.0, 10.0))
    assert explain(model, [*deviations, same]).score > explain(data, [*deviations, same]).score
    assert explain(data, [*deviations, larger]).score > explain(model, [*deviations, larger]).score


def test_an_offset_of_the_labels_has_no_common_distance_in_contact() -> None:
    """A larger object is farther away from every side, shifted labels by their own amount in each direction."""
    data, labels = (next(c for c in CAUSES if c.name == name) for name in ("data.shift", "labels.offset"))
    deviations = [deviation(f"module {kind}/image x/all", 10.0) for kind in ("bias", "error")]
    deviations.append(deviation("contact distance error/labels/contact", 10.0))
    common, scattered = (deviation(f"contact distance{kind}/labels/contact", 10.0) for kind in ("", " scatter"))
    assert explain(data, [*deviations, common]).score > explain(labels, [*deviations, common]).score
    assert explain(labels, [*deviations, scattered]).score > explain(data, [*deviations, scattered]).score


@pytest.mark.parametrize(
    ("values", "expected"), [((3.0, 2.0, 4.0), 2.0), ((3.0, -2.0, 4.0), 0.0), ((3.0, 2.0), math.nan)]
)
def test_the_common_part_of_episodes(values: tuple[float, ...], expected: float) -> None:
    name = "contact distance/labels/contact"
    healthy = HealthyProfile("data", 20, None, {name: np.linspace(-1.0, 1.0, 20)})
    columns, rows = with_scatter(healthy, [{name: value} for value in values])
    assert [row[name] for row in rows] == pytest.approx([expected] * len(values), nan_ok=True)
    scatter = [row["contact distance scatter/labels/contact"] for row in rows]
    assert scatter == pytest.approx([abs(value - np.mean(values)) for value in values])
    column = columns.statistics["contact distance scatter/labels/contact"]
    np.testing.assert_allclose(column, np.abs(healthy.statistics[name]))


def test_the_burden_counts_phases_once_and_the_filter_less() -> None:
    upstream = [deviation("black/image/all", 20.0), deviation("black/image/contact", 20.0)]
    assert burden(upstream) == pytest.approx(1.0, abs=1e-3)
    assert burden([deviation("nees/fused/all", 20.0)]) < 0.5


@pytest.mark.parametrize(("haptics", "shared"), [(0.02, True), (0.0, False)])
def test_a_shift_of_all_modalities_is_common(haptics: float, shared: bool) -> None:
    """The haptics model has a standard error of 5 mm; the image model has moved by 2 cm."""
    deviations = [
        Deviation(f"module bias/{name} x/all", value, 0.0, -2 * sigma, 2 * sigma, 0.0, True, value / sigma)
        for name, value, sigma in (("image", 0.02, 0.001), ("haptics", haptics, 0.005))
    ]
    common, alone = (support(Symptom("module bias/*", target=target), deviations) for target in ("common", "alone"))
    assert (common > 0.9 and alone < -0.9) if shared else (alone > 0.9 and common < -0.9)


def test_a_cause_may_lower_statistics_without_raising_them() -> None:
    bias = next(cause for cause in CAUSES if cause.name == "model.image.bias")
    module = deviation("module bias/image x/all", 10.0)
    lower, higher = (explain(bias, [module, deviation("module spread/image x/all", t)]).score for t in (-10.0, 10.0))
    assert lower == explain(bias, [module]).score
    assert higher < lower - 0.9


def test_consecutive_episodes_are_ranges() -> None:
    assert index_ranges([3, 4, 9, 10, 11, 12, 20]) == "3, 4, 9 to 12, 20"
    assert index_ranges([]) == ""


def test_a_fault_of_an_unused_sensor_has_no_action_for_the_filter() -> None:
    """Unless the controls contain its readings: the dynamics of every filter use them."""
    names = ("haptics", "image", "crossmodal")
    checkpoints = {name: load_checkpoint(pretrained_path("door", f"{name}-ekf")) for name in names}
    unused = {name: {c.name for c in CAUSES if is_unused(c, checkpoint)} for name, checkpoint in checkpoints.items()}
    assert unused["haptics"] == {f"image.{mechanism}" for mechanism in REQUIRED["image"]}
    sensors = ("force", "torque")
    assert unused["image"] == {f"{sensor}.{mechanism}" for sensor in sensors for mechanism in REQUIRED[sensor]}
    assert not unused["crossmodal"]
    frozen = next(cause for cause in CAUSES if cause.name == "image.frozen")
    assert next_action(frozen, checkpoints["haptics"]).startswith("This filter does not use the image sensor and")
    assert next_action(frozen, checkpoints["image"]) == frozen.next
