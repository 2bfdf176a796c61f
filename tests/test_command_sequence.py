"""Sequences of commands: each output is a valid input of the next command."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rerun.chunk import RrdReader

from beliefscope.datasets.store import open_dataset
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.trace import load_trace
from beliefscope.recordings.read import read_recording

pytestmark = pytest.mark.slow

Run = Callable[[str], tuple[int, str, str]]
EKF = "door --filter ekf.safetensors"


@pytest.mark.parametrize("task", ["door", "push"])
def test_collect_compares_statistics_with_the_paper(run: Run, folder: Path, task: str) -> None:
    from beliefscope.datasets.dataset_statistics import PAPER_DATA

    code, out, _ = run(f"collect {task} --episodes 1 --steps 4 --workers 1 -o one.h5")
    assert code == 0
    head, _, _, title, *rows = out.splitlines()
    assert re.split("  +", title.strip()) == ["quantity", "measure", "unit", "this data set", "paper", "this / paper"]
    assert head.startswith("one.h5")
    row = next(row for row in rows if row.startswith("  steps in contact"))
    assert float(row.split()[-2]) == PAPER_DATA[task].statistics["contact_fraction"]
    forces = [re.split("  +", row.strip()) for row in rows if row.startswith("  force ")]
    assert [force[:3] for force in forces] == [[f"force {axis}", "standard deviation", "N"] for axis in "xyz"]
    assert all(float(ratio) == pytest.approx(float(own) / float(paper), rel=0.01) for *_, own, paper, ratio in forces)


def test_from_collect_to_record(run: Run, folder: Path) -> None:
    """Each command reads the output of the previous one, and the JSON documents match the files."""
    code, out, _ = run("collect door --episodes 2 --steps 12 --seed 3 --workers 1 -o few.h5 --json -")
    collected = json.loads(out)
    assert code == 0
    with open_dataset(folder / "few.h5") as data:
        assert collected["data_hash"] == data.hash
        assert (collected["episodes"], [len(episode) for episode in data]) == (2, [12, 12])
        assert collected["contact_fraction"] == np.mean([episode.contact for episode in data])
        digest = data[1].digest()
    assert collected["statistics"].keys() > collected["authors"].keys() > {"force_std_N", "angle_std_deg"}

    code, out, err = run("evaluate door --filter ekf.safetensors --data few.h5 --json -")
    evaluated = json.loads(out)
    assert code == 0
    assert "Evaluating" in err
    assert evaluated["data_hash"] == collected["data_hash"]
    assert set(evaluated["rmse"]) == {"hinge_x_cm", "hinge_y_cm", "angle_deg", "position_cm"}
    assert {"task", "filter", "checkpoint_hash", "episodes", "faults", "nll", "nees", "coverage95"} <= set(evaluated)

    code, out, _ = run(f"trace {EKF} --data few.h5 --episode 1 -o one.trace --json -")
    assert code == 0
    traced = load_trace(folder / "one.trace")
    assert json.loads(out)["data_hash"] == traced.data_hash == digest
    assert json.loads(out)["checkpoint_hash"] == traced.checkpoint_hash == evaluated["checkpoint_hash"]

    code, out, _ = run(f"record {EKF} --data few.h5 --episode 1 --maps 6 --map-size 11 -o one.rrd")
    assert code == 0
    assert out.startswith("one.rrd (")
    assert len(out.splitlines()) == 1
    (chunk,) = RrdReader(folder / "one.rrd").stream().filter(content="/maps/image").drop(is_static=True)
    maps = chunk.to_record_batch().column("EncodedDepthImage:blob")
    assert [Image.open(BytesIO(bytes(row))).size for (row,) in maps.to_pylist()] == [(11, 11), (11, 11)]


@pytest.mark.long  # six seconds
def test_figures_of_the_paper(run: Run, folder: Path) -> None:
    """Output is deterministic, and --step changes only the map of its own phase."""
    line = f"figure maps {EKF} --json - -o"
    first, again = (json.loads(run(f"{line} {name}.svg")[1]) for name in ("first", "again"))
    assert first["map_steps"] == again["map_steps"] == {"free motion": 66, "contact": 31}
    assert (folder / "first.svg").read_bytes() == (folder / "again.svg").read_bytes()
    moved = json.loads(run(f"{line} moved.pdf --step 20")[1])
    assert moved["map_steps"] == {"free motion": 66, "contact": 20}
    assert (folder / "moved.pdf").read_bytes().startswith(b"%PDF")
    code, out, _ = run(f"figure weights {EKF} -o weights.png")
    assert (code, out) == (0, "weights.png (0.2 MB): crossmodal-ekf over 100 steps of door episode 9\n")
    for arguments in (f"maps {EKF} --step 100000", "weights door --filter image-ekf"):
        code, out, err = run(f"figure {arguments} -o invalid.svg")
        assert (code, out) == (2, "")
        assert err.splitlines()[-1].startswith("error: ")
        assert not (folder / "invalid.svg").exists()


@pytest.mark.long
def test_counterfactual_outputs_agree(run: Run, folder: Path) -> None:
    """Text, JSON, figure and trace agree, and the trace contains the intervention."""
    line = "counterfactual door --filter crossmodal-pf --particles 50 --from 40 --to 60"
    outputs = "-o what.svg --trace edited.trace"
    code, out, _ = run(f"{line} --faults blackout --weights image=0.9 {outputs} --json -")
    document = json.loads(out)
    assert code == 0
    assert document["intervention"]["weights"] == {"image": 0.9}
    assert (document["intervention"]["from"], document["intervention"]["to"]) == (40, 60)
    counterfactual = load_trace(folder / "edited.trace")
    assert counterfactual.settings["edits"] == [document["intervention"]]
    assert str(counterfactual.faults) == "blackout:from=40:to=60"
    assert counterfactual.weights is not None
    np.testing.assert_allclose(counterfactual.weights[40:60, 0], 0.9, rtol=1e-6)  # float32, through a logarithm
    np.testing.assert_array_equal(counterfactual.estimate_mean, np.float32(document["counterfactual"]))
    assert (folder / "what.svg").read_text().startswith("<?xml")
    code, out, _ = run(f"{line} --faults blackout --weights image=0.9")
    title, *tables = out.split("\n\n")
    assert (code, title) == (0, document["verdict"])
    assert "With blackout, beta of image 0.9 over steps 40 to 59, the estimate moved by up to " in title
    assert [table.splitlines()[0] for table in tables] == [
        "Mean over steps",
        "Largest difference of the estimates",
        "Mean during the intervention",
    ]


@pytest.mark.long
def test_all_faults_can_be_combined(run: Run, folder: Path) -> None:
    run("collect door --episodes 1 --steps 40 --workers 1 -o one.h5")
    faults = json.loads(run("faults --json -")[1])
    names = [fault["fault"] for fault in faults["faults"]]
    assert {"blackout", "force_stuck", "effector_offset", "contact_delayed", "delay", "drop"} <= set(names)
    text = run("faults")[1]
    assert all(f"\n{name} " in f"\n{text}" for name in names)
    everything = ",".join(names)
    line = f"{EKF} --data one.h5 --episode 0 --faults {everything} --json - -o"
    traced = json.loads(run(f"trace {line} all.trace")[1])
    assert [fault["fault"] for fault in traced["faults"]] == names
    assert load_trace(folder / "all.trace").faults.to_json() == traced["faults"]
    recorded = json.loads(run(f"record {line} all.rrd --maps 0")[1])
    assert recorded["faults"] == traced["faults"] == read_recording(folder / "all.rrd").faults.to_json()
    assert (
        f"with {load_trace(folder / 'all.trace').faults}" in run(f"trace {line.replace('--json -', '')} all.trace")[1]
    )


def test_all_notations_of_faults_are_equal(run: Run, folder: Path) -> None:
    run("collect door --episodes 1 --steps 40 --workers 1 -o one.h5")
    (folder / "faults.json").write_text('[{"fault": "blackout", "probability": 0.4}]')

    def evaluated(rest: str) -> dict[str, Any]:
        code, out, _ = run(f"evaluate {EKF} --data one.h5 --json - {rest}")
        assert code == 0
        return dict(json.loads(out))

    clean = evaluated("")
    assert (clean["faults"], clean["only"]) == ([], None)
    faulty = evaluated("--faults blackout=0.4")
    assert faulty["faults"] == [{"fault": "blackout", "probability": 0.4}]
    assert faulty["rmse"] != clean["rmse"]
    for other in (
        """'{"blackout": 0.4}'""",
        "faults.json",
        "./faults.json",
        """'[{"fault": "blackout", "probability": 0.4}]'""",
    ):
        assert evaluated(f"--faults {other}") == faulty
    unimodal = evaluated("--faults blackout=0.4 --only image")
    assert unimodal["only"] == "image"
    assert unimodal["rmse"] != faulty["rmse"]


@pytest.mark.long
def test_skip_bad(run: Run, folder: Path) -> None:
    line = f"trace {EKF} --data shape.h5 -o some.trace"
    assert run(line)[0] == 2
    code, out, err = run(f"{line} --skip-bad --json -")
    assert code == 0
    note = "skipped: shape.h5: 'states' of trajectory9 has shape (100, 2), expected (100, 3)."
    assert err.splitlines()[0] == note
    assert json.loads(out)["episode"] == 18, "the first remaining held-out episode"


@pytest.mark.long
def test_train_writes_a_checkpoint_that_evaluates(run: Run, folder: Path) -> None:
    run("collect door --episodes 10 --steps 20 --workers 1 -o ten.h5")
    line = "train door --filter crossmodal-pf --data ten.h5 --preset smoke -o pf.safetensors --json -"
    code, out, err = run(line)
    trained = json.loads(out)
    assert code == 0
    assert all(text in err for text in ("dynamics", "evaluation: 100 %", "healthy record: 100 %"))
    assert trained["record"]["command"].startswith("beliefscope train door --filter crossmodal-pf --data ten.h5")
    assert trained["record"]["faults"] == []
    episodes = trained["record"]["episodes"]
    code, out, _ = run("evaluate door --filter pf.safetensors --data ten.h5 --particles 50 --json -")
    assert code == 0
    assert json.loads(out)["checkpoint_hash"] == trained["checkpoint_hash"]
    assert json.loads(out)["episodes"] == 1

    options = "--faults force_bias:x=5,blackout=0.4 --blackouts 0,0.8 --json"
    hardened = json.loads(run(line.replace("pf.", "hardened.").replace("--json", options))[1])["record"]
    assert (trained["record"]["blackouts"], hardened["blackouts"]) == ([0.0, 0.4, 0.8], [0.0, 0.8])
    assert hardened["command"].partition("--blackouts ")[2].startswith("0,0.8")
    assert [fault["fault"] for fault in hardened["faults"]] == ["force_bias", "blackout"]
    assert hardened["episodes"] == episodes | {"train": 2 * episodes["train"]}
    assert "--faults force_bias=5,blackout=0.4" in hardened["command"]


@pytest.mark.long
def test_inspect_reports_applicable_diagnostics_and_reasons(run: Run, folder: Path) -> None:
    for episode in (9, 19):
        assert run(f"trace {EKF} --episode {episode} -o {episode}.trace")[0] == 0
    code, out, _ = run("inspect 9.trace 19.trace --filter ekf.safetensors --figures figures --format png --json -")
    document = json.loads(out)
    assert code == 0
    assert set(document["diagnostics"]) | set(document["not_made"]) == set(DIAGNOSTICS)
    assert "no particles" in document["not_made"]["particles"]
    assert document["not_made"]["maps"] == "slow diagnostic; include it with --all"
    # Of several traces, errors and weights have tables only.
    assert {path.stem for path in (folder / "figures").iterdir()} == set(document["diagnostics"]) - {
        "errors",
        "weights",
    }
    assert [trace["episode"] for trace in document["traces"]] == [9, 19]
    for name, result in document["diagnostics"].items():
        command = f"inspect 9.trace 19.trace --filter ekf.safetensors --only {name} --json -"
        single = json.loads(run(command)[1])["diagnostics"]
        assert single == {name: result}
    assert (
        "Likelihood maps: slow diagnostic; include it with --all" in run("inspect 9.trace --filter ekf.safetensors")[1]
    )
    # The filter is not built in, so diagnostics that need its checkpoint are not available.
    code, out, _ = run("inspect 9.trace")
    assert code == 0
    assert "Particle health: not available" in out
    assert "Likelihood maps: not available: diagnostic maps needs the filter, not only its trace" in out
    code, _, err = run("inspect 9.trace --only particles")
    assert (code, err.splitlines()[-1]) == (2, "error: filter crossmodal-ekf has no particles")
    assert run("trace door --filter crossmodal-pf --particles 10 -o pf.trace")[0] == 0
    code, _, err = run("inspect 9.trace pf.trace")
    assert code == 2
    assert "different checkpoints" in err
