"""Studies over HTTP: results, checkpoints, and training of unfinished cells."""

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

from beliefscope.app.runs.result_filters import all_studies
from beliefscope.app.runs.settings import Settings
from beliefscope.app.workspace.studies import BUILT_IN, FILE, Study
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.checkpoint import PRETRAINED, load_checkpoint
from beliefscope.filters.training.study import run_cell, study_cells
from beliefscope.recordings.study_figures import write_study

pytestmark = pytest.mark.slow

FILTER = "crossmodal-ekf"


def results(hash_: str, **fields: Any) -> dict[str, Any]:
    """A study of one filter and two seeds; the second has no checkpoint."""
    row = {
        "task": "door",
        "filter": FILTER,
        "blackout": 0.4,
        "seeds": 1,
        "requested": 2,
        "failed": 0,
        "mean": {"position_cm": 0.5, "nees": None},
        "spread": {"position_cm": None},
        "by_seed": {"0": {"position_cm": 0.5}},
    }
    study = {"preset": "smoke", "tasks": {"door": {"data": "door.h5"}}, "seeds": 2, "rows": [row]}
    return study | {"checkpoints": {f"door/{FILTER}/seed0": hash_}} | fields


@pytest.fixture
def folder(settings: Settings, tmp_path: Path) -> Path:
    """Folder of a study whose checkpoint is not in the catalog; another one there has the same name."""
    cell = tmp_path / "mine" / "cells" / "door" / FILTER / "seed0.safetensors"
    cell.parent.mkdir(parents=True)
    shutil.copy(PRETRAINED / f"door-{FILTER}.safetensors", cell)
    (tmp_path / "mine" / FILE).write_text(json.dumps(results(load_checkpoint(cell).hash)))
    return tmp_path / "mine"


def name_in_catalog(folder: Path) -> str:
    (hash_,) = json.loads((folder / FILE).read_text())["checkpoints"].values()
    return f"{FILTER}-seed0-{hash_[:8]}"


def find_study(client: TestClient, name: str) -> dict[str, Any]:
    (study,) = (s for s in client.get("/api/studies").json()["studies"] if s["name"] == name)
    return study


def test_built_in_study(settings: Settings, open_client: Callable[..., TestClient]) -> None:
    with open_client(replace(settings, checkpoints={}, data={})) as client:
        study = find_study(client, BUILT_IN)
    assert [task["name"] for task in study["tasks"]] == ["door", "push"]
    for task in study["tasks"]:
        names = {f["name"]: [seed["catalog_name"] for seed in f["trained"]] for f in task["filters"]}
        assert len(names) == 12
        for name, seeds in names.items():
            built_in = (PRETRAINED / f"{task['name']}-{name}.safetensors").is_file()
            assert seeds == [name if built_in else None, None, None]
        for row in task["rows"]:
            for key, mean in row["mean"].items():
                values = [numbers[key] for numbers in row["by_seed"].values() if key in numbers]
                if mean is not None and row["blackout"] is not None:
                    assert mean == pytest.approx(sum(values) / len(values))
                    assert min(values) <= mean <= max(values)


def test_checkpoint_is_added_to_the_catalog_once(
    settings: Settings, folder: Path, open_client: Callable[..., TestClient]
) -> None:
    with open_client(replace(settings, studies={"mine": folder})) as client:
        (task,) = find_study(client, "mine")["tasks"]
        assert task["filters"] == [{"name": FILTER, "trained": [{"seed": 0, "catalog_name": None, "file": True}]}]
        url = f"/api/studies/mine/door/{FILTER}/0"
        opened = client.post(url).json()
        assert opened == {"filter": name_in_catalog(folder)} == client.post(url).json()
        (door,) = (t for t in client.get("/api/catalog").json()["tasks"] if t["name"] == "door")
        assert [f["name"] for f in door["filters"]].count(opened["filter"]) == 1
        (task,) = find_study(client, "mine")["tasks"]
        assert task["filters"][0]["trained"][0]["catalog_name"] == opened["filter"]
        assert client.post(f"/api/studies/mine/door/{FILTER}/1").status_code == 404
        assert client.post(f"/api/studies/none/door/{FILTER}/0").status_code == 404


@pytest.mark.long
def test_name_of_a_checkpoint_is_valid_in_another_server(
    settings: Settings, folder: Path, open_client: Callable[..., TestClient]
) -> None:
    name, file = name_in_catalog(folder), folder / "cells" / "door" / FILTER / "seed0.safetensors"
    new_server = replace(settings, studies={"renamed": folder}, data={}, checkpoints={})
    damaged = settings.workspace / "damaged" / FILE
    damaged.parent.mkdir(parents=True)
    damaged.write_text(json.dumps(results("") | {"checkpoints": {"door": "0"}}))

    def catalog(client: TestClient) -> tuple[list[str], list[str]]:
        """Names of the filters of door, and problems."""
        reply = client.get("/api/catalog", params={"task": "door", "filter": ["lstm-seed0-00000000", name]}).json()
        (door,) = (task for task in reply["tasks"] if task["name"] == "door")
        return [filter_["name"] for filter_ in door["filters"]], reply["problems"]

    with open_client(new_server) as client:
        filters, problems = catalog(client)
        assert (filters[1:].count(name), problems) == (1, []), "listed after the default"
        assert client.get(f"/api/trace/door/{name}/0").status_code in (200, 202)
        assert client.get(f"/api/trace/door/{FILTER}-seed0-00000000/0").status_code == 400
        assert client.get(f"/api/trace/push/{name}/0").status_code == 400, "of another task"
    shutil.copy(PRETRAINED / "door-image-ekf.safetensors", file)
    with open_client(new_server) as client:
        filters, (problem,) = catalog(client)
        assert name not in filters
        assert problem.startswith(f"filter '{name}' of study 'renamed': ")
        assert "seed0.safetensors' was changed after its evaluation" in problem
        assert problem in client.get(f"/api/trace/door/{name}/0").json()["error"]
    file.unlink()
    with open_client(new_server) as client:
        assert catalog(client)[1][0].endswith("seed0.safetensors' does not exist")


def test_checkpoint_with_another_hash_is_refused(
    settings: Settings, folder: Path, open_client: Callable[..., TestClient]
) -> None:
    (folder / FILE).write_text(json.dumps(results("0" * 64)))
    with open_client(replace(settings, studies={"mine": folder})) as client:
        answer = client.post(f"/api/studies/mine/door/{FILTER}/0")
    assert answer.status_code == 400
    assert "was changed after its evaluation" in answer.json()["error"]


def test_order_of_studies(settings: Settings, folder: Path, open_client: Callable[..., TestClient]) -> None:
    workspace = settings.workspace
    shutil.copytree(folder, workspace / "later")
    (workspace / "broken").mkdir()
    (workspace / "broken" / FILE).write_text("{}")
    names = [study.name for study in all_studies({"mine": folder, "again": workspace / "later"}, workspace)]
    assert names == ["mine", "again", "broken", BUILT_IN], "studies are listed once"
    with open_client(replace(settings, studies={"mine": folder})) as client:
        answer = client.get("/api/studies").json()
    assert [s["name"] for s in answer["studies"]] == ["mine", "later", BUILT_IN]
    (problem,) = answer["problems"]
    assert "broken/study.json' does not contain the results of a study: preset" in problem


@pytest.mark.parametrize(
    "text", ["[]", "{", '"\\udcff"', json.dumps(results("", seeds=0)), json.dumps(results("")).replace("0.5", "NaN")]
)
def test_invalid_results_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / FILE).write_text(text)
    with pytest.raises(BadInput, match="does not contain the results of a study"):
        Study("mine", tmp_path, has_checkpoints=True).read()


@pytest.mark.long
def test_job_trains_unfinished_cells(
    settings: Settings, tmp_path: Path, open_client: Callable[..., TestClient]
) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    cells = study_cells("smoke", ["door"], ["haptics-ekf"], 2, {"door": settings.data["mine"]})
    write_study(folder, cells, "smoke")
    run_cell(cells[0], folder)  # without updating the table
    with open_client(replace(settings, studies={"mine": folder})) as client:
        study = find_study(client, "mine")
        assert (study["unfinished"], study["cells"], study["job"], study["why_not"]) == (2, 2, None, "")
        job = client.post("/api/studies/mine/cells").json()["job"]
        assert find_study(client, "mine")["job"] == job["id"]
        deadline = time.monotonic() + 400.0  # jobs have a low priority
        while not (job := client.get(f"/api/jobs/{job['id']}").json())["ended"]:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        assert (job["state"], job["error"]) == ("done", "")
        assert client.get(f"/api/jobs/{job['id']}/result").json() == {"finished": [str(cells[1])]}
        assert all(cell.finished(folder) for cell in cells)
        study = find_study(client, "mine")
        *trained, trivial = (row["seeds"] for row in study["tasks"][0]["rows"])
        assert (study["unfinished"], set(trained), trivial) == (0, {2}, 0)
        again = client.post("/api/studies/mine/cells")
        assert (again.status_code, again.json()["error"]) == (400, "all cells of study 'mine' are finished")
        cells[1].path(folder).unlink()
        write_study(folder, cells, "smoke")
        assert client.post("/api/studies/mine/cells").json()["job"]["state"] in ("waiting", "running")


def test_reason_why_cells_cannot_be_trained(
    settings: Settings, folder: Path, open_client: Callable[..., TestClient]
) -> None:
    def reason(**fields: Any) -> str:
        fields = {"cells": {f"door/{FILTER}/seed1": "missing"}} | fields
        (folder / FILE).write_text(json.dumps(results("", **fields)))
        study = find_study(client, "mine")
        answer = client.post("/api/studies/mine/cells")
        assert (answer.status_code, answer.json()["error"]) == (400, study["why_not"])
        return str(study["why_not"])

    with open_client(replace(settings, studies={"mine": folder})) as client:
        assert reason() == "this server does not have door.h5 (), the training data of door: serve it with --data"
        assert reason(preset="huge").startswith("preset 'huge' does not exist")
        hash_ = open_dataset(settings.data["mine"]).hash
        tasks = {"tasks": {"door": {"data": "door.h5", "data_hash": hash_}}}
        assert (
            reason(**tasks, cells={"push/lstm/seed0": "missing"})
            == "study 'mine' does not name the training data of push"
        )
        assert client.post("/api/studies/shipped/cells").status_code == 400
        assert client.post("/api/studies/none/cells").status_code == 404
        (folder / FILE).write_text(json.dumps(results("", cells={"../../door/seed0": "missing"})))
        assert "does not contain the results of a study: cells" in client.get("/api/studies").json()["problems"][0]
