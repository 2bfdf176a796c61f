"""The command line as its users meet it: help that is true, one line for what is wrong, files that are whole."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
import typer.main
from safetensors.torch import save_file

from beliefscope.app.cli import COMMANDS, cli, main
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import save_checkpoint
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.trace import load_trace
from beliefscope.recordings.read import read_recording

ROOT = Path(__file__).resolve().parents[1]
GOLDEN = Path(__file__).parent / "golden" / "errors.txt"
NAMES = [command.__name__ for command in COMMANDS]
OPTIONS = {
    "serve": "--port --host --workspace --task --data --filter --checkpoint --open --no-open --seed",
    "collect": "--episodes --steps --seed --workers -o --json",
    "convert": "--data --skip-bad -o --json",
    "train": "--filter --data --skip-bad --preset --recipe --seed --log -o --json",
    "evaluate": "--filter --data --skip-bad --recipe --only --particles --seed --json",
    "study": "--preset --task --filter --seeds --data --skip-bad --engine -o --json",
    "trace": "--filter --data --skip-bad --episode --recipe --seed -o --json",
    "record": "--filter --data --skip-bad --episode --maps --recipe --seed -o --json",
    "inspect": "--filter --only --all --figures --format --json",
    "counterfactual": "--filter --data --episode --recipe --weights --from --to --particles --seed --trace -o --json",
    "figure": "--filter --data --skip-bad --episode --step --recipe --particles --seed -o --json",
    "failures": "--filter --data --skip-bad --recipe --by --top --group --all --url --particles --seed --json",
    "recipes": "--json",
}
"""What scripts outside the project may rely on."""

Run = Callable[[str], tuple[int, str, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a command line in this process: (exit code, standard output, standard error)."""

    def run(line: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["beliefscope", *shlex.split(line)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            main()
        code = end.value.code or 0
        assert isinstance(code, int)
        return code, *capsys.readouterr()

    return run


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with files that can be used and files that cannot."""
    place = tmp_path_factory.mktemp("files")
    sample = sample_path("door").read_bytes()
    (place / "cut.h5").write_bytes(sample[: len(sample) // 2])
    (place / "foreign.h5").write_text("no HDF5 at all\n")
    with h5py.File(place / "other.h5", "w") as file:
        file["numbers"] = np.arange(3)
    (place / "shape.h5").write_bytes(sample)
    with h5py.File(place / "shape.h5", "r+") as file:
        group = file["trajectory9"]
        states = group["states"][()]
        del group["states"]
        group["states"] = states[:, :2]
    untrained = build(architecture("door", "crossmodal-ekf"))
    save_checkpoint(untrained, "crossmodal-ekf", {}, place / "ekf.safetensors")
    (place / "cut.safetensors").write_bytes((place / "ekf.safetensors").read_bytes()[:-1000])
    (place / "foreign.safetensors").write_bytes(b"\x80\x04" + bytes(100))
    save_file({"weight": torch.zeros(2)}, place / "other.safetensors")
    (place / "notes.txt").write_text("{not json")
    (place / "taken").mkdir()
    return place


@pytest.fixture
def folder(files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory: a copy of ``files``."""
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def examples() -> list[str]:
    """Every command line shown in the help and in the documentation."""
    text = "\n".join([main_help(), *(command.__doc__ or "" for command in COMMANDS)])
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        if page.is_file():
            text += "\n" + "\n".join(re.findall(r"```(?:sh|bash)?\n(.*?)```", page.read_text(), re.DOTALL))
    return list(dict.fromkeys(re.findall(r"^ *(beliefscope (?:-|[a-z]+).*?)(?:   .*| +#.*)?$", text, re.MULTILINE)))


def main_help() -> str:
    return cli.registered_callback.callback.__doc__ or ""  # type: ignore[union-attr]


@pytest.mark.parametrize("name", NAMES)
def test_help_names_every_promised_option_and_shows_an_example(run: Run, name: str) -> None:
    code, out, err = run(f"{name} --help")
    assert (code, err) == (0, "")
    missing = [option for option in OPTIONS[name].split() if not re.search(rf"(?<![\w-]){option}\b", out)]
    assert not missing
    assert f"beliefscope {name} " in out.split("Example", 1)[1]


def test_help_lists_the_commands(run: Run) -> None:
    assert run("") == run("--help") == run("-h")
    code, out, _ = run("")
    assert code == 0
    assert [line.split()[0] for line in out.split("Commands:\n")[1].splitlines()] == NAMES == list(OPTIONS)
    assert "...\n" not in out.split("Commands:")[1], "a command's first sentence is too long for the list"


@pytest.mark.parametrize("line", examples())
def test_examples_are_accepted(line: str) -> None:
    name, *arguments = shlex.split(line)[1:]
    if name.startswith("-"):
        return
    command = typer.main.get_command(cli).commands[name]  # type: ignore[attr-defined]
    command.make_context(name, arguments)


def test_version(run: Run) -> None:
    assert re.fullmatch(r"beliefscope \d+\.\d+\.\d+\S*\n", run("--version")[1])


def test_help_imports_nothing_heavy() -> None:
    heavy = {"torch", "mujoco", "h5py", "rerun", "fastapi", "uvicorn", "viser", "mjviser", "numpy", "rich"}
    code = f"import sys, beliefscope.app.cli; print(*sorted(set(sys.modules) & {heavy}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.split() == []


EKF = "door --filter ekf.safetensors"
BAD = [
    "nosuch",
    "evaluate",
    "evaluate dor --filter crossmodal-pf",
    "evaluate door --filter crosmodal-pf",
    "evaluate door --filter missing.safetensors",
    "evaluate door --filter ./missing",
    "evaluate door --filter foreign.safetensors",
    "evaluate door --filter other.safetensors",
    "evaluate door --filter cut.safetensors",
    "evaluate door --filter shape.h5",
    f"evaluate {EKF} --data missing.h5",
    f"evaluate {EKF} --data taken",
    f"evaluate {EKF} --data foreign.h5",
    f"evaluate {EKF} --data other.h5",
    f"evaluate {EKF} --data cut.h5",
    f"evaluate {EKF} --data shape.h5",
    f"evaluate {EKF} --data ekf.safetensors",
    f"evaluate {EKF} --particles 0",
    f"evaluate {EKF} --seed -1",
    f"evaluate {EKF} --json out.json",
    f"evaluate {EKF} --recipe notes.txt",
    f"evaluate {EKF} --recipe missing.json",
    f"evaluate {EKF} --recipe {{no}}",
    f"""evaluate {EKF} --recipe '{{"noise": 1}}'""",
    f"evaluate {EKF} --recipe blackout=1.5",
    f"evaluate {EKF} --recipe force_bias:w=5",
    f"evaluate {EKF} --recipe drop=touch",
    f"evaluate {EKF} --only touch",
    f"trace {EKF} --recipe blackout=0.4: -o new.trace",
    f"record {EKF} --recipe frozen -o new.rrd",
    "train door --filter crossmodal-pf --recipe blackout=much -o new.safetensors",
    "train door --filter crossmodal-pf --blackouts 0,1.5 -o new.safetensors",
    "inspect",
    "inspect missing.trace",
    "inspect ekf.safetensors",
    "inspect missing.trace --only health",
    "inspect missing.trace --format gif",
    "inspect missing.trace --figures notes.txt",
    "recipes --json file",
    f"""evaluate {EKF} --recipe '{{"blackout": "much"}}'""",
    f"""evaluate {EKF} --recipe '{{"blackout": 1.5}}'""",
    f"""evaluate {EKF} --recipe '{{"only": "touch"}}'""",
    "collect dor --episodes 1 -o new.h5",
    "collect door --episodes 0 -o new.h5",
    "collect door --episodes 1 --steps 1 -o new.h5",
    "collect door --episodes 1 -o missing/new.h5",
    "collect door --episodes 1 -o taken",
    "collect door --episodes many -o new.h5",
    "train door --filter crosmodal-pf -o new.safetensors",
    "train door --filter crossmodal-pf --preset fast -o new.safetensors",
    "train door --filter crossmodal-pf --data cut.h5 -o new.safetensors",
    "train door --filter crossmodal-pf -o missing/new.safetensors",
    "train door --filter crossmodal-pf",
    f"trace {EKF} --episode 100000 -o new.trace",
    f"trace {EKF} --episode -1 -o new.trace",
    f"trace {EKF} -o missing/new.trace",
    f"record {EKF} --maps -1 -o new.rrd",
    f"record {EKF} --data cut.h5 -o new.rrd",
    f"record {EKF} -o taken",
    f"figure bars {EKF} -o new.svg",
    f"figure maps {EKF} -o new.gif",
    f"figure maps {EKF} -o taken",
    f"figure weights {EKF} --step 40 -o new.svg",
    "serve --port 70000",
    "serve --workspace notes.txt",
    "serve --workspace missing/deep",
    "serve --task dor",
    "serve --task missing.py:TASK",
    "serve --data missing.h5",
    "serve --data other.h5 --data cut.h5",
    "serve --filter other.safetensors",
    "serve --checkpoint ./missing",
]


@pytest.mark.parametrize("line", BAD)
def test_bad_input_is_one_line_and_code_2(run: Run, folder: Path, line: str) -> None:
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}
    code, out, err = run(line)
    assert (code, out) == (2, "")
    assert re.fullmatch(r"error: .+\n", err)
    after = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}
    assert after == before, "something half-written stays"
    assert err.strip() == golden().get(line, err.strip())


def golden() -> dict[str, str]:
    """Command line -> error, of those whose text no library has a share in."""
    found = re.findall(r"^\$ beliefscope (.*)\n(error: .*)$", GOLDEN.read_text(), re.MULTILINE)
    return dict(found)


def test_golden_errors_are_all_tested() -> None:
    assert golden()
    assert not golden().keys() - set(BAD)


def test_busy_port(run: Run, folder: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        code, out, err = run(f"serve --port {port}")
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert f"port {port}" in err
    assert "--port" in err
    assert not (folder / "workspace").exists()


def test_other_failures_are_code_1_and_explain_themselves_on_demand(
    run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("the network is full of eels")

    monkeypatch.setattr("beliefscope.filters.evaluate.evaluate", broken)
    code, out, err = run(f"evaluate {EKF}")
    assert (code, out) == (1, "")
    assert err.splitlines()[-1].startswith("error: RuntimeError: the network is full of eels")
    assert "Traceback" not in err
    monkeypatch.setattr(sys, "argv", ["beliefscope", "--debug", "evaluate", *EKF.split()])
    with pytest.raises(RuntimeError, match="eels"):
        main()


@pytest.mark.parametrize("task", ["door", "push"])
def test_collect_shows_the_authors_statistics_beside_its_own(run: Run, folder: Path, task: str) -> None:
    from beliefscope.datasets.statistics import AUTHORS

    code, out, _ = run(f"collect {task} --episodes 1 --steps 4 --workers 1 -o one.h5")
    assert code == 0
    head, empty, title, *rows = out.splitlines()
    assert (empty, title.split()) == ("", ["this", "set", "authors", "ratio"])
    assert head.startswith("one.h5")
    row = next(row for row in rows if row.startswith("contact fraction"))
    assert row.split()[3] == str(AUTHORS[task].statistics["contact_fraction"])
    force = next(row for row in rows if row.startswith("force std, N"))
    assert len(force.split()) == 3 + 3 * 3, "three axes each"


def test_collect_to_recording(run: Run, folder: Path) -> None:
    """The whole line: what one command writes, the next one reads, and the JSON agrees with the files."""
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
    assert {"task", "filter", "checkpoint_hash", "episodes", "recipe", "nll", "nees", "coverage95"} <= set(evaluated)

    code, out, _ = run(f"trace {EKF} --data few.h5 --episode 1 -o one.trace --json -")
    assert code == 0
    traced = load_trace(folder / "one.trace")
    assert json.loads(out)["data_hash"] == traced.data_hash == digest
    assert json.loads(out)["checkpoint_hash"] == traced.checkpoint_hash == evaluated["checkpoint_hash"]

    code, out, _ = run(f"record {EKF} --data few.h5 --episode 1 --maps 6 -o one.rrd")
    assert code == 0
    assert out.startswith("one.rrd (")
    assert len(out.splitlines()) == 1
    assert (folder / "one.rrd").stat().st_size > 10_000


def test_figures_of_the_paper(run: Run, folder: Path) -> None:
    """What is shown is said, the same command gives the same bytes, and --step moves only its own state's map."""
    line = f"figure maps {EKF} --json - -o"
    first, again = (json.loads(run(f"{line} {name}.svg")[1]) for name in ("first", "again"))
    assert first["shown"] == again["shown"] == {"no contact": 66, "contact": 31}
    assert (folder / "first.svg").read_bytes() == (folder / "again.svg").read_bytes()
    moved = json.loads(run(f"{line} moved.pdf --step 20")[1])
    assert moved["shown"] == {"no contact": 66, "contact": 20}
    assert (folder / "moved.pdf").read_bytes().startswith(b"%PDF")
    code, out, _ = run(f"figure weights {EKF} -o weights.png")
    assert (code, out) == (0, "weights.png (0.2 MB): crossmodal-ekf over 100 steps of door episode 9\n")
    for wrong in (f"maps {EKF} --step 100000", "weights door --filter image-ekf"):
        code, out, err = run(f"figure {wrong} -o wrong.svg")
        assert (code, out) == (2, "")
        assert err.splitlines()[-1].startswith("error: ")
        assert not (folder / "wrong.svg").exists()


def test_one_option_breaks_any_sensor(run: Run, folder: Path) -> None:
    run("collect door --episodes 1 --steps 40 --workers 1 -o one.h5")
    faults = json.loads(run("recipes --json -")[1])
    names = [fault["fault"] for fault in faults["faults"]]
    assert {"blackout", "force_stuck", "effector_offset", "contact_late", "delay", "drop"} <= set(names)
    text = run("recipes")[1]
    assert all(f"\n{name} " in f"\n{text}" for name in names)
    everything = ",".join(names)
    line = f"{EKF} --data one.h5 --episode 0 --recipe {everything} --json - -o"
    traced = json.loads(run(f"trace {line} all.trace")[1])
    assert [fault["fault"] for fault in traced["recipe"]] == names
    assert load_trace(folder / "all.trace").recipe.to_json() == traced["recipe"]
    recorded = json.loads(run(f"record {line} all.rrd --maps 0")[1])
    assert recorded["recipe"] == traced["recipe"] == read_recording(folder / "all.rrd").recipe.to_json()
    assert (
        f"with {load_trace(folder / 'all.trace').recipe}" in run(f"trace {line.replace('--json -', '')} all.trace")[1]
    )


def test_every_way_to_write_a_recipe_is_the_same(run: Run, folder: Path) -> None:
    run("collect door --episodes 1 --steps 40 --workers 1 -o one.h5")
    (folder / "recipe.json").write_text('[{"fault": "blackout", "probability": 0.4}]')

    def evaluated(rest: str) -> dict[str, Any]:
        code, out, _ = run(f"evaluate {EKF} --data one.h5 --json - {rest}")
        assert code == 0
        return dict(json.loads(out))

    whole = evaluated("")
    assert (whole["recipe"], whole["only"]) == ([], None)
    asked = evaluated("--recipe blackout=0.4")
    assert asked["recipe"] == [{"fault": "blackout", "probability": 0.4}]
    assert asked["rmse"] != whole["rmse"]
    for other in (
        """'{"blackout": 0.4}'""",
        "recipe.json",
        "./recipe.json",
        """'[{"fault": "blackout", "probability": 0.4}]'""",
    ):
        assert evaluated(f"--recipe {other}") == asked
    alone = evaluated("--recipe blackout=0.4 --only image")
    assert alone["only"] == "image"
    assert alone["rmse"] != asked["rmse"]
    assert evaluated("""--recipe '{"blackout": 0.4, "only": "image"}'""") == alone


def test_what_is_bad_can_be_left_out(run: Run, folder: Path) -> None:
    line = f"trace {EKF} --data shape.h5 -o some.trace"
    assert run(line)[0] == 2
    code, out, err = run(f"{line} --skip-bad --json -")
    assert code == 0
    left_out = "left out: shape.h5: 'states' of trajectory9 has shape (100, 2), expected (100, 3)."
    assert err.splitlines()[0] == left_out
    assert json.loads(out)["episode"] == 18, "the first of the held-out ones, now that the tenth is gone"


def test_train_writes_a_checkpoint_that_evaluates(run: Run, folder: Path) -> None:
    run("collect door --episodes 10 --steps 20 --workers 1 -o ten.h5")
    line = "train door --filter crossmodal-pf --data ten.h5 --preset smoke -o pf.safetensors --json -"
    code, out, err = run(line)
    trained = json.loads(out)
    assert code == 0
    assert "dynamics" in err
    assert trained["record"]["command"].startswith("beliefscope train door --filter crossmodal-pf --data ten.h5")
    assert trained["record"]["recipe"] == []
    episodes = trained["record"]["episodes"]
    more = "--recipe force_bias:x=5,blackout=0.4 --blackouts 0,0.8 --json"
    hardened = json.loads(run(line.replace("--json", more))[1])["record"]
    assert (trained["record"]["blackouts"], hardened["blackouts"]) == ([0.0, 0.4, 0.8], [0.0, 0.8])
    assert hardened["command"].partition("--blackouts ")[2].startswith("0,0.8")
    assert [fault["fault"] for fault in hardened["recipe"]] == ["force_bias", "blackout"]
    assert hardened["episodes"] == episodes | {"train": 2 * episodes["train"]}
    assert "--recipe force_bias=5,blackout=0.4" in hardened["command"]
    trained = json.loads(run(line)[1])
    code, out, _ = run("evaluate door --filter pf.safetensors --data ten.h5 --particles 50 --json -")
    assert code == 0
    assert json.loads(out)["checkpoint_hash"] == trained["checkpoint_hash"]
    assert json.loads(out)["episodes"] == 1


def test_inspect_says_what_applies_and_why_the_rest_does_not(run: Run, folder: Path) -> None:
    for episode in (9, 19):
        assert run(f"trace {EKF} --episode {episode} -o {episode}.trace")[0] == 0
    code, out, _ = run("inspect 9.trace 19.trace --filter ekf.safetensors --figures figures --format png --json -")
    document = json.loads(out)
    assert code == 0
    assert set(document["diagnostics"]) | set(document["not_made"]) == set(DIAGNOSTICS)
    assert "no particles" in document["not_made"]["particles"]
    assert "--only maps" in document["not_made"]["maps"]
    assert {path.stem for path in (folder / "figures").iterdir()} == set(document["diagnostics"])
    assert [trace["episode"] for trace in document["traces"]] == [9, 19]
    for name, found in document["diagnostics"].items():
        alone = json.loads(run(f"inspect 9.trace 19.trace --only {name} --json -")[1])["diagnostics"]
        assert alone == {name: found}
    # Its filter does not ship: what needs the checkpoint says so.
    code, out, _ = run("inspect 9.trace")
    assert code == 0
    assert "Particle health: not made" in out
    assert "Likelihood maps: not made. maps needs the filter's checkpoint" in out
    code, _, err = run("inspect 9.trace --only particles")
    assert (code, err.splitlines()[-1]) == (2, "error: crossmodal-ekf has no particles")
    assert run("trace door --filter crossmodal-pf --particles 10 -o pf.trace")[0] == 0
    code, _, err = run("inspect 9.trace pf.trace")
    assert code == 2
    assert "another checkpoint" in err
