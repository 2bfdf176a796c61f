"""The filters of the external faults are consistent, and every fault has an effect."""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
import torch
from external_faults.__main__ import TASKS, Answer, rank_of, row, totals
from external_faults.fault import delay, hold

import beliefscope as bs
from beliefscope.filters.external.adapter import FailedStep
from beliefscope.inspect.diagnosis.catalog import causes_in
from beliefscope.inspect.diagnosis.cause import Candidate
from beliefscope.inspect.statistics.measures import nees

STEPS = 80
REPORTED = ("mower", "shuttle")  # mistakes with a public report
TRAINED = ("tray", "slot")  # by simulated episodes, hence not exactly consistent
COUNTS = (
    dict.fromkeys(REPORTED, (2, 10))
    | dict.fromkeys(("rover", "river", "skiff"), (3, 5))
    | dict.fromkeys(TRAINED, (5, 5))
)
"""Numbers of faults of the data and of the filter; 5 and 7 of other tasks."""
UNDONE = ("dropout_on",)
"""Faults of the filter that evaluation mode undoes."""
REDRAWN = {"camera_noise": "tip"}
"""Fault of the data -> sensor whose noise is drawn after that of the fault."""


@pytest.fixture(params=TASKS)
def task(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    module = importlib.import_module(f"external_faults.{request.param}")
    if hasattr(module, "PARTICLES"):
        monkeypatch.setattr(module, "PARTICLES", 300)
    return module


def inputs(episode: bs.Episode) -> Mapping[str, np.ndarray]:
    return {**episode.observations, "control": episode.controls}


@pytest.mark.slow
@pytest.mark.long
def test_filter_is_consistent_and_each_fault_of_it_changes_its_estimates(task: ModuleType) -> None:
    episode = task.simulate(4, steps=50)  # the headings pass pi

    def run(fault: str) -> bs.Trace:
        torch.manual_seed(0)
        return bs.trace(bs.load_filter(task.make(fault)), [episode])

    right = run("")
    assert 0.4 < nees(right)[10:, -1].mean() < (2.5 if task.TASK.name in TRAINED else 2)
    faults = [name for name, fault in task.FAULTS.items() if fault.where == "filter"]
    assert len(faults) == COUNTS.get(task.TASK.name, (5, 7))[1]
    for name in faults:
        with suppress(FailedStep):  # the faulty filter may fail
            assert np.array_equal(run(name).estimate_mean, right.estimate_mean) == (name in UNDONE), name


def test_each_fault_of_the_data_changes_the_episode(task: ModuleType) -> None:
    clean = task.simulate(2, steps=STEPS)  # some faults are not in all episodes
    faults = [name for name, fault in task.FAULTS.items() if fault.where == "data"]
    assert len(faults) == COUNTS.get(task.TASK.name, (5, 7))[0]
    for name in faults:
        faulty = task.simulate(2, name, steps=STEPS)
        before, after = ({**inputs(episode), "labels": episode.states} for episode in (clean, faulty))
        changed = {key for key, values in before.items() if not np.array_equal(after[key], values)}
        assert len(changed - {REDRAWN.get(name)}) == 1, name
        assert ("labels" in changed) == name.startswith("labels")


@pytest.mark.first(3)
def test_accepted_causes_are_in_the_catalog_and_counted(task: ModuleType) -> None:
    for name, fault in task.FAULTS.items():
        accepted = [c for c in causes_in(bs.load_filter(task.make(name))) if re.fullmatch(fault.accepted, c.name)]
        assert accepted, name
        other = replace(accepted[0], name="other.cause")
        candidates = [Candidate(cause, 0.5, (), None, (), None, "") for cause in (other, *accepted)]
        diagnosis = bs.Diagnosis("fault", False, "Headline", tuple(candidates))
        assert rank_of(fault, diagnosis) == 2
        answer = Answer(task.TASK.name, name, fault, diagnosis, 1)
        assert f"{fault.where}: 1 of 1 (100 %, 21 to 100 %)" in totals([answer])
        assert row(answer).endswith("| Headline | 1 |")
        assert re.search(r" \([\w-]+/[\w-]+#\d+\) \|", row(answer)) if task.TASK.name in REPORTED else not fault.source


def test_late_and_held_readings() -> None:
    values = np.arange(5.0)[:, None]
    assert delay(values, 2)[:, 0].tolist() == [0, 0, 0, 1, 2]
    assert hold(values, np.array([True, False, False, True, False]))[:, 0].tolist() == [0, 0, 0, 3, 3]
