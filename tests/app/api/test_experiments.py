"""Sweeps over HTTP: results, episodes, CSV, and checkpoints to open."""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from starlette.testclient import TestClient

from beliefscope.app.runs.settings import Settings
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path, save_checkpoint
from beliefscope.inspect.sweep import Inputs
from beliefscope.recordings.experiments import Experiments
from beliefscope.recordings.sweep_table import CHECKPOINTS, run_sweep

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of a pretrained filter over the sample set and three further episodes, and of one of the user's own."""
    folder = tmp_path_factory.mktemp("sweep")
    with open_dataset(sample_path("door")) as sample:
        write_dataset(folder / "own.h5", sample.task, [sample[i] for i in sample.held_out()[:3]])
    base = load_checkpoint(pretrained_path("door", "image-ekf"))
    next(base.filter.parameters()).data *= 1.001
    save_checkpoint(base.filter, base.name, base.record, folder / "mine.safetensors")
    checkpoints = (pretrained_path("door", "image-ekf"), folder / "mine.safetensors")
    run_sweep(Inputs(checkpoints, (folder / "own.h5",), ("", "blackout=0.4")).cells(), folder)
    return folder


def test_results(settings: Settings, sweep: Path, open_client: Callable[..., TestClient]) -> None:
    data = {"own": sweep / "own.h5"}
    with open_client(replace(settings, sweeps={"mine": sweep}, data=data, checkpoints={})) as client:
        (info,) = client.get("/api/experiments").json()["sweeps"]
        assert info["name"] == "mine"
        assert (info["checkpoints"], info["faults"]) == (2, ["", "blackout=0.4"])
        assert info["rows"] == len(Experiments([sweep]).query("SELECT * FROM results"))
        answer = client.get("/api/experiments/mine?phase=contact").json()
        expected = Experiments([sweep]).overview("contact").to_pylist()
        assert answer["count"] == len(expected) == 4
        for row, stored in zip(answer["rows"], expected, strict=True):
            errors = {key: stored.pop(key) for key in ("hinge_x_cm", "hinge_y_cm", "angle_deg")}
            assert row["components"] == errors
            assert stored.items() <= row.items()
            assert (row["data_name"], row["data_file"]) == ("own", "own.h5")
            assert row["catalog_name"] == ("image-ekf" if stored["checkpoint"] == info_hash("image-ekf") else None)
        row = answer["rows"][0]
        query = {key: row[key] for key in ("checkpoint", "data", "faults")} | {"phase": "contact"}
        episodes = client.get("/api/experiments/mine/episodes", params=query).json()["episodes"]
        assert [e["error"] for e in episodes] == sorted((e["error"] for e in episodes), reverse=True)
        assert sum(e["steps"] for e in episodes) == row["steps"]
        assert max(e["worst"] for e in episodes) == row["worst"]
        table = client.get("/api/experiments/mine/results.csv?phase=contact")
        assert table.headers["content-type"].startswith("text/csv")
        rows = list(csv.DictReader(io.StringIO(table.text)))
        assert [float(r["error"]) for r in rows] == pytest.approx([r["error"] for r in expected])


def test_provenance_of_earlier_versions_is_sent_as_standard_json(
    settings: Settings, sweep: Path, open_client: Callable[..., TestClient], tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(sweep, tmp_path / "copy"))
    rows = [
        row | {"provenance": '{"loss": NaN, "lr": 0.1}'}
        for row in pq.read_table(copy / f"{CHECKPOINTS}.parquet").to_pylist()
    ]
    pq.write_table(pa.Table.from_pylist(rows), copy / f"{CHECKPOINTS}.parquet")
    with open_client(replace(settings, sweeps={"mine": copy}, data={}, checkpoints={})) as client:
        (provenance,) = {row["provenance"] for row in client.get("/api/experiments/mine").json()["rows"]}
        assert read_json(provenance) == {"loss": None, "lr": 0.1}


def info_hash(name: str) -> str:
    return load_checkpoint(pretrained_path("door", name)).hash


def test_checkpoints_are_added_to_the_catalog_once(
    settings: Settings, sweep: Path, open_client: Callable[..., TestClient]
) -> None:
    with open_client(replace(settings, sweeps={"mine": sweep}, data={}, checkpoints={})) as client:
        mine = load_checkpoint(sweep / "mine.safetensors").hash
        assert client.post(f"/api/experiments/mine/{info_hash('image-ekf')}").json() == {"filter": "image-ekf"}
        name = f"mine-{mine[:8]}"
        for _ in range(2):
            assert client.post(f"/api/experiments/mine/{mine}").json() == {"filter": name}
        (door,) = (task for task in client.get("/api/catalog").json()["tasks"] if task["name"] == "door")
        assert [f["name"] for f in door["filters"]].count(name) == 1
        rows = client.get("/api/experiments/mine").json()["rows"]
        assert {row["catalog_name"] for row in rows} == {name, "image-ekf"}
        assert {row["data_name"] for row in rows} == {None}, "the episodes are not served"
        assert client.post(f"/api/experiments/mine/{'0' * 64}").status_code == 404
        assert client.get("/api/experiments/none").status_code == 404


@pytest.mark.long
def test_names_of_checkpoints_are_valid_in_another_server(
    settings: Settings, sweep: Path, open_client: Callable[..., TestClient], tmp_path: Path
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(sweep, copy)
    file = sweep / "mine.safetensors"
    content = file.read_bytes()
    name = f"mine-{load_checkpoint(file).hash[:8]}"
    new_server = replace(settings, sweeps={"mine": copy}, data={}, checkpoints={})

    def catalog(client: TestClient) -> tuple[list[str], list[str]]:
        """Names of the filters, and problems."""
        reply = client.get("/api/catalog", params={"task": "door", "filter": ["absent-00000000", name]}).json()
        (door,) = (task for task in reply["tasks"] if task["name"] == "door")
        return [filter_["name"] for filter_ in door["filters"]], reply["problems"]

    with open_client(new_server) as client:
        assert client.get(f"/api/trace/door/{name}/0").status_code in (200, 202)
    with open_client(new_server) as client:
        filters, problems = catalog(client)
        assert filters[1:].count(name) == 1, "listed after the default"
        assert problems == []
        assert client.get("/api/trace/door/mine-00000000/0").status_code == 400
    try:
        save_checkpoint(load_checkpoint(pretrained_path("door", "image-ekf")).filter, "image-ekf", {}, file)
        with open_client(new_server) as client:
            filters, (problem,) = catalog(client)
            assert name not in filters
            assert "mine.safetensors' was changed after its evaluation" in problem
            assert problem in client.get(f"/api/trace/door/{name}/0").json()["error"]
        file.unlink()
        with open_client(new_server) as client:
            (problem,) = catalog(client)[1]
            assert problem.startswith(f"filter '{name}' of sweep 'mine': checkpoint")
            assert problem.endswith("mine.safetensors' was deleted or moved after the sweep; move it back")
    finally:
        file.write_bytes(content)


def test_sweeps_of_the_workspace(settings: Settings, sweep: Path, open_client: Callable[..., TestClient]) -> None:
    folder = settings.workspace / "found"
    folder.mkdir(parents=True)
    (folder / "results.parquet").write_bytes(b"PAR1 and nothing else")
    with open_client(settings) as client:
        answer = client.get("/api/experiments").json()
        assert answer["sweeps"] == []
        assert len(answer["problems"]) == 1
        for name in ("results", "checkpoints", "datasets"):
            (folder / f"{name}.parquet").write_bytes((sweep / f"{name}.parquet").read_bytes())
        assert [s["name"] for s in client.get("/api/experiments").json()["sweeps"]] == ["found"]
