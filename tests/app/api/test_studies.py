"""A study over HTTP: the one that ships, one that was given, and which of their checkpoints can be looked at."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from beliefscope.app.api.studies import FILE, SHIPPED, Study, studies_of
from beliefscope.app.cli.commands.study import matrix, write
from beliefscope.app.runs.trace_store import Settings
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.checkpoint import PRETRAINED, load_checkpoint
from beliefscope.filters.training.study import run_cell

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


def test_the_cells_that_are_left_are_trained_by_a_job(
    settings: Settings, tmp_path: Path, open_client: Callable[..., TestClient]
) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    cells = matrix("smoke", ["door"], ["haptics-ekf"], 2, [f"door={settings.data['mine']}"], False)
    write(folder, cells, "smoke")  # none of them is trained
    run_cell(cells[0], folder)  # by another process, after which the table was not written
    with open_client(replace(settings, studies={"mine": folder})) as client:
        study = named(client, "mine")
        assert (study["left"], study["cells"], study["job"], study["why_not"]) == (2, 2, None, "")
        job = client.post("/api/studies/mine/cells").json()["job"]
        assert named(client, "mine")["job"] == job["id"]
        until = time.monotonic() + 400.0  # jobs run at a low priority
        while not (job := client.get(f"/api/jobs/{job['id']}").json())["ended"]:
            assert time.monotonic() < until
            time.sleep(0.05)
        assert (job["state"], job["error"]) == ("done", "")
        assert client.get(f"/api/jobs/{job['id']}/result").json() == {"finished": [str(cells[1])]}
        assert all(cell.finished(folder) for cell in cells)
        study = named(client, "mine")
        assert (study["left"], [row["seeds"] for row in study["tasks"][0]["rows"]]) == (0, [2, 2, 2, 0])
        again = client.post("/api/studies/mine/cells")
        assert (again.status_code, again.json()["error"]) == (400, "all cells of study 'mine' are finished")
        cells[1].path(folder).unlink()
        write(folder, cells, "smoke")
        assert client.post("/api/studies/mine/cells").json()["job"]["state"] in ("waiting", "running")


def test_cells_that_cannot_be_trained_here_say_why(
    settings: Settings, folder: Path, open_client: Callable[..., TestClient]
) -> None:
    def why(**more: Any) -> str:
        left = {"cells": {f"door/{FILTER}/seed1": "missing"}} | more
        (folder / FILE).write_text(json.dumps(results("", **left)))
        shown = named(client, "mine")
        answer = client.post("/api/studies/mine/cells")
        assert (answer.status_code, answer.json()["error"]) == (400, shown["why_not"])
        return str(shown["why_not"])

    with open_client(replace(settings, studies={"mine": folder})) as client:
        assert why() == "no data set of this server is door.h5 (), on which door is trained: serve it with --data"
        assert why(preset="huge").startswith("preset 'huge' does not exist")
        hash_ = open_dataset(settings.data["mine"]).hash
        known = {"tasks": {"door": {"data": "door.h5", "data_hash": hash_}}}
        assert why(**known, cells={"push/lstm/seed0": "missing"}) == "study 'mine' does not say what push is trained on"
        assert client.post("/api/studies/shipped/cells").status_code == 400
        assert client.post("/api/studies/none/cells").status_code == 404
        (folder / FILE).write_text(json.dumps(results("", cells={"../../door/seed0": "missing"})))
        assert "does not hold a study's results: cells" in client.get("/api/studies").json()["problems"][0]
