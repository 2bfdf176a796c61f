"""Report of an external filter whose map components have different units, and whose estimate leaves the map."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import beliefscope as bs
from beliefscope.app.cli.main import main
from beliefscope.inspect.maps.map_engine import MapEngine
from beliefscope.inspect.maps.plane import is_outside
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.report.compose import compose, write_report
from beliefscope.recordings.report.sections import event_table

STEPS = 12
TASK = bs.Task(
    name="crane",
    components=(bs.Component("cart", "m", display=("mm", 1000)), bs.Component("swing", "rad")),
    observations={"encoder": (1,)},
    modalities={"encoder": ("encoder",)},
    control_size=0,
    dt=0.1,
    map_components=("cart", "swing"),
    map_half_width=0.2,
)


class Drifting:
    """The estimate of the cart is 2 cm further off at each step; the map ends at 20 cm."""

    def initialize_beliefs(self, *, mean, covariance):
        self.mean = mean

    def __call__(self, *, observations, controls):
        self.mean = self.mean + np.array([0.02, 0.0])
        innovation = observations["encoder"] - self.mean[:1]
        return {
            "estimate_mean": self.mean,
            "estimate_covariance": np.diag([0.01, 0.02]) ** 2,
            "innovation": innovation[None],
            "innovation_covariance": np.eye(1)[None],
        }


@pytest.fixture(scope="module")
def filter_() -> bs.Checkpoint:
    return bs.load_filter(bs.Adapter(Drifting(), batched=False, initial_std=(0.03, 0.1)), TASK, name="drifting")


@pytest.fixture(scope="module")
def run(filter_: bs.Checkpoint) -> Trace:
    states = np.zeros((STEPS, 2))
    return bs.trace(filter_, [bs.Episode(TASK, states, observations={"encoder": states[:, :1]})], 0)


@pytest.mark.parametrize(("step", "outside"), [(2, False), (11, True)])
def test_numbers_of_maps_that_do_not_contain_the_belief_are_omitted(
    run: Trace, filter_: bs.Checkpoint, step: int, outside: bool
) -> None:
    map_ = MapEngine(filter_, run).map(step)
    assert is_outside(run, step) == outside
    table = event_table(run, step, map_)
    assert table.columns.count("cart error (mm)") == 1
    row = dict(zip(table.columns, table.rows[-1], strict=True))
    assert row["cart error (mm)"] == pytest.approx(20 * (step + 1))
    area = np.pi * 5.991 * 10.0 * np.degrees(0.02)  # of the 95 % ellipse
    assert row["map: 95 % region (mm·deg)"] == (None if outside else pytest.approx(area, rel=0.05))


def test_texts_name_the_quantities_of_the_run(run: Trace, filter_: bs.Checkpoint, tmp_path: Path) -> None:
    write_report(compose([run], filter_), tmp_path / "report")
    text = re.sub("<[^>]*>", "", (tmp_path / "report" / "report.html").read_text())
    assert "{}" not in text
    assert "Steps with the largest cart error" in text
    assert "Cart error of the fused estimate." in text
    assert "The fused estimate is outside of the map." in text
    assert "with the standard deviations cart 30 mm, swing 5.73 deg." in text
    assert "estimates, covariance, innovations." in text


@pytest.mark.long
def test_episodes_are_in_order_and_the_caption_names_what_is_drawn(
    run: Trace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for episode in (9, 19):
        bs.save_trace(replace(run, episode_index=episode), tmp_path / f"{episode}.trace")
    monkeypatch.setattr(sys, "argv", ["beliefscope", "report", str(tmp_path), "-o", str(tmp_path / "report")])
    with pytest.raises(SystemExit) as end:
        main()
    assert not end.value.code
    text = re.sub("<[^>]*>", "", (tmp_path / "report" / "report.html").read_text())
    assert "9, 19: 24 steps in total" in text
    assert "Cart error of the fused estimate. Dotted: the events below." in text
