"""Baselines on small cases."""

from __future__ import annotations

from pathlib import Path

import pytest
from beliefbench.baselines import Learned, answer_of, cause_of_alarm, first_alarm
from beliefbench.cases import Spec, load_case, planted
from beliefbench.generate import write_case

from beliefscope.inspect.diagnostics.healthy_comparison import Deviation


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    directory = tmp_path_factory.mktemp("cases")
    causes = [(), (planted("covariance.small", 2),), (planted("weights.inverted", 2),)]
    specs = [
        Spec("door", "crossmodal-ekf", cause, seed=1000 + 2 * i, episodes=2, steps=60) for i, cause in enumerate(causes)
    ]
    return [write_case(spec, directory) for spec in specs]


@pytest.mark.long
@pytest.mark.slow
def test_learned_baselines_recognise_the_cases_they_were_fitted_to(folders: list[Path]) -> None:
    learned = Learned.fit(folders)
    assert learned.causes == ["healthy", "covariance.small", "weights.inverted"]
    assert learned.nearest_neighbour(load_case(folders[0]))["state"] == "healthy"
    for i in (1, 2):
        answer = learned.nearest_neighbour(load_case(folders[i]))
        assert answer["causes"][0]["cause"] == learned.causes[i]
        assert sum(cause["probability"] for cause in answer["causes"]) <= 1.0
        tree = learned.decision_tree(load_case(folders[i]))
        assert tree["state"] in ("healthy", "fault")


@pytest.mark.slow
@pytest.mark.long
def test_first_alarm(folders: list[Path]) -> None:
    assert first_alarm(load_case(folders[2]))["causes"][0]["cause"].startswith("weights.")


@pytest.mark.parametrize(
    ("statistic", "high", "cause"),
    [
        ("nees/image/all", True, "model.image.overconfident"),
        ("nees/fused/contact", False, "covariance.large"),
        ("weight/image hinge_x/all", False, "weights.ignores_image"),
        ("weight/haptics/all", True, "weights.ignores_image"),
        ("ess//all", False, "particles.deprived"),
    ],
)
def test_causes_of_alarms(statistic: str, high: bool, cause: str) -> None:
    value = 2.0 if high else 0.5
    assert cause_of_alarm(Deviation(statistic, value, 1.0, 0.9, 1.1, p_value=0.001, alarm=True, t=9.0)) == cause


def test_answers_are_sorted() -> None:
    answer = answer_of({"a.x": 0.2, "healthy": 0.3, "b.y": 0.5})
    assert [(c["cause"], c["component"]) for c in answer["causes"]] == [("b.y", "b"), ("a.x", "a")]
    assert answer_of({"a.x": 0.2, "healthy": 0.8})["state"] == "healthy"
