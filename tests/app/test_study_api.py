"""A study over HTTP: the one that ships, one that was given, and which of their checkpoints can be looked at."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from beliefscope.app.library import Settings
from beliefscope.app.study import FILE, SHIPPED, Study, studies_of
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import PRETRAINED, load_checkpoint

FILTER = "crossmodal-ekf"


def results(hash_: str, **more: Any) -> dict[str, Any]:
    """A study of one filter and two seeds, of which the second has no checkpoint yet."""
    row = {
        "task": "door",
        "filter": FILTER,
        "blackout": 0.4,
        "seeds": 1,
        "asked": 2,
        "failed": 0,
        "mean": {"position_cm": 0.5, "nees": None},
        "spread": {"position_cm": None},
        "each": {"0": {"position_cm": 0.5}},
    }
    told = {"preset": "smoke", "tasks": {"door": {"data": "door.h5"}}, "seeds": 2, "rows": [row]}
    return told | {"checkpoints": {f"door/{FILTER}/seed0": hash_}} | more


@pytest.fixture
def folder(settings: Settings, tmp_path: Path) -> Path:
    """Of a study whose checkpoint is not on the shelf: another one has that filter's name there."""
    cell = tmp_path / "mine" / "cells" / "door" / FILTER / "seed0.safetensors"
    cell.parent.mkdir(parents=True)
    shutil.copy(PRETRAINED / f"door-{FILTER}.safetensors", cell)
    (tmp_path / "mine" / FILE).write_text(json.dumps(results(load_checkpoint(cell).hash)))
    return tmp_path / "mine"


def named(client: TestClient, name: str) -> dict[str, Any]:
    (study,) = (one for one in client.get("/api/studies").json()["studies"] if one["name"] == name)
    return study


def test_the_study_that_ships_is_whole_and_says_which_weights_are_here(
    settings: Settings, open_client: Callable[..., TestClient]
) -> None:
    with open_client(replace(settings, checkpoints={}, data={})) as client:
        study = named(client, SHIPPED)
    assert [task["name"] for task in study["tasks"]] == ["door", "push"]
    for task in study["tasks"]:
        shelf = {one["name"]: [seed["shelf"] for seed in one["trained"]] for one in task["filters"]}
        assert len(shelf) == 12
        for name, seeds in shelf.items():
            ships = (PRETRAINED / f"{task['name']}-{name}.safetensors").is_file()
            assert seeds == [name if ships else None, None, None]
        for row in task["rows"]:
            for key, mean in row["mean"].items():
                each = [numbers[key] for numbers in row["each"].values()]
                if mean is not None and row["blackout"] is not None:
                    assert mean == pytest.approx(sum(each) / 3)
                    assert min(each) <= mean <= max(each)


def test_a_checkpoint_of_a_study_is_put_on_the_shelf_once(
    settings: Settings, folder: Path, open_client: Callable[..., TestClient]
) -> None:
    with open_client(replace(settings, studies={"mine": folder})) as client:
        (task,) = named(client, "mine")["tasks"]
        assert task["filters"] == [{"name": FILTER, "trained": [{"seed": 0, "shelf": None, "file": True}]}]
        url = f"/api/studies/mine/door/{FILTER}/0"
        opened = client.post(url).json()
        assert opened == {"filter": f"mine-{FILTER}-seed0"} == client.post(url).json()
        (door,) = (one for one in client.get("/api/catalog").json()["tasks"] if one["name"] == "door")
        assert [one["name"] for one in door["filters"]].count(opened["filter"]) == 1
        (task,) = named(client, "mine")["tasks"]
        assert task["filters"][0]["trained"][0]["shelf"] == opened["filter"]
        assert client.post(f"/api/studies/mine/door/{FILTER}/1").status_code == 404
        assert client.post(f"/api/studies/none/door/{FILTER}/0").status_code == 404


def test_a_checkpoint_that_is_not_the_measured_one_is_refused(
    settings: Settings, folder: Path, open_client: Callable[..., TestClient]
) -> None:
    (folder / FILE).write_text(json.dumps(results("0" * 64)))
    with open_client(replace(settings, studies={"mine": folder})) as client:
        answer = client.post(f"/api/studies/mine/door/{FILTER}/0")
    assert answer.status_code == 400
    assert "is not the checkpoint that study 'mine' measured" in answer.json()["error"]


def test_studies_of_the_workspace_come_after_those_given_and_before_the_one_that_ships(
    settings: Settings, folder: Path, open_client: Callable[..., TestClient]
) -> None:
    workspace = settings.workspace
    shutil.copytree(folder, workspace / "later")
    (workspace / "broken").mkdir()
    (workspace / "broken" / FILE).write_text("{}")
    names = [one.name for one in studies_of({"mine": folder, "again": workspace / "later"}, workspace)]
    assert names == ["mine", "again", "broken", SHIPPED], "one that was given is not found once more"
    with open_client(replace(settings, studies={"mine": folder})) as client:
        answer = client.get("/api/studies").json()
    assert [one["name"] for one in answer["studies"]] == ["mine", "later", SHIPPED]
    (problem,) = answer["problems"]
    assert "broken/study.json' does not hold a study's results: preset" in problem


@pytest.mark.parametrize(
    "text", ["[]", "{", '"\\udcff"', json.dumps(results("", seeds=0)), json.dumps(results("")).replace("0.5", "NaN")]
)
def test_what_is_no_study_is_said_in_a_line(tmp_path: Path, text: str) -> None:
    (tmp_path / FILE).write_text(text)
    with pytest.raises(BadInput, match="does not hold a study's results"):
        Study("mine", tmp_path, checkpoints=True).read()
